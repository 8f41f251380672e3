"""What the tests of the report share: a registration that is known beforehand, with everything that it may have."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from nested_settings import settings_of

from torchdeform.core.image import Image
from torchdeform.core.transform import Affine
from torchdeform.metrics.evaluation import Evaluation, Measures
from torchdeform.registration.affine.align import Alignment
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.tissue import TissueFit, TissueOutcome
from torchdeform.report.record import describe, repeat_command
from torchdeform.report.report_data import ReportData, make_report_data

SHAPES = {2: (40, 52), 3: (20, 26, 31)}
KINDS = {1: "rigid", 2: "incompressible", 3: "stiff", 14: {"div": 50.0}}
NASTY = "<script>alert('x')</script> & \"more\""


@pytest.fixture(autouse=True)
def _closed_figures() -> Iterator[None]:
    """Figures of pyplot are closed after every test."""
    yield
    from matplotlib import pyplot

    pyplot.close("all")


@pytest.fixture
def make_full(make_image, make_result) -> Callable[..., tuple[ReportData, dict[str, Any]]]:
    """Return ``make_full(dim)``: the data of a report, and a record with everything in it."""

    def make(
        dim: int, *, labels: int = 3, landmarks: int = 4, tissue: bool = True, **images: Any
    ) -> tuple[ReportData, dict[str, Any]]:
        shape = images.pop("shape", SHAPES[dim])
        fixed = make_image(shape, name=f"/data/{NASTY}/fixed{NASTY}.nii.gz", **images)
        moving = make_image(tuple(n - 3 for n in shape), (1.1,) * dim, name="moving.nii.gz", **images)
        settings = settings_of(
            similarity={"lncc": 1.0, "mi": 0.5}, steps=(5, 4), **({"tissues": KINDS} if tissue else {})
        )
        result = make_result(fixed, moving, settings)
        shift = Affine(torch.eye(dim, dtype=torch.float64), torch.ones(dim, dtype=torch.float64))
        result = replace(
            result,
            affine=shift,
            alignment=Alignment(shift, 0.1, 0.2, "centres", 0.5, ()),
            evaluation=_evaluation(labels, landmarks),
            warnings=(f"this is odd: {NASTY}",),
        )
        object.__setattr__(result, "absent", _corner(fixed).data)
        object.__setattr__(result, "tissue", _tissue() if tissue else ())
        record = describe(result, fixed, moving)
        inputs = {"fixed": fixed.name, "moving": moving.name, "out": "my results"}
        record |= {
            "inputs": inputs,
            "seconds": {"read": 0.1, **result.seconds},
            "memory": {"read": 10**8, "optimise": 2 * 10**9},
            "command": repeat_command(inputs, settings, "cpu", 10**9),
            "folder": "/home/somebody",
        }
        return make_report_data(fixed, moving, result, annotations=_annotations(fixed, moving), slices=7), record

    return make


def _corner(image: Image) -> Image:
    """1 in a box around the middle of an image, else 0."""
    data = torch.zeros_like(image.data[:, :1])
    data[(..., *(slice(n // 3, n // 2) for n in image.grid.shape))] = 1.0
    return replace(image, data=data)


def _annotations(fixed: Image, moving: Image) -> Annotations:
    """Labels, masks and landmarks in the middle of both images."""
    middle = fixed.to_world(torch.tensor(fixed.grid.extent, dtype=torch.float64).view(1, -1, 1) / 2)
    steps = torch.linspace(-4, 4, 4, dtype=torch.float64).view(1, 1, -1)
    return Annotations(
        fixed_mask=_corner(fixed),
        moving_mask=_corner(moving),
        fixed_labels=_corner(fixed),
        moving_labels=_corner(moving),
        tissue=_corner(fixed),
        fixed_points=middle + steps,
        moving_points=middle + 1.5 * steps,
    )


def _tissue() -> tuple[TissueOutcome, ...]:
    """A label of each kind, the last one sliding and not there."""

    def fit(*values: float) -> TissueFit:
        return TissueFit(*(torch.tensor([v], dtype=torch.float64) for v in values))

    nodes = torch.tensor([1234])
    return (
        TissueOutcome(1, "rigid", False, nodes, fit(0.3123, 0.04, 1.01), fit(0.02, 1e-4, 1.0)),
        TissueOutcome(2, "incompressible", False, nodes, fit(2.0, 0.041, 0.979), fit(2.1, 0.008, 1.0002)),
        TissueOutcome(3, "stiff", False, nodes, fit(1.5, 0.2, 1.123), fit(1.5, 0.2, 1.123)),
        TissueOutcome(14, "own", True, 0 * nodes, fit(*[math.nan] * 3), fit(*[math.nan] * 3)),
    )


def _evaluation(labels: int, landmarks: int) -> Evaluation:
    def measures(dice: float, distance: float) -> Measures:
        overlap = torch.full((1, labels), dice, dtype=torch.float64)
        return Measures(
            labels=tuple(range(1, labels + 1)),
            dice=overlap,
            hausdorff=1 / overlap,
            distances=torch.full((1, landmarks), distance, dtype=torch.float64),
        )

    return Evaluation(measures(0.4, 9.0), measures(0.5, 4.0), measures(0.8, 1.5))
