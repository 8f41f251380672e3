"""``template``: the mean shape and the mean intensity of a cohort's images."""

import os
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any, Self

import typer

from torchdeform.cli.batch import RetryFailed
from torchdeform.cli.options import Quiet, table
from torchdeform.cli.progress import CohortProgress
from torchdeform.cohort.run import Event
from torchdeform.cohort.schema import read_cohort
from torchdeform.cohort.template import RECORD, Built, build
from torchdeform.errors import ComputationError

CohortFile = Annotated[
    Path,
    typer.Argument(metavar="COHORT.yaml", help="Which images, and how they are registered; see docs/templates.md."),
]


def template(cohort_file: CohortFile, retry_failed: RetryFailed = False, quiet: Quiet = False) -> None:
    """Make an unbiased template of the images of COHORT.yaml. Run again, it continues where it was stopped.

    Writes template.nii.gz, overview.png, result.json and, for each image, subjects/NAME/ with warped.*, transform.h5
    (maps points of the template to the image and warps the image onto the template) and inverse.h5 (the other way).
    """
    cohort = read_cohort(cohort_file)
    with _Rounds(cohort.template.rounds, quiet) as rounds:
        built = build(cohort, retry_failed=retry_failed, report=rounds.show)
    if not quiet:
        typer.echo(summary(built))
    if built.failures:
        names = ", ".join(failure.name for failure in built.failures)
        raise ComputationError(f"the template was made without {names}; see left_out in {built.folder / RECORD}")


class _Rounds:
    """Shows the events of each round under its own title."""

    def __init__(self, rounds: int, quiet: bool) -> None:
        self._rounds, self._quiet, self._number = rounds, quiet, 0
        self._open, self._progress = ExitStack(), CohortProgress(quiet)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def show(self, number: int, event: Event) -> None:
        """Show an event of a round."""
        if number != self._number:  # the bar of the last round ends before the next one starts
            self._open.close()
            title = f"round {number} of {self._rounds},"
            self._number, self._progress = number, self._open.enter_context(CohortProgress(self._quiet, title))
        self._progress.show(event)


def summary(built: Built) -> str:
    """Return the most important figures of a template in a few lines."""
    record: dict[str, Any] = dict(built.record)
    images = record["images"].values()
    low, high = min(i["determinant_min"] for i in images), max(i["determinant_max"] for i in images)
    bias = [f"round {r['round']}: {r['bias_voxels'][0]:.3g} -> {r['bias_voxels'][-1]:.2g}" for r in record["rounds"]]
    return table(
        {
            "images": f"{len(images)}, {len(record['left_out'])} left out",
            "mean of the maps": f"moves by at most, in voxels: {', '.join(bias)}",
            "folds": f"{sum(i['folds'] for i in images)}, determinant {low:.3g} to {high:.3g}",
            "results": f"{built.folder}{os.sep}",
        }
    )
