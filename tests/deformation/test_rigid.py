"""Labels that stay rigid: the best motion against scipy, exactly on the label, nothing far away, nothing folded."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled import ball, smooth_map, turned
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchdeform.core.derivatives import curl, jacobian_determinant
from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.core.regions import grown, nearest
from torchdeform.deformation.rigid import RigidHold, fit_rigid, hold_rigid
from torchdeform.deformation.tissue import label_fit
from torchdeform.errors import InputError

UNTIMED = settings(deadline=None, max_examples=25)


GRIDS = [Grid((48, 40), (1.0, 0.8)), Grid((30, 32, 28), (1.5, 1.0, 0.7))]


@pytest.mark.parametrize("seed", range(3))
def test_the_motion_is_the_one_that_scipy_finds(seed):
    rng = np.random.default_rng(seed)
    points, weights = rng.normal(size=(3, 40)) * 20 + 100, rng.uniform(0, 1, 40)
    turn = Rotation.random(random_state=seed).as_matrix()
    moved = turn @ points + rng.normal(size=(3, 40)) + 7
    motion = fit_rigid(*(torch.from_numpy(a) for a in (points, moved[None], weights[None])))
    before, after = (p - np.average(p, axis=1, weights=weights)[:, None] for p in (points, moved))
    want, _ = Rotation.align_vectors(after.T, before.T, weights=weights)
    np.testing.assert_allclose(motion.turn[0] + torch.eye(3), want.as_matrix(), atol=1e-8)
    np.testing.assert_allclose(motion.end[0], np.average(moved, axis=1, weights=weights))


@pytest.mark.parametrize(
    "points",
    [[[5.0], [3.0], [2.0]], [[0.0, 1, 2], [0, 0, 0], [0, 0, 0]], [[0.0, 1, 0, 1], [0, 0, 1, 1], [0, 0, 0, 0]]],
    ids=["point", "line", "plane"],
)
def test_what_points_leave_open_is_no_turn(points):
    x = torch.tensor(points, dtype=torch.float64)
    shift = torch.tensor([[1.0], [-2.0], [0.5]], dtype=torch.float64)
    motion = fit_rigid(x, (x + shift).unsqueeze(0), torch.ones(1, x.shape[1]))
    assert float(motion.turn.abs().max()) < 1e-9
    torch.testing.assert_close(motion.at(x), shift.expand_as(x).unsqueeze(0))


def test_a_reflection_is_no_motion():
    x = torch.randn(3, 30, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    motion = fit_rigid(x, (x * torch.tensor([[-1.0], [1.0], [1.0]])).unsqueeze(0), torch.ones(1, 30))
    torch.testing.assert_close((motion.turn[0] + torch.eye(3)).det(), torch.tensor(1.0, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("grid", GRIDS)
def test_a_label_becomes_rigid_and_its_neighbours_with_it(grid, dtype):
    inside = ball(grid, (0.5,) * grid.dim, 7)
    u = turned(grid, inside, 0.15, smooth_map(grid, 0.5)).to(dtype)
    held = hold_rigid(u, inside, grid)
    assert held.dtype == dtype
    exact = 2e-5 if dtype == torch.float32 else 1e-9
    before, after = label_fit(u, inside, grid), label_fit(held, inside, grid)
    assert float(before.rigid) > 0.2
    assert float(after.rigid) < exact
    assert float(after.determinant) < exact
    assert float(after.volume) == pytest.approx(1, abs=exact)
    # The curl of a rigid motion is the same at every node of the label: its differences are taken from outside too.
    turning = curl(held, grid)[:, :, inside[0, 0]]
    assert float((turning - turning.mean(2, keepdim=True)).abs().max()) < 10 * exact
    assert int(diagnose(held, grid).folds) == 0
    far = nearest(inside, 18)[0] > 17.8**2
    assert torch.equal(held.masked_select(far), u.masked_select(far))


def test_a_small_change_stays_near():
    grid = GRIDS[0]
    inside = ball(grid, (0.5, 0.5), 7)
    u = smooth_map(grid, 0.05)
    changed = (hold_rigid(u, inside, grid) != u).any(1, keepdim=True)
    assert not bool((changed & (nearest(grown(inside), 4)[0] > 4.1**2)).any())


def test_what_is_rigid_is_left():
    grid = GRIDS[1]
    inside = ball(grid, (0.5,) * 3, 6)
    held = hold_rigid(turned(grid, inside, 0.2, torch.zeros(1, 3, *grid.shape, dtype=torch.float64)), inside, grid)
    assert float((RigidHold(inside, grid)(held) - held).abs().max()) < 1e-9


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("gap", [0, 1, 2, 5])
def test_labels_side_by_side_are_each_rigid(grid, gap):
    n = grid.shape[-1]
    column = torch.arange(n)
    slab = ball(grid, (0.5,) * grid.dim, 9)
    one, two = slab & (column < n // 2), slab & (column >= n // 2 + gap)
    labels = torch.cat([one, two], dim=1)
    u = turned(grid, one, 0.04, smooth_map(grid, 0.12))
    held = hold_rigid(u, labels, grid)
    for label in (one, two):
        assert float(label_fit(u, label, grid).rigid) > 0.02
        assert float(label_fit(held, label, grid).rigid) < 1e-9
    assert int(diagnose(held, grid).folds) == 0


def test_bones_that_turn_against_each_other():
    grid = Grid((96, 96))
    bones = torch.cat([ball(grid, (0.35, 0.5), 9), ball(grid, (0.65, 0.5), 9)], dim=1)
    u = turned(grid, bones[:, :1], math.radians(20), torch.zeros(1, 2, 96, 96, dtype=torch.float64), 5)
    u = turned(grid, bones[:, 1:], math.radians(-10), u, 5)
    hold = RigidHold(bones, grid)
    held = hold(u)
    angles = [float(torch.atan2(m.turn[0, 1, 0], 1 + m.turn[0, 0, 0])) for m in hold.fit(held)]
    assert angles == pytest.approx([math.radians(20), math.radians(-10)], abs=0.02)
    assert max(float(label_fit(held, bone, grid).rigid) for bone in bones.split(1, 1)) < 1e-9
    assert int(diagnose(held, grid).folds) == 0


@pytest.mark.parametrize("grid", GRIDS)
def test_faces_that_a_label_does_not_touch_stay(grid):
    centre = (5 / (grid.shape[0] - 1), *(0.5,) * (grid.dim - 1))
    inside = ball(grid, centre, 4.1)
    assert not bool(inside[:, :, 0].any())
    assert bool(inside[:, :, 1].any())
    u = smooth_map(grid, 0.3)
    held = hold_rigid(u, inside, grid)
    for k, axis in enumerate(grid.axes):
        for side in (0, -1):
            assert torch.equal(held[:, k].select(axis - 1, side), u[:, k].select(axis - 1, side))
    assert float(label_fit(held, inside, grid).rigid) < 1e-9
    assert int(diagnose(held, grid).folds) == 0


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("angle", [-0.2, 0.2])
def test_a_label_at_a_face_moves_into_the_box_and_never_out(grid, angle):
    inside = ball(grid, (0.5,) * (grid.dim - 1) + (0.0,), 8)
    u = turned(grid, inside, angle, torch.zeros(1, grid.dim, *grid.shape, dtype=torch.float64), 7)
    u[:, -1] *= (torch.arange(grid.shape[-1]) / 7).clamp(max=1)  # as flows do, it keeps the face
    u = u + smooth_map(grid, 0.1)
    held = hold_rigid(u, inside, grid)
    x = grid.points(dtype=torch.float64) + held
    side = grid.along(grid.extent, x)
    assert bool((x >= -1e-12).all())
    assert bool((x <= side + 1e-12).all())
    assert int(diagnose(held, grid).folds) == 0
    motion = RigidHold(inside, grid).fit(u)[0]
    points = grid.points(dtype=torch.float64)[0, :, inside[0, 0]]
    place = points + motion.at(points)[0]
    free = place[-1] >= 0.2 * points[-1]  # these may go where the motion takes them
    off = (held[0][:, inside[0, 0]] + points - place)[:, free]
    assert bool(free.any())
    assert float(off.abs().max()) < 1e-9


def test_a_batch_equals_its_items_one_by_one():
    grid = GRIDS[0]
    one, two = ball(grid, (0.4, 0.4), 6), ball(grid, (0.6, 0.6), 4)
    labels = torch.cat([torch.cat([one, two], 1), torch.cat([two, torch.zeros_like(one)], 1)])
    u = torch.cat([turned(grid, one, 0.4, smooth_map(grid, 0.3, 1)), smooth_map(grid, 0.1, 2)])
    together = RigidHold(labels, grid)(u)
    alone = [hold_rigid(u[i : i + 1], labels[i : i + 1], grid) for i in range(2)]
    torch.testing.assert_close(together, torch.cat(alone), rtol=0, atol=1e-12)
    shared = RigidHold(labels[:1], grid)(u)
    torch.testing.assert_close(shared[1:], hold_rigid(u[1:], labels[:1], grid), rtol=0, atol=1e-12)


def test_without_a_label_nothing_happens():
    grid = GRIDS[0]
    u = smooth_map(grid, 0.3)
    assert hold_rigid(u, torch.zeros(1, 2, *grid.shape, dtype=torch.bool), grid) is u


def test_where_no_width_will_do_the_best_is_returned():
    grid = GRIDS[0]
    one, two = ball(grid, (0.4, 0.5), 4), ball(grid, (0.6, 0.5), 4)
    u = torch.zeros(1, 2, *grid.shape, dtype=torch.float64)
    u[:, :1] = 6.0 * one - 6.0 * two  # into each other
    held = hold_rigid(u, torch.cat([one, two], 1), grid)
    assert max(float(label_fit(held, label, grid).rigid) for label in (one, two)) < 1e-9
    assert int(diagnose(held, grid).folds) > 0


@given(st.integers(0, 99), st.floats(0.0, 0.4), st.sampled_from((0.05, 0.3)))
@UNTIMED
def test_scattered_labels_are_rigid_however_they_lie(seed, size, share):
    grid = Grid((17, 14), (1.0, 1.7))
    noise = torch.rand(1, 1, *grid.shape, generator=torch.Generator().manual_seed(seed))
    inside = noise < share
    held = hold_rigid(smooth_map(grid, size, seed), inside, grid)
    motion = RigidHold(inside, grid).fit(smooth_map(grid, size, seed))
    x = grid.points(dtype=torch.float64)[0, :, inside[0, 0]]
    if inside.any() and bool((x + motion[0].at(x)[0] >= 0.2 * x).all()):
        assert float(label_fit(held, inside, grid).rigid) < 1e-9 or bool(_at_faces(inside, grid).any())


def _at_faces(inside: Tensor, grid: Grid) -> Tensor:
    return torch.stack([inside.select(axis, side).any() for axis in grid.axes for side in (0, -1)])


def test_gradients_take_the_motion_for_a_constant():
    grid = GRIDS[0]
    inside = ball(grid, (0.5, 0.5), 7)
    u = smooth_map(grid, 0.1).requires_grad_()
    held = hold_rigid(u, inside, grid)
    (label,) = torch.autograd.grad(held.masked_select(inside).sum(), u, retain_graph=True)
    assert float(label.abs().max()) < 1e-9
    (far,) = torch.autograd.grad(held[..., 0].sum(), u)
    assert bool((far[..., 0] == 1).all())


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        (torch.ones(1, 1, 48, 40), "RigidHold: inside must be bool"),
        (torch.ones(1, 1, 40, 48, dtype=torch.bool), r"of shape \(B, L, 48, 40\)"),
    ],
)
def test_wrong_labels_are_refused(inside, message):
    with pytest.raises(InputError, match=message):
        RigidHold(inside, GRIDS[0])


def test_a_wrong_map_is_refused():
    with pytest.raises(InputError, match="RigidHold: u must have shape"):
        hold_rigid(torch.zeros(1, 3, 48, 40), torch.ones(1, 1, 48, 40, dtype=torch.bool), GRIDS[0])


def test_the_determinant_on_a_held_label_is_one_by_other_means():
    """Volumes of the cells of a label as polygons, by the shoelace formula."""
    grid = GRIDS[0]
    inside = ball(grid, (0.5, 0.5), 7)
    held = hold_rigid(smooth_map(grid, 0.3), inside, grid)
    phi = (grid.points(dtype=torch.float64) + held)[0].numpy()
    for i, j in torch.nonzero(inside[0, 0])[:20].tolist():
        corners = phi[:, [i, i + 1, i + 1, i], [j, j, j + 1, j + 1]]
        x, y = corners
        area = 0.5 * abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))
        assert area == pytest.approx(grid.cell_volume, rel=1e-9)
    assert float((jacobian_determinant(held, grid) - 1).abs().masked_select(inside).max()) < 1e-9
