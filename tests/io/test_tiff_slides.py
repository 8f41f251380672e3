"""Slides: known by content under any name; the full picture at its scale, without label, macro and smaller copies."""

import os

import numpy as np
import pytest

from torchdeform.errors import InputError
from torchdeform.io import gate, read_image, tiff
from torchdeform.io.images import ending_like, image_size
from torchdeform.io.tiff import tiff_parts, tiff_size

tifffile = pytest.importorskip("tifffile")
PIL = pytest.importorskip("PIL.Image")
APERIO = "Aperio Image Library v11.2.1\r\n"
MPP = 0.499


def tissue(shape=(192, 256)):
    return np.random.default_rng(0).integers(0, 255, (*shape, 3)).astype(np.uint8)


def write(path, *pages, **how):
    """Write pages ``(pixels, options)``, one after another."""
    with tifffile.TiffWriter(path, **how) as file:
        for pixels, options in pages:
            file.write(pixels, photometric="rgb", metadata=None, **options)


def aperio(path, *, half=False, aside=True, **how):
    base = tissue()
    pages = [(base, {"tile": (64, 64), "description": f"{APERIO}256x192 (64x64) |AppMag = 20|MPP = {MPP}"})]
    pages += [(base[::2, ::2], {})] if half else [(base[::8, ::8], {"description": f"{APERIO}256x192 -> 32x24"})]
    if aside:
        pages += [(base[::4, ::4], {"tile": (64, 64), "description": f"{APERIO}256x192 -> 64x48"})]
        pages += [(base[:40, :60], {"subfiletype": 1}), (base[:30, :90], {"subfiletype": 9})]
    write(path, *pages, **how)
    return base


def is_the_base(image, base, spacing=(MPP * 1e-3,) * 2, unit="µm"):
    assert image.data.shape[1:] == (3, *base.shape[:2])
    assert np.array_equal(image.data[0].numpy(), np.moveaxis(base, -1, 0))
    np.testing.assert_allclose(image.grid.spacing, spacing)
    assert image.unit == unit


@pytest.mark.parametrize("name", ["a.svs", "a.tif", "a", "a.png", "a.dcm", "a.scan", "a.SVS"])
@pytest.mark.parametrize("how", [{}, {"half": True, "aside": False}, {"aside": False}, {"bigtiff": True}])
def test_a_slide_is_its_base_level(tmp_path, name, how):
    base = aperio(tmp_path / name, **how)
    is_the_base(read_image(tmp_path / name), base)
    assert tiff_size(tmp_path / name) == image_size(tmp_path / name) == (base.shape[:2], 3)


def test_results_of_slides_are_tiff(tmp_path):
    aperio(tmp_path / "a.svs")
    assert ending_like(tmp_path / "a.svs", read_image(tmp_path / "a.svs")) == ".tif"


def test_tiles_of_jpeg_are_read(tmp_path):
    base = np.kron(tissue((12, 16)), np.ones((16, 16, 1), np.uint8))
    PIL.fromarray(base).save(
        tmp_path / "a.svs", "TIFF", compression="jpeg", quality=95, tiffinfo={270: f"{APERIO}|MPP = {MPP}"}
    )
    image = read_image(tmp_path / "a.svs")
    assert np.abs(image.data[0].numpy() - np.moveaxis(base, -1, 0)).mean() < 20
    np.testing.assert_allclose(image.grid.spacing, (MPP * 1e-3,) * 2)


def test_a_pyramid_in_ome(tmp_path):
    base = tissue()
    with tifffile.TiffWriter(tmp_path / "a.ome.tif") as file:
        about = {"axes": "YXS", "PhysicalSizeX": 0.25, "PhysicalSizeY": 0.25}
        file.write(base, photometric="rgb", tile=(64, 64), subifds=2, metadata=about)
        for step in (2, 4):
            file.write(base[::step, ::step], photometric="rgb", tile=(64, 64), subfiletype=1, metadata=None)
        file.write(base[:40, :60], photometric="rgb", metadata={"axes": "YXS", "Name": "label image"})
        file.write(base[:30, :90], photometric="rgb", metadata={"axes": "YXS", "Name": "macro image"})
    is_the_base(read_image(tmp_path / "a.ome.tif"), base, (0.25e-3,) * 2)


def test_labels_of_one_size_are_not_left_out_in_silence(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.ome.tif") as file:
        for name in ("image", "labels"):
            file.write(tissue(), photometric="rgb", metadata={"axes": "YXS", "Name": name})
    with pytest.raises(InputError, match="series of 2 images"):
        read_image(tmp_path / "a.ome.tif")


@pytest.mark.parametrize("how", [{"tile": (64, 64)}, {}])
def test_a_pyramid_of_reduced_pages(tmp_path, how):
    """As GDAL, libvips and ImageMagick write them, with a mask beside."""
    base = tissue()
    smaller = [(base[::step, ::step], {"subfiletype": 1, **how}) for step in (2, 4, 8)]
    thumbnail = (base[:50, :70], {"subfiletype": 1})
    micrometre = {"resolution": (20_000, 20_000), "resolutionunit": "CENTIMETER"}
    write(tmp_path / "a.tif", (base, {**how, **micrometre}), *smaller, thumbnail)
    is_the_base(read_image(tmp_path / "a.tif"), base, (0.5e-3,) * 2)


def test_a_mask_beside_a_picture_is_left_out(tmp_path):
    base = tissue()
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        file.write(base, photometric="rgb", metadata=None)
        file.write(base[:100, :100, 0] > 100, photometric="minisblack", subfiletype=4, metadata=None)
    is_the_base(read_image(tmp_path / "a.tif"), base, (1.0, 1.0), "px")


def test_ventanas_xml_says_the_scale(tmp_path):
    xml = b'<?xml version="1.0"?><EncodeInfo Ver="2"><iScan Magnification="40" ScanRes="0.2325"/></EncodeInfo>'
    base = tissue()
    pages = [(base[:60, :60], {"description": "Label Image"}), (base, {"description": "level=0 mag=40 quality=90"})]
    with tifffile.TiffWriter(tmp_path / "a.bif") as file:
        for pixels, options in pages:
            tag = [(700, 1, len(xml), xml, True)]
            file.write(pixels, photometric="rgb", metadata=None, tile=(16, 16), extratags=tag, **options)
    with tifffile.TiffFile(tmp_path / "a.bif") as file:
        assert "bif" in file.flags
    is_the_base(read_image(tmp_path / "a.bif"), base, (0.2325e-3,) * 2)


def test_a_slide_that_is_too_large_leads_to_a_level_that_fits(tmp_path, monkeypatch):
    """The command in the sentence is run as it stands."""
    aperio(tmp_path / "a.svs")
    for module in (gate, tiff):
        monkeypatch.setattr(module, "available", lambda: 500_000)
    with pytest.raises(InputError, match=r"save one of its smaller levels 1 \(64×48\)") as error:
        read_image(tmp_path / "a.svs")
    monkeypatch.chdir(tmp_path)
    exec(str(error.value).partition("give that: ")[2])
    level = read_image(tmp_path / "level.tif")
    is_the_base(level, tissue()[::4, ::4], (4 * MPP * 1e-3,) * 2)


def test_pages_of_different_sizes_are_still_refused(tmp_path):
    write(tmp_path / "a.tif", (tissue(), {}), (tissue((100, 90)), {}))
    with pytest.raises(InputError, match="pages of different sizes"):
        read_image(tmp_path / "a.tif")


def ome_in_two_files(folder, name):
    """An OME-TIFF of two planes, the second of which is said to be in ``name``."""
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:1">'
        '<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint8" SizeX="20" SizeY="10" SizeZ="2"'
        ' SizeC="1" SizeT="1"><Channel ID="Channel:0:0" SamplesPerPixel="1"/>'
        '<TiffData IFD="0" FirstZ="0" PlaneCount="1"><UUID FileName="a.ome.tif">urn:uuid:1</UUID></TiffData>'
        f'<TiffData IFD="0" FirstZ="1" PlaneCount="1"><UUID FileName="{name}">urn:uuid:2</UUID></TiffData>'
        "</Pixels></Image></OME>"
    )
    planes = np.random.default_rng(0).integers(0, 255, (2, 10, 20)).astype(np.uint8)
    tifffile.imwrite(folder / "a.ome.tif", planes[0], description=xml, metadata=None)
    return planes


def test_an_ome_image_in_two_files(tmp_path):
    planes = ome_in_two_files(tmp_path, "b.ome.tif")
    tifffile.imwrite(tmp_path / "b.ome.tif", planes[1], metadata=None)
    assert tiff_parts(tmp_path / "a.ome.tif") == [tmp_path / "b.ome.tif"]
    assert np.array_equal(read_image(tmp_path / "a.ome.tif").data[0, 0].numpy(), planes)


@pytest.mark.parametrize("name", ["b.ome.tif", "../b.ome.tif", "/dev/zero", "pipe.tif"])
def test_parts_that_are_missing_elsewhere_or_no_files(tmp_path, name):
    ome_in_two_files(tmp_path, name)
    if name == "pipe.tif":
        if not hasattr(os, "mkfifo"):
            pytest.skip("no pipes here")
        os.mkfifo(tmp_path / name)
    with pytest.raises(
        InputError, match=r"a\.ome\.tif is an image in several files: .*(does not exist|not beside|device or a pipe)"
    ):
        read_image(tmp_path / "a.ome.tif")
    assert image_size(tmp_path / "a.ome.tif") is None


def test_other_tiffs_are_in_one_file(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", tissue(), photometric="rgb")
    assert tiff_parts(tmp_path / "a.tif") == []
