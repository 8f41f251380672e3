"""The shell: errors are one sentence on stderr; exit code 0 means done, 1 failed, 2 wrong input."""

import os
import sys
from collections.abc import Sequence

import typer

from torchdeform.commands.check import check
from torchdeform.commands.deformation import adapt_grid, reconstruct, simulate
from torchdeform.commands.options import Version
from torchdeform.commands.register import register
from torchdeform.commands.transforms import VERBS as TRANSFORM_VERBS
from torchdeform.errors import ComputationError, InputError

_TRACEBACK = "TORCHDEFORM_TRACEBACK"

# What `torchdeform` can do, by the name of the verb.
VERBS = {
    "register": register,
    "check": check,
    **TRANSFORM_VERBS,
    "grid": adapt_grid,
    "reconstruct": reconstruct,
    "simulate": simulate,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``register`` with the shell's arguments, or those given, and return the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(register)
    return _run(app, "register", arguments)


def torchdeform(arguments: Sequence[str] | None = None) -> int:
    """Run ``torchdeform``, whose commands are what can be done, like `main`."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, no_args_is_help=True)
    app.callback()(_root)
    for name, verb in VERBS.items():
        app.command(name)(verb)
    return _run(app, "torchdeform", arguments)


def _root(version: Version = False) -> None:
    """Registration of images by maps that do not fold, built from divergence and curl."""


def _run(app: typer.Typer, name: str, arguments: Sequence[str] | None) -> int:
    """Run a command; whatever goes wrong becomes one sentence and an exit code."""
    try:
        return app(args=arguments, prog_name=name, standalone_mode=False) or 0
    except Exception as error:  # the boundary to the shell: a person gets a sentence, not a traceback
        if os.environ.get(_TRACEBACK):
            raise
        sentence, code = explain(error)
        if sentence:
            typer.echo(f"{name}: {sentence}", err=True)
        return code


def explain(error: Exception) -> tuple[str, int]:
    """Return what to tell a person about an error, and the exit code."""
    if isinstance(error, InputError):
        return str(error), 2
    if isinstance(error, typer.TyperException):
        message = error.format_message().rstrip(".")  # empty where typer has shown the help already
        return f"{message}; see --help" if message else "", error.exit_code
    if isinstance(error, ComputationError):
        return str(error), 1
    if isinstance(error, MemoryError) or "out of memory" in str(error) or "allocate memory" in str(error):
        return "there is not enough memory for images of this size; use a machine with more, or smaller images", 1
    if isinstance(error, OSError):
        return f"{error.filename or 'a file'}: {error.strerror or error}; check the disk and its permissions", 1
    text = " ".join(str(error).split())
    return f"unexpected {type(error).__name__}: {text}; set {_TRACEBACK}=1 to see where, and report it", 1


if __name__ == "__main__":
    sys.exit(torchdeform())
