"""Constant forms as sums of Kronecker products of one-dimensional matrices."""

import pytest
import torch
from forms import DEVICES, close, element_values, random_field
from rounding import assert_same_to_rounding
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.fem import quadrature
from torchdeform.fem.assembly import assemble
from torchdeform.fem.elements import INTERVAL
from torchdeform.fem.form import div_curl_form
from torchdeform.fem.operator import apply_form
from torchdeform.fem.weights import Weights


def test_the_matrix_is_a_sum_of_kronecker_products():
    grid, (div, curl, zero) = Grid((3, 4, 5), (0.7, 1.0, 1.4)), (0.2, 4.0, 0.6)

    def chain(axis: int, test: bool, trial: bool, centre: bool) -> Tensor:
        local, power = INTERVAL[test, trial, centre and not (test or trial)]
        size, total = grid.shape[axis], torch.zeros(grid.shape[axis], grid.shape[axis], dtype=torch.float64)
        for i in range(size - 1):
            total[i : i + 2, i : i + 2] += torch.tensor(local, dtype=torch.float64) * grid.spacing[axis] ** power
        return total

    def block(test: int | None, trial: int | None, centre: bool = False) -> Tensor:
        product = torch.ones(1, 1, dtype=torch.float64)
        for axis in range(3):
            product = torch.kron(product, chain(axis, test == axis, trial == axis, centre))
        return product

    def turn(test: int | None, trial: int | None) -> Tensor:
        return 2 * div * block(test, trial) + (curl - 2 * div) * block(test, trial, centre=True)

    rows = []
    for k in range(3):
        others = [a for a in range(3) if a != k]
        own = div * block(k, k) + sum(turn(a, a) for a in others) + zero * block(None, None)
        rows.append([own if m == k else div * block(k, m) - turn(m, k) for m in range(3)])
    want = torch.cat([torch.cat(r, dim=1) for r in rows])
    close(assemble(div_curl_form(3, Weights(div, curl, zero)), grid).to_dense(), want)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_batch_gives_its_items(dtype, device, monkeypatch):
    monkeypatch.setattr(quadrature, "_SLAB", 100)
    grid = Grid((7, 7, 6), (0.7, 1.0, 1.4))
    v, varying = random_field(grid, batch=3).to(device, dtype), element_values(grid, batch=3).to(device, dtype)
    for weights in (Weights(2.0, 0.5, 0.1), Weights(varying, 2.0, 0.1), Weights(varying[:, :, :1, :1, :1], 2.0)):
        together = apply_form(div_curl_form(3, weights), v, grid)
        for i in range(3):
            alone = weights.with_tensors(tuple(w[i : i + 1] for w in weights.tensors))
            one, want = together[i : i + 1], apply_form(div_curl_form(3, alone), v[i : i + 1], grid)
            if not weights.tensors:
                assert torch.equal(one, want)  # no product of matrices: every node is computed alike
            # Components, corners of an element, its points, elements at a node.
            assert_same_to_rounding(one, want, terms=3 * 8 * 8 * 8)
