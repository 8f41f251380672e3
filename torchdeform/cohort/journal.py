"""What is known of a cohort's pairs: a journal that a kill leaves readable, and prints of what they are made from."""

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import time_ns
from types import TracebackType
from typing import Any, Self

from torchdeform import __version__
from torchdeform.cohort.plan import Job
from torchdeform.cohort.task import Report
from torchdeform.errors import InputError
from torchdeform.io.dicom import is_dicom
from torchdeform.io.files import stem

JOURNAL = "journal.jsonl"

_SETTLED = 2_000_000_000  # ns that a file must be old for its date to tell that it is the same
_HEADERS = (".mhd", ".nhdr", ".hdr", ".img")  # whose pixels, or header, are in another file
_UNREADABLE = "unreadable"


@dataclass(frozen=True)
class Record:
    """A pair's line of the journal: its name, the print of what it was made from, and what became of it."""

    name: str
    key: str
    report: Report


@dataclass(frozen=True)
class Stamp:
    """A file's size and date, and the hash of the content that it had with them."""

    size: int
    mtime_ns: int
    digest: str


class Journal:
    """The lines of ``journal.jsonl`` in a cohort's folder, the last one of a pair being the one that counts.

    Args:
        folder: of the cohort's results; made if need be.

    Raises:
        InputError: the folder will not do, or another run is at work there.

    Notes:
        A line is written by one call and is on the disk when `record` returns. A line that was torn by a crash is
        skipped, and a new one begins after it.
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
        """Append what became of a pair; it is on the disk when this returns."""
        self._append({"pair": record.name, "key": record.key, **asdict(record.report)})
        os.fsync(self._file)
        self.records[record.name] = record

    def fingerprint(self, job: Job) -> str:
        """Return a hash of all that a pair's results depend on: the content of its files, settings and version."""
        inputs = {
            f.name: (path.suffix, self._digest(path))
            for f in fields(job.files)
            if f.name != "out" and (path := getattr(job.files, f.name)) is not None
        }
        parts = {
            "version": __version__,
            "settings": asdict(job.settings),
            "device": job.device,
            "memory": job.memory,
            "voxels": job.voxels,
            "submission": None if job.submission is None else job.submission.name,
            "inputs": inputs,
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def _digest(self, path: Path) -> str:
        """Return the hash of an image's content; one that cannot be read has a hash of its own."""
        try:
            digests = [self._digest_file(file) for file in _belonging(path)]
        except OSError:
            return _UNREADABLE
        return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()

    def _digest_file(self, path: Path) -> str:
        """Return the hash of a file, without reading it if it has the size and date that it had before."""
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
        while line:  # a disk that is nearly full takes a part
            line = line[os.write(self._file, line) :]

    def _lock(self, folder: Path) -> None:
        """Keep other runs out until this process ends, however it ends."""
        try:
            import fcntl
        except ImportError:  # no such locks on this system
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(self._file)
            raise InputError(f"another run is at work in {folder}; wait until it ends, or stop it") from error
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
                self.records[name] = Record(name, key, Report(**record | {"files": tuple(record["files"])}))
            else:
                name = record.pop("file")
                self._stamps[name] = Stamp(**record)


def _belonging(path: Path) -> Iterator[Path]:
    """Yield the files that an image consists of: those of a folder, a series, or a header and its pixels."""
    if path.is_dir():
        yield from (p for p in sorted(path.rglob("*")) if p.is_file())
    elif path.suffix.lower() in _HEADERS:
        yield from (p for p in sorted(path.parent.iterdir()) if p.is_file() and stem(p) == stem(path))
    elif is_dicom(path):
        yield from (p for p in sorted(path.parent.iterdir()) if p.is_file())
    else:
        yield path


def _sync_folder(folder: Path) -> None:
    """Make sure that the journal's name is on the disk too, where folders can be synchronised."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
