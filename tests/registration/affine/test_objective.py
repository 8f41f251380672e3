"""The similarity as a function of the affine map: its slope."""

import pytest
import torch
from affine_pairs import make_objective

from torchdeform.registration.affine.lie import exponential, generators


@pytest.mark.parametrize("similarity", ["ncc", "ssd", "lncc", "detail"])
@pytest.mark.parametrize("dim", [2, 3])
def test_slope_is_that_of_differences(dim, similarity):
    """Up to the interpolated derivative of the moving image, and weights at its edge that count as constant."""
    level, moves = make_objective(dim, similarity), generators("affine", dim)
    start = exponential(torch.full((1, len(moves)), 0.03, dtype=torch.float64), moves)
    slope = torch.einsum("bij,pij->p", level.evaluate(start)[1], moves)
    steps = 1e-3 * torch.eye(len(moves), dtype=torch.float64)
    values = [level.values(start @ exponential(sign * steps, moves))[0] for sign in (1, -1)]
    expected = (values[0] - values[1]) / 2e-3
    assert (slope - expected).norm() < 0.15 * expected.norm()
