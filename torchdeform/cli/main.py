"""The shell: errors are one sentence on stderr; exit code 0 means done, 1 failed, 2 wrong input."""

import os
import sys
from collections.abc import Callable, Sequence
from inspect import cleandoc
from typing import NamedTuple

import typer

from torchdeform.cli.batch import batch, schema
from torchdeform.cli.check import check
from torchdeform.cli.cite import cite
from torchdeform.cli.deformation import adapt_grid, reconstruct, simulate
from torchdeform.cli.options import Version
from torchdeform.cli.register import register
from torchdeform.cli.template import template
from torchdeform.cli.transforms import VERBS as TRANSFORM_VERBS
from torchdeform.errors import TRACEBACK, explain

# What `torchdeform` can do, by the name of the verb.
VERBS = {
    "register": register,
    "check": check,
    **TRANSFORM_VERBS,
    "grid": adapt_grid,
    "reconstruct": reconstruct,
    "simulate": simulate,
    "batch": batch,
    "template": template,
    "schema": schema,
    "cite": cite,
}


class Help(NamedTuple):
    """A line for the list of verbs, and a command that shows how one is used."""

    summary: str
    example: str


HELP = {
    "register": Help(
        "Warp one image onto another by a map that does not fold.",
        "torchdeform register fixed.nii.gz moving.nii.gz --out results",
    ),
    "check": Help(
        "Say what two images are and what looks wrong with them.",
        "torchdeform check fixed.nii.gz moving.nii.gz --out overlay.png",
    ),
    "apply": Help(
        "Bring an image or labels onto the grid of the fixed image.",
        "torchdeform apply transform.h5 labels.nii.gz --reference fixed.nii.gz --interpolation label --out l.nii.gz",
    ),
    "points": Help(
        "Take points of the fixed image to the moving image.",
        "torchdeform points transform.h5 landmarks.csv --out landmarks_in_moving.csv",
    ),
    "invert": Help("Write the inverse of a transform.", "torchdeform invert transform.h5 --out inverse.h5"),
    "compose": Help(
        "Write one transform for several, one after the other.",
        "torchdeform compose 1Warp.nii.gz 0GenericAffine.mat --out transform.h5",
    ),
    "jacobian": Help(
        "Write the change of volume, the Jacobian determinant.",
        "torchdeform jacobian transform.h5 --reference fixed.nii.gz --out determinant.nii.gz",
    ),
    "grid": Help(
        "Adapt a regular grid to an image.",
        "torchdeform grid brain.nii.gz --monitor gradient --f-min 0.1",
    ),
    "reconstruct": Help(
        "Get a map back from its divergence and curl.",
        "torchdeform reconstruct results/displacement.nii.gz --steps 10",
    ),
    "simulate": Help(
        "Let labelled regions grow or shrink by given factors.",
        "torchdeform simulate brain.nii.gz --labels labels.nii.gz --volume 17=0.95 --volume 53=0.95",
    ),
    "batch": Help("Register all pairs of a cohort.", "torchdeform batch cohort.yaml --dry-run"),
    "template": Help("Make one unbiased image of many.", "torchdeform template cohort.yaml"),
    "schema": Help(
        "Print the JSON Schema of a cohort file, for editors.",
        "torchdeform schema --out cohort.schema.json",
    ),
    "cite": Help("Print what to cite for a registration, in BibTeX.", "torchdeform cite results/result.json"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``register`` with the shell's arguments, or those given, and return the exit code."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(help=_text(register), epilog=_example("register").replace("torchdeform register", "register"))(register)
    return _run(app, "register", arguments)


def torchdeform(arguments: Sequence[str] | None = None) -> int:
    """Run ``torchdeform``, whose commands are what can be done, like `main`."""
    app = typer.Typer(pretty_exceptions_enable=False, no_args_is_help=True)
    app.callback()(_root)
    for name, verb in VERBS.items():
        app.command(name, help=_text(verb), short_help=HELP[name].summary, epilog=_example(name))(verb)
    return _run(app, "torchdeform", arguments)


def _text(verb: Callable[..., None]) -> str:
    """Return a verb's docstring with a line a paragraph, which the terminal breaks where it ends."""
    paragraphs = cleandoc(verb.__doc__ or "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def _example(name: str) -> str:
    return f"Example: {HELP[name].example}"


def _root(version: Version = False) -> None:
    """Registration of images by maps that do not fold, built from divergence and curl."""


def _run(app: typer.Typer, name: str, arguments: Sequence[str] | None) -> int:
    """Run a command; whatever goes wrong becomes one sentence and an exit code."""
    try:
        return app(args=arguments, prog_name=name, standalone_mode=False) or 0
    except Exception as error:  # the boundary to the shell: a person gets a sentence, not a traceback
        if os.environ.get(TRACEBACK):
            raise
        sentence, code = _typer_says(error) if isinstance(error, typer.TyperException) else explain(error)
        if sentence:
            typer.echo(f"{name}: {sentence}", err=True)
        return code


def _typer_says(error: typer.TyperException) -> tuple[str, int]:
    """Return what typer says of a wrong call, empty where it has shown the help already, and its exit code."""
    message = error.format_message().rstrip(".")
    return f"{message}; see --help" if message else "", error.exit_code


if __name__ == "__main__":
    sys.exit(torchdeform())
