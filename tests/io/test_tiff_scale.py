"""Scale of a TIFF: taken where the file means one; the dots per inch of a print are none."""

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.io import read_image, write_image
from torchdeform.io.tiff_scale import NO_SCALE

tifffile = pytest.importorskip("tifffile")
PIL = pytest.importorskip("PIL.Image")


def values(shape=(20, 30), kind="uint16"):
    top = np.iinfo(kind).max if np.dtype(kind).kind in "ui" else 1.0
    return (np.random.default_rng(0).random(shape) * top).astype(kind)


def scale(path):
    image = read_image(path)
    return image.grid.spacing, image.unit


@pytest.mark.parametrize(
    ("unit", "known"),
    [("mm", 1.0), ("um", 1e-3), ("micron", 1e-3), ("\\u00B5m", 1e-3), ("nm", 1e-6), ("cm", 10.0), ("pixel", None)],
)
def test_imagej_says_the_spacing(tmp_path, unit, known):
    millimetres = known or 1.0
    where = {"axes": "ZYX", "spacing": 2.5, "unit": unit}
    tifffile.imwrite(
        tmp_path / "a.tif", values((5, 20, 30)), imagej=True, resolution=(1 / 0.5, 1 / 0.25), metadata=where
    )
    spacing, shown = scale(tmp_path / "a.tif")
    np.testing.assert_allclose(spacing, np.array([2.5, 0.25, 0.5]) * millimetres, rtol=1e-6)
    assert shown == {1e-3: "µm", 1e-6: "µm", None: "px"}.get(known, "mm")


def test_ome_says_the_spacing(tmp_path):
    sizes = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.25, "PhysicalSizeZ": 2.0}
    units = {f"{key}Unit": "µm" for key in sizes}
    tifffile.imwrite(tmp_path / "a.ome.tif", values((5, 20, 30)), metadata={"axes": "ZYX"} | sizes | units)
    spacing, shown = scale(tmp_path / "a.ome.tif")
    np.testing.assert_allclose(spacing, (2e-3, 0.25e-3, 0.5e-3))
    assert shown == "µm"


@pytest.mark.parametrize(
    ("unit", "length", "shown"),
    [("nm", 1e-6, "µm"), ("Å", 1e-7, "µm"), ("in", 25.4, "mm"), ("m", 1e3, "mm"), ("pixel", 1.0, "px"),
     ("reference frame", 1.0, "px")],
)  # fmt: skip
def test_units_of_ome(tmp_path, unit, length, shown):
    """Lengths in mm; what is no length counts pixels."""
    sizes = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.25, "PhysicalSizeXUnit": unit, "PhysicalSizeYUnit": unit}
    tifffile.imwrite(tmp_path / "a.ome.tif", values(), metadata={"axes": "YX"} | sizes)
    spacing, found = scale(tmp_path / "a.ome.tif")
    np.testing.assert_allclose(spacing, (0.25 * length, 0.5 * length))
    assert found == shown


@pytest.mark.parametrize("depth", [{}, {"PhysicalSizeZ": 2.0, "PhysicalSizeZUnit": "pixel"}])
def test_pages_without_a_distance_are_as_far_apart_as_columns_and_it_is_said(tmp_path, depth):
    sizes = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.25} | depth
    tifffile.imwrite(tmp_path / "a.ome.tif", values((5, 20, 30)), metadata={"axes": "ZYX"} | sizes)
    tifffile.imwrite(tmp_path / "b.tif", values((5, 20, 30)), photometric="minisblack", resolution=(2e4, 4e4),
                     resolutionunit="CENTIMETER", metadata=None)  # fmt: skip
    for name in ("a.ome.tif", "b.tif"):
        image = read_image(tmp_path / name)
        np.testing.assert_allclose(image.grid.spacing, (0.5e-3, 0.25e-3, 0.5e-3))
        assert ["does not say how far apart its pages are" in remark for remark in image.remarks] == [True]


@pytest.mark.parametrize(
    ("unit", "per_unit", "size"),
    [
        ("INCH", 72, None),  # screens
        ("INCH", 300, None),  # prints
        ("INCH", 4800, None),  # scanners
        ("INCH", 50_800, 0.5e-3),  # a microscope that counts in inches
        ("CENTIMETER", 28.35, None),
        ("CENTIMETER", 118.11, None),
        ("CENTIMETER", 400, None),
        ("CENTIMETER", 600, 10 / 600),
        ("CENTIMETER", 20_000, 0.5e-3),
        ("NONE", 20_000, None),
        ("NONE", 300, None),
    ],
)
@pytest.mark.parametrize("shape", [(20, 30), (5, 20, 30)])
def test_resolution_tags_count_if_finer_than_prints(tmp_path, unit, per_unit, size, shape):
    tifffile.imwrite(
        tmp_path / "a.tif",
        values(shape),
        photometric="minisblack",
        resolution=(per_unit, per_unit),
        resolutionunit=unit,
    )
    spacing, shown = scale(tmp_path / "a.tif")
    np.testing.assert_allclose(spacing[-2:], (size or 1.0,) * 2, rtol=1e-5)
    assert (spacing[:-2], shown) == (spacing[-1:] * (len(shape) - 2), "px" if size is None else "µm")


@pytest.mark.parametrize("dpi", [72, 300])
def test_imagejs_inches_are_those_of_a_print(tmp_path, dpi):
    """ImageJ writes the unit inch for a picture that it was given with dots per inch."""
    tifffile.imwrite(tmp_path / "a.tif", values(), imagej=True, resolution=(dpi, dpi), metadata={"unit": "inch"})
    assert scale(tmp_path / "a.tif") == ((1.0, 1.0), "px")


@pytest.mark.parametrize(("spacing", "unit"), [((0.25, 0.5), "mm"), ((1.0, 1.0), "px")])
def test_itk_means_the_spacing_that_it_writes_as_dots_per_inch(tmp_path, spacing, unit):
    itk = sitk.GetImageFromArray(values())
    itk.SetSpacing(spacing[::-1])
    sitk.WriteImage(itk, str(tmp_path / "a.tif"))
    found, shown = scale(tmp_path / "a.tif")
    np.testing.assert_allclose(found, spacing, rtol=1e-6)
    assert shown == unit


@pytest.mark.parametrize("unit", ["px", "mm", "µm"])
@pytest.mark.parametrize(
    ("kind", "channels"), [("uint8", 1), ("uint8", 3), ("uint16", 1), ("uint16", 2), ("float32", 1)]
)
@pytest.mark.parametrize("shape", [(5, 6), (4, 5, 6)])
def test_what_is_written_is_read_back(tmp_path, unit, kind, channels, shape):
    spacing = tuple(h * (1e-3 if unit == "µm" else 1.0) for h in (2.5, 0.25, 0.5)[-len(shape) :])
    data = torch.from_numpy(values((1, channels, *shape), kind).astype(np.float32))
    write_image(Image(data, Grid(shape, spacing), unit=unit, pixel_type=kind), tmp_path / "a.tif")
    back = read_image(tmp_path / "a.tif")
    assert torch.equal(back.data, data)
    assert (back.unit, back.pixel_type) == (unit, kind)
    np.testing.assert_allclose(back.grid.spacing, spacing, rtol=1e-6)


@pytest.mark.parametrize(("kind", "channels"), [("int16", 1), ("uint16", 3), ("float32", 3)])
def test_what_imagej_has_no_room_for_is_written_in_mm(tmp_path, kind, channels):
    data = torch.from_numpy(values((1, channels, 5, 6), kind).astype(np.float32))
    write_image(Image(data, Grid((5, 6), (0.25, 0.5)), pixel_type=kind), tmp_path / "a.tif")
    back = read_image(tmp_path / "a.tif")
    assert torch.equal(back.data, data)
    np.testing.assert_allclose(back.grid.spacing, (0.25, 0.5), rtol=1e-6)
    assert back.unit == "mm"


def test_electron_microscopes_say_metres(tmp_path):
    text = "[User]\r\nDate=1\r\n[Scan]\r\nPixelWidth=5e-09\r\nPixelHeight=4e-09\r\n"
    tag = (34682, 2, len(text) + 1, text, True)
    tifffile.imwrite(tmp_path / "a.tif", values(), extratags=[tag], metadata=None)
    spacing, unit = scale(tmp_path / "a.tif")
    np.testing.assert_allclose(spacing, (4e-6, 5e-6))
    assert unit == "µm"


@pytest.mark.parametrize("size", ["0", "-1", "nan", "inf"])
def test_sizes_without_sense_are_none(tmp_path, size):
    tifffile.imwrite(tmp_path / "a.ome.tif", values(), metadata={"PhysicalSizeX": 123.5, "PhysicalSizeY": 123.5})
    content = (tmp_path / "a.ome.tif").read_bytes()
    (tmp_path / "a.ome.tif").write_bytes(content.replace(b"123.5", size.ljust(5).encode()))
    assert scale(tmp_path / "a.ome.tif") == (NO_SCALE[0][1:], "px")


def test_geotiff_is_no_scale(tmp_path):
    """Degrees or metres of the ground."""
    tag = (33550, 12, 3, (30.0, 30.0, 0.0), True)
    tifffile.imwrite(tmp_path / "a.tif", values(), extratags=[tag], metadata=None)
    assert scale(tmp_path / "a.tif") == ((1.0, 1.0), "px")


def test_philips_says_the_spacing(tmp_path):
    levels = "".join(
        f'<Attribute Name="DICOM_PIXEL_SPACING" Element="0x0030">&quot;{h}&quot; &quot;{h}&quot;</Attribute>'
        for h in ("0.0005", "0.00025")
    )
    text = f'<?xml version="1.0"?><DataObject ObjectType="DPUfsImport">{levels}</DataObject>'
    tifffile.imwrite(tmp_path / "a.tiff", values(), description=text, software="Philips DP v1.0", metadata=None)
    spacing, unit = scale(tmp_path / "a.tiff")
    np.testing.assert_allclose(spacing, (0.25e-3, 0.25e-3))
    assert unit == "µm"
