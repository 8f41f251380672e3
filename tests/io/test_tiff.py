"""TIFF: pages, channels, numbers of any width, and files that make no sense."""

import struct
import zlib

import numpy as np
import pytest
import torch
from broken_files import outcome

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import gate, read_image, write_image
from torchdeform.io.images import image_size
from torchdeform.io.loading import load
from torchdeform.io.tiff import tiff_size

tifffile = pytest.importorskip("tifffile")
PIL = pytest.importorskip("PIL.Image")


def values(shape, kind="uint16"):
    top = np.iinfo(kind).max if np.dtype(kind).kind in "ui" else 1.0
    return (np.random.default_rng(0).random(shape) * top).astype(kind)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "int16", "uint32", "float32", "float64"])
@pytest.mark.parametrize("shape", [(20, 30), (5, 20, 30)])
def test_pages_are_a_volume_in_any_number(tmp_path, shape, kind):
    pixels = values(shape, kind)
    tifffile.imwrite(tmp_path / "a.tif", pixels, photometric="minisblack")
    image = read_image(tmp_path / "a.tif")
    assert (image.grid.shape, image.pixel_type) == (shape, kind)
    assert np.array_equal(image.data[0, 0].numpy(), pixels.astype(np.float32))


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "packbits", "tiff_adobe_deflate"])
def test_compressions_are_read(tmp_path, compression):
    pixels = values((20, 30), "uint8")
    PIL.fromarray(pixels).save(tmp_path / "a.tif", compression=compression)
    assert np.array_equal(read_image(tmp_path / "a.tif").data[0, 0].numpy(), pixels)


def test_jpeg_inside_is_read_in_colour(tmp_path):
    pixels = np.kron(values((5, 6, 3), "uint8"), np.ones((8, 8, 1), np.uint8))
    PIL.fromarray(pixels).save(tmp_path / "a.tif", compression="jpeg", quality=95)
    image = read_image(tmp_path / "a.tif")
    assert image.data.shape == (1, 3, 40, 48)
    assert np.abs(image.data[0].numpy() - np.moveaxis(pixels, -1, 0)).mean() < 20


@pytest.mark.parametrize("unit", ["px", "mm", "µm"])
def test_volumes_keep_their_unit(tmp_path, unit):
    spacing = (2.5e-3, 0.25e-3, 0.5e-3) if unit == "µm" else (2.5, 0.25, 0.5)
    write_image(Image(torch.zeros(1, 1, 4, 5, 6), Grid((4, 5, 6), spacing), unit=unit), tmp_path / "a.tif")
    back = read_image(tmp_path / "a.tif")
    assert back.unit == unit
    np.testing.assert_allclose(back.grid.spacing, spacing, rtol=1e-6)


@pytest.mark.parametrize(
    ("axes", "shape"),
    [("ZCYX", (5, 2, 20, 30)), ("CYX", (2, 20, 30)), ("TZCYX", (1, 5, 2, 20, 30)), ("ZYXS", (5, 20, 30, 3))],
)
def test_channels_are_channels(tmp_path, axes, shape):
    pixels = values(shape, "uint8" if "S" in axes else "uint16")
    tifffile.imwrite(tmp_path / "a.tif", pixels, imagej=True, metadata={"axes": axes})
    wanted = np.moveaxis(pixels, axes.find("C") if "C" in axes else axes.find("S"), 0)
    got = read_image(tmp_path / "a.tif").data[0].numpy()
    assert np.array_equal(got, wanted.reshape(got.shape))


def test_planes_of_colour_and_colour_tables(tmp_path):
    colour = values((3, 20, 30))
    tifffile.imwrite(tmp_path / "planes.tif", colour, photometric="rgb", planarconfig="separate")
    assert np.array_equal(read_image(tmp_path / "planes.tif").data[0].numpy(), colour)
    table = PIL.fromarray(np.moveaxis(values((3, 20, 30), "uint8"), 0, -1)).quantize(16)
    table.save(tmp_path / "table.tif")
    wanted = np.moveaxis(np.asarray(table.convert("RGB")), -1, 0)
    assert np.array_equal(read_image(tmp_path / "table.tif").data[0].numpy(), wanted)


@pytest.mark.parametrize(("kind", "channels"), [("uint8", 1), ("uint8", 3), ("uint16", 2), ("float32", 1)])
def test_volumes_keep_their_spacing(tmp_path, kind, channels):
    data = torch.from_numpy(values((1, channels, 5, 20, 30), kind).astype(np.float32))
    image = Image(data, Grid((5, 20, 30), (2.5, 0.25, 0.5)), pixel_type=kind)
    write_image(image, tmp_path / "a.tif")
    back = read_image(tmp_path / "a.tif")
    assert torch.equal(back.data, data)
    assert back.pixel_type == kind
    np.testing.assert_allclose(back.grid.spacing, image.grid.spacing, rtol=1e-6)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: tifffile.imwrite(p, values((3, 5, 20, 30)), imagej=True, metadata={"axes": "TZYX"}), "series of 3"),
        (lambda p: tifffile.imwrite(p, values((20, 30), "float32").astype("c8")), "complex"),
        (lambda p: tifffile.imwrite(p, values((1, 300))), "at least two axes"),
        (lambda p: p.write_bytes(b"II*\0" + bytes(100)), "damaged"),
    ],
)
def test_what_is_no_image_is_refused(tmp_path, capfd, write, message):
    write(tmp_path / "a.tif")
    with pytest.raises(InputError, match=message) as error:
        read_image(tmp_path / "a.tif")
    assert "a.tif" in str(error.value)
    assert capfd.readouterr() == ("", "")


def tiny(**tags):
    """The header of a TIFF and one page of 8 × 8 pixels, its tags changed; the pixels are behind it."""
    entries = {256: 8, 257: 8, 258: 8, 259: 1, 262: 1, 273: 200, 277: 1, 278: 8, 279: 64}
    entries |= {int(name[1:]): value for name, value in tags.items()}
    head = struct.pack("<2sHIH", b"II", 42, 8, len(entries))
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(entries.items()))
    return (head + body + bytes(4)).ljust(200, b"\0") + bytes(range(64))


def test_the_tiny_file_is_sound(tmp_path):
    (tmp_path / "a.tif").write_bytes(tiny())
    assert read_image(tmp_path / "a.tif").data.flatten().tolist() == list(range(64))


def test_bits_from_the_right(tmp_path):
    """FillOrder 2."""
    (tmp_path / "a.tif").write_bytes(tiny(t258=1, t266=2, t279=8))
    with PIL.open(tmp_path / "a.tif") as picture:
        wanted = np.asarray(picture)
    assert np.array_equal(read_image(tmp_path / "a.tif").data[0, 0].numpy(), wanted)
    assert wanted[1].tolist() == [1, 0, 0, 0, 0, 0, 0, 0]


@pytest.mark.parametrize(
    "tags",
    [
        {"t256": 100_000, "t257": 100_000},
        {"t256": 2**31, "t257": 2**31},
        {"t256": 22_000, "t257": 22_000, "t258": 1, "t259": 4},
        {"t256": 2**32 - 1, "t257": 2**32 - 1, "t277": 65_535},
        {"t322": 2**20, "t323": 2**20, "t324": 200, "t325": 64},
        {"t258": 65_535},
        {"t258": 0},
        {"t277": 0},
        {"t257": 0},
        {"t273": 2**32 - 1},
        {"t279": 2**32 - 1},
        {"t278": 0},
        {"t259": 9999},
        {"t259": 5},
        {"t259": 7},
        {"t284": 9},
        {"t274": 99},
        {"t262": 99},
        {"t339": 99},
        {"t317": 99},
        {"t330": 8},
    ],
)
def test_a_page_that_makes_no_sense(tmp_path, capfd, tags):
    """One sentence, or a picture; nothing is printed, and no memory taken for what is only announced."""
    (tmp_path / "a.tif").write_bytes(tiny(**tags))
    said = outcome(tmp_path / "a.tif")
    assert not said or said.startswith(str(tmp_path / "a.tif"))
    assert "\n" not in said
    image_size(tmp_path / "a.tif")
    assert capfd.readouterr() == ("", "")


def test_a_strip_that_is_far_longer_than_its_pixels(tmp_path):
    body = zlib.compress(bytes(200_000_000))
    (tmp_path / "a.tif").write_bytes(tiny(t259=8, t279=len(body))[:200] + body)
    with pytest.raises(InputError, match="damaged"):
        read_image(tmp_path / "a.tif")


def test_pages_in_a_ring(tmp_path):
    content = bytearray(tiny())
    struct.pack_into("<I", content, 8 + 2 + 12 * 9, 8)
    (tmp_path / "a.tif").write_bytes(content)
    said = outcome(tmp_path / "a.tif")
    assert not said or "damaged" in said


def test_a_volume_larger_than_what_is_free_is_refused(tmp_path, monkeypatch):
    tifffile.imwrite(tmp_path / "a.tif", values((5, 20, 30)), photometric="minisblack")
    monkeypatch.setattr(gate, "available", lambda: 10_000)
    with pytest.raises(InputError, match="18 kB of memory and 10 kB are free; crop it"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize(
    ("shape", "how", "wanted"),
    [
        ((20, 30), {"photometric": "minisblack"}, ((20, 30), 1)),
        ((5, 20, 30), {"photometric": "minisblack"}, ((5, 20, 30), 1)),
        ((20, 30, 3), {"photometric": "rgb"}, ((20, 30), 3)),
        ((3, 20, 30), {"photometric": "rgb", "planarconfig": "separate"}, ((20, 30), 3)),
        ((20, 30, 4), {"photometric": "separated"}, ((20, 30), 3)),
        ((5, 2, 20, 30), {"imagej": True, "metadata": {"axes": "ZCYX"}}, ((5, 20, 30), 2)),
        ((20, 30), {"photometric": "minisblack", "extratags": [(274, 3, 1, 6, True)]}, ((30, 20), 1)),
    ],
)
def test_sizes_are_known_without_the_pixels(tmp_path, shape, how, wanted):
    tifffile.imwrite(tmp_path / "a.tif", values(shape, "uint8"), **how)
    image = read_image(tmp_path / "a.tif")
    assert tiff_size(tmp_path / "a.tif") == image_size(tmp_path / "a.tif") == wanted
    assert (image.grid.shape, image.data.shape[1]) == wanted


def test_itk_is_not_given_tiff(tmp_path):
    tifffile.imwrite(tmp_path / "a.mha", values((20, 30)))
    with pytest.raises(InputError, match=r"a.mha is a TIFF"):
        load(tmp_path / "a.mha")


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.9, 0.99])
def test_missing_pages_are_noticed(tmp_path, capfd, share):
    """A file with fewer pages than it was written with is refused, not read as a thinner volume."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for page in values((6, 20, 30)):
            file.write(page, contiguous=False)
    assert read_image(tmp_path / "a.tif").grid.shape == (6, 20, 30)
    content = (tmp_path / "a.tif").read_bytes()
    (tmp_path / "a.tif").write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InputError, match="damaged or incomplete"):
        read_image(tmp_path / "a.tif")
    assert capfd.readouterr() == ("", "")
