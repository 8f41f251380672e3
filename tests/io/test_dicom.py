"""DICOM: files, series and folders, their place in the world, and everything that can be wrong with a series."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchdeform.errors import InputError
from torchdeform.io import read_image

# Columns: world directions of rows, columns and slices; oblique.
AXES = np.array([[0.936293363584, -0.275095847318, 0.218350663146],
                 [0.289629477625, 0.956425085849, -0.036957013525],
                 [-0.198669330795, 0.097843395007, 0.975170327202]])  # fmt: skip
SPACING, ORIGIN, SIZE = (0.7, 0.9, 2.5), np.array([-31.0, 22.0, 140.0]), (40, 30)


def pixels(index: float) -> np.ndarray:
    return np.random.default_rng(int(index)).integers(-100, 1000, SIZE[::-1]).astype(np.int16)


def write_slice(path: Path, index: float, *, series: str = "1.2.3", tilt: float = 0.0, **tags: str) -> None:
    """Write slice ``index`` of a volume, shifted sideways by ``tilt`` mm a slice."""
    position = ORIGIN + AXES[:, 2] * SPACING[2] * index + AXES[:, 1] * tilt * index
    image = sitk.GetImageFromArray(pixels(index)[None])
    image.SetSpacing(SPACING)
    image.SetOrigin(position.tolist())
    image.SetDirection(AXES.ravel().tolist())
    about = {
        "0020|000e": series, "0020|000d": "1.2", "0008|0018": f"{series}.{index}.{abs(hash(path.name)) % 10**6}",
        "0008|0060": "MR", "0020|0013": str(index), "0008|103e": f"scan {series}",
        "0020|0032": "\\".join(f"{x:.9f}" for x in position),
        "0020|0037": "\\".join(f"{x:.9f}" for x in (*AXES[:, 0], *AXES[:, 1])),
    } | {key.replace("_", "|"): value for key, value in tags.items()}  # fmt: skip
    for key, value in about.items():
        image.SetMetaData(key, value)
    writer = sitk.ImageFileWriter()
    writer.SetImageIO("GDCMImageIO")
    writer.KeepOriginalImageUIDOn()
    writer.SetFileName(str(path))
    writer.Execute(image)


def write_series(folder: Path, indices=range(10), *, ending: str = ".dcm", **how) -> Path:
    """Write slices under names whose order is not that of their positions."""
    folder.mkdir(exist_ok=True)
    for index in indices:
        write_slice(folder / f"{how.get('series', 'a')}-{(7 * index) % 31:02d}{ending}", index, **how)
    return folder


@pytest.mark.parametrize("ending", [".dcm", "", ".IMA"])
def test_a_folder_and_each_of_its_files_are_the_volume(tmp_path, ending):
    folder = write_series(tmp_path / "scan", ending=ending)
    for path in (folder, sorted(folder.iterdir())[3]):
        image = read_image(path)
        assert image.name == str(path)
        assert image.grid.shape == (10, *SIZE[::-1])
        np.testing.assert_allclose(image.grid.spacing, SPACING[::-1], rtol=1e-6)
        np.testing.assert_allclose(image.origin, ORIGIN, atol=1e-6)
        np.testing.assert_allclose(image.direction, AXES, atol=1e-6)
        for index in range(10):
            assert np.array_equal(image.data[0, 0, index].numpy(), pixels(index))


def test_every_voxel_is_where_itk_has_it(tmp_path):
    """SimpleITK's own reader of the sorted files puts the same value at the same place in the world."""
    folder = write_series(tmp_path / "scan")
    theirs = sitk.ReadImage(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder)))
    ours = read_image(folder)
    world = ours.to_world(ours.grid.points(dtype=torch.float64))
    for index in ((0, 0, 0), (5, 20, 9), (39, 29, 3)):
        place = world[(0, slice(None), *index[::-1])].tolist()
        np.testing.assert_allclose(theirs.TransformPhysicalPointToContinuousIndex(place), index, atol=1e-3)
        assert theirs[index] == ours.data[(0, 0, *index[::-1])]


def test_slices_with_scales_of_their_own(tmp_path):
    """Each slice's own slope counts, as in PET."""
    folder = tmp_path / "pet"
    folder.mkdir()
    for index in range(9):
        write_slice(folder / f"{index}.dcm", index, **{"0028_1053": str(1 + index), "0028_1052": "0"})
    single = []
    for index in range(9):
        alone = tmp_path / f"alone{index}"
        alone.mkdir()
        shutil.copy(folder / f"{index}.dcm", alone)
        single.append(read_image(alone / f"{index}.dcm").data[0, 0])
    torch.testing.assert_close(read_image(folder).data[0, 0], torch.stack(single))


def test_one_slice_is_a_2d_image_of_its_spacing(tmp_path):
    write_slice(tmp_path / "a.dcm", 0)
    image = read_image(tmp_path / "a.dcm")
    assert image.grid.shape == SIZE[::-1]
    np.testing.assert_allclose(image.grid.spacing, SPACING[1::-1])
    assert read_image(tmp_path).grid == image.grid
    assert image.unit == "mm"


def test_pixels_of_a_slice_without_spacing_are_no_millimetres(tmp_path):
    picture = sitk.GetImageFromArray(pixels(0)[None])
    sitk.WriteImage(picture, str(tmp_path / "a.dcm"))
    content = (tmp_path / "a.dcm").read_bytes()
    for group, element in ((b"\x28\x00", b"\x30\x00"), (b"\x18\x00", b"\x10\x20")):  # ITK has two tags for it
        content = content.replace(group + element, group + b"\x39\x20")
    (tmp_path / "b.dcm").write_bytes(content)
    assert [read_image(tmp_path / name).unit for name in ("a.dcm", "b.dcm")] == ["mm", "px"]


@pytest.mark.parametrize("count", range(2, 8))
def test_few_slices_are_a_volume_too(tmp_path, count):
    folder = write_series(tmp_path / "scan", range(count))
    for path in (folder, next(folder.iterdir())):
        assert read_image(path).grid.shape == (count, *SIZE[::-1])


def test_a_copy_of_one_of_two_slices_is_named(tmp_path):
    folder = write_series(tmp_path / "scan", range(2))
    shutil.copy(next(folder.iterdir()), folder / "copy.dcm")
    for path in (folder, folder / "copy.dcm"):
        with pytest.raises(InputError, match="are slices at the same position; remove one of them"):
            read_image(path)


def test_views_of_three_directions_are_2d_each(tmp_path):
    """A localizer has one series number for slices that cross."""
    for name, axes in (("a", "1\\0\\0\\0\\1\\0"), ("b", "1\\0\\0\\0\\0\\-1"), ("c", "0\\1\\0\\0\\0\\-1")):
        write_slice(tmp_path / f"{name}.dcm", 0, **{"0020_0037": axes})
    assert read_image(tmp_path / "b.dcm").grid.shape == SIZE[::-1]
    with pytest.raises(InputError, match=r"holds 3 DICOM series: 'scan 1.2.3' \(1 file, a.dcm for one\)"):
        read_image(tmp_path)


@pytest.mark.parametrize("tags", [{"0018_1060": "{moment}"}, {"0008_0032": "1200{moment:02d}"}, {}])
def test_frames_of_a_beating_heart_are_2d(tmp_path, tags):
    """Several moments at each position: a frame is an image, the folder is refused with advice."""
    for index in range(9):
        for moment in range(3):
            values = {key: value.format(moment=moment) for key, value in tags.items()}
            write_slice(tmp_path / f"{index}-{moment}.dcm", index, **values)
    assert read_image(tmp_path / "4-1.dcm").grid.shape == SIZE[::-1]
    with pytest.raises(InputError, match="series over time, 27 frames at 9 positions; give one of its files"):
        read_image(tmp_path)


@pytest.mark.parametrize("tag", ["0018_0086", "0020_0100"])
def test_echoes_and_moments_with_numbers_are_volumes_each(tmp_path, tag):
    for index in range(9):
        for number in (1, 2):
            write_slice(tmp_path / f"{index}-{number}.dcm", index, **{tag: str(number)})
    assert read_image(tmp_path / "0-2.dcm").grid.shape == (9, *SIZE[::-1])
    with pytest.raises(InputError, match="holds 2 DICOM series"):
        read_image(tmp_path)


def test_several_series_are_listed_and_one_file_chooses(tmp_path):
    write_series(tmp_path, range(10), series="1.2.3")
    write_series(tmp_path, range(12), series="1.2.4")
    with pytest.raises(InputError) as error:
        read_image(tmp_path)
    for word in ("2 DICOM series", "'scan 1.2.3' (10 files", "'scan 1.2.4' (12 files", "give one file of the series"):
        assert word in str(error.value)
    assert read_image(tmp_path / "1.2.4-00.dcm").grid.shape[0] == 12


def test_other_files_in_the_folder_do_not_matter(tmp_path):
    folder = write_series(tmp_path / "scan")
    (folder / "notes.txt").write_text("hello", encoding="utf-8")
    (folder / "report.pdf").write_bytes(b"%PDF" + bytes(500))
    directory = b"\0" * 128 + b"DICM\x02\0\x02\0UI\x14\x001.2.840.10008.1.3.10\0" + bytes(200)
    (folder / "DICOMDIR").write_bytes(directory)
    assert read_image(folder).grid.shape[0] == 10
    with pytest.raises(InputError, match="holds no DICOM image"):
        read_image(folder / "DICOMDIR")


def broken(tmp_path: Path, what: str) -> Path:
    folder = write_series(tmp_path / "scan", [k for k in range(12) if what != "missing" or k not in (4, 5)])
    names = {index: folder / f"a-{(7 * index) % 31:02d}.dcm" for index in range(12)}
    if what == "doubled":
        shutil.copy(names[4], folder / "copy.dcm")
    elif what == "tilted":
        write_series(folder, range(12), tilt=0.4)
    elif what == "cut":
        content = names[4].read_bytes()
        names[4].write_bytes(content[: len(content) // 2])
    return folder


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("missing", "2 slices are missing between a-21.dcm and a-11.dcm"),
        ("doubled", "a-28.dcm and copy.dcm are slices at the same position"),
        ("tilted", "shifted sideways by 0.4 mm each"),
        ("cut", "a-28.dcm is damaged or incomplete"),
    ],
)
def test_what_is_wrong_with_a_series_is_named(tmp_path, capfd, what, message):
    folder = broken(tmp_path, what)
    for path in (folder, folder / "a-00.dcm"):
        with pytest.raises(InputError, match=message) as error:
            read_image(path)
        assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_uneven_slices_are_named(tmp_path):
    for index in range(9):
        write_slice(tmp_path / f"{index}.dcm", index if index < 5 else index + 0.3)
    with pytest.raises(InputError, match=r"unevenly spaced \(3.25 mm between 4.dcm and 5.dcm, 2.5 mm elsewhere\)"):
        read_image(tmp_path)


def test_a_folder_without_dicom_says_what_it_has(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "a.txt").write_text("hello", encoding="utf-8")
    with pytest.raises(InputError, match=r"give the folder of one series \(it has inner\), or an image"):
        read_image(tmp_path)


def test_colour_is_kept(tmp_path):
    values = np.random.default_rng(0).integers(0, 255, (30, 40, 3)).astype(np.uint8)
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=True), str(tmp_path / "a.dcm"))
    np.testing.assert_array_equal(read_image(tmp_path / "a.dcm").data[0].numpy(), np.moveaxis(values, -1, 0))


@pytest.mark.data
@pytest.mark.parametrize("number", ["0020", "0028", "0040", "0048"])
def test_real_frames_of_a_heart(data_folder, number):
    image = read_image(data_folder / "heart_dicom_2d" / f"IM-0009-{number}.dcm")
    assert image.grid.shape == (256, 256)
    np.testing.assert_allclose(image.grid.spacing, 1.3672)


@pytest.mark.data
def test_a_real_folder_of_frames_is_refused(data_folder):
    with pytest.raises(InputError, match="series over time"):
        read_image(data_folder / "heart_dicom_2d")
