"""Alignment: known maps are found again, in any frame; its derivative against differences; what it refuses."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine
from torchdeform.errors import InputError
from torchdeform.metrics.correlation import DetailCorrelation
from torchdeform.metrics.similarity import make_similarity
from torchdeform.registration.affine.align import AlignmentSettings, affine_warp, align
from torchdeform.registration.affine.bfgs import climb
from torchdeform.registration.affine.lie import angle, exponential, generators, homogeneous, rotations
from torchdeform.registration.affine.objective import Frame, Level, Masked
from torchdeform.registration.affine.search import body, make_starts
from torchdeform.registration.settings import ALIGNMENTS

TILTED = {
    2: ((math.cos(0.4), -math.sin(0.4)), (math.sin(0.4), math.cos(0.4))),
    3: ((0.936293363584, -0.275095847318, 0.218350663146),
        (0.289629477625, 0.956425085849, -0.036957013525),
        (-0.198669330795, 0.097843395007, 0.975170327202)),
}  # fmt: skip
SHAPES = {2: ((60, 76), (84, 68)), 3: ((32, 40, 48), (40, 44, 50))}
SPACINGS = {2: ((1.4, 1.2), (1.2, 1.3)), 3: ((2.0, 1.6, 1.4), (1.6, 1.7, 1.5))}
SIDES = (60.0, 44.0, 36.0)


def scene(world: Tensor, count: int = 14) -> Tensor:
    """A value for every world point: blobs of different width and height near the origin, no two places alike."""
    random = torch.Generator().manual_seed(0)
    dim = world.shape[1]
    centres = (torch.rand(count, dim, generator=random, dtype=torch.float64) - 0.5) * torch.tensor(SIDES[:dim])
    widths = 5 + 5 * torch.rand(count, generator=random, dtype=torch.float64)
    heights = 50 + 150 * torch.rand(count, generator=random, dtype=torch.float64)
    total = torch.zeros_like(world[:, :1])
    for centre, width, height in zip(centres, widths, heights, strict=True):
        away = (world - centre.view(1, -1, *([1] * (world.dim() - 2)))).square().sum(1, keepdim=True)
        total += height * torch.exp(-away / (2 * width**2))
    return total


def empty(shape, spacing, *, centre=None, tilted=False) -> Image:
    """An image whose box has its middle at ``centre``."""
    grid = Grid(shape, spacing)
    image = Image(torch.zeros(1, 1, *shape), grid, (), TILTED[len(shape)] if tilted else ())
    middle = image.to_world(torch.tensor(grid.extent, dtype=torch.float64).view(1, -1, 1) / 2).flatten()
    target = torch.zeros(len(shape)) if centre is None else torch.as_tensor(centre)
    return replace(image, origin=tuple((target - middle).tolist()))


def picture(place: Image, through: Affine | None = None) -> Image:
    """The scene on the grid of ``place``, each world point being taken through a map first."""
    world = place.to_world(place.grid.points(dtype=torch.float64))
    return replace(place, data=scene(world if through is None else through(world)).float())


def make_pair(true: Affine, *, follow: bool = False, finer: float = 1.0) -> tuple[Image, Image]:
    """Two images with moving(true(x)) = fixed(x), on grids that have nothing in common."""
    dim = len(true.offset)
    (first, second), (wide, other) = SHAPES[dim], SPACINGS[dim]
    fixed = picture(empty(first, wide, tilted=True))
    other = tuple(h * finer for h in other)
    return fixed, picture(empty(second, other, centre=true.offset if follow else None), true.inverse())


def turn(dim: int, degrees: float) -> Tensor:
    axis = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64) / math.sqrt(14)
    a, b, c = (math.radians(degrees) * axis).tolist()
    spin = {2: [[0.0, -math.radians(degrees)], [math.radians(degrees), 0.0]], 3: [[0, -c, b], [c, 0, -a], [-b, a, 0]]}
    return torch.matrix_exp(torch.tensor(spin[dim], dtype=torch.float64))


def make_true(linear: Tensor, *shift: float) -> Affine:
    offset = torch.tensor((shift or (3.0, -4.0, 2.0))[: len(linear)], dtype=torch.float64)
    return Affine(linear, offset)


def distance(found: Affine, true: Affine, fixed: Image) -> float:
    """Mean distance of both maps over the fixed grid, in its smallest voxels."""
    world = fixed.to_world(fixed.grid.points(dtype=torch.float64))
    return float((found(world) - true(world)).norm(dim=1).mean()) / min(fixed.grid.spacing)


SHEARED = {dim: torch.eye(dim, dtype=torch.float64).index_put((torch.tensor([0]), torch.tensor([1])), torch.tensor(0.3,
           dtype=torch.float64)) for dim in (2, 3)}  # fmt: skip


@pytest.mark.parametrize(
    ("dim", "kind", "degrees"),
    [(2, "rigid", 170), (2, "rigid", -100), (2, "affine", 45), (2, "affine", 170), (3, "rigid", 60), (3, "affine", 40)],
)
def test_rotations_are_found(dim, kind, degrees):
    true = make_true(turn(dim, degrees))
    fixed, moving = make_pair(true)
    found = align(fixed, moving, kind)
    assert distance(found.affine, true, fixed) < 0.1
    assert found.warnings == ()
    assert found.similarity_after > found.similarity_before


@pytest.mark.parametrize("dim", [2, 3])
def test_shear_and_rotation_are_found(dim):
    true = make_true(SHEARED[dim] @ turn(dim, 25))
    fixed, moving = make_pair(true)
    assert distance(align(fixed, moving).affine, true, fixed) < 0.1


@pytest.mark.parametrize("scale", [0.7, 1.4])
@pytest.mark.parametrize("dim", [2, 3])
def test_scales_are_found(dim, scale):
    true = make_true(scale * turn(dim, 15))
    fixed, moving = make_pair(true, finer=scale)
    assert distance(align(fixed, moving, "similarity").affine, true, fixed) < 0.1


@pytest.mark.parametrize("kind", ["translation", "rigid"])
@pytest.mark.parametrize("dim", [2, 3])
def test_shifts_by_half_an_image_are_found(dim, kind):
    true = make_true(torch.eye(dim, dtype=torch.float64), 45.0, -36.0, 30.0)
    fixed, moving = make_pair(true, follow=True)
    assert distance(align(fixed, moving, kind).affine, true, fixed) < 0.1


@pytest.mark.parametrize("similarity", ["ssd", "ncc", "mi", "nmi", {"lncc": 1.0, "ncc": 1.0}])
def test_other_similarities_find_it_too(similarity):
    true = make_true(turn(2, 20))
    fixed, moving = make_pair(true)
    found = align(fixed, moving, "rigid", settings=AlignmentSettings(similarity=similarity))
    assert distance(found.affine, true, fixed) < 0.5


@pytest.mark.parametrize("similarity", ["lncc", "nmi"])
def test_another_contrast_is_no_obstacle(similarity):
    true = make_true(turn(2, 20))
    fixed, moving = make_pair(true)
    moving = replace(moving, data=500 - moving.data)
    found = align(fixed, moving, "rigid", settings=AlignmentSettings(similarity=similarity))
    assert distance(found.affine, true, fixed) < 0.5


def reoriented(image: Image) -> Image:
    """The same image in the same place, its first axis reversed and its first and last axis swapped in the file."""
    grid, dim = image.grid, image.grid.dim
    order = [dim - 1, *range(1, dim - 1), 0]
    end = torch.zeros(1, dim, 1, dtype=torch.float64)
    end[0, 0, 0] = grid.extent[0]
    columns = torch.tensor(image.direction, dtype=torch.float64).flip(1)  # in array order
    columns[:, 0] *= -1
    columns = columns[:, order].flip(1)
    data = image.data.flip(2).permute(0, 1, *(2 + a for a in order)).contiguous()
    shape, spacing = (tuple(v[a] for a in order) for v in (grid.shape, grid.spacing))
    origin = tuple(image.to_world(end).flatten().tolist())
    return Image(data, Grid(shape, spacing), origin, tuple(map(tuple, columns.tolist())))


@pytest.mark.parametrize("dim", [2, 3])
def test_the_order_of_axes_in_the_files_does_not_matter(dim):
    true = make_true(turn(dim, 25))
    fixed, moving = make_pair(true)
    world = fixed.to_world(fixed.grid.points(dtype=torch.float64))
    again = reoriented(fixed)
    torch.testing.assert_close(scene(again.to_world(again.grid.points(dtype=torch.float64))).float(), again.data)
    first, second = align(fixed, moving, "rigid"), align(again, reoriented(moving), "rigid")
    assert (first.affine(world) - second.affine(world)).norm(dim=1).max() < 0.05 * min(fixed.grid.spacing)


def test_moving_both_images_in_the_world_moves_the_map_with_them():
    true = make_true(turn(2, 25))
    fixed, moving = make_pair(true)
    away = torch.tensor([1e4, -3e4], dtype=torch.float64)
    shifted = [replace(i, origin=tuple((torch.tensor(i.origin) + away).tolist())) for i in (fixed, moving)]
    first, second = align(fixed, moving, "rigid"), align(*shifted, "rigid")
    expected = Affine(torch.eye(2, dtype=torch.float64), -away).then(first.affine)
    expected = Affine(expected.matrix, expected.offset + away)
    assert distance(second.affine, expected, shifted[0]) < 0.05


def test_the_same_again_is_the_same_to_the_last_bit():
    fixed, moving = make_pair(make_true(turn(2, 60)))
    first, second = align(fixed, moving), align(fixed, moving)
    assert torch.equal(first.affine.matrix, second.affine.matrix)
    assert torch.equal(first.affine.offset, second.affine.offset)


@pytest.mark.parametrize("kind", ALIGNMENTS)
@pytest.mark.parametrize("dim", [2, 3])
def test_each_kind_stays_what_it_is(dim, kind):
    fixed, moving = make_pair(make_true(SHEARED[dim] @ turn(dim, 20)))
    found = align(fixed, moving, kind, settings=AlignmentSettings(steps=5))
    matrix, eye = found.affine.matrix, torch.eye(dim, dtype=torch.float64)
    assert torch.linalg.det(matrix) > 0
    gram = matrix @ matrix.T
    if kind in ("none", "translation"):
        torch.testing.assert_close(matrix, eye)
    if kind == "rigid":
        torch.testing.assert_close(gram, eye, atol=1e-10, rtol=0)
    if kind == "similarity":
        torch.testing.assert_close(gram / gram[0, 0], eye, atol=1e-10, rtol=0)
    if kind == "none":
        assert not found.affine.offset.any()
        assert found.similarity_before == found.similarity_after


@pytest.mark.parametrize("dim", [2, 3])
def test_a_mirror_image_is_told_and_not_taken(dim):
    mirror = torch.eye(dim, dtype=torch.float64)
    mirror[0, 0] = -1
    fixed, moving = make_pair(make_true(turn(dim, 20) @ mirror))
    found = align(fixed, moving)
    assert torch.linalg.det(found.affine.matrix) > 0
    assert any("mirror image" in sentence for sentence in found.warnings)


def test_a_mask_keeps_what_moves_differently_out_of_it():
    """A bright bar lies elsewhere in each image; masks on both sides leave it out."""
    true = make_true(turn(2, 15))
    fixed, moving = make_pair(true)
    pair, masks = [], []
    for image, rows in ((fixed, slice(0, 12)), (moving, slice(60, 84))):
        data, inside = image.data.clone(), torch.ones_like(image.data)
        data[:, :, rows], inside[:, :, rows] = 400.0, 0.0
        pair.append(replace(image, data=data))
        masks.append(replace(image, data=inside))
    settings = AlignmentSettings(similarity="ncc")
    plain = align(*pair, "rigid", settings=settings)
    masked = align(*pair, "rigid", fixed_mask=masks[0], moving_mask=masks[1], settings=settings)
    assert distance(masked.affine, true, fixed) < 0.2
    assert distance(plain.affine, true, fixed) > 1.0


def test_a_mask_on_another_grid_is_taken_in_its_place():
    true = make_true(turn(2, 15))
    fixed, moving = make_pair(true)
    mask = empty((30, 30), (3.0, 3.0))
    mask = replace(mask, data=torch.ones_like(mask.data))
    assert distance(align(fixed, moving, fixed_mask=mask).affine, true, fixed) < 0.2


def test_a_wrong_spacing_is_told():
    fixed, moving = make_pair(make_true(2.6 * torch.eye(2, dtype=torch.float64)))
    moving = picture(empty((84, 68), (3.0, 3.0)), make_true(2.6 * torch.eye(2, dtype=torch.float64)).inverse())
    found = align(fixed, moving, "similarity")
    assert any("check the spacing" in sentence for sentence in found.warnings)


def test_colour_is_aligned_on_its_luminance():
    true = make_true(turn(2, 15))
    fixed, moving = make_pair(true)
    colour = replace(moving, data=moving.data.expand(-1, 3, -1, -1))
    torch.testing.assert_close(
        align(fixed, colour, "rigid").affine.matrix, align(fixed, moving, "rigid").affine.matrix, atol=1e-3, rtol=0
    )


def make_level(dim: int, similarity: str = "ncc") -> Level:
    fixed, moving = make_pair(make_true(turn(dim, 10)))
    weight = torch.rand(fixed.data.shape, generator=torch.Generator().manual_seed(1))
    parts = (
        Masked(replace(fixed, data=fixed.data.double() / 200), weight.double()),
        Masked(replace(moving, data=moving.data.double() / 200)),
    )
    make = {"detail": lambda f, grid: DetailCorrelation(f, 5)}.get(
        similarity, lambda f, grid: make_similarity(similarity, f, 5, grid=grid)
    )
    return Level(*parts, Frame.of(fixed), make, 0.1)


@pytest.mark.parametrize("similarity", ["ncc", "ssd", "lncc", "detail"])
@pytest.mark.parametrize("dim", [2, 3])
def test_slope_is_that_of_differences(dim, similarity):
    """Up to the interpolated derivative of the moving image, and weights at its edge that count as constant."""
    level, moves = make_level(dim, similarity), generators("affine", dim)
    start = exponential(torch.full((1, len(moves)), 0.03, dtype=torch.float64), moves)
    slope = torch.einsum("bij,pij->p", level.evaluate(start)[1], moves)
    steps = 1e-3 * torch.eye(len(moves), dtype=torch.float64)
    values = [level.values(start @ exponential(sign * steps, moves))[0] for sign in (1, -1)]
    expected = (values[0] - values[1]) / 2e-3
    assert (slope - expected).norm() < 0.15 * expected.norm()


def test_several_maps_climb_as_each_alone():
    level, moves = make_level(2), generators("affine", 2)
    starts = exponential(0.1 * torch.randn(3, 6, generator=torch.Generator().manual_seed(2)).double(), moves)
    maps, values = climb(level, starts, moves, steps=8)
    for k in range(3):
        alone, value = climb(level, starts[k : k + 1], moves, steps=8)
        torch.testing.assert_close(maps[k], alone[0], atol=1e-8, rtol=0)
        torch.testing.assert_close(values[k], value[0])


@pytest.mark.parametrize("dim", [2, 3])
def test_rotations_are_a_group_that_leaves_no_gaps(dim):
    every = rotations(dim)
    eye = torch.eye(dim, dtype=torch.float64)
    assert len(every) == {2: 36, 3: 60}[dim]
    torch.testing.assert_close(every[0], eye)
    torch.testing.assert_close(every @ every.transpose(1, 2), eye.expand_as(every))
    assert (torch.linalg.det(every) > 0).all()
    products = (every[:, None] @ every).flatten(0, 1)
    nearest = (products[:, None] - every).flatten(2).norm(dim=2).amin(1)
    assert nearest.max() < 1e-12
    others = torch.linalg.qr(torch.randn(500, dim, dim, generator=torch.Generator().manual_seed(0)).double()).Q
    others[:, :, 0] *= torch.linalg.det(others).view(-1, 1)
    gaps = angle(others[:, None] @ every.transpose(1, 2)).amin(1)
    assert gaps.max() < {2: 5.01, 3: 44.5}[dim]


@pytest.mark.parametrize("dim", [2, 3])
def test_principal_axes_give_the_rotation_of_an_elongated_body(dim):
    parts = []
    for place, back in zip(make_pair(make_true(turn(dim, 50))), (turn(dim, 0), turn(dim, -50)), strict=True):
        own = make_true(back, 0.0, 0.0, 0.0)(place.to_world(place.grid.points(dtype=torch.float64)))
        lengths = place.grid.along((10.0, 6.0, 3.0)[:dim], own)
        parts.append(Masked(place, torch.exp(-(own / lengths).square().sum(1, keepdim=True))))
    frame = Frame.of(parts[0].image)
    starts = make_starts(body(parts[0], frame), body(parts[1], frame), turn=True, scale=False)
    axes = [s.map[:dim, :dim] for s in starts if s.name.startswith("moments")]
    assert len(axes) == 2 ** (dim - 1)
    assert min(float(angle(a @ turn(dim, -50))) for a in axes) < 5


@pytest.mark.parametrize("dim", [2, 3])
def test_affine_warp_differentiates_in_the_map_and_the_image(dim):
    shape = (5, 6, 7)[:dim]
    random = torch.Generator().manual_seed(0)
    pixels = torch.rand(1, 1, *shape, generator=random, dtype=torch.float64, requires_grad=True)
    place = empty(shape, (1.1, 0.9, 1.0)[:dim], tilted=True)
    matrix = (turn(dim, 7) * 0.8).requires_grad_(True)
    offset = torch.full((dim,), 0.123, dtype=torch.float64, requires_grad=True)

    def warped(m: Tensor, t: Tensor, values: Tensor) -> Tensor:
        return affine_warp(replace(place, data=values), place, Affine(m, t), outside=None)

    assert torch.autograd.gradcheck(warped, (matrix, offset, pixels))


def test_affine_warp_gives_the_scene_back():
    true = make_true(turn(2, 15))
    fixed, moving = make_pair(true)
    difference = (affine_warp(moving, fixed, true) - fixed.data)[:, :, 15:-15, 15:-15]
    assert difference.abs().max() < 3.0


def test_exponential_is_the_flow_of_a_move():
    spin = generators("rigid", 2)[2:]
    map_ = exponential(torch.tensor([[0.3]], dtype=torch.float64), spin)[0]
    torch.testing.assert_close(map_, homogeneous(turn(2, math.degrees(0.3)), torch.zeros(2, dtype=torch.float64)))


@pytest.mark.parametrize("dim", [2, 3])
def test_settings_left_open_go_by_the_number_of_axes(dim):
    window, nodes = {2: (7, 20_000), 3: (5, 150_000)}[dim]
    open_, said = AlignmentSettings(), AlignmentSettings(window=9, nodes=5000)
    assert (open_.window_in(dim), open_.nodes_in(dim)) == (window, nodes)
    assert (said.window_in(dim), said.nodes_in(dim)) == (9, 5000)
    fixed, moving = make_pair(make_true(turn(dim, 10)))
    first, second = (align(fixed, moving, settings=s) for s in (open_, AlignmentSettings(window=window, nodes=nodes)))
    assert torch.equal(first.affine.matrix, second.affine.matrix)


FIXED, MOVING = make_pair(make_true(turn(2, 5)))
SOLID = picture(empty((16, 16, 16), (4.0, 4.0, 4.0)))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: align(FIXED, MOVING, "rigit"), "did you mean 'rigid'"),
        (lambda: align(FIXED, SOLID), "is 2D but .* is 3D"),
        (lambda: align(FIXED, replace(MOVING, data=0 * MOVING.data)), "constant"),
        (lambda: align(FIXED, replace(MOVING, data=MOVING.data / 0)), "NaN"),
        (lambda: align(FIXED, replace(MOVING, data=MOVING.data.expand(-1, 2, -1, -1))), "channels"),
        (lambda: align(FIXED, MOVING, fixed_mask=replace(FIXED, data=0 * FIXED.data)), "marks no voxel"),
        (lambda: align(FIXED, MOVING, moving_mask=SOLID), "is 3D but"),
        (lambda: AlignmentSettings(similarity="nncc"), "did you mean 'ncc'"),
        (lambda: AlignmentSettings(window=4), "window must be"),
        (lambda: AlignmentSettings(min_overlap=0.0), "min_overlap must"),
        (lambda: AlignmentSettings(nodes=10), "nodes must"),
        (lambda: AlignmentSettings(steps=0), "steps must"),
    ],
)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()
