"""The gate of every path from outside: what may be opened, how much of it is read, how much memory it may take."""

import codecs
import os
import stat
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchdeform.core.memory import available, readable
from torchdeform.errors import InputError, nearest_name, of_machine

DAMAGED = "is damaged or incomplete; fetch or export it again"
EMPTY = "is empty; fetch or export it again"
CROP = "crop it, or use a machine with more"

LONGEST_TEXT = 16_000_000  # bytes of a text: settings, tables, landmarks, transforms
_SMALL, _DENSEST = 64_000_000, 1100  # bytes that any file may announce; and per byte of a larger one
_GROWTH = 16  # times that pixels may grow when they are read: bits become float32
_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def require_file(path: Path, what: str = "file", *, folder: bool = False) -> None:
    """Raise `InputError` unless ``path`` is a regular file that can be opened and is not empty.

    Args:
        path: from outside: an argument, a setting, a cell of a table, a line of a header.
        what: what is asked for, say ``image file``, for the sentence.
        folder: whether a folder that can be listed will do too.

    Notes:
        Pipes, devices and sockets are refused without being opened: opening a pipe waits for ever.
    """
    mode = _mode(path, what)
    if stat.S_ISDIR(mode):
        if not folder:
            raise InputError(f"{path} is a folder; give {article(what)}")
    elif not stat.S_ISREG(mode):
        raise InputError(f"{path} is no file but a device or a pipe; give {article(what)}")
    try:
        if stat.S_ISDIR(mode):
            os.scandir(path).close()
        else:
            path.open("rb").close()
    except OSError as error:
        raise InputError(f"{path} cannot be opened: {error.strerror}; check its permissions") from error
    if stat.S_ISREG(mode) and path.stat().st_size == 0:
        raise InputError(f"{path} {EMPTY}")


def _mode(path: Path, what: str) -> int:
    """Return the mode of what ``path`` leads to."""
    require_name(path, what)
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path} does not exist; check the name{nearest_file(path)}") from None
    except OSError as error:
        raise InputError(f"{path} cannot be opened: {error.strerror}; check its name and permissions") from error


def nearest_file(path: Path) -> str:
    """Return a hint at the name beside ``path`` that is nearest to it."""
    try:
        return nearest_name(path.name, os.listdir(path.parent))  # noqa: PTH208 - names are enough
    except OSError:
        return ""


def require_name(path: Path, what: str = "file") -> None:
    """Raise `InputError` unless the system can have a file of this name."""
    try:
        fits = b"\0" not in os.fsencode(path)
        str(path).encode()  # libraries and records take UTF-8
    except UnicodeEncodeError:
        fits = False
    if not fits:
        shown = str(path).encode("ascii", "backslashreplace").decode().replace("\0", "\\0")
        raise InputError(f"{shown!r} is a name that other programs cannot read; rename the {what}")


def article(what: str) -> str:
    """Return ``a file`` or ``an image``."""
    return f"{'an' if what[0] in 'aeiou' else 'a'} {what}"


def read_text(path: Path, what: str = "text file", *, legacy: bool = False) -> str:
    """Return the text of a file: UTF-8, or UTF-16 with its mark.

    Args:
        path: the file.
        what: what is asked for, for the sentence.
        legacy: take what is neither as Windows-1252, as spreadsheets save tables.

    Raises:
        InputError: no regular file, larger than 16 MB, no text, or with NUL in it.
    """
    require_file(path, what)
    with path.open("rb") as file:
        content = file.read(LONGEST_TEXT + 1)
    if len(content) > LONGEST_TEXT:
        raise InputError(
            f"{path} is larger than {readable(LONGEST_TEXT)}, too large for {article(what)}; check the name"
        )
    coding = next((name for mark, name in _MARKS.items() if content.startswith(mark)), "utf-8")
    try:
        text = _decode(content, coding, legacy)
    except UnicodeError as error:
        raise InputError(f"{path} is no text; give {article(what)} in UTF-8") from error
    if "\0" in text:
        raise InputError(f"{path} is no text, it has zero bytes; give {article(what)} in UTF-8")
    return text


def _decode(content: bytes, coding: str, legacy: bool) -> str:
    try:
        return content.decode(coding)
    except UnicodeError:
        if not legacy or coding != "utf-8":
            raise
        return content.decode("cp1252")


def require_room(
    path: Path, needed: int, *, stored: int | None = None, held: int | None = None, remedy: str = CROP
) -> None:
    """Raise `InputError` unless the ``needed`` bytes that the header of ``path`` announces can be there and fit.

    Args:
        path: the file of the header.
        needed: bytes of its pixels.
        stored: bytes of the files that hold them; those of ``path`` by default.
        held: bytes that reading takes, with what the pixels become; ``needed`` by default.
        remedy: what to do where they are too many.

    Notes:
        Nothing that deflate packed becomes more than 1032 times as long, and other packings of pixels stay below.
    """
    stored = path.stat().st_size if stored is None else stored
    held = needed if held is None else held
    announced = max(needed, held // _GROWTH)
    if announced > max(_SMALL, _DENSEST * stored):
        raise InputError(f"{path} announces {readable(announced)} of pixels, far more than it can hold; it {DAMAGED}")
    free = available()
    if free is not None and held > free:
        raise InputError(
            f"{path} takes, by its header, {readable(held)} of memory and {readable(free)} are free; {remedy}"
        )


def require_beside(data: Path, header: Path) -> None:
    """Raise `InputError` unless ``data``, that a header names, is a regular file beside or below the header."""
    require_name(data, "file of pixels")
    try:
        beside = data.resolve().is_relative_to(header.parent.resolve())
    except (OSError, RuntimeError) as error:  # too long, or links that lead to each other
        raise InputError(f"{header} keeps its pixels in {data.name[:80]}, which cannot be opened; rename it") from error
    if not beside:
        raise InputError(
            f"{header} keeps its pixels in {str(data)[-200:]}, which is not beside it; put both into one folder and "
            "name the pixels in the header without a folder"
        )
    require_file(data, "file of pixels")


@contextmanager
def reading(path: Path, fault: str = DAMAGED) -> Iterator[None]:
    """Say in one sentence that a library failed at the content of a file, with whatever it raises; drop its warnings.

    Args:
        path: the file.
        fault: what is said about it.

    Raises:
        InputError: instead of any error inside the block.
        OSError: the machine failed, not the file.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and of_machine(error):
            raise
        if isinstance(error, MemoryError):
            raise InputError(
                f"{path} takes more memory than there is for it, so it may be damaged; if not, {CROP}"
            ) from error
        raise InputError(f"{path} {fault}") from error
