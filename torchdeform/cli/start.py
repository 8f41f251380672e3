"""The programs ``register`` and ``torchdeform``: on a terminal they say at once that they load, which takes long."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_COMPLETION = "_TORCHDEFORM_COMPLETE"  # set while a shell asks for completions


def register() -> int:
    """Run ``register``."""
    with _loading():
        from torchdeform.cli.main import main
    return main()


def torchdeform() -> int:
    """Run ``torchdeform``."""
    with _loading():
        from torchdeform.cli.main import torchdeform
    return torchdeform()


@contextmanager
def _loading() -> Iterator[None]:
    """Show a word on a terminal while the block runs, and take it away at its end."""
    silent = "--quiet" in sys.argv or _COMPLETION in os.environ or not sys.stderr.isatty()
    show = (lambda _: None) if silent else _show
    show("loading ...")
    try:
        yield
    finally:
        show("\r\x1b[K")


def _show(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()
