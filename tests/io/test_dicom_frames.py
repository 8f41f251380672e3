"""Frames of one file are slices like those of a series: sorted, scaled, checked, told apart."""

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import torch
from dicom_files import AXES, ORIGIN, SIZE, SPACING, enhanced, item, picture, place, save, single, volume

from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.images import image_size


def same(one, other):
    assert (one.grid, one.unit) == (other.grid, other.unit)
    np.testing.assert_allclose(one.origin, other.origin, atol=1e-6)
    np.testing.assert_allclose(one.direction, other.direction, atol=1e-9)
    assert torch.equal(one.data, other.data)


def test_frames_are_the_volume_that_single_files_are(tmp_path):
    """Also of SimpleITK's reader of series; spacing comes from the positions, not from a header's number."""
    folder, values = single(tmp_path / "single", volume()), volume()
    frames = read_image(enhanced(tmp_path / "frames.dcm", values))
    same(frames, read_image(folder))
    theirs = sitk.ReadImage(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder)))
    np.testing.assert_allclose(frames.grid.spacing, theirs.GetSpacing()[::-1], rtol=1e-5)
    np.testing.assert_allclose(frames.origin, theirs.GetOrigin(), atol=1e-5)
    np.testing.assert_allclose(np.ravel(frames.direction), theirs.GetDirection(), atol=1e-5)
    assert np.array_equal(frames.data[0, 0].numpy(), sitk.GetArrayFromImage(theirs))
    assert image_size(tmp_path / "frames.dcm") == image_size(folder) == ((10, *SIZE[::-1]), 1)


def test_frames_in_any_order_are_sorted(tmp_path):
    order = np.random.default_rng(1).permutation(10)
    values = volume()
    shuffled = enhanced(tmp_path / "a.dcm", values[order], [place(k) for k in order])
    same(read_image(shuffled), read_image(enhanced(tmp_path / "b.dcm", values)))


def test_every_frame_has_its_own_scale(tmp_path):
    scales = [
        {"PixelValueTransformationSequence": item(RescaleSlope=1 + k, RescaleIntercept=-5 * k, RescaleType="US")}
        for k in range(10)
    ]
    values = volume()
    image = read_image(enhanced(tmp_path / "a.dcm", values, frames=scales))
    k = np.arange(10).reshape(-1, 1, 1)
    assert np.array_equal(image.data[0, 0].numpy(), values * (1.0 + k) - 5.0 * k)
    assert image.pixel_type == "float32"


def test_few_frames_are_a_volume_and_one_is_a_picture(tmp_path):
    assert read_image(enhanced(tmp_path / "a.dcm", volume(3))).grid.shape == (3, *SIZE[::-1])
    assert read_image(enhanced(tmp_path / "b.dcm", volume(1))).grid.shape == SIZE[::-1]


def test_files_that_continue_each_other(tmp_path):
    values = volume(12)
    for k in range(2):
        part = slice(6 * k, 6 * k + 6)
        path = enhanced(tmp_path / f"{k}.dcm", values[part], [place(j) for j in range(12)[part]])
        data = pydicom.dcmread(path)
        data.ConcatenationUID = "1.2.3.7"
        data.save_as(path)
    for path in (tmp_path, tmp_path / "0.dcm", tmp_path / "1.dcm"):
        assert np.array_equal(read_image(path).data[0, 0].numpy(), values)


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([place(k) for k in range(12) if k not in (6, 7)], "2 slices are missing between frame 6 and frame 7"),
        ([place(k) for k in range(11) if k != 4], "1 slice is missing between frame 4 and frame 5"),
        ([place(k) for k in (*range(9), 4)], "frame 5 and frame 10 are slices at the same position"),
        ([place(k, sideways=0.4) for k in range(10)], r"shifted sideways by 0\.4 mm each \(a tilted gantry\)"),
        ([place(k if k < 5 else k + 0.3) for k in range(10)], "unevenly spaced .3.25 mm between frame 5 and frame 6"),
        ([place(k, sideways=2.0 * (k == 5)) for k in range(10)], r"shifted sideways by 10 mm"),
    ],
)
def test_what_is_wrong_with_frames_is_named(tmp_path, positions, message):
    with pytest.raises(InputError, match=message) as error:
        read_image(enhanced(tmp_path / "a.dcm", volume(10), positions))
    assert "\n" not in str(error.value)


KINDS = {
    "stack": lambda k: {"FrameContentSequence": item(StackID=str(k))},
    "time point": lambda k: {"FrameContentSequence": item(TemporalPositionIndex=k + 1)},
    "time": lambda k: {"TemporalPositionSequence": item(TemporalPositionTimeOffset=1.5 * k)},
    "echo time": lambda k: {"MREchoSequence": item(EffectiveEchoTime=10.0 * (k + 1))},
    "inversion time": lambda k: {"MRModifierSequence": item(InversionTimes=10.0 * (k + 1))},
    "b-value": lambda k: {"MRDiffusionSequence": item(DiffusionBValue=1000.0 * k)},
    "gradient": lambda k: {
        "MRDiffusionSequence": item(
            DiffusionGradientDirectionSequence=item(DiffusionGradientOrientation=[1.0 - k, 1.0 * k, 0.0])
        )
    },
    "component": lambda k: {"MRImageFrameTypeSequence": item(ComplexImageComponent=["MAGNITUDE", "PHASE"][k])},
    "kind of image": lambda k: {"CTImageFrameTypeSequence": item(FrameType=["ORIGINAL", "PRIMARY", "MAX"][: 2 + k])},
}


@pytest.mark.parametrize("together", [True, False])
@pytest.mark.parametrize("name", KINDS)
def test_several_volumes_in_one_file_are_told_apart(tmp_path, name, together):
    """Whether their frames follow each other or alternate."""
    which = [k // 5 if together else k % 2 for k in range(10)]
    positions = [place(k % 5 if together else k // 2) for k in range(10)]
    path = enhanced(tmp_path / "a.dcm", volume(10), positions, [KINDS[name](k) for k in which])
    for given in (path, tmp_path):
        with pytest.raises(
            InputError, match=rf"holds 2 volumes that differ in {name} \(.*; convert it with `dcm2niix`"
        ):
            read_image(given)
    assert image_size(path) is None


def test_one_time_point_echo_and_stack_is_a_volume(tmp_path):
    more = [{sequence: value for name in KINDS for sequence, value in KINDS[name](0).items()} for _ in range(10)]
    assert read_image(enhanced(tmp_path / "a.dcm", volume(), frames=more)).grid.shape == (10, *SIZE[::-1])


def test_moments_without_numbers_are_a_series_over_time(tmp_path):
    more = [{"FrameContentSequence": item(FrameAcquisitionDateTime=f"2026010112{k:02d}00")} for k in range(10)]
    path = enhanced(tmp_path / "a.dcm", volume(10), [place(k % 5) for k in range(10)], more)
    with pytest.raises(InputError, match="is a DICOM series over time, 10 frames at 5 positions; convert it"):
        read_image(path)


def test_slices_that_are_turned_are_other_volumes(tmp_path):
    turned = {"PlaneOrientationSequence": item(ImageOrientationPatient=[1, 0, 0, 0, 0, -1])}
    path = enhanced(tmp_path / "a.dcm", volume(10), frames=[turned if k > 5 else {} for k in range(10)])
    with pytest.raises(InputError, match="2 volumes that differ in orientation;"):
        read_image(path)


def test_files_of_a_series_with_two_weightings(tmp_path):
    """A file stands for the volume of its own weighting, the folder is refused."""
    values = volume(20)
    for k in range(20):
        weight = 1000.0 * (k % 2)
        data = picture(values[k], ImagePositionPatient=place(k // 2), DiffusionBValue=weight, PixelSpacing=[0.9, 0.7])
        data.ImageOrientationPatient = [float(x) for x in AXES[:, :2].T.ravel().round(9)]
        save(data, tmp_path / f"{k}.dcm")
    assert np.array_equal(read_image(tmp_path / "3.dcm").data[0, 0].numpy(), values[1::2])
    with pytest.raises(InputError, match="holds 2 DICOM series"):
        read_image(tmp_path)


def test_frames_at_offsets_from_one_position(tmp_path):
    """A dose grid: slices at listed offsets, in its own unit of dose."""
    values = volume(6)
    data = picture(values, "1.2.840.10008.5.1.4.1.1.481.2", ImagePositionPatient=ORIGIN.tolist(), DoseGridScaling=0.01)
    data.ImageOrientationPatient, data.PixelSpacing = [1, 0, 0, 0, 1, 0], [0.9, 0.7]
    data.GridFrameOffsetVector = [3.0 * k for k in range(6)]
    image = read_image(save(data, tmp_path / "dose.dcm"))
    np.testing.assert_allclose(image.grid.spacing, (3.0, 0.9, 0.7))
    np.testing.assert_allclose(image.origin, ORIGIN)
    np.testing.assert_allclose(image.data[0, 0].numpy(), values * 0.01, rtol=1e-6)


def test_nuclear_frames_have_a_step_that_may_be_negative(tmp_path):
    data = picture(volume(6), Modality="NM", PixelSpacing=[0.9, 0.7], SpacingBetweenSlices=-SPACING[2])
    data.DetectorInformationSequence = item(ImagePositionPatient=[1, 2, 3], ImageOrientationPatient=[1, 0, 0, 0, 1, 0])
    image = read_image(save(data, tmp_path / "a.dcm"))
    assert image.origin == (1.0, 2.0, 3.0 - 5 * SPACING[2])
    assert np.array_equal(image.data[0, 0].numpy(), volume(6)[::-1])


def test_frames_without_any_spacing_are_pixels(tmp_path):
    image = read_image(save(picture(volume(6)), tmp_path / "a.dcm"))
    assert (image.grid.spacing, image.unit) == ((1.0, 1.0, 1.0), "px")


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        ({"FrameTime": 33.0}, "is a cine of 6 frames; export one frame"),
        ({"FrameTimeVector": [0, 33.0, 33, 33, 33, 33]}, "is a cine of 6 frames"),
        ({"NumberOfTimeSlots": 2}, "is a cine of 6 frames"),
        ({"ImageType": ["ORIGINAL", "PRIMARY", "M", "MOSAIC"]}, "is a mosaic, all slices tiled in one picture;"),
        ({"SOPClassUID": "1.2.840.10008.5.1.4.1.1.77.1.6"}, "is a slide in tiles; convert it to TIFF"),
        ({"SOPClassUID": "1.2.840.10008.5.1.4.1.1.66.4"}, "holds a segmentation, no image; convert it to labels"),
        ({"SOPClassUID": "1.2.840.10008.5.1.4.1.1.481.3"}, "holds contours, no image; convert them to labels"),
        ({"PixelSpacing": [1, 1]}, "does not say how far apart its 6 frames are; convert it with `dcm2niix`"),
        ({"GridFrameOffsetVector": [0.0, 1.0]}, "is damaged or incomplete"),
        ({"PixelSpacing": [0, 1], "SpacingBetweenSlices": 2}, "has the pixel spacing .* in its header; correct"),
        ({"ImageOrientationPatient": [1, 0, 0, 1, 0, 0]}, "has an orientation in its header that is no plane"),
        ({"NumberOfFrames": 10**9}, "is damaged or incomplete"),
        ({"NumberOfFrames": 7}, "is damaged or incomplete"),
        ({"Rows": 60000}, "is damaged or incomplete"),
        ({"Rows": 0}, "is damaged or incomplete"),
        ({"PerFrameFunctionalGroupsSequence": item(), "FrameTime": 3}, "is damaged or incomplete"),
        ({"PerFrameFunctionalGroupsSequence": 6 * item()}, "does not say where its 6 frames are; convert"),
    ],
)  # fmt: skip
def test_frames_that_are_no_volume_are_told_what_they_are(tmp_path, elements, message):
    path = save(picture(volume(6), **elements), tmp_path / "a.dcm")
    with pytest.raises(InputError, match=message) as error:
        read_image(path)
    assert "\n" not in str(error.value)


def test_slices_without_a_place_are_no_volume(tmp_path):
    for k in range(9):
        save(picture(volume(1)[0], SOPInstanceUID=f"1.2.{k}"), tmp_path / f"{k}.dcm")
    assert read_image(tmp_path / "3.dcm").grid.shape == SIZE[::-1]
    with pytest.raises(InputError, match="holds 9 DICOM images that do not say where they are"):
        read_image(tmp_path)
