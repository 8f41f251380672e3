"""Maps stay without folds: the guard finds how far a move may go, the repair opens what is folded and nothing else."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pictures import bend
from torch import Tensor

from torchdeform.core.diagnostics import diagnose
from torchdeform.core.fold_free import largest_share, lowest_determinant, repair_folds, smooth_elastically
from torchdeform.core.grid import Grid
from torchdeform.errors import ComputationError


def stays_on_faces(u: Tensor) -> bool:
    dim = u.dim() - 2
    return all(not u[:, k].select(k + 1, end).any() for k in range(dim) for end in (0, -1))


@given(st.lists(st.floats(0.0, 1.2), min_size=1, max_size=5), st.integers(0, 8))
def test_the_guard_halves_until_a_move_is_accepted(limits, halvings):
    """Of limits at random: the first of 1, 1/2, .. below, else 0; the last look shows all that was accepted."""
    limit, seen = torch.tensor(limits, dtype=torch.float64), []

    def accept(share: Tensor) -> Tensor:
        seen.append(share)
        return share <= limit

    found = largest_share(accept, limit, halvings=halvings)
    options = [0.5**k for k in range(halvings + 1)]
    assert found.tolist() == [next((s for s in options if s <= one), 0.0) for one in limit.tolist()]
    good = found > 0
    assert torch.equal(seen[-1][good], found[good])
    assert len(seen) <= halvings + 1


@given(st.lists(st.floats(0.0, 1.2), min_size=1, max_size=5), st.integers(1, 8))
def test_the_guard_refines_by_bisection(limits, halvings):
    limit = torch.tensor(limits, dtype=torch.float64)
    found = largest_share(lambda share: share <= limit, limit, halvings=halvings, refine=True)
    unit = 0.5**halvings
    wanted = [1.0 if one >= 1 else math.floor(one / unit) * unit for one in limit.tolist()]
    assert found.tolist() == wanted


def test_what_is_not_finite_is_never_accepted():
    share = largest_share(lambda t: t * math.nan >= 0, torch.ones(2), halvings=5)
    assert share.tolist() == [0.0, 0.0]


def folded(shape: tuple[int, ...]) -> Tensor:
    """A gentle map with one node out of place."""
    u = bend(Grid(shape), 2.0)
    u[(0, slice(None), *(n // 2 for n in shape))] += 3.0
    return u


@pytest.mark.parametrize("shape", [(20, 24), (14, 16, 12)])
def test_repair_opens_folds_and_leaves_the_rest_alone(shape):
    grid, u = Grid(shape), folded(shape)
    assert (lowest_determinant(u, grid) < 0).any()
    both = repair_folds(torch.cat([u, bend(grid, 2.0)]), grid, 0.03)
    assert (lowest_determinant(both, grid) > 0.03).all()
    changed = ((both[:1] - u).abs() > 0).any(1)
    assert changed.sum() < 9**grid.dim
    assert torch.equal(both[1:], bend(grid, 2.0))
    edge = torch.zeros(1, grid.dim, *shape)
    edge[(0, slice(1, None), 0, *(n // 2 for n in shape[1:]))] = 3.0  # along the face, which it must not leave
    flat = repair_folds(edge, grid)
    assert (lowest_determinant(flat, grid) > 0).all()
    assert (flat[:, 0, 0] == 0).all()


def test_folds_are_removed_where_they_are_and_nowhere_else():
    grid = Grid((40, 40))
    u = torch.zeros(2, 2, 40, 40, dtype=torch.float64)
    u[0, 0, 20, 20] = 3.0
    assert diagnose(u, grid).folds.tolist()[0] > 0
    clean = repair_folds(u, grid)
    assert diagnose(clean, grid).diffeomorphic.all()
    assert torch.equal(clean[1], u[1])
    assert not clean[0, :, :10].any()
    assert not clean[0, :, :, 30:].any()
    assert stays_on_faces(clean)


@pytest.mark.parametrize("grid", [Grid((9, 12), (0.5, 1.0)), Grid((7, 6, 8), (1.0, 0.5, 2.0))])
def test_any_displacement_is_unfolded(grid):
    u = torch.randn(1, grid.dim, *grid.shape, dtype=torch.float64, generator=torch.manual_seed(0)) * 3
    for k in range(grid.dim):
        for end in (0, -1):
            u[:, k].select(k + 1, end).zero_()
    clean = repair_folds(u, grid)
    assert diagnose(clean, grid).diffeomorphic.all()
    assert stays_on_faces(clean)


def test_a_map_that_is_not_finite_is_an_error():
    grid = Grid((6, 6))
    with pytest.raises(ComputationError, match="the map is not finite"):
        repair_folds(torch.full((1, 2, 6, 6), math.nan), grid)


def test_the_floor_is_given_up_where_only_no_folds_can_be_had():
    """Cells that are squeezed along the whole box cannot reach a floor of 0.9, but they do not fold."""
    grid = Grid((8, 9))
    u = torch.zeros(1, 2, 8, 9)
    u[:, 0] = torch.linspace(0, 1, 8).square().sub(torch.linspace(0, 1, 8)).mul(3).view(1, 8, 1)
    lowest = float(lowest_determinant(u, grid).min())
    assert 0 < lowest < 0.9
    assert float(lowest_determinant(repair_folds(u, grid, 0.9), grid).min()) > 0


@pytest.mark.parametrize("shape", [(12, 14), (9, 10, 11)])
def test_a_displacement_is_smoothed_as_heat_spreads(shape):
    grid, share = Grid(shape), torch.tensor([0.1, 0.0], dtype=torch.float64)
    sides = [n - 1 for n in shape]
    phase = torch.pi * grid.points(dtype=torch.float64)[0] / torch.tensor(sides).view(-1, *[1] * len(shape))
    sine, cosine = phase.sin(), phase.cos()  # sin along the own axis, so that the faces stay, cos along the others
    axes = range(len(shape))
    u = torch.stack([torch.stack([sine[b] if b == a else cosine[b] for b in axes]).prod(0) for a in axes]).expand(
        2, *[-1] * (len(shape) + 1)
    )
    factor = math.prod((1 + math.cos(math.pi / side)) / 2 for side in sides)  # of the kernel 1, 2, 1 for these waves
    expected = torch.stack([(1 - 0.1 * (1 - factor)) * u[0], u[1]])
    torch.testing.assert_close(smooth_elastically(u, share, grid), expected)
    assert torch.equal(smooth_elastically(u[1:], share[1:], grid), u[1:])
