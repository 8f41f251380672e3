"""Images in and out of files: nothing lost, nothing misplaced, every wrong file named."""

import gzip
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from broken_files import save, volume

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import read_image, write_image
from torchdeform.io.images import ending_like

PICTURES = {".png": (1, 3, 4), ".tif": (1, 3, 4), ".bmp": (3, 4)}


VOLUMES = [".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr"]


def _itk(values: np.ndarray, channels: bool = False) -> sitk.Image:
    return sitk.GetImageFromArray(values, isVector=channels)


def _bytes(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ending", VOLUMES)
def test_volume_formats_keep_pixels_and_place(tmp_path, make_image, dim, ending):
    image = make_image((9, 12, 15)[-dim:], (2.5, 0.7, 1.3)[-dim:], origin=(-31.5, 220.25, 7.0)[:dim], tilted=True)
    write_image(image, tmp_path / f"a{ending}")
    back = read_image(tmp_path / f"a{ending}")
    assert torch.equal(back.data, image.data)
    np.testing.assert_allclose(back.grid.spacing, image.grid.spacing, rtol=1e-6)
    np.testing.assert_allclose(back.origin, image.origin, rtol=1e-6)
    np.testing.assert_allclose(back.direction, image.direction, atol=1e-6)
    assert back.grid.shape == image.grid.shape


@pytest.mark.parametrize("dim", [2, 3])
def test_place_is_what_itk_says(tmp_path, make_image, dim):
    """The world position of a voxel equals SimpleITK's own."""
    image = make_image((9, 12, 15)[-dim:], (2.5, 0.7, 1.3)[-dim:], origin=(-31.5, 220.25, 7.0)[:dim], tilted=True)
    write_image(image, tmp_path / "a.mha")
    itk, back = sitk.ReadImage(str(tmp_path / "a.mha")), read_image(tmp_path / "a.mha")
    index = (5, 3, 2)[:dim]  # x, y, z
    world = back.to_world(back.grid.points(dtype=torch.float64))[(0, slice(None), *index[::-1])]
    np.testing.assert_allclose(world.numpy(), itk.TransformIndexToPhysicalPoint(index), atol=1e-9)
    assert back.data[(0, 0, *index[::-1])].item() == pytest.approx(itk[index])


def test_nifti_agrees_with_nibabel(tmp_path, make_image):
    """An independent reader puts the same value at the same place (its world is RAS)."""
    nibabel = pytest.importorskip("nibabel")
    image = make_image((9, 12, 15), (2.5, 0.7, 1.3), origin=(-31.5, 220.25, 7.0), tilted=True)
    write_image(image, tmp_path / "a.nii.gz")
    file = nibabel.load(tmp_path / "a.nii.gz")
    ras = file.affine @ (5, 3, 2, 1)
    world = image.to_world(image.grid.points(dtype=torch.float64))[0, :, 2, 3, 5].numpy()
    np.testing.assert_allclose(ras[:3] * (-1, -1, 1), world, atol=1e-4)
    assert np.asarray(file.dataobj)[5, 3, 2] == image.data[0, 0, 2, 3, 5].item()


@pytest.mark.parametrize(("ending", "channels"), [(e, c) for e, counts in PICTURES.items() for c in counts])
@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_pictures_keep_their_pixel_type(tmp_path, ending, channels, kind):
    if ending == ".bmp" and kind == "uint16":
        pytest.skip("BMP has 8 bits")
    values = torch.randint(0, np.iinfo(kind).max, (1, channels, 11, 14), generator=torch.manual_seed(0)).float()
    write_image(Image(values, Grid((11, 14)), pixel_type=kind), tmp_path / f"a{ending}")
    back = read_image(tmp_path / f"a{ending}")
    assert (back.pixel_type, back.data.shape) == (kind, values.shape)
    assert torch.equal(back.data, values)


def test_jpeg_is_read_as_it_looks(tmp_path, make_image):
    image = make_image((40, 50), channels=3, pixel_type="uint8")
    write_image(image, tmp_path / "a.jpg")
    assert (read_image(tmp_path / "a.jpg").data - image.data).abs().mean() < 2


def test_integers_are_rounded_and_clamped(tmp_path):
    values = torch.tensor([[-3.0, 0.4, 0.6], [254.4, 254.6, 300.0]])[None, None]
    write_image(Image(values, Grid((2, 3)), pixel_type="uint8"), tmp_path / "a.png")
    assert read_image(tmp_path / "a.png").data.flatten().tolist() == [0, 0, 1, 254, 255, 255]


def test_grey_with_alpha_becomes_rgba(tmp_path):
    pil = pytest.importorskip("PIL.Image")
    values = np.arange(160, dtype=np.uint8).reshape(8, 10, 2)
    pil.fromarray(values, "LA").save(tmp_path / "a.png")
    data = read_image(tmp_path / "a.png").data[0].numpy()
    np.testing.assert_array_equal(data, np.moveaxis(values[..., [0, 0, 0, 1]], -1, 0))


def test_one_slice_is_a_2d_image_in_its_place(tmp_path):
    itk = _itk(np.arange(20, dtype=np.float32).reshape(1, 4, 5))
    itk.SetSpacing((0.5, 0.7, 9.0))
    itk.SetOrigin((3.0, 4.0, 5.0))
    itk.SetDirection((0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    sitk.WriteImage(itk, str(tmp_path / "a.mha"))
    image = read_image(tmp_path / "a.mha")
    assert (image.grid.shape, image.grid.spacing, image.origin) == ((4, 5), (0.7, 0.5), (3.0, 4.0))
    assert image.direction == ((0.0, -1.0), (1.0, 0.0))


def test_oblique_slices_of_one_plane_keep_their_distance(tmp_path, make_image):
    tilted = make_image((3, 4, 5), tilted=True).direction
    images = []
    for shift in (0.0, 2.0):  # along the rows of the same oblique plane
        itk = _itk(np.arange(20, dtype=np.float32).reshape(1, 4, 5))
        itk.SetDirection([entry for row in tilted for entry in row])
        itk.SetOrigin([10 * k + shift * tilted[k][0] for k in range(3)])
        sitk.WriteImage(itk, str(tmp_path / "a.mha"))
        images.append(read_image(tmp_path / "a.mha"))
    np.testing.assert_allclose(np.subtract(images[1].origin, images[0].origin), (2.0, 0.0), atol=1e-9)
    assert images[0].direction == ((1.0, 0.0), (0.0, 1.0))


def test_series_of_one_volume_is_the_volume(tmp_path):
    values = np.random.default_rng(0).random((1, 4, 5, 6), dtype=np.float32)
    sitk.WriteImage(_itk(values), str(tmp_path / "a.nii.gz"))
    np.testing.assert_array_equal(read_image(tmp_path / "a.nii.gz").data[0].numpy(), values)


def test_writing_replaces_whole_and_makes_folders(tmp_path, make_image):
    path = tmp_path / "new" / "folder" / "a.mha"
    for channels in (1, 2):
        write_image(make_image((6, 7), channels=channels), path)
        assert read_image(path).data.shape[1] == channels
    assert [p.name for p in path.parent.iterdir()] == ["a.mha"]


@pytest.mark.parametrize(
    ("ending", "share"),
    [
        (e, s)
        for e in (".nii", ".nii.gz", ".mha", ".nrrd", ".png", ".jpg", ".bmp", ".tif")
        for s in (0.0, 0.1, 0.7, 0.97)
    ],
)
def test_damaged_files_are_refused_quietly(tmp_path, capfd, ending, share):
    """A file that breaks off is never read as if it were whole, and nothing but our error is said."""
    values = np.random.default_rng(0).integers(0, 255, (60, 70)).astype(np.uint8)
    path = tmp_path / f"broken{ending}"
    sitk.WriteImage(_itk(values), str(path))
    _bytes(path, share)
    with pytest.raises(InputError, match="broken"):
        read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("no.png", lambda p: None, "does not exist"),
        ("folder.png", lambda p: p.mkdir(), "is a folder"),
        ("text.png", lambda p: p.write_text("hello"), "no image of a known format"),
        ("text.txt", lambda p: p.write_text("hello"), "no image of a known format"),
        ("series.nii.gz", lambda p: sitk.WriteImage(_itk(np.zeros((3, 4, 5, 6))), str(p)), "is a series"),
        ("line.mha", lambda p: sitk.WriteImage(_itk(np.zeros((1, 1, 6))), str(p)), "at least two axes"),
        ("complex.nii.gz", lambda p: sitk.WriteImage(_itk(np.zeros((4, 5), np.complex64)), str(p)), "complex"),
        ("bad.nii.gz", lambda p: p.write_bytes(gzip.compress(b"x" * 1000)), "no image of a known format"),
    ],
)
def test_wrong_files_are_named(tmp_path, capfd, name, make, message):
    path = tmp_path / name
    make(path)
    with pytest.raises(InputError, match=message) as error:
        read_image(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_missing_file_suggests_a_neighbour(tmp_path, make_image):
    write_image(make_image((6, 7)), tmp_path / "moving.mha")
    with pytest.raises(InputError, match=r"did you mean 'moving.mha'"):
        read_image(tmp_path / "movin.mha")


def test_sheared_nifti_is_explained(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    affine = np.eye(4)
    affine[0, 1] = 0.3
    nibabel.save(nibabel.Nifti1Image(np.zeros((5, 6, 7), np.float32), affine), tmp_path / "a.nii.gz")
    with pytest.raises(InputError, match="not at right angles"):
        read_image(tmp_path / "a.nii.gz")


@pytest.mark.parametrize(
    ("name", "channels", "kind", "message"),
    [
        ("a.xyz", 1, "uint8", "no ending that can be written"),
        ("a.png", 2, "uint8", "cannot hold"),
        ("a.png", 1, "float32", "cannot hold"),
        ("a.jpg", 4, "uint8", "cannot hold"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(tmp_path, make_image, name, channels, kind, message):
    with pytest.raises(InputError, match=message):
        write_image(make_image((6, 7), channels=channels, pixel_type=kind), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_no_place_to_write_is_said(tmp_path, make_image):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="is not a folder"):
        write_image(make_image((6, 7)), tmp_path / "file" / "a.mha")


@pytest.mark.parametrize(
    ("moving", "kind", "channels", "ending"),
    [
        ("a.PNG", "uint8", 3, ".png"),
        ("a.gif", "uint8", 3, ".png"),
        ("a.jpeg", "uint8", 1, ".jpeg"),
        ("a.tif", "int32", 1, ".tif"),
        ("a.nii.gz", "int16", 1, ".nii.gz"),
        ("a.dcm", "int16", 1, ".nii.gz"),
        ("a.png", "uint8", 2, ".nii.gz"),
    ],
)
def test_results_are_stored_like_their_source(make_image, moving, kind, channels, ending):
    assert ending_like(Path(moving), make_image((6, 7), channels=channels, pixel_type=kind)) == ending


@pytest.mark.parametrize("kind", ["uint8", "int16", "uint16", "int32", "float64"])
def test_every_kind_of_number_is_read(folder, kind):
    save(volume(kind), folder / "a.nii.gz")
    image = read_image("a.nii.gz")
    assert image.pixel_type == kind
    np.testing.assert_allclose(image.data[0, 0].numpy(), volume(kind).astype(np.float32))


@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_black_and_white_is_an_image(folder, ending):
    pil = pytest.importorskip("PIL.Image")
    values = volume(shape=(30, 40)) > 100
    pil.fromarray(values).save(folder / f"a{ending}")
    data = read_image(f"a{ending}").data[0, 0]
    assert torch.equal(data == data.max(), torch.from_numpy(values))


@pytest.mark.parametrize("name", ["absent_mask.nii.gz", "sound.nii"])
def test_a_mask_that_is_not_there_is_an_error(folder, name):
    with pytest.raises(InputError, match="does not exist"):
        read_image(name)


@pytest.mark.parametrize(
    ("ending", "spacing", "unit"),
    [
        (".png", 1.0, "px"),
        (".png", 0.5, "mm"),
        (".jpg", 1.0, "px"),
        (".jpg", 0.5, "px"),
        (".bmp", 1.0, "px"),
        (".bmp", 0.5, "px"),
        (".tif", 1.0, "mm"),
        (".tif", 0.5, "mm"),
        (".nii.gz", 1.0, "mm"),
        (".mha", 1.0, "mm"),
    ],
)
def test_files_without_a_spacing_count_in_pixels(tmp_path, ending, spacing, unit):
    """JPEG and BMP keep no scale: their dots per inch are those of a print."""
    image = Image(torch.zeros(1, 1, 12, 15), Grid((12, 15), (spacing, spacing)), pixel_type="uint8")
    write_image(image, tmp_path / f"a{ending}")
    assert read_image(tmp_path / f"a{ending}").unit == unit


@pytest.mark.parametrize(("code", "unit", "size"), [(2, "mm", 1.0), (3, "µm", 1e-3), (1, "mm", 1e3), (0, "mm", 1.0)])
def test_nifti_says_its_unit(tmp_path, make_image, code, unit, size):
    """Metres, millimetres, micrometres or nothing: ITK gives millimetres."""
    write_image(make_image((8, 9, 10)), tmp_path / "a.nii")
    head = bytearray((tmp_path / "a.nii").read_bytes())
    head[123] = code | 8  # xyzt_units, 8 is seconds
    (tmp_path / "a.nii").write_bytes(head)
    image = read_image(tmp_path / "a.nii")
    assert image.unit == unit
    assert image.grid.spacing == pytest.approx((size,) * 3)
