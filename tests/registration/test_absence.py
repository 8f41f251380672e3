"""What only one image shows: it is found, let go of, and the map is carried through; what both show is kept."""

import pytest
import torch
from nested_settings import settings_of
from pictures import bend, blobs, disc
from torch import Tensor

from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.warp import warp
from torchdeform.registration.absence import absent_regions, let_go
from torchdeform.registration.deformable import register
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.settings import RegistrationSettings

SETTINGS = settings_of(steps=(30, 20, 10))
SHAPES = [(120, 112), (64, 60, 56)]


def head(shape: tuple[int, ...], seed: int = 1) -> Tensor:
    """Tissue with texture in a ball, nothing around it."""
    texture = blobs(shape, seed)
    texture = 0.3 + 0.7 * (texture - texture.min()) / (texture.max() - texture.min())
    return texture * disc(shape, tuple((n - 1) / 2 for n in shape), 0.42 * min(shape))


def hole(shape: tuple[int, ...]) -> Tensor:
    """A tenth of the head, away from its middle."""
    share = 0.1 ** (1 / len(shape))
    centre = tuple((n - 1) / 2 + 0.1 * n * (-1) ** k for k, n in enumerate(shape))
    return disc(shape, centre, 0.42 * min(shape) * share)


def problem_of(fixed: Tensor, moving: Tensor) -> RegistrationProblem:
    return RegistrationProblem(Grid(tuple(fixed.shape[2:])), fixed, moving)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("side", [0, 1])
def test_a_hole_is_found_in_the_image_that_has_it(shape, side):
    whole, cut = head(shape), hole(shape)
    images = [whole, whole]
    images[side] = whole * (1 - cut)
    found = absent_regions(problem_of(*images))
    assert not found[1 - side].any()
    overlap = 2 * (found[side] * cut).sum() / (found[side] + cut).sum()
    assert overlap > 0.95


@pytest.mark.parametrize("shape", SHAPES)
def test_nothing_is_let_go_where_both_show_something(shape):
    grid, whole = Grid(shape), head(shape)
    narrow = disc(shape, tuple(n / 2 for n in shape), 0.03 * min(shape))  # such as a vessel, which a map can close
    for other in (whole, warp(whole, bend(grid, 3.0), grid), head(shape, 2), whole * (1 - narrow), whole + 0.2):
        problem = problem_of(whole, other)
        same, regions = let_go(problem, RegistrationSettings())
        assert regions is None
        assert same is problem


def test_images_of_different_things_are_not_let_go_as_a_whole():
    left, right = (disc((96, 96), (48, 48 + s), 22.0) * (0.5 + 0.1 * blobs((96, 96), 3)) for s in (-22, 22))
    assert let_go(problem_of(left, right), RegistrationSettings())[1] is None


@pytest.mark.parametrize("shape", SHAPES)
def test_what_is_displaced_is_not_absent(shape):
    """One image is empty on one side, the other on the other side: that is motion, which the map has to find."""
    whole = head(shape)
    moved = whole.roll(tuple(n // 8 for n in shape), tuple(range(2, 2 + len(shape))))
    assert let_go(problem_of(whole, moved), RegistrationSettings())[1] is None


def test_tissue_full_of_small_holes_is_not_absent():
    """As that of lungs: most of its pixels are as empty as the background, but no place is."""
    shape = (240, 240)
    region = disc(shape, (120, 120), 90.0)
    generator = torch.Generator().manual_seed(3)
    walls = (torch.rand(1, 1, *shape, generator=generator) > 0.7).float()
    solid = region * (0.5 + 0.1 * blobs(shape, 2))
    assert let_go(problem_of(region * walls, solid), RegistrationSettings())[1] is None


def test_each_item_of_a_batch_has_its_own_region():
    whole, cut = head((120, 112)), hole((120, 112))
    found = absent_regions(problem_of(torch.cat([whole, whole * (1 - cut)]), torch.cat([whole, whole])))
    assert not found[0][0].any()
    assert found[0][1].any()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("side", ["fixed", "moving", "symmetric"])
def test_a_resection_does_not_tear_the_map(shape, side):
    """The map outside of it is as without it; with ``absent: off`` it is not."""
    grid, moving, cut = Grid(shape), head(shape), hole(shape)
    truth = bend(grid, 3.0)
    fixed = warp(moving, truth, grid)
    cut_fixed, cut_moving = (fixed, moving * (1 - cut)) if side == "moving" else (fixed * (1 - cut), moving)
    settings = settings_of(steps=(30, 20, 10), symmetric=side == "symmetric")
    result = register(cut_fixed, cut_moving, settings)
    where = warp(cut, truth, grid) if side == "moving" else cut
    pool = torch.nn.functional.max_pool2d if grid.dim == 2 else torch.nn.functional.max_pool3d
    outside = (pool(where, 7, 1, 3) < 0.01) & (fixed > 0)
    det, true = jacobian_determinant(result.displacement, grid), jacobian_determinant(truth, grid)
    rough = settings_of(steps=(30, 20, 10), symmetric=side == "symmetric", absent="off")
    plain = jacobian_determinant(register(cut_fixed, cut_moving, rough).displacement, grid)
    within = [((d / true > 0.7) & (d / true < 1.4))[outside].double().mean().item() for d in (det, plain)]
    assert within[0] > 0.99
    assert within[0] > within[1]
    whole = register(fixed, moving, settings)
    errors = [(one.displacement - truth).norm(dim=1, keepdim=True)[outside].mean() for one in (result, whole)]
    assert errors[0] < errors[1] + 0.3
    assert (result.absent * where).sum() > 0.9 * where.sum()
    assert result.diagnosis.folds.item() == 0
