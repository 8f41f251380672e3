"""NIfTI in all its forms, compared with nibabel, whose world is RAS."""

import gzip
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import read_image, read_labels
from torchdeform.io.images import image_size
from torchdeform.io.nifti import read_nifti
from torchdeform.pipeline.preflight import WARNING, preflight

nibabel = pytest.importorskip("nibabel")

VALUES = np.random.default_rng(0).random((5, 6, 7)).astype(np.float32)  # x, y, z
TILTED = nibabel.affines.from_matvec(
    nibabel.eulerangles.euler2mat(0.3, -0.2, 0.5) @ np.diag([1.0, 1.2, 2.0]), [3.0, -4.0, 5.0]
)


def _save(path: Path, affine=TILTED, *, kind=nibabel.Nifti1Image, values=VALUES, codes=(1, 1), other=None, **header):
    """Write ``affine`` as the sform and ``other``, by default the same, as the qform, with these codes."""
    image = kind(values, None, dtype=values.dtype)
    image.set_qform(affine if other is None else other, codes[0])
    image.set_sform(affine, codes[1])
    for name, value in header.items():
        image.header[name] = value
    image.to_filename(path)
    return path


def _changed(path: Path, form: str, position: int, *values: float) -> Path:
    content = bytearray(path.read_bytes())
    struct.pack_into(form, content, position, *values)
    path.write_bytes(content)
    return path


def _world(image: Image, index: tuple[int, int, int]) -> np.ndarray:
    points = image.grid.points(dtype=torch.float64)
    return image.to_world(points)[(0, slice(None), *index[::-1])].numpy()


def _require_alike(path: Path, image: Image) -> None:
    """Values and places are those of nibabel."""
    theirs = nibabel.load(path)
    np.testing.assert_array_equal(image.data[0, 0].numpy().T, np.asarray(theirs.dataobj).astype(np.float32))
    for index in ((0, 0, 0), (4, 5, 6)):
        ras = (theirs.affine @ (*index, 1))[:3]
        np.testing.assert_allclose(_world(image, index), ras * (-1, -1, 1), atol=2e-5)


@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
@pytest.mark.parametrize("codes", [(1, 1), (0, 1), (1, 0), (2, 4), (0, 4), (3, 0)])
def test_values_and_place(tmp_path, ending, kind, codes):
    path = _save(tmp_path / f"a{ending}", kind=kind, codes=codes)
    image = read_image(path)
    _require_alike(path, image)
    assert image.remarks == ()
    assert image_size(path) == ((7, 6, 5), 1)


@pytest.mark.parametrize("mirror", [np.diag([1, 1, 1, 1]), np.diag([-1, 1, 1, 1]), np.diag([1, 1, -1, 1])])
@pytest.mark.parametrize("codes", [(1, 0), (0, 1)])
def test_mirrored_axes(tmp_path, mirror, codes):
    path = _save(tmp_path / "a.nii", TILTED @ mirror, codes=codes)
    _require_alike(path, read_image(path))


@pytest.mark.parametrize("name", ["no_ending", "download.nii.gz.1", "packed.nii", "picture.png", "a.dcm"])
@pytest.mark.parametrize("packed", [False, True])
def test_any_name(tmp_path, name, packed):
    path = _save(tmp_path / "a.nii")
    content = path.read_bytes()
    (tmp_path / name).write_bytes(gzip.compress(content) if packed else content)
    _require_alike(path, read_image(tmp_path / name))
    assert read_image(tmp_path / name).name == str(tmp_path / name)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Pair, nibabel.Nifti2Pair])
@pytest.mark.parametrize("given", ["a.hdr", "a.img"])
def test_pairs(tmp_path, kind, given):
    path = _save(tmp_path / "a.img", kind=kind)
    _require_alike(path, read_image(tmp_path / given))
    assert image_size(tmp_path / given) == ((7, 6, 5), 1)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Pair, nibabel.AnalyzeImage])
def test_a_header_without_its_pixels(tmp_path, kind):
    kind(VALUES, np.eye(4)).to_filename(tmp_path / "lone.img")
    (tmp_path / "lone.img").unlink()
    with pytest.raises(
        InputError, match=r"lone\.hdr is the header of two files, and lone\.img, its pixels, is missing"
    ):
        read_image(tmp_path / "lone.hdr")
    assert image_size(tmp_path / "lone.hdr") is None


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"])
def test_every_type_in_both_orders(tmp_path, kind, order):
    values = (VALUES * 100).astype(order + kind)
    image = nibabel.Nifti1Image(values, TILTED, nibabel.Nifti1Header(endianness=order), dtype=values.dtype)
    image.to_filename(tmp_path / "a.nii")
    found = read_image(tmp_path / "a.nii")
    _require_alike(tmp_path / "a.nii", found)
    assert found.pixel_type == np.dtype(kind).name


@pytest.mark.parametrize(("slope", "inter"), [(0.5, 3.0), (-2.0, 0.0), (1.0, -1000.0), (1e-3, 1e-3)])
def test_scaled_values(tmp_path, slope, inter):
    path = _save(tmp_path / "a.nii", values=(VALUES * 100).astype(np.int16))
    _changed(path, "<2f", 112, slope, inter)
    expected = nibabel.load(path).get_fdata()
    np.testing.assert_allclose(read_image(path).data[0, 0].numpy().T, expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize(("slope", "inter"), [(0.0, 7.0), (np.nan, 7.0), (np.inf, 0.0), (1.0, 0.0)])
def test_no_scale(tmp_path, slope, inter):
    path = _changed(_save(tmp_path / "a.nii", values=(VALUES * 100).astype(np.int16)), "<2f", 112, slope, inter)
    image = read_image(path)
    assert image.pixel_type == "int16"
    np.testing.assert_array_equal(image.data[0, 0].numpy().T, (VALUES * 100).astype(np.int16))


def test_colours_and_vectors(tmp_path):
    colours = np.random.default_rng(0).integers(0, 255, (5, 6, 7, 3), dtype=np.uint8)
    packed = colours.copy().view([("R", "u1"), ("G", "u1"), ("B", "u1")])[..., 0]
    image = read_image(_save(tmp_path / "rgb.nii", values=packed))
    np.testing.assert_array_equal(image.data[0].numpy().T, colours)
    vectors = np.random.default_rng(0).random((5, 6, 7, 1, 4)).astype(np.float32)
    image = read_image(_save(tmp_path / "vectors.nii", values=vectors))
    np.testing.assert_array_equal(image.data[0].numpy().T, vectors[:, :, :, 0])
    assert image_size(tmp_path / "vectors.nii") == ((7, 6, 5), 4)


def test_a_slice_is_flat(tmp_path):
    image = read_image(_save(tmp_path / "a.nii", np.diag([0.5, 0.7, 9, 1]), values=VALUES[:, :, 0]))
    assert (image.grid.shape, image.direction) == ((6, 5), ((-1.0, 0.0), (0.0, -1.0)))
    assert image.grid.spacing == pytest.approx((0.7, 0.5))


def test_the_sform_counts_where_the_qform_disagrees(tmp_path):
    """For any pair of codes, as in nibabel; and it is said, where the images are checked."""
    moved = TILTED.copy()
    moved[:3, 3] += (5, 7, 9)
    for codes in ((1, 1), (1, 2), (2, 4)):
        path = _save(tmp_path / "a.nii", moved, other=TILTED, codes=codes)
        image = read_image(path)
        _require_alike(path, image)
        (remark,) = image.remarks
        assert "an sform and a qform that place it up to 12.4 voxels apart; the sform is used" in remark
        assert remark in preflight(image, image).of(WARNING)


def test_small_differences_are_no_news(tmp_path):
    moved = TILTED.copy()
    moved[:3, 3] += 0.01
    moved[:3, :3] *= 1.0004
    assert read_image(_save(tmp_path / "a.nii", moved, other=TILTED)).remarks == ()


def test_a_spoilt_qform_beside_an_sform_does_no_harm(tmp_path):
    path = _changed(_save(tmp_path / "a.nii"), "<3f", 256, np.nan, 0, 0)
    _require_alike(path, read_image(path))


@pytest.mark.parametrize("rows", [[0.0] * 12, [np.nan] * 12, [1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0]])
def test_an_sform_without_sense_leaves_the_qform(tmp_path, rows):
    expected = read_image(_save(tmp_path / "a.nii", codes=(1, 0)))
    image = read_image(_changed(_save(tmp_path / "b.nii"), "<12f", 280, *rows))
    assert (image.grid, image.origin, image.direction) == (expected.grid, expected.origin, expected.direction)
    assert "has an sform without sense; the qform is used" in image.remarks[0]


def test_an_sform_of_another_voxel_size_is_said(tmp_path):
    path = _changed(_save(tmp_path / "a.nii", codes=(0, 1)), "<3f", 80, 3, 3, 3)
    image = read_image(path)
    _require_alike(path, image)
    assert "voxels of 1×1.2×2 by its sform and of 3×3×3 by its pixdim; the sform is used" in image.remarks[0]


def test_rounded_directions_are_squared(tmp_path):
    """Three digits, which ITK refuses; the nearest rotation is within the rounding."""
    rounded = TILTED.copy()
    rounded[:3, :3] = np.round(rounded[:3, :3], 3)
    image = read_image(_save(tmp_path / "a.nii", rounded, codes=(0, 1)))
    turn = np.array(image.direction)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turn * image.grid.spacing[::-1], np.diag([-1, -1, 1]) @ rounded[:3, :3], atol=1.5e-3)
    assert image.remarks == ()


@pytest.mark.parametrize("shear", [0.02, 0.3])
def test_sheared_axes_are_refused(tmp_path, shear):
    affine = TILTED.copy()
    affine[0, 1] += shear
    with pytest.raises(InputError, match="not at right angles"):
        read_image(_save(tmp_path / "a.nii", affine, codes=(0, 1), other=TILTED))


def test_no_place_at_all_is_that_of_itk(tmp_path):
    sitk = pytest.importorskip("SimpleITK")
    path = _save(tmp_path / "a.nii", codes=(0, 0))
    image, theirs = read_image(path), sitk.ReadImage(str(path))
    assert image.origin == theirs.GetOrigin() == (0, 0, 0)
    assert np.ravel(image.direction).tolist() == list(theirs.GetDirection())
    np.testing.assert_allclose(image.grid.spacing[::-1], theirs.GetSpacing())


def test_qfac_0_is_1(tmp_path):
    path = _changed(_save(tmp_path / "a.nii", codes=(1, 0)), "<f", 76, 0.0)
    _require_alike(path, read_image(path))


@pytest.mark.parametrize(
    ("code", "size", "unit"), [("meter", 1e3, "mm"), ("mm", 1, "mm"), ("micron", 1e-3, "µm"), ("unknown", 1, "mm")]
)
@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
def test_units(tmp_path, kind, code, size, unit):
    image = kind(VALUES, np.diag([-0.38, -0.38, 0.76, 1]) + np.outer([1, 2, 3, 0], [0, 0, 0, 1]))
    image.header.set_xyzt_units(code, "sec")
    image.to_filename(tmp_path / "a.nii.gz")
    found = read_image(tmp_path / "a.nii.gz")
    assert found.unit == unit
    np.testing.assert_allclose(found.grid.spacing, np.array([0.76, 0.38, 0.38]) * size, rtol=1e-6)
    np.testing.assert_allclose(found.origin, np.array([-1, -2, 3]) * size, rtol=1e-6)


@pytest.mark.parametrize("kind", ["i4", "u4", "i8", "u8", "f8"])
def test_labels_keep_every_value(tmp_path, kind):
    values = np.zeros((5, 6, 7), kind)
    values[1], values[2] = 2**24 + 1, 2**24 + 2
    _save(tmp_path / "a.nii", values=values).rename(tmp_path / "labels")
    found = read_labels(tmp_path / "labels").data
    assert found.dtype == torch.float64
    np.testing.assert_array_equal(found[0, 0].numpy().T, values)


WRONG: dict[str, tuple[Callable[[Path], Path], str]] = {
    "quaternion": (lambda p: _changed(_save(p, codes=(1, 0)), "<3f", 256, 2, 0, 0), "a qform that is no rotation"),
    "NaN in the qform": (lambda p: _changed(_save(p, codes=(1, 0)), "<f", 256, np.nan), "a qform that is no rotation"),
    "NaN in the sform": (lambda p: _changed(_save(p, codes=(0, 1)), "<f", 280, np.nan), "NaN or infinite numbers"),
    "flat sform": (lambda p: _changed(_save(p, codes=(0, 1)), "<12f", 280, *[0.0] * 12), "affine that is singular"),
    "intercept": (lambda p: _changed(_save(p), "<2f", 112, 2, np.nan), "the intercept nan"),
    "type": (lambda p: _changed(_save(p), "<h", 70, 1), "pixels of the type 1, which is unknown"),
    "complex": (lambda p: _save(p, values=VALUES.astype(np.complex64)), "complex numbers"),
    "series": (lambda p: _save(p, values=np.zeros((5, 6, 7, 3), np.float32)), "a series of 3 volumes, size"),
    "NaN": (lambda p: _save(p, values=np.full((5, 6, 7), np.nan, np.float32)), "NaN or infinite"),
    "announced": (lambda p: _changed(_save(p), "<4h", 40, 3, 20000, 20000, 20000), "far more than it can hold"),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_what_is_wrong_is_said(tmp_path, wrong):
    make, message = WRONG[wrong]
    with pytest.raises(InputError, match=message):
        read_image(make(tmp_path / "a.nii"))


def test_a_bomb_is_not_unpacked(tmp_path):
    """A small file whose pixels begin after, or are followed by, gigabytes of zeros."""
    path = _save(tmp_path / "a.nii")
    tail = gzip.compress(bytes(10_000_000)) * 20
    (tmp_path / "b.nii.gz").write_bytes(gzip.compress(path.read_bytes()) + tail)
    _require_alike(path, read_image(tmp_path / "b.nii.gz"))
    _changed(path, "<f", 108, 1e9)
    (tmp_path / "c.nii.gz").write_bytes(gzip.compress(path.read_bytes()) + tail)
    with pytest.raises(InputError, match=r"c\.nii\.gz .*far more than it can hold"):
        read_image(tmp_path / "c.nii.gz")


def test_pixels_need_no_offset(tmp_path):
    path = _save(tmp_path / "a.nii")
    expected = read_nifti(path).values
    np.testing.assert_array_equal(read_nifti(_changed(path, "<f", 108, 0.0)).values, expected)


def test_vectors_on_the_fourth_axis(tmp_path):
    vectors = np.random.default_rng(0).random((5, 6, 7, 3)).astype(np.float32)
    path = _save(tmp_path / "a.nii", values=vectors, intent_code=1006)
    found = read_nifti(path, vectors=True)
    np.testing.assert_array_equal(found.values.swapaxes(0, 2), vectors)
    assert (found.stacked, found.intent) == (True, 1006)
    with pytest.raises(InputError, match="a series of 3 volumes"):
        read_nifti(path)
