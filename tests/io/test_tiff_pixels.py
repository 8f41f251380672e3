"""Packings, colours and turns of TIFF: what a viewer shows, with Pillow and tifffile as oracles."""

import numpy as np
import pytest
import SimpleITK as sitk
from broken_files import outcome

from torchdeform.errors import InputError
from torchdeform.io import read_image, tiff_pixels
from torchdeform.io.pictures import upright

tifffile = pytest.importorskip("tifffile")
PIL = pytest.importorskip("PIL.Image")
SHAPE = (40, 50)


def values(shape=SHAPE, kind="uint8"):
    of = np.dtype(kind)
    low, top = (np.iinfo(of).min, np.iinfo(of).max) if of.kind in "ui" else (0.0, 1.0)
    return (np.random.default_rng(0).random(shape) * (float(top) - low) + low).astype(of)


def read(path):
    return read_image(path).data[0].numpy()


def first(array):
    return np.moveaxis(array, -1, 0) if array.ndim == 3 else array[None]


PACKINGS = [None, "tiff_lzw", "tiff_deflate", "tiff_adobe_deflate", "packbits", "zstd", "lzma"]
PICTURES = {
    "1": lambda: PIL.fromarray(values()).convert("1"),
    "L": lambda: PIL.fromarray(values()),
    "I;16": lambda: PIL.fromarray(values(kind="uint16")),
    "F": lambda: PIL.fromarray(values(kind="float32")),
    "P": lambda: PIL.fromarray(values((*SHAPE, 3))).quantize(16),
    "RGB": lambda: PIL.fromarray(values((*SHAPE, 3))),
    "RGBA": lambda: PIL.fromarray(values((*SHAPE, 4))),
    "CMYK": lambda: PIL.fromarray(values((*SHAPE, 4)), "CMYK"),
    "YCbCr": lambda: PIL.fromarray(values((*SHAPE, 3))).convert("YCbCr"),
}


@pytest.mark.parametrize("packing", PACKINGS)
@pytest.mark.parametrize("mode", PICTURES)
def test_packings_and_modes(tmp_path, packing, mode):
    picture = PICTURES[mode]()
    try:
        picture.save(tmp_path / "a.tif", compression=packing)
    except OSError:
        pytest.skip(f"this Pillow does not write {packing}")
    wanted = np.asarray(picture.convert("RGB") if mode in ("P", "CMYK", "YCbCr") else picture)
    assert np.abs(read(tmp_path / "a.tif") - first(wanted).astype(np.float32)).max() <= (mode in ("CMYK", "YCbCr"))


@pytest.mark.parametrize("packing", ["group3", "group4", "tiff_ccitt"])
def test_faxes(tmp_path, packing):
    picture = PICTURES["1"]()
    picture.save(tmp_path / "a.tif", compression=packing)
    assert np.array_equal(read(tmp_path / "a.tif")[0], np.asarray(picture))


@pytest.mark.parametrize("white_is_zero", [False, True])
@pytest.mark.parametrize("packing", [None, "packbits", "tiff_lzw", "group4"])
@pytest.mark.parametrize("bits", ["1", "L"])
def test_white_is_zero_is_shown_as_viewers_do(tmp_path, white_is_zero, packing, bits):
    """Bright where Pillow shows bright, so a mask selects the same pixels."""
    if (bits, packing) == ("L", "group4"):
        pytest.skip("fax is black and white")
    shown = PICTURES[bits]()
    shown.save(tmp_path / "a.tif", compression=packing, tiffinfo={262: 0 if white_is_zero else 1})
    with PIL.open(tmp_path / "a.tif") as picture:
        wanted = np.asarray(picture)
    assert np.array_equal(read(tmp_path / "a.tif")[0], wanted)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize("packing", [None, "zlib"])
def test_white_is_zero_keeps_the_range(tmp_path, kind, packing):
    stored = values(kind=kind)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="miniswhite", compression=packing)
    if stored.dtype.kind == "f":
        wanted = stored.min() + stored.max() - stored
    else:
        wanted = np.iinfo(kind).max + np.iinfo(kind).min - stored.astype(float)
    np.testing.assert_allclose(read(tmp_path / "a.tif")[0], wanted, rtol=1e-6)


@pytest.mark.parametrize("kind", ["uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64"])
@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize(
    "how",
    [{}, {"tile": (16, 32)}, {"compression": "zlib"}, {"tile": (16, 32), "compression": "zlib"}, {"bigtiff": True},
     {"byteorder": ">"}, {"rowsperstrip": 7, "compression": "zlib"}],
)  # fmt: skip
def test_numbers_in_tiles_and_strips(tmp_path, kind, samples, how):
    stored = values((*SHAPE, 3) if samples == 3 else SHAPE, kind)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb" if samples == 3 else "minisblack", **how)
    image = read_image(tmp_path / "a.tif")
    assert np.array_equal(image.data[0].numpy(), first(stored).astype(np.float32))
    assert image.pixel_type == kind


@pytest.mark.parametrize("kind", ["uint8", "uint16", "int16"])
def test_differences_are_added_up(tmp_path, kind):
    """Predictor 2."""
    stored = values((*SHAPE, 3), kind)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", compression="zlib", predictor=True)
    assert np.array_equal(read(tmp_path / "a.tif"), first(stored))


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("packing", [None, "tiff_lzw", "group4"])
@pytest.mark.parametrize("mode", ["1", "L", "RGB"])
def test_pages_are_turned_as_a_viewer_shows_them(tmp_path, orientation, packing, mode):
    if packing == "group4" and mode != "1":
        pytest.skip("fax is black and white")
    stored = PICTURES[mode]()
    stored.save(tmp_path / "a.tif", compression=packing, tiffinfo={274: orientation})
    assert np.array_equal(read(tmp_path / "a.tif"), upright(first(np.asarray(stored)), orientation))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_volumes_and_their_spacing_are_turned(tmp_path, orientation):
    stored, tag = values((3, *SHAPE)), (274, 3, 1, orientation, True)
    tifffile.imwrite(
        tmp_path / "a.tif", stored, imagej=True, extratags=[tag], resolution=(2, 4),
        metadata={"axes": "ZYX", "unit": "mm", "spacing": 3.0},
    )  # fmt: skip
    image = read_image(tmp_path / "a.tif")
    assert np.array_equal(image.data[0, 0].numpy(), upright(stored, orientation))
    assert image.grid.spacing == ((3.0, 0.25, 0.5) if orientation <= 4 else (3.0, 0.5, 0.25))


def test_colours_in_planes(tmp_path):
    stored = values((3, *SHAPE), "uint16")
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", planarconfig="separate", compression="zlib")
    assert np.array_equal(read(tmp_path / "a.tif"), stored)


def test_colours_of_16_bits_without_a_decoder_of_tifffile(tmp_path):
    """Pillow would make 8 bits of them; ITK, in another process, does not."""
    stored = np.kron(values((10, 10, 3), "uint16"), np.ones((8, 8, 1), np.uint16))
    image = sitk.GetImageFromArray(stored, isVector=True)
    writer = sitk.ImageFileWriter()
    writer.SetFileName(str(tmp_path / "a.tif"))
    writer.SetCompressor("LZW")
    writer.UseCompressionOn()
    writer.Execute(image)
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.pages[0].compression.name == "LZW"
    assert np.array_equal(read(tmp_path / "a.tif"), first(stored))


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_a_table_of_8_bits_is_one(tmp_path, kind):
    """Some programs write colours of 8 bits where 16 are meant."""
    table = np.random.default_rng(1).integers(1, 255, (3, 256)).astype(np.uint16)
    stored = values()
    tifffile.imwrite(
        tmp_path / "a.tif", stored, photometric="palette", colormap=table * (1 if kind == "uint8" else 256)
    )
    assert np.array_equal(read(tmp_path / "a.tif"), table[:, stored])


@pytest.mark.parametrize(
    ("extra", "wanted"),
    [
        ("unassalpha", lambda v: v),
        ("unspecified", lambda v: v[:3]),
        ("assocalpha", lambda v: np.stack([*(v[:3] * (255 / np.maximum(v[3], 1))).clip(0, 255), v[3]])),
    ],
)
def test_what_lies_beside_the_colours(tmp_path, extra, wanted):
    stored = values((*SHAPE, 4))
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extrasamples=[extra])
    got = read(tmp_path / "a.tif")
    assert np.abs(got - wanted(first(stored).astype(float))).max() < 1


def test_two_channels_are_not_grey_with_alpha(tmp_path):
    stored = values((*SHAPE, 2))
    for extra, channels in (("unspecified", 2), ("unassalpha", 4)):
        tifffile.imwrite(
            tmp_path / "a.tif", stored, photometric="minisblack", planarconfig="contig", extrasamples=[extra]
        )
        got = read(tmp_path / "a.tif")
        assert len(got) == channels
        assert np.array_equal(got[[0, -1]], first(stored))


@pytest.mark.parametrize(
    ("kind", "name"), [(8, "CIELab"), (9, "ICCLab"), (32803, "CFA"), (32845, "LogLuv"), (77, "77")]
)
def test_colours_that_are_unknown_are_named(tmp_path, kind, name):
    tifffile.imwrite(tmp_path / "a.tif", values((*SHAPE, 3)), photometric="rgb", metadata=None)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        file.pages[0].tags["PhotometricInterpretation"].overwrite(kind)
    with pytest.raises(InputError, match=rf"a\.tif stores its colours as .*{name}.*; save it as grey or RGB"):
        read_image(tmp_path / "a.tif")


def test_what_nothing_here_unpacks_is_named(tmp_path, monkeypatch):
    PIL.fromarray(values()).save(tmp_path / "a.tif", compression="tiff_lzw")
    monkeypatch.setattr(tiff_pixels, "_by_pillow", lambda *_: None)
    monkeypatch.setattr(tiff_pixels, "_by_itk", lambda *_: None)
    monkeypatch.setattr(tifffile.TiffPageSeries, "asarray", _no_decoder)
    with pytest.raises(InputError, match=r"packed as LZW, 8 bits.*pip install 'torchdeform\[formats\]'"):
        read_image(tmp_path / "a.tif")


def _no_decoder(*_):
    raise ModuleNotFoundError("No module named 'compression'")


@pytest.mark.parametrize("packing", ["tiff_lzw", "zstd", "lzma", "tiff_adobe_deflate", "packbits", "group4", "jpeg"])
def test_broken_strips_are_noticed(tmp_path, capfd, packing):
    """Bytes in the middle of the pixels: read as something, or refused in one sentence; nothing is printed."""
    picture = PICTURES["1" if packing == "group4" else "L"]()
    picture.save(tmp_path / "a.tif", compression=packing)
    content = bytearray((tmp_path / "a.tif").read_bytes())
    middle = len(content) // 2
    for cut in (content[:middle], content[:middle] + bytes(60) + content[middle + 60 :]):
        (tmp_path / "a.tif").write_bytes(cut)
        assert "\n" not in outcome(tmp_path / "a.tif")
    assert capfd.readouterr() == ("", "")
