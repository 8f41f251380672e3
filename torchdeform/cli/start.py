"""The programs ``register`` and ``torchdeform``: on a terminal they say at once that they load, which takes long."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from torchdeform.cli.streams import STOPPED, steady

_COMPLETION = "_TORCHDEFORM_COMPLETE"  # set while a shell asks for completions


def register() -> int:
    """Run ``register``."""
    with _starting():
        from torchdeform.cli.main import main
    return main()


def torchdeform() -> int:
    """Run ``torchdeform``."""
    with _starting():
        from torchdeform.cli.main import torchdeform
    return torchdeform()


@contextmanager
def _starting() -> Iterator[None]:
    """Load in this block: with streams that bear everything, and an end without a traceback if it is stopped."""
    steady()
    try:
        with _loading():
            yield
    except KeyboardInterrupt:
        raise SystemExit(STOPPED) from None


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
