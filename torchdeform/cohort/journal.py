"""The journal of a cohort: the outcome of every pair, readable even after a crash, and fingerprints of its files."""

import hashlib
import json
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import time_ns
from types import TracebackType
from typing import Annotated, Literal, Self

from pydantic import Field, TypeAdapter, ValidationError

from torchdeform import __version__
from torchdeform.cohort.plan import Job
from torchdeform.cohort.task import DONE, PairReport
from torchdeform.errors import InputError, MachineError, of_machine
from torchdeform.io.files import disk_failure, sync, take_lock
from torchdeform.io.gate import require_file
from torchdeform.io.parts import files_of

JOURNAL = "journal.jsonl"

_SETTLED = 2_000_000_000  # ns; age from which on unchanged dates mean unchanged content
_UNREADABLE = "unreadable"
_LONGEST = 1_000_000  # bytes of a line
_DATE = b'{"file": '  # how lines begin that earlier versions wrote about dates of files


@dataclass(frozen=True)
class Record:
    """A line of the journal about a pair: its name, the fingerprint of its inputs, and its outcome."""

    name: str
    key: str
    report: PairReport


@dataclass(frozen=True)
class _Line:
    """A line as it is written: the fields of a `PairReport` and two more."""

    pair: str
    key: str
    status: Literal["done", "failed"]
    sentence: str
    seconds: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    peak_memory: Annotated[int, Field(ge=0, lt=1 << 63)]
    gpu_memory: Annotated[int, Field(ge=0, lt=1 << 63)]
    figures: dict[str, float | str]
    files: tuple[str, ...]


_LINES = TypeAdapter(_Line)


class Journal:
    """The lines of ``journal.jsonl`` in a cohort's folder. The last line of a pair counts.

    Args:
        folder: of the cohort's results; created if missing.

    Raises:
        InputError: the folder cannot be written, or another run is working there.

    Notes:
        A line is on the disk when `record` returns. A line that a crash left incomplete, or that makes no sense, is
        skipped and counted in ``skipped``.
    """

    def __init__(self, folder: Path) -> None:
        self.records: dict[str, Record] = {}
        self.skipped = 0
        self._digests: dict[tuple[int, ...], str] = {}
        self._path = folder / JOURNAL
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = open_lines(self._path)
        except OSError as error:
            if of_machine(error):
                raise disk_failure(error, folder) from error
            raise InputError(f"cannot write to {folder}: {error.strerror}; choose another folder") from error
        try:
            take_lock(self._file)
            self._read()
        except BlockingIOError as error:
            os.close(self._file)
            raise InputError(f"another run is working in {folder}; wait until it ends, or stop it") from error
        except BaseException:
            os.close(self._file)
            raise
        with suppress(OSError):  # so that a crash cannot lose the journal's name
            sync(folder)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def record(self, record: Record) -> None:
        """Append the outcome of a pair; it is on the disk when this returns.

        Raises:
            MachineError: the journal is not there any more.
            OSError: it cannot be written; it is as before then.
        """
        self.require_there()
        append(self._file, {"pair": record.name, "key": record.key, **asdict(record.report)})
        os.fsync(self._file)
        self.records[record.name] = record

    def require_there(self) -> None:
        """Raise `MachineError` if the journal was removed or replaced since it was opened."""
        try:
            there = os.path.samestat(self._path.stat(), os.fstat(self._file))
        except FileNotFoundError:
            there = False
        if not there:
            raise MachineError(
                f"{self._path.parent} was removed or replaced while the run was working there; "
                "put it back, or run the same command again"
            )

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
            "submission": [path.name for path in (job.submission, *job.also) if path is not None],
            "inputs": inputs,
            "programs": [self._digest(Path(path)) for path in job.settings.programs],
        }
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def _digest(self, path: Path) -> str:
        """Return the hash of an image's content; images that cannot be read share one hash."""
        try:
            digests = [self._digest_file(file) for file in files_of(path)]
        except (OSError, InputError) as error:
            if of_machine(error):
                raise
            return _UNREADABLE
        return digests[0] if len(digests) == 1 else hashlib.sha256("".join(digests).encode()).hexdigest()

    def _digest_file(self, path: Path) -> str:
        """Return the hash of a file's content, which one run reads once unless the system says that it changed.

        Notes:
            The next run reads it again: dates can be set, and where there is a date that cannot (of POSIX' change of
            status), file systems of a network may not keep it.
        """
        require_file(path)
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            same = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
            if same not in self._digests:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                if os.name != "posix" or time_ns() - max(status.st_mtime_ns, status.st_ctime_ns) < _SETTLED:
                    return digest
                self._digests[same] = digest
        return self._digests[same]

    def _read(self) -> None:
        last = b"\n"
        with self._path.open("rb") as file:
            while line := file.readline(_LONGEST):
                self.skipped += not self._take(line)
                last = line
        if not last.endswith(b"\n"):
            os.write(self._file, b"\n")

    def _take(self, line: bytes) -> bool:
        """Keep the record of a line; return whether the line makes sense."""
        if not line.strip() or line.startswith(_DATE):
            return True
        try:
            found = _LINES.validate_json(line, strict=True)
        except ValidationError:
            return False
        report = PairReport(**{field.name: getattr(found, field.name) for field in fields(PairReport)})
        if report.status == DONE and not report.files:
            return False
        self.records[found.pair] = Record(found.pair, found.key, report)
        return True


def open_lines(path: Path) -> int:
    """Return the descriptor of a file for `append`; made if missing, `InputError` if it is a pipe or a device."""
    taken = f"{path} is no file; remove it, or choose another folder"
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
    except IsADirectoryError:
        raise InputError(taken) from None
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise InputError(taken)
    return file


def append(file: int, record: Mapping[str, object]) -> None:
    """Append a record as a line of JSON to an open file, whole or not at all."""
    line, before = memoryview(json.dumps(record).encode() + b"\n"), os.fstat(file).st_size
    try:
        while line:  # a disk that is nearly full writes a part
            line = line[os.write(file, line) :]
    except BaseException:
        with suppress(OSError):
            os.ftruncate(file, before)
        raise
