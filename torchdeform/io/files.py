"""Files: results that appear complete or not at all, and C libraries that print nothing."""

import errno
import os
import platform
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from torchdeform.core.memory import readable
from torchdeform.errors import InputError, MachineError, of_machine
from torchdeform.io.gate import require_name

_STDERR = threading.Lock()
_PREFIX, _LOCK = ".torchdeform-", "lock"  # names of folders of unfinished files, and of the lock in each
_A_DAY = 86400.0  # s
_PROBE = 1 << 16  # bytes
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # the last two with offsets of 64 bits (BigTIFF)


def suffix(path: Path) -> str:
    """Return the lower-case ending of a file name that tells its format; ``.nii.gz`` counts as one ending."""
    endings = [s.lower() for s in path.suffixes]
    return "".join(endings[-2:]) if endings[-1:] == [".gz"] else "".join(endings[-1:])


def stem(path: Path) -> str:
    """Return a file name without the ending that `suffix` returns."""
    return path.name[: len(path.name) - len(suffix(path))] or path.name


def read_head(path: Path, count: int) -> bytes:
    """Return the first bytes of a file."""
    with path.open("rb") as file:
        return file.read(count)


def is_tiff(path: Path) -> bool:
    """Return whether the content of a file starts like a TIFF, whatever its name: most slides are TIFF too."""
    return read_head(path, 4) in _TIFF


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield where to write a file, which becomes ``path`` at the end, or is deleted after an error; `atomic_folder`."""
    require_target(path)
    with atomic_folder(path.parent) as folder:
        yield folder / path.name


def require_target(path: Path) -> None:
    """Raise `InputError` unless a file can have this name; libraries in C++ end the process at some of them."""
    require_name(path)
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):  # of the folder `atomic_folder` says so
        pass
    except OSError as error:
        if of_machine(error):
            raise disk_failure(error, path.parent) from error
        raise InputError(f"cannot write to {path}: {error.strerror}; choose another name") from error


@contextmanager
def atomic_folder(folder: Path, replaced: Callable[[], Iterable[str]] = tuple) -> Iterator[Path]:
    """Yield an empty folder whose files move into ``folder`` at the end, or are deleted after an error.

    Args:
        folder: where the files go; created if missing. Files of the same names are replaced, others stay.
        replaced: returns further names in ``folder`` that go when the new files come.

    Raises:
        InputError: nothing can be written there.
        MachineError: the disk is full or broken.

    Notes:
        The files are renamed once all are complete and on the disk. All places are on one file system, so a rename is
        atomic and nobody sees a half-written file. Where one fails, those before it are taken back. Of several files
        the record (``.json``) is the first to go and the last to come: a folder without it is not whole.
    """
    with _workplace(folder) as place:
        new, old = place / "new", place / "old"
        try:
            for part in (new, old):
                part.mkdir()
            yield new
            if not _places_above(folder):  # else the outer one does it
                _sync_all(new)
            _exchange(new, old, folder, replaced)
        except Exception as error:
            failure = None if isinstance(error, MachineError) else of_machine(error) or _probe(place)
            if isinstance(failure, OSError) and _places_above(folder):
                raise failure from error  # the outer one says where
            if isinstance(failure, OSError):
                raise disk_failure(failure, folder, size_of_files(new.rglob("*"))) from error
            if failure is not None:
                raise failure from error
            raise


def disk_failure(error: OSError, folder: Path, begun: int = 0) -> MachineError:
    """Return the error about a disk, in one sentence.

    Args:
        error: what the system said.
        folder: that was to be written.
        begun: bytes that were written there and are removed again.
    """
    advice = "mend that"
    if error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None)):
        free = begun
        with suppress(OSError):
            free += shutil.disk_usage(_nearest_folder(folder)).free
        advice = f"{readable(free)} are free, which is not enough; make room"
    return MachineError(f"cannot write to {folder}: {error.strerror}; {advice} and run the same command again")


def require_space(folder: Path, size: int) -> None:
    """Raise the system's error of a full disk unless it has room for so many bytes; some libraries bear it badly."""
    if shutil.disk_usage(folder).free < size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def _places_above(folder: Path) -> list[Path]:
    """Return the folders of unfinished files that a folder is in, the inner ones first."""
    return [part for part in (folder, *folder.parents) if part.name.startswith(_PREFIX)]


def _probe(place: Path) -> OSError | None:
    """Return what the disk says to a small file, because libraries do not say why they could not write."""
    try:
        with (place / "probe").open("wb") as file:
            file.write(bytes(_PROBE))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error if of_machine(error) else None
    return None


def size_of_files(paths: Iterable[Path]) -> int:
    """Return the bytes of those of some files that exist."""
    total = 0
    for path in paths:
        with suppress(OSError):
            total += path.lstat().st_size
    return total


def _sync_all(folder: Path) -> None:
    """Wait until the files are on the disk: a disk that is not of this machine says only then that it is full."""
    with ThreadPoolExecutor() as pool:  # together they take hardly longer than one
        list(pool.map(sync, filter(Path.is_file, folder.rglob("*"))))


def sync(path: Path) -> None:
    """Wait until a file, or a folder's list of names, is on the disk."""
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if of_machine(error):
            raise  # else the file system knows no such call
    finally:
        os.close(descriptor)


def _exchange(new: Path, old: Path, folder: Path, replaced: Callable[[], Iterable[str]]) -> None:
    """Move the files of ``new`` into ``folder``, and those that they replace into ``old``: all of them or none."""
    missing = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _alone(folder):
            names = sorted((path.name for path in new.iterdir()), key=_of_record)
            going = sorted({name for name in {*names, *replaced()} if _is_there(folder / name)}, key=_of_record)
            moves = [(new / name, folder / name) for name in names]
            if len(names) > 1 or going != names:  # a single file is replaced at once
                moves = [(folder / name, old / name) for name in reversed(going)] + moves
            _move(moves, folder)
    except BaseException:
        if missing:
            with suppress(OSError):
                folder.rmdir()
        raise


def _of_record(name: str) -> tuple[bool, str]:
    """Return the key that sorts names so that the record is the last."""
    return name.endswith(".json"), name


def _is_there(path: Path) -> bool:
    """Return whether a file or link is there; `InputError` if it is a folder, which is never replaced."""
    if path.is_dir() and not path.is_symlink():
        raise InputError(f"{path} is a folder where a file is to be written; move it away")
    return path.exists() or path.is_symlink()


def _move(moves: Sequence[tuple[Path, Path]], folder: Path) -> None:
    """Rename one file after the other; after an error, take those back that were renamed."""
    begun: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            begun.append((source, target))
            source.replace(target)
    except BaseException as error:
        if len(moves) > 1:
            _take_back(begun, folder, error)
        raise


def _take_back(begun: Sequence[tuple[Path, Path]], folder: Path, reason: BaseException) -> None:
    lost = []
    for source, target in reversed(begun):
        try:
            target.replace(source)
        except FileNotFoundError:  # it was not renamed
            continue
        except OSError as error:
            lost.append(f"{target.name}: {error.strerror}")
    if lost:
        raise MachineError(
            f"{folder} has files of two runs and no record, because renaming failed and could not be taken back "
            f"({lost[0]}); mend the disk and run the same command again"
        ) from reason


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other processes from exchanging files of a folder, where the system has such locks."""
    with ExitStack() as stack:
        with suppress(OSError, ImportError):
            import fcntl

            descriptor = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


def require_writable(folder: Path) -> None:
    """Raise `InputError` unless files can be written into ``folder``, which may be missing.

    Notes:
        Leaves nothing behind, and removes what dead processes left there.
    """
    for place in {_nearest_folder(folder), folder.absolute().parent}:
        remove_leftovers(place)
    with _workplace(folder):
        pass


@contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """Yield a new folder on the file system of ``folder``, that is gone after the block."""
    place, lock = _locked_folder(folder)
    try:
        yield place
    finally:
        os.close(lock)
        shutil.rmtree(place, ignore_errors=True)


def _locked_folder(folder: Path) -> tuple[Path, int]:
    """Return a new folder on the file system of ``folder``, and the open lock that says that its process lives."""
    nearest = _nearest_folder(folder)
    try:
        found = None
        while found is None:  # it may be taken for one of a dead process before it is locked
            place = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=nearest))
            found = _lock(place)
        return place, found
    except OSError as error:
        if of_machine(error):
            raise disk_failure(error, folder) from error
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another folder") from error


def _lock(place: Path) -> int | None:
    """Return the open lock of a folder, None if another process removes the folder."""
    with ExitStack() as undo:
        undo.callback(shutil.rmtree, place, ignore_errors=True)
        try:
            lock = os.open(place / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
            undo.callback(os.close, lock)
            os.write(lock, platform.node().encode())
            take_lock(lock)
            (place / _LOCK).stat()
        except (FileNotFoundError, BlockingIOError):
            return None
        undo.pop_all()
        return lock


def take_lock(lock: int) -> bool:
    """Lock a file until this process ends, and return whether locks can be had here; raises if it is locked."""
    try:
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except (ImportError, OSError):
        return False
    return True


def remove_leftovers(folder: Path) -> None:
    """Remove what `atomic_folder` of processes that are dead left in a folder."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.startswith(_PREFIX) and entry.is_dir(follow_symlinks=False) and _is_dead(Path(entry)):
                shutil.rmtree(entry, ignore_errors=True)


def _is_dead(place: Path) -> bool:
    """Return whether the process that made a folder is gone, for certain.

    Notes:
        Locks may not reach as far as the file system does: a folder of another machine counts only after a day.
    """
    try:
        lock = os.open(place / _LOCK, os.O_RDWR)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    try:
        here = os.read(lock, 1000) == platform.node().encode()
        return (here or time.time() - place.stat().st_mtime > _A_DAY) and take_lock(lock)
    except OSError:
        return False
    finally:
        os.close(lock)


def _nearest_folder(folder: Path) -> Path:
    """Return the folder itself if it exists, else its nearest parent that exists."""
    require_name(folder, "folder")
    try:
        for candidate in (folder, *folder.absolute().parents):
            if candidate.is_dir():
                return candidate
            if candidate.exists() or candidate.is_symlink():
                raise InputError(f"cannot write to {folder}: {candidate} is not a folder; choose another name")
    except OSError as error:  # a name that is too long
        if of_machine(error):
            raise disk_failure(error, folder) from error
        raise InputError(f"cannot write to {folder}: {error.strerror}; choose another name") from error
    raise InputError(f"cannot write to {folder}: there is no such place; choose another folder")


@contextmanager
def native_stderr(*, stdout: bool = False) -> Iterator[list[str]]:
    """Collect what C and C++ libraries print on stderr; the list is filled when the block ends.

    Args:
        stdout: collect what they print there, too; libjpeg inside of ITK does.

    Notes:
        It redirects the file descriptors of the whole process, so only one thread at a time can be in such a block.
    """
    lines: list[str] = []
    descriptors = (1, 2) if stdout else (2,)
    with _STDERR, tempfile.TemporaryFile() as sink:
        sys.stdout.flush()
        sys.stderr.flush()
        saved = [os.dup(descriptor) for descriptor in descriptors]
        for descriptor in descriptors:
            os.dup2(sink.fileno(), descriptor)
        try:
            yield lines
        finally:
            for descriptor, before in zip(descriptors, saved, strict=True):
                os.dup2(before, descriptor)
                os.close(before)
            sink.seek(0)
            lines.extend(sink.read().decode(errors="replace").splitlines())
