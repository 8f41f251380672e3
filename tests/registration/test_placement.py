"""Where a deformation begins: alignments that help are taken, others are not, and the contrast tells the similarity."""

from dataclasses import replace

import pytest
import torch
from affine_pairs import distance
from nested_settings import changed
from pictures import bend, blobs
from torch import Tensor

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.transform import Affine
from torchdeform.core.warp import warp
from torchdeform.metrics.correlation import window_mean
from torchdeform.metrics.similarity import measure_name, similarity_weights
from torchdeform.registration.affine.align import Alignment
from torchdeform.registration.annotations import Annotations
from torchdeform.registration.placement import choose, place, sign_agreement
from torchdeform.registration.problem import RegistrationProblem
from torchdeform.registration.settings import RegistrationSettings

SETTINGS = RegistrationSettings()
SHAPES = [(96, 80), (40, 44, 36)]
MODES = {2: "bicubic", 3: "trilinear"}


def as_image(data: Tensor, name: str = "image") -> Image:
    return Image(data.float(), Grid(tuple(data.shape[2:])), name=name)


def tissues(shape: tuple[int, ...], seed: int, values: tuple[float, ...]) -> Tensor:
    """Regions of a few tissues, each with its value, and a little noise."""
    level = torch.nn.functional.interpolate(blobs(tuple(n // 4 for n in shape), 7), size=shape, mode=MODES[len(shape)])
    ranks = level.flatten().argsort().argsort().view(level.shape) * len(values) // level.numel()
    noise = torch.randn(level.shape, generator=torch.Generator().manual_seed(seed))
    return torch.tensor(values)[ranks] + 0.01 * noise


@pytest.mark.parametrize("shape", SHAPES)
def test_an_image_is_left_where_it_is_when_it_is_aligned_with_itself(shape):
    image = as_image(blobs(shape, 1))
    placed = place(image, image, SETTINGS, Annotations())
    assert placed.alignment is not None
    assert placed.alignment.start == "geometry"
    assert distance(placed.affine, Affine.identity(len(shape)), image) == 0
    assert placed.unaligned.item() == pytest.approx(1, abs=1e-5)


def test_a_place_where_nothing_but_background_is_seen_is_not_taken():
    """The spacing of one file is wrong by 100, so the files put the fixed image beside the first pixel of the other."""
    data = torch.nn.functional.pad(blobs((56, 56), 1), (4, 4, 4, 4))
    moving = Image(data, Grid((64, 64), (100.0, 100.0)), name="moving")
    placed = place(as_image(data), moving, SETTINGS, Annotations())
    assert placed.unaligned is not None
    assert float(placed.unaligned) == 0
    assert placed.alignment is not None
    assert placed.alignment.start != "geometry"


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shift_is_found_and_taken(shape):
    grid = Grid(shape)
    wide = blobs(tuple(n + 12 for n in shape), 1)
    cut = (slice(None), slice(None))
    fixed, moving = (as_image(wide[(*cut, *(slice(a, a + n) for n in shape))]) for a in (4, 9))
    placed = place(fixed, moving, SETTINGS, Annotations())
    true = Affine(torch.eye(grid.dim, dtype=torch.float64), torch.full((grid.dim,), -5.0, dtype=torch.float64))
    assert distance(placed.affine, true, fixed) < 0.3
    assert placed.unaligned.item() < 0.9


@pytest.mark.parametrize(
    ("tissues", "kind", "found"),
    [
        ({}, "affine", "affine"),
        ({1: "stiff", 2: {"div": 1e4}, 3: "free"}, "affine", "affine"),
        ({1: "stiff", 2: "rigid"}, "affine", "rigid"),
        ({2: "incompressible"}, "similarity", "rigid"),
        ({2: "rigid"}, "translation", "translation"),
        ({2: "rigid"}, "none", "none"),
    ],
)
def test_tissue_that_is_kept_is_aligned_rigidly(tissues, kind, found):
    """The map is that of the deformation and of the alignment, and each of them must keep what is to be kept."""
    image = as_image(blobs((32, 36), 1))
    longer = replace(image, grid=Grid((32, 36), (1.0, 1.1)))
    settings = replace(SETTINGS, tissues=tissues, align=kind)
    placed = place(image, longer, settings, Annotations())
    assert placed.settings.align.kind == found
    if found == "rigid":
        assert placed.affine is not None
        matrix = placed.affine.matrix
        torch.testing.assert_close(matrix @ matrix.T, torch.eye(2, dtype=matrix.dtype))


def test_an_alignment_that_does_not_help_is_not_taken(monkeypatch):
    """Whatever the alignment says of itself: full detail decides."""
    image = as_image(blobs((64, 64), 1), "fixed")
    near = replace(as_image(warp(image.data, bend(image.grid, 0.5), image.grid)), name="moving")
    away = Affine(torch.eye(2, dtype=torch.float64), torch.tensor([3.0, -2.0], dtype=torch.float64))

    def found(*_: object, **__: object) -> Alignment:
        return Alignment(away, 0.5, 0.9, "mass", 0.1, ("a warning",))

    monkeypatch.setattr("torchdeform.registration.placement.align", found)
    placed = place(image, near, SETTINGS, Annotations())
    assert distance(placed.affine, Affine.identity(2), image) == 0
    assert placed.alignment.start == "geometry"
    assert placed.alignment.warnings == ("a warning",)


def test_images_that_the_files_place_apart_keep_their_alignment():
    fixed = as_image(blobs((64, 64), 1))
    placed = place(fixed, replace(fixed, origin=(500.0, 0.0)), SETTINGS, Annotations())
    assert placed.unaligned is None
    assert distance(placed.affine, Affine(torch.eye(2), torch.tensor([500.0, 0.0])), fixed) < 0.1


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("values", "measure"),
    [
        ((0.0, 0.3, 0.6, 1.0), "lncc"),  # the same
        ((1.0, 0.8, 0.45, 0.2), "lncc"),  # reversed: still a linear function
        ((0.1, 1.0, 0.3, 0.7), "mind"),  # tissues in another order
        ((0.9, 0.2, 1.0, 0.1), "mind"),
    ],
)
def test_the_contrast_tells_the_similarity(shape, values, measure):
    grid = Grid(shape)
    fixed = as_image(tissues(shape, 1, (0.0, 0.3, 0.6, 1.0)))
    moving = as_image(warp(tissues(shape, 2, values), bend(grid, 2.0), grid))
    placed = place(fixed, moving, changed(SETTINGS, align="none"), Annotations())
    assert measure in similarity_weights(placed.settings.similarity.measure)
    assert placed.settings.start == ("discrete" if measure == "mind" else "identity")
    assert placed.choice.startswith(f"similarity {measure_name(placed.settings.similarity.measure)}: the images have ")
    given = place(fixed, moving, changed(SETTINGS, align="none", similarity="ncc"), Annotations())
    assert (given.settings.similarity.measure, given.choice) == ("ncc", None)


def test_edges_count_beside_self_similarities_the_less_the_more_noise_there_is():
    grid = Grid((96, 96))
    both = tissues(grid.shape, 1, (0.0, 0.3, 0.6, 1.0)), tissues(grid.shape, 2, (0.1, 1.0, 0.3, 0.7))
    fixed, moving = (window_mean(image, 5) for image in both)
    weights = []
    for deviation in (0.0, 0.01, 0.3):
        noise = deviation * torch.randn(1, 1, *grid.shape, generator=torch.manual_seed(0))
        problem = RegistrationProblem(grid, fixed + noise, moving).scaled(SETTINGS)
        chosen = choose(problem, changed(SETTINGS, similarity="auto"))[0].similarity.measure
        weights.append(similarity_weights(chosen).get("ngf", 0.0))
    assert weights[0] > weights[1] > weights[2] == 0


def test_sign_agreement_of_one_half_and_the_other():
    """Where half of the windows correlate and the other half as much the other way round, they cancel."""
    image = blobs((64, 64), 3)
    image = (image - image.min()) / (image.max() - image.min())
    halves = torch.cat([image[..., :32], 1 - image[..., 32:]], dim=-1)
    grid, apart = Grid((64, 64)), torch.ones_like(image)
    apart[..., 27:37] = 0  # windows across the seam
    assert sign_agreement(RegistrationProblem(grid, image, image)) == pytest.approx(1, abs=1e-6)
    assert sign_agreement(RegistrationProblem(grid, image, 1 - image)) == pytest.approx(1, abs=1e-6)
    assert sign_agreement(RegistrationProblem(grid, image, halves, apart)) < 0.3
