"""Alignment: known maps are found again, in any frame; its derivative against differences; what it refuses."""

from dataclasses import replace

import pytest
import torch
from affine_pairs import distance, empty, make_pair, make_true, picture, scene, turn
from pictures import blobs

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine, Transform
from torchdeform.errors import InputError
from torchdeform.registration.affine.align import align
from torchdeform.registration.affine.settings import ALIGNMENTS, AlignmentSettings

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


def texture(shape: tuple[int, int]) -> torch.Tensor:
    """Structure of several widths, fading to nothing at the borders."""
    coarse = torch.nn.functional.interpolate(blobs(tuple(n // 3 for n in shape), 5), size=shape, mode="bicubic")
    x = [torch.linspace(-1, 1, n) for n in shape]
    return (coarse + 0.7 * blobs(shape, 6)) * torch.sigmoid(
        12 * (0.8 - torch.hypot(*torch.meshgrid(*x, indexing="ij")))
    )


@pytest.mark.parametrize(
    "ratio", [1e-3, 16.0, *(pytest.param(ratio, marks=pytest.mark.slow) for ratio in (1e-6, 0.0625, 1e3, 1e6))]
)
def test_one_content_in_other_units_is_found(ratio):
    """The same pixels, shifted by some, in two units: the map is the ratio of the units."""
    whole = texture((110, 130))
    fixed = Image(whole[:, :, 3:103, 2:122], Grid((100, 120)))
    moving = Image(whole[:, :, 7:107, 5:125], Grid((100, 120), (ratio, ratio)))
    true = make_true(ratio * torch.eye(2, dtype=torch.float64), -3 * ratio, -4 * ratio)
    for images, expected in (((fixed, moving), true), ((moving, fixed), true.inverse())):
        found = align(*images)
        scale = min(images[1].grid.spacing) / min(images[0].grid.spacing)
        assert distance(found.affine, expected, images[0]) < 0.5 * scale
        assert any("check the spacing" in sentence for sentence in found.warnings)


@pytest.mark.parametrize("first", [(30, 150), (120, 60)])
@pytest.mark.parametrize("known", [True, False])
def test_a_part_is_found_in_the_whole(first, known):
    """A sixth of the side, where the file places it or at the origin; and the whole about the part."""
    whole, side = texture((240, 264)), 40
    fixed = Image(whole, Grid((240, 264)))
    data = whole[:, :, first[0] : first[0] + side, first[1] : first[1] + side]
    part = Image(data, Grid((side, side)), tuple(first[::-1]) if known else ())
    shift = (0.0, 0.0) if known else tuple(-float(k) for k in first[::-1])
    true = make_true(torch.eye(2, dtype=torch.float64), *shift)
    assert distance(align(fixed, part).affine, true, fixed) < 1
    assert distance(align(part, fixed).affine, true.inverse(), part) < 0.5


def test_a_part_without_spacing_is_found():
    whole = texture((240, 264))
    fixed = Image(whole, Grid((240, 264), (0.5, 0.5)))
    part = Image(whole[:, :, 100:150, 90:140], Grid((50, 50), (3.0, 3.0)))
    true = make_true(6 * torch.eye(2, dtype=torch.float64), -270.0, -300.0)
    assert distance(align(fixed, part).affine, true, fixed) < 6


def test_colour_is_aligned_on_its_luminance():
    true = make_true(turn(2, 15))
    fixed, moving = make_pair(true)
    colour = replace(moving, data=moving.data.expand(-1, 3, -1, -1))
    torch.testing.assert_close(
        align(fixed, colour, "rigid").affine.matrix, align(fixed, moving, "rigid").affine.matrix, atol=1e-3, rtol=0
    )


def test_the_true_map_gives_the_image_back():
    true = make_true(turn(2, 15))
    fixed, moving = make_pair(true)
    difference = (Transform((true,)).image(moving, fixed).data - fixed.data)[:, :, 15:-15, 15:-15]
    assert difference.abs().max() < 3.0


FIXED, MOVING = make_pair(make_true(turn(2, 5)))


SOLID = picture(empty((16, 16, 16), (4.0, 4.0, 4.0)))


def test_the_kind_is_that_of_the_settings_unless_another_is_asked_for():
    settings = AlignmentSettings(kind="translation", steps=5)
    found = [align(FIXED, MOVING, settings=settings), align(FIXED, MOVING, "rigid", settings=settings)]
    identity = torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(found[0].affine.matrix, identity)
    assert (found[1].affine.matrix - identity).abs().max() > 0.01


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
    ],
)
def test_bad_input_is_one_sentence(call, sentence):
    with pytest.raises(InputError, match=sentence):
        call()
