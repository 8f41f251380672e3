"""The search along slopes: several maps at once go as each alone."""

import torch
from affine_pairs import make_objective

from torchdeform.registration.affine.bfgs import maximise
from torchdeform.registration.affine.lie import exponential, generators


def test_several_maps_go_as_each_alone():
    level, moves = make_objective(2), generators("affine", 2)
    starts = exponential(0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(2)).double(), moves)
    maps, values = maximise(level, starts, moves, steps=8)
    for k in range(3):
        alone, value = maximise(level, starts[k : k + 1], moves, steps=8)
        torch.testing.assert_close(maps[k], alone[0], atol=1e-8, rtol=0)
        torch.testing.assert_close(values[k], value[0])
