"""The stages of a run by name, told by Python's logging: a shell can show them, and nobody need listen."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_LOG = logging.getLogger("torchdeform.stages")


def begin(stage: str) -> None:
    """Say that a stage begins, such as ``aligning``; the one before has ended."""
    _LOG.info(stage)


@contextmanager
def heard_by(listener: Callable[[str], None]) -> Iterator[None]:
    """Call ``listener`` with the name of every stage that begins inside the block."""
    handler, level = logging.Handler(), _LOG.level
    handler.emit = lambda record: listener(record.getMessage())
    _LOG.addHandler(handler)
    _LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        _LOG.removeHandler(handler)
        _LOG.setLevel(level)
