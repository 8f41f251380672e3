"""The pre-flight check: all that can be wrong is found, real pairs are not cried wolf at, and the verb says so."""

from dataclasses import replace

import pytest
import torch
from lopsided import lopsided
from nested_settings import settings_of

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.pipeline.memory import footprint
from torchdeform.pipeline.preflight import (
    ERROR,
    NOTE,
    WARNING,
    Report,
    flip_correlations,
    looks_like_labels,
    preflight,
)
from torchdeform.registration.settings import RegistrationSettings


def texts(report: Report, severity: str) -> str:
    return "\n".join(report.of(severity))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_sound_pair_has_no_findings(dim):
    fixed = lopsided(dim)
    assert preflight(fixed, replace(fixed, data=fixed.data + 1, name="moving.nii")).findings == ()


def nan(image: Image) -> Image:
    data = image.data.clone()
    data.view(-1)[[5, 7]] = torch.tensor([torch.nan, torch.inf])
    return replace(image, data=data)


def zeros(image: Image) -> Image:
    return replace(image, data=image.data * (torch.arange(image.data.numel()).view(image.data.shape) < 30))


def holes(image: Image) -> Image:
    data = image.data.clone()
    data[:, :, 7:9] = 3.0
    return replace(image, data=data)


def margins(image: Image) -> Image:
    data = torch.zeros_like(image.data)
    inner = (slice(None), slice(None), *(slice(0, n // 2) for n in image.grid.shape))
    data[inner] = image.data[inner]
    return replace(image, data=data)


def thin(image: Image) -> Image:
    return Image(image.data[:, :, :5], Grid((5, *image.grid.shape[1:]), image.grid.spacing), name=image.name)


def spaced(image: Image, factor: float) -> Image:
    return replace(image, grid=Grid(image.grid.shape, tuple(h * factor for h in image.grid.spacing)))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    ("change", "severity", "message"),
    [
        (nan, ERROR, "has 2 pixels that are NaN or infinite"),
        (lambda i: replace(i, data=torch.full_like(i.data, 7.0)), ERROR, "is constant, so there is nothing to align"),
        (zeros, WARNING, "of its pixels; crop it"),
        (holes, WARNING, "has 2 slices along"),
        (margins, NOTE, "has margins without contrast in"),
        (thin, NOTE, "nothing is moved along axes of fewer than 8 voxels"),
        (lambda i: spaced(i, 1e-4), WARNING, "if that is not so, correct it in the header"),
        (lambda i: spaced(i, 200.0), WARNING, "if that is not so, correct it in the header"),
        (lambda i: spaced(i, 4.0), WARNING, "mm; check the spacings"),
        (lambda i: replace(i, grid=Grid(i.grid.shape)), WARNING, "has spacing 1 on all axes"),
        (lambda i: replace(i, origin=(1e4,) * i.grid.dim), ERROR, "do not overlap in physical space"),
        (lambda i: replace(i, origin=tuple(0.8 * s for s in i.grid.extent[::-1])), WARNING, "% only"),
        (lambda i: replace(i, data=i.data / 4095), NOTE, "grey values and"),
        (lambda i: replace(i, data=i.data.expand(-1, 3, *i.grid.shape)), NOTE, "channels and"),
        (lambda i: replace(i, data=i.data.flip(2)), WARNING, "looks mirrored along"),
        (lambda i: replace(i, data=i.data.flip(2, 3)), WARNING, "looks turned over along"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_found(dim, change, severity, message):
    fixed = lopsided(dim)
    moving = change(replace(fixed, name="moving.nii"))
    report = preflight(fixed, moving)
    assert message in texts(report, severity), report
    for finding in report.findings:
        assert ".nii" in finding.text
        assert "\n" not in finding.text
        assert "; " in finding.text


def test_2d_against_3d():
    report = preflight(lopsided(2), lopsided(3, name="moving.nii"))
    assert "fixed.nii is 2D but moving.nii is 3D" in texts(report, ERROR)
    with pytest.raises(InputError, match="give two of one kind"):
        report.require_ok()


def test_a_thin_fixed_image_is_no_error():
    fixed = lopsided(3)
    preflight(thin(fixed), fixed).require_ok()


def test_apart_is_no_error_when_an_alignment_comes_first():
    fixed = lopsided(3)
    moving = replace(fixed, origin=(1e4, 0.0, 0.0), name="moving.nii")
    report = preflight(fixed, moving, aligned=True)
    assert "do not overlap" in texts(report, WARNING)
    report.require_ok()


def test_scaled_intensities_matter_to_ssd():
    fixed = lopsided(2)
    moving = replace(fixed, data=fixed.data / 4095, name="moving.nii")
    assert "another similarity than ssd" in texts(
        preflight(fixed, moving, settings=settings_of(similarity="ssd")), WARNING
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_the_header_explains_a_mirrored_array(dim):
    """An image that is stored flipped, and says so in its direction, is not mirrored."""
    fixed = lopsided(dim)
    sign = [[-1.0 if i == j == 0 else float(i == j) for j in range(dim)] for i in range(dim)]
    origin = (fixed.grid.extent[-1], *[0.0] * (dim - 1))
    stored = replace(fixed, data=fixed.data.flip(-1), direction=tuple(map(tuple, sign)), origin=origin)
    assert preflight(fixed, stored).findings == ()
    scores = flip_correlations(fixed, stored)
    assert max(scores, key=lambda signs: scores[signs]) == (1.0,) * dim


def test_correlation_of_blocks_keeps_the_place():
    """Coarse grids of a fine and a coarse copy of one image lie on each other."""
    fixed = lopsided(2)
    fine = torch.nn.functional.interpolate(fixed.data, scale_factor=5, mode="bilinear", align_corners=True)
    spacing = tuple(s / (n - 1) for s, n in zip(fixed.grid.extent, fine.shape[2:], strict=True))
    moving = Image(fine, Grid(tuple(fine.shape[2:]), spacing))
    assert flip_correlations(fixed, moving)[1.0, 1.0] > 0.99


def a_mask(image: Image, values: torch.Tensor, **how) -> Image:
    return Image(values.float().expand(1, 1, *image.grid.shape), image.grid, name="mask.nii", **how)


@pytest.mark.parametrize("dim", [2, 3])
def test_masks(dim):
    fixed = lopsided(dim)
    grid, some = fixed.grid, (fixed.data > 20).float()
    far = (1e4,) * dim
    cases = [
        (a_mask(fixed, some), ERROR, None),
        (a_mask(fixed, torch.zeros(())), ERROR, "mask.nii is empty"),
        (a_mask(fixed, torch.tensor(torch.nan)), ERROR, "mask.nii has pixels that are NaN"),
        (a_mask(fixed, some, origin=far), ERROR, "mask.nii excludes all of fixed.nii"),
        (a_mask(fixed, some, origin=(1.0,) * dim), WARNING, "mask.nii has another grid than fixed.nii"),
        (a_mask(fixed, torch.ones(())), NOTE, "excludes nothing"),
        (Image(some.expand(1, 2, *grid.shape), grid, name="mask.nii"), ERROR, "2 channels"),
        (Image(torch.ones(1, 1, *[9] * (5 - dim)), Grid((9,) * (5 - dim)), name="mask.nii"), ERROR, f"{5 - dim}D"),
    ]
    for mask, severity, message in cases:
        for which in ("fixed_mask", "moving_mask"):
            report = preflight(fixed, fixed, **{which: mask})
            if message is None:
                assert report.findings == ()
            else:
                assert message in texts(report, severity)


def test_memory_that_will_not_do(monkeypatch):
    fixed = lopsided(3)
    for room, severity in ((2 * 10**8, ERROR), (4.5 * 10**8, WARNING)):
        monkeypatch.setattr("torchdeform.pipeline.preflight.available", lambda device, room=room: int(room))
        report = preflight(fixed, fixed)
        assert "of memory and" in texts(report, severity)
        assert "--memory" in texts(report, severity)
    monkeypatch.setattr("torchdeform.pipeline.preflight.available", lambda device: None)
    assert preflight(fixed, fixed).findings == ()


def test_the_memory_of_what_will_be_registered(monkeypatch):
    """Two maps take more than one, and a limit that is given is kept to, so nothing is said."""
    fixed, one, both = lopsided(3), RegistrationSettings(), settings_of(symmetric=True)
    between = (footprint(fixed.grid, 1, one) + footprint(fixed.grid, 1, both)) / 2
    monkeypatch.setattr("torchdeform.pipeline.preflight.available", lambda device: between / 0.8)
    assert preflight(fixed, fixed, settings=one).findings == ()
    assert "of memory and" in texts(preflight(fixed, fixed, settings=both), WARNING)
    monkeypatch.setattr("torchdeform.pipeline.preflight.available", lambda device: 10**8)
    assert "of memory and" in texts(preflight(fixed, fixed), ERROR)
    assert preflight(fixed, fixed, memory=10**9).findings == ()


def test_errors_come_first():
    fixed = lopsided(2)
    moving = replace(zeros(fixed), origin=(1e5, 0.0), grid=Grid(fixed.grid.shape), name="moving.nii")
    severities = [finding.severity for finding in preflight(fixed, moving).findings]
    assert severities == sorted(severities, key=[ERROR, WARNING, NOTE].index)
    assert severities[0] == ERROR


@pytest.mark.data
@pytest.mark.parametrize(
    ("fixed", "moving"),
    [
        ("lung_ct_3d/fixed.mha", "lung_ct_3d/moving.mha"),
        ("mouse_brain_3d/mouse1.nii.gz", "mouse_brain_3d/mouse2.nii.gz"),
        ("spine_t1t2_3d/t1w.nii.gz", "spine_t1t2_3d/t2.nii.gz"),
        ("hippocampus_3d/hippocampus_001.nii.gz", "hippocampus_3d/hippocampus_003.nii.gz"),
        ("histology_2d/1-he.png", "histology_2d/2-cd31.png"),
        ("histology_2d/1-he.png", "histology_2d/6-ki67.png"),
        ("heart_2d/SC-HF-I-09_slice12_ED.png", "heart_2d/SC-HF-I-09_slice12_ES.png"),
        ("heart_dicom_2d/IM-0009-0020.dcm", "heart_dicom_2d/IM-0009-0028.dcm"),
        ("mindboggle_2d/subject1.nii.gz", "mindboggle_2d/subject2.nii.gz"),
        ("slices_2d/r16slice.jpg", "slices_2d/r64slice.jpg"),
    ],
)
def test_real_pairs_are_not_warned_of(data_folder, fixed, moving):
    report = preflight(read_image(data_folder / fixed), read_image(data_folder / moving), aligned=True)
    assert report.of(ERROR) == report.of(WARNING) == ()


@pytest.mark.data
@pytest.mark.parametrize("name", ["lung_ct_3d/fixed.mha", "heart_2d/SC-HF-I-09_slice12_ED.png"])
def test_real_images_turned_over_are_warned_of(data_folder, name):
    image = read_image(data_folder / name)
    turned = replace(image, data=image.data.flip(-1), name="turned")
    assert "turned looks mirrored along x" in texts(preflight(image, turned), WARNING)


def pictures() -> dict[str, torch.Tensor]:
    """Label images and images of grey values, each ``(40, 50)``."""
    disc = (torch.cartesian_prod(torch.arange(40), torch.arange(50)) - 20).square().sum(1).view(40, 50)
    noise = torch.rand(40, 50, generator=torch.manual_seed(0))
    return {
        "mask": (disc < 200).float(),
        "regions": (disc < 300).float() * (1 + (disc < 100) + 998 * (disc < 30)),
        "photograph": (noise * 255).round(),
        "few grey values": (disc < 300) * (noise * 12).round(),
        "not whole": (disc < 200) * 0.3,
        "constant": torch.zeros(40, 50),
    }


@pytest.mark.parametrize("name", pictures())
def test_labels_are_known_by_their_values(name):
    image = Image(pictures()[name][None, None], Grid((40, 50)), name=f"{name}.nii.gz")
    assert looks_like_labels(replace(image, name="a.nii.gz")) == (name in ("mask", "regions"))
    colours = replace(image, data=image.data.expand(1, 3, -1, -1), name="a.png")
    assert not looks_like_labels(colours)


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        ("sub-01_seg.nii.gz", True),
        ("brain_mask.mha", True),
        ("Labels.png", True),
        ("aparc+aseg.mgz", True),
        ("masked.nii.gz", False),
        ("segovia.png", False),
    ],
)
def test_labels_are_known_by_their_names(name, labels):
    image = Image(pictures()["photograph"][None, None] / 7, Grid((40, 50)), name=f"/seg/{name}")
    assert looks_like_labels(image) == labels


def test_the_noise_of_a_margin_is_no_contrast_and_a_ramp_no_fault():
    """A JPEG's margin is not quite constant; the columns of a ramp are, all of them."""
    noisy = lopsided(2)
    noisy.data[:, :, :6] = torch.tensor([0.0, 1e-3, 0.0, 0.0, 1e-3, 1e-3]).view(1, 1, 6, 1) * noisy.data.amax()
    noisy.data[:, :, [1, 4, 5], 0] = 0
    ramp = replace(noisy, data=torch.arange(noisy.grid.shape[1]).float().expand(1, 1, *noisy.grid.shape).contiguous())
    for image in (noisy, ramp):
        assert not [text for text in texts(preflight(image, image), WARNING) if "constant" in text]
