"""Mutations of files: bytes flipped, cut, repeated and inserted, fields set to extremes. Same seed, same mutant."""

import re
import struct
from collections.abc import Callable
from random import Random

# Whole numbers and fractions that break what expects ordinary ones.
_WHOLE = (0, 1, -1, -3, 127, 255, 2**15 - 1, -(2**15), 2**16 - 1, 2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1)
_FRACTIONS = (0.0, -1.0, 1e-40, 1e9, 1e38, 1e300, float("nan"), float("inf"), float("-inf"))


_HEAD = 600  # bytes at the start of a file, where most formats have their header

_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_TEXTS = tuple(
    text.encode()
    for text in (
        "0", "-1", "2147483647", "-2147483648", "4294967296", "9" * 400, "9" * 5000, "1" + "0" * 350 + ".5", "1e999",
        "-1e999", "1e-400", "nan", "NaN", ".nan", "inf", "-inf", ".inf", "", "x", "0x10", "1_000", "1,5", "½", "٣",
        "true", "null", "~", "2024-31-12", "2024-12-31", "12:30:45", "[]", "{}", "[1, 2", '""', "'", "-", "*a", "&a 1",
    )
)  # fmt: skip
_PIECES = (
    b"\0", b"\n", b"\r", b"\n\n", b"\t", b" ", b"#", b'"', b"'", b",", b";", b":", b"{", b"}", b"[", b"]", b"%", b"$",
    b"$X", b"~nosuchuser/", b"../", b"/dev/zero", b"\xff", b"\xfe\xff", b"\xff\xfe", b"\xed\xa0\x80", b"\\ud800",
    b"\xef\xbb\xbf",
    b"&a [*a, *a]", b"<<: *a\n", b"!!python/object:os.system x", b"!!binary x", b"(a+)+$", b"(" * 300, b"[" * 3000,
    b"{" * 3000, b"{a: " * 300, b"-" * 300 + b" ", b"a" * 70000, b"1" * 5000,
)  # fmt: skip

Mutation = Callable[[bytearray, Random], None]


def mutant(content: bytes, random: Random) -> bytes:
    """Return a content with one to three mutations."""
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        random.choice(_MUTATIONS)(changed, random)
    return bytes(changed)


def _place(content: bytearray, random: Random) -> int:
    """Return a position, as often near the start as anywhere."""
    return random.randrange(max(1, min(len(content), random.choice((_HEAD, len(content))))))


def _span(content: bytearray, random: Random) -> slice:
    """Return the place of some bytes, or of some lines."""
    start = _place(content, random)
    stop = start + random.choice((1, 2, 4, 16, 100, len(content)))
    if random.random() < 0.5:
        start = content.rfind(b"\n", 0, start) + 1
        stop = content.find(b"\n", start) + 1 or stop
    return slice(start, stop)


def _flip(content: bytearray, random: Random) -> None:
    for _ in range(random.choice((1, 1, 2, 8))):
        if content:
            content[_place(content, random)] ^= random.choice((1 << random.randrange(8), 0xFF))


def _cut(content: bytearray, random: Random) -> None:
    del content[_place(content, random) :]


def _delete(content: bytearray, random: Random) -> None:
    del content[_span(content, random)]


def _repeat(content: bytearray, random: Random) -> None:
    span = _span(content, random)
    content[span.start : span.start] = content[span] * random.choice((1, 1, 2, 30))


def _swap(content: bytearray, random: Random) -> None:
    one, other = _span(content, random), _place(content, random)
    moved = content[one]
    del content[one]
    content[other:other] = moved


def _insert(content: bytearray, random: Random) -> None:
    piece = random.choice((random.choice(_PIECES), random.randbytes(random.choice((1, 4, 100)))))
    at = _place(content, random)
    content[at:at] = piece


def _set_binary(content: bytearray, random: Random) -> None:
    """Set a field of one to eight bytes; most formats align them."""
    order, width = random.choice("<>"), random.choice((1, 2, 4, 4, 8))
    at = _place(content, random) // width * width
    if width > 2 and random.random() < 0.3:
        field = struct.pack(order + {4: "f", 8: "d"}[width], _single(random.choice(_FRACTIONS), width))
    else:
        field = (random.choice(_WHOLE) % 2 ** (8 * width)).to_bytes(width, "little" if order == "<" else "big")
    content[at : at + width] = field


def _single(value: float, width: int) -> float:
    """Return a value that fits into a float of so many bytes."""
    return value if width == 8 or abs(value) <= 1e38 or value != value else float("inf")


def _set_text(content: bytearray, random: Random) -> None:
    """Set a number that is written in digits."""
    found = list(_NUMBER.finditer(content, 0, 20_000))
    if not found:
        _set_binary(content, random)
        return
    start, stop = random.choice(found).span()
    content[start:stop] = random.choice(_TEXTS)


_MUTATIONS: tuple[Mutation, ...] = (
    _flip, _flip, _cut, _delete, _repeat, _swap, _insert, _insert, _set_binary, _set_binary, _set_text, _set_text,
)  # fmt: skip
