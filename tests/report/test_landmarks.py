"""Landmarks: they are drawn where their images are, and as far apart as the tables say."""

from dataclasses import replace

import pytest
import torch

from torchdeform.core.transform import Affine
from torchdeform.metrics.evaluation import evaluate_images
from torchdeform.registration.annotations import Annotations
from torchdeform.report.landmarks import landmarks_of


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("aligned", [False, True])
def test_arrows_end_where_the_map_takes_the_points(make_image, make_result, dim, aligned):
    """Moving landmarks made by the map itself arrive at the fixed ones; distances are those of the evaluation."""
    fixed = make_image((24, 26, 28)[-dim:], (1.0, 0.8, 1.2)[-dim:], tilted=True)
    turn = Affine(torch.eye(dim, dtype=torch.float64) * 1.1, torch.full((dim,), 2.0, dtype=torch.float64))
    result = replace(make_result(fixed, fixed), affine=turn if aligned else None)
    nodes = torch.rand(1, dim, 6, dtype=torch.float64) * 10 + 6
    here = fixed.to_world(nodes)
    there = evaluated = here.clone()
    moved = landmarks_of(fixed, result, Annotations(fixed_points=here, moving_points=there))
    assert moved is not None
    found = evaluate_images(fixed, result.affine, result.displacement, points=(here, evaluated))
    assert found is not None
    for stage, measures in {"original": found.before, "moving": found.aligned, "warped": found.after}.items():
        if measures is not None:
            torch.testing.assert_close(moved.distances[stage], measures.distances[0], atol=1e-4, rtol=1e-4)
    spacing = torch.tensor(fixed.grid.spacing, dtype=torch.float64)
    torch.testing.assert_close(moved.fixed, nodes[0].T / spacing)
    from torchdeform.core.transform import Transform

    whole = Transform.from_displacement(result.displacement, fixed, inverse=result.inverse, affine=result.affine)
    exact = landmarks_of(fixed, result, Annotations(fixed_points=here, moving_points=whole.points(here)))
    assert exact is not None
    torch.testing.assert_close(exact.moved["warped"], exact.fixed, atol=0.05, rtol=0)
    assert float(exact.distances["warped"].max()) < 1e-4
    assert landmarks_of(fixed, result, Annotations()) is None
