"""The command line. Errors are one sentence on stderr; exit code 0 means done, 1 failed, 2 wrong input."""

import os
import sys
from collections.abc import Callable, Sequence
from inspect import cleandoc
from typing import NamedTuple

import typer

from torchdeform.cli import transforms
from torchdeform.cli.batch import batch, schema
from torchdeform.cli.check import check
from torchdeform.cli.cite import cite
from torchdeform.cli.deformation import adapt_grid, reconstruct, simulate
from torchdeform.cli.options import Version
from torchdeform.cli.register import register
from torchdeform.cli.streams import STOPPED, interruptible, lost_output, steady
from torchdeform.cli.template import template
from torchdeform.errors import TRACEBACK, InputError, explain

_STOP = "stopped; what is finished is kept and nothing is half-written, run the same command again to continue"


class Verb(NamedTuple):
    """A verb of ``torchdeform``: its function, a line for the list of verbs, and an example."""

    run: Callable[..., None]
    summary: str
    example: str


VERBS = {
    "register": Verb(
        register,
        "Warp one image onto another by a map that does not fold.",
        "torchdeform register fixed.nii.gz moving.nii.gz --out results",
    ),
    "check": Verb(
        check,
        "Show what two images are and what looks wrong with them.",
        "torchdeform check fixed.nii.gz moving.nii.gz --out overlay.png",
    ),
    "apply": Verb(
        transforms.apply,
        "Warp an image or labels onto the grid of the fixed image.",
        "torchdeform apply transform.h5 labels.nii.gz --reference fixed.nii.gz --interpolation label --out l.nii.gz",
    ),
    "points": Verb(
        transforms.points,
        "Map points of the fixed image to the moving image.",
        "torchdeform points transform.h5 landmarks.csv --out landmarks_in_moving.csv",
    ),
    "invert": Verb(
        transforms.invert, "Write the inverse of a transform.", "torchdeform invert transform.h5 --out inverse.h5"
    ),
    "compose": Verb(
        transforms.compose,
        "Join several transforms into one.",
        "torchdeform compose 1Warp.nii.gz 0GenericAffine.mat --out transform.h5",
    ),
    "jacobian": Verb(
        transforms.jacobian,
        "Write the change of volume, the Jacobian determinant.",
        "torchdeform jacobian transform.h5 --reference fixed.nii.gz --out determinant.nii.gz",
    ),
    "grid": Verb(
        adapt_grid,
        "Adapt a regular grid to an image.",
        "torchdeform grid brain.nii.gz --monitor gradient --f-min 0.1",
    ),
    "reconstruct": Verb(
        reconstruct,
        "Reconstruct a map from its divergence and curl.",
        "torchdeform reconstruct results/displacement.nii.gz --steps 10",
    ),
    "simulate": Verb(
        simulate,
        "Grow or shrink labelled regions by given factors.",
        "torchdeform simulate brain.nii.gz --labels labels.nii.gz --volume 17=0.95 --volume 53=0.95",
    ),
    "batch": Verb(batch, "Register all pairs of a cohort.", "torchdeform batch cohort.yaml --dry-run"),
    "template": Verb(template, "Make one unbiased image of many.", "torchdeform template cohort.yaml"),
    "schema": Verb(
        schema,
        "Print the JSON Schema of a cohort file, for editors.",
        "torchdeform schema --out cohort.schema.json",
    ),
    "cite": Verb(cite, "Print what to cite for a registration, in BibTeX.", "torchdeform cite results/result.json"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``register`` with the arguments of the shell, or those given, and return the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(help=_text(register), epilog=_example("register").replace("torchdeform register", "register"))(register)
    return _run(app, "register", arguments)


def torchdeform(arguments: Sequence[str] | None = None) -> int:
    """Run ``torchdeform`` with one of its verbs, like `main`."""
    app = typer.Typer(pretty_exceptions_enable=False, no_args_is_help=True)
    app.callback()(_root)
    for name, verb in VERBS.items():
        app.command(name, help=_text(verb.run), short_help=verb.summary, epilog=_example(name))(verb.run)
    return _run(app, "torchdeform", arguments)


def _text(verb: Callable[..., None]) -> str:
    """Return a verb's docstring with one line per paragraph, which the terminal wraps."""
    paragraphs = cleandoc(verb.__doc__ or "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def _example(name: str) -> str:
    return f"Example: {VERBS[name].example}"


def _root(version: Version = False) -> None:
    """Registration of images by maps that do not fold, built from divergence and curl."""


def _run(app: typer.Typer, name: str, arguments: Sequence[str] | None) -> int:
    """Run a command. Every error, and a stop, becomes one sentence and an exit code."""
    steady()
    try:
        with interruptible():
            _require_given(sys.argv[1:] if arguments is None else arguments)
            code = app(args=arguments, prog_name=name, standalone_mode=False) or 0
    except KeyboardInterrupt:
        code = STOPPED
    except Exception as error:  # at the shell a person gets a sentence, not a traceback
        if os.environ.get(TRACEBACK):
            raise
        sentence, code = _usage_error(error) if isinstance(error, typer.TyperException) else explain(error)
        if sentence:
            typer.echo(f"{name}: {sentence}", err=True)
        return code
    if code == STOPPED:
        typer.echo(f"{name}: {_STOP}", err=True)
    elif why := lost_output():
        typer.echo(f"{name}: standard output cannot be written: {why}; the work itself is done", err=True)
        return code or 1
    return code


def _require_given(arguments: Sequence[str]) -> None:
    """Raise `InputError` if an argument is empty: as a path it would be the folder that the shell is in."""
    if "" in arguments:
        place = list(arguments).index("")
        after = f" after {arguments[place - 1]}" if place else ""
        raise InputError(f"argument {place + 1}{after} is empty; check the variable or the quotes that it comes from")


def _usage_error(error: typer.TyperException) -> tuple[str, int]:
    """Return the message of typer about a wrong call (empty if it has shown the help already) and its exit code."""
    message = error.format_message().rstrip(".")
    return f"{message}; see --help" if message else "", error.exit_code


if __name__ == "__main__":
    sys.exit(torchdeform())
