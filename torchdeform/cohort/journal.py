"""The journal of a cohort: the outcome of every pair, readable even after a crash, and fingerprints of its files."""

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from time import time_ns
from types import TracebackType
from typing import Any, Self

from torchdeform import __version__
from torchdeform.cohort.plan import Job
from torchdeform.cohort.task import PairReport
from torchdeform.errors import InputError
from torchdeform.io.dicom import is_dicom
from torchdeform.io.files import stem

JOURNAL = "journal.jsonl"

_SETTLED = 2_000_000_000  # ns; age from which on an unchanged date means unchanged content
_HEADERS = (".mhd", ".nhdr", ".hdr", ".img")  # formats with header and pixels in two files
_UNREADABLE = "unreadable"


@dataclass(frozen=True)
class Record:
    """A line of the journal about a pair: its name, the fingerprint of its inputs, and its outcome."""

    name: str
    key: str
    report: PairReport


@dataclass(frozen=True)
class Stamp:
    """Size and date of a file, and the hash that its content had then."""

    size: int
    mtime_ns: int
    digest: str


class Journal:
    """The lines of ``journal.jsonl`` in a cohort's folder. The last line of a pair counts.

    Args:
        folder: of the cohort's results; created if missing.

    Raises:
        InputError: the folder cannot be written, or another run is working there.

    Notes:
        A line is on the disk when `record` returns. A line that a crash left incomplete is skipped.
    """

    def __init__(self, folder: Path) -> None:
        self.records: dict[str, Record] = {}
        self._stamps: dict[str, Stamp] = {}
        self._path = folder / JOURNAL
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        except OSError as error:
            raise InputError(f"cannot write to {folder}: {error.strerror}; choose another folder") from error
        self._lock(folder)
        self._read()
        _sync_folder(folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def record(self, record: Record) -> None:
        """Append the outcome of a pair; it is on the disk when this returns."""
        self._append({"pair": record.name, "key": record.key, **asdict(record.report)})
        os.fsync(self._file)
        self.records[record.name] = record

    def fingerprint(self, job: Job) -> str:
        """Return a hash of everything that a pair's results depend on: content of its files, settings, version."""
        given = ((name, path) for name, path in job.files.given().items() if name != "out")
        inputs = {name: (path.suffix, self._digest(path)) for name, path in given}
        parts = {
            "version": __version__,
            "settings": asdict(job.settings),
            "device": job.device,
            "memory": job.memory,
            "report": job.report,
            "voxels": job.voxels,
            "submission": None if job.submission is None else job.submission.name,
            "inputs": inputs,
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def _digest(self, path: Path) -> str:
        """Return the hash of an image's content; images that cannot be read share one hash."""
        try:
            digests = [self._digest_file(file) for file in _files_of(path)]
        except OSError:
            return _UNREADABLE
        return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()

    def _digest_file(self, path: Path) -> str:
        """Return the hash of a file, without reading it if its size and date are unchanged."""
        status, name = path.stat(), str(path)
        known = self._stamps.get(name)
        if known is not None and (known.size, known.mtime_ns) == (status.st_size, status.st_mtime_ns):
            return known.digest
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if time_ns() - status.st_mtime_ns > _SETTLED:
            self._stamps[name] = Stamp(status.st_size, status.st_mtime_ns, digest)
            self._append({"file": name, **asdict(self._stamps[name])})
        return digest

    def _append(self, record: dict[str, Any]) -> None:
        line = memoryview(json.dumps(record).encode() + b"\n")
        while line:  # a disk that is nearly full writes a part
            line = line[os.write(self._file, line) :]

    def _lock(self, folder: Path) -> None:
        """Lock out other runs until this process ends, however it ends."""
        try:
            import fcntl
        except ImportError:  # no such locks on this system
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._file)
            raise InputError(f"another run is working in {folder}; wait until it ends, or stop it") from error
        except OSError:  # a file system without locks
            return

    def _read(self) -> None:
        with self._path.open("rb") as file:
            last = b"\n"
            for last in file:
                self._take(last)
        if not last.endswith(b"\n"):
            os.write(self._file, b"\n")

    def _take(self, line: bytes) -> None:
        with suppress(ValueError, KeyError, TypeError, AttributeError):
            record = json.loads(line)
            if "pair" in record:
                name, key = record.pop("pair"), record.pop("key")
                self.records[name] = Record(name, key, PairReport(**record | {"files": tuple(record["files"])}))
            else:
                name = record.pop("file")
                self._stamps[name] = Stamp(**record)


def _files_of(path: Path) -> Iterator[Path]:
    """Yield all files of an image: those of a folder, of a series, or a header and its pixels."""
    if path.is_dir():
        yield from (p for p in sorted(path.rglob("*")) if p.is_file())
    elif path.suffix.lower() in _HEADERS:
        yield from (p for p in sorted(path.parent.iterdir()) if p.is_file() and stem(p) == stem(path))
    elif is_dicom(path):
        yield from (p for p in sorted(path.parent.iterdir()) if p.is_file())
    else:
        yield path


def _sync_folder(folder: Path) -> None:
    """Write the folder's list of names to the disk, so that a crash cannot lose the journal's name."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
