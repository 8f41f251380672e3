"""Typed errors: one sentence that says what is wrong, where, and what to do about it."""

import difflib
import errno
import math
from collections.abc import Callable, Iterable
from typing import Any

# What a disk answers that is full, read-only, broken or gone, and a system that has no more open files to give.
_OF_MACHINE = {
    number
    for name in (
        "ENOSPC", "EDQUOT", "EROFS", "EIO", "ESTALE", "EFBIG", "EMFILE", "ENFILE", "ENOTCONN", "EREMOTEIO", "ETIMEDOUT",
    )
    if (number := getattr(errno, name, None)) is not None
}  # fmt: skip

# Set in the environment: the shell shows the traceback of an error.
TRACEBACK = "TORCHDEFORM_TRACEBACK"

_WIDEST, _MOST_BITS = 80, 1000  # characters of a wrong value, and bits of a number, that are shown
_LONGEST = 900  # characters of a sentence


class TorchdeformError(Exception):
    """Base of every error that this package raises on purpose: one line, however long or odd what it quotes is."""

    def __init__(self, sentence: str = "") -> None:
        line = "".join(c if c.isprintable() else " " for c in sentence)
        super().__init__(line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}")


class InputError(TorchdeformError, ValueError):
    """The caller's input is wrong: a shape, a value, a file or a setting (exit code 2 at the shell)."""


class ComputationError(TorchdeformError, RuntimeError):
    """The input was fine, the computation failed (exit code 1 at the shell)."""


class MachineError(ComputationError):
    """The machine failed, such as a disk that is full or gone: nothing is settled, the same command goes on later."""


def of_machine(error: BaseException | None) -> OSError | MachineError | None:
    """Return the failure of the machine that an error is or comes from, None if there is none."""
    while error is not None:
        if isinstance(error, MachineError) or (isinstance(error, OSError) and error.errno in _OF_MACHINE):
            return error
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return None


def shown(value: object) -> str:
    """Return a wrong value as it is written, as far as a sentence has room for it."""
    if isinstance(value, int) and value.bit_length() > _MOST_BITS:  # Python refuses to write the longest
        return "a number of too many digits"
    text = repr(value)
    return text if len(text) <= _WIDEST else f"{text[:_WIDEST]}..."


def nearest_name(name: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the known name nearest to ``name``, else an empty string."""
    match = difflib.get_close_matches(name[:_WIDEST], list(known), n=1, cutoff=0.5)
    return f"; did you mean '{match[0]}'?" if match else ""


def require_choice(value: object, choices: Iterable[object], where: str) -> None:
    """Raise `InputError` unless ``value`` is one of ``choices``; ``where`` names the argument or setting."""
    known = list(choices)
    if value not in known:
        names = [str(choice) for choice in known]
        hint = nearest_name(value, names) if isinstance(value, str) else ""
        raise InputError(f"{where} must be one of {', '.join(names)}, got {shown(value)}{hint}")


# What a number must be: the test, and the words for it; those that are asked for often have a name.
Range = tuple[Callable[[Any], bool], str]
RANGES: dict[str, Range] = {
    "positive": (lambda x: 0 < x < math.inf, "be positive and finite"),
    "finite, not negative": (lambda x: 0 <= x < math.inf, "be finite and not negative"),
    "not negative": (lambda x: x >= 0, "not be negative"),
    "at least 1": (lambda x: 1 <= x < math.inf, "be at least 1"),
    "whole": (lambda x: isinstance(x, int) and x >= 1, "be a whole number, at least 1"),
    "below 1": (lambda x: 0 <= x < 1, "be at least 0 and below 1"),
    "inside 0 to 1": (lambda x: 0 < x < 1, "lie between 0 and 1"),
    "0 to 1": (lambda x: 0 <= x <= 1, "lie between 0 and 1, both allowed"),
    "window": (lambda x: x >= 3 and x % 2 == 1, "be an odd number of voxels, at least 3"),
}


def require_ranges(settings: object, prefix: str, **ranges: str | Range) -> None:
    """Raise `InputError` unless the numbers of these names are in range.

    Args:
        settings: has them as attributes: a number, None, which is always allowed, or one or more of them.
        prefix: what comes before the name in the message, say ``"optimiser."``.
        ranges: what each must be, a name of `RANGES` or a range of its own.
    """
    for name, wanted in ranges.items():
        fits, words = RANGES[wanted] if isinstance(wanted, str) else wanted
        value = getattr(settings, name)
        numbers = value if isinstance(value, tuple | list) else (value,)
        if not numbers or not all(number is None or fits(number) for number in numbers):
            raise InputError(f"{prefix}{name} must {words}, got {shown(value)}")


def explain(error: Exception) -> tuple[str, int]:
    """Return what to tell a person about an error, and the exit code."""
    machine = of_machine(error)
    if isinstance(machine, OSError):
        where = machine.filename or "the disk"
        return f"{where}: {machine.strerror}; mend that, or make room, and run the same command again", 1
    error = machine or error
    if isinstance(error, InputError):
        return str(error), 2
    if isinstance(error, ComputationError):
        return str(error), 1
    if isinstance(error, MemoryError) or "out of memory" in str(error) or "allocate memory" in str(error):
        return "there is not enough memory for images of this size; use a machine with more, or smaller images", 1
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}; check the disk and its permissions", 1
    text = " ".join(str(error).split())
    return f"unexpected {type(error).__name__}: {text}; set {TRACEBACK}=1 to see where, and report it", 1
