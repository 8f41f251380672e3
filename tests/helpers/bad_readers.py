"""Readers that fail in every way that a file can make them fail; another process imports them."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from time import sleep

from torchdeform.errors import InputError


def sound(path: Path) -> Iterator[float]:
    yield float(path.read_bytes()[0])


def refusing(path: Path) -> Iterator[float]:
    raise InputError(f"{path} is damaged; fetch it again")
    yield


def rambling(path: Path) -> Iterator[float]:
    error = InputError("")
    error.args = (f"{path}\nis damaged",)  # it makes one line of what it is given
    raise error
    yield


def failing(path: Path) -> Iterator[float]:
    yield 1 / len(path.name[:0])


def crashing(path: Path) -> Iterator[float]:
    os.kill(os.getpid(), signal.SIGSEGV)
    yield 0.0


def endless(path: Path) -> Iterator[float]:
    while True:
        sleep(0.1)
    yield 0.0


def infinite(path: Path) -> Iterator[float]:
    yield from (1.0, float("inf"))


def greedy(path: Path) -> Iterator[float]:
    yield float(len(b"x" * 1_200_000_000))


def boundless(path: Path) -> Iterator[float]:
    yield float(len(bytearray(1 << 40)))
