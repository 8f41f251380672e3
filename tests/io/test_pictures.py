"""Pictures as a viewer shows them, in pixels, whatever they are called; Pillow is the oracle."""

import struct
import zlib

import numpy as np
import pytest
import SimpleITK as sitk
from broken_files import outcome

from torchdeform.errors import InputError
from torchdeform.io import gate, read_image
from torchdeform.io.images import image_size
from torchdeform.io.pictures import is_picture, picture_size, upright

PIL = pytest.importorskip("PIL.Image")
OPS = pytest.importorskip("PIL.ImageOps")
SHAPE = (24, 40)


def smooth(channels=0):
    """Grey or colours without symmetry, smooth enough for JPEG."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    planes = [5 * y + 2 * x, 255 - 5 * x, 8 * y, 60 + 3 * x]
    values = np.stack(planes[: max(channels, 1)], -1).clip(0, 255).astype(np.uint8)
    return values if channels else values[..., 0]


def with_orientation(picture, value):
    tags = picture.getexif()
    tags[274] = value
    return tags


def shown(path, mode=None):
    """What Pillow shows of a file."""
    with PIL.open(path) as picture:
        upright_picture = OPS.exif_transpose(picture)
        return channels_first(upright_picture.convert(mode) if mode else upright_picture)


def channels_first(picture):
    values = np.asarray(picture)
    return np.moveaxis(values if values.ndim == 3 else values[..., None], -1, 0)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(
    ("ending", "options", "most"),
    [(".jpg", {"quality": 97}, 3), (".png", {}, 0), (".webp", {"lossless": True}, 0)],
)
@pytest.mark.parametrize("channels", [0, 3])
def test_pictures_are_turned_as_a_viewer_shows_them(tmp_path, orientation, ending, options, most, channels):
    path, stored = tmp_path / f"a{ending}", PIL.fromarray(smooth(channels))
    stored.save(path, exif=with_orientation(stored, orientation), **options)
    image = read_image(path)
    wanted = shown(path)
    assert image.data.shape[1:] == wanted.shape
    assert np.abs(image.data[0].numpy() - wanted).mean() <= most
    assert (image.unit, set(image.grid.spacing)) == ("px", {1.0})


def test_upright_is_its_definition():
    """The eight turns by the words of the EXIF standard: where row 0 and column 0 are."""
    a = np.arange(6).reshape(2, 3)
    wanted = [a, a[:, ::-1], a[::-1, ::-1], a[::-1], a.T, np.rot90(a, -1), a[::-1, ::-1].T, np.rot90(a)]
    for orientation, turned in enumerate(wanted, 1):
        assert np.array_equal(upright(a, orientation), turned)
    assert np.array_equal(upright(a, 0), a)


@pytest.mark.parametrize("tag", [0, 9, 65535])
def test_an_orientation_that_means_nothing_is_none(tmp_path, tag):
    stored = PIL.fromarray(smooth())
    stored.save(tmp_path / "a.png", exif=with_orientation(stored, tag))
    assert np.array_equal(read_image(tmp_path / "a.png").data[0, 0].numpy(), smooth())


def test_a_scale_is_turned_with_its_picture(tmp_path):
    """The chunk sCAL, in which ITK keeps a scale, and an orientation that swaps rows and columns."""
    itk = sitk.GetImageFromArray(smooth())
    itk.SetSpacing((0.5, 0.25))
    sitk.WriteImage(itk, str(tmp_path / "a.png"))
    stored = PIL.fromarray(smooth())
    exif = with_orientation(stored, 6).tobytes().removeprefix(b"Exif\0\0")
    chunk = struct.pack(">I", len(exif)) + b"eXIf" + exif + struct.pack(">I", zlib.crc32(b"eXIf" + exif))
    content = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(content[:33] + chunk + content[33:])
    image = read_image(tmp_path / "a.png")
    assert (image.grid.shape, image.grid.spacing, image.unit) == (SHAPE[::-1], (0.5, 0.25), "mm")


@pytest.mark.parametrize("dpi", [72, 96, 300, 1200, 25400])
@pytest.mark.parametrize("ending", [".jpg", ".png", ".bmp"])
def test_dots_per_inch_are_no_scale(tmp_path, ending, dpi):
    PIL.fromarray(smooth(3)).save(tmp_path / f"a{ending}", dpi=(dpi, dpi))
    image = read_image(tmp_path / f"a{ending}")
    assert (image.grid.spacing, image.unit) == ((1.0, 1.0), "px")


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.tif", "a.svs", "a.dat", "a.1"])
@pytest.mark.parametrize("form", ["PNG", "JPEG", "BMP", "GIF", "WEBP", "JPEG2000"])
def test_content_says_the_kind(tmp_path, name, form):
    PIL.fromarray(smooth(3)).save(tmp_path / name, form)
    assert is_picture(tmp_path / name)
    wanted = shown(tmp_path / name, "RGB")
    got = read_image(tmp_path / name)
    assert got.data.shape[1:] == wanted.shape
    assert np.abs(got.data[0].numpy() - wanted).mean() < (3 if form == "JPEG" else 1e-6)


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "RGBA"])
@pytest.mark.parametrize("ending", [".bmp", ".png", ".gif"])
def test_modes_are_read_as_pillow_shows_them(tmp_path, ending, mode):
    if (ending, mode) == (".gif", "RGBA"):
        pytest.skip("GIF has no alpha but on and off")
    stored = PIL.fromarray(smooth(3)).convert(mode)
    stored.save(tmp_path / f"a{ending}")
    got = read_image(tmp_path / f"a{ending}").data[0].numpy()
    assert np.array_equal(got[:3], shown(tmp_path / f"a{ending}", "L" if len(got) == 1 else "RGB"))


def test_colours_of_16_bits_stay_whole(tmp_path):
    values = np.random.default_rng(0).integers(0, 65535, (*SHAPE, 3)).astype(np.uint16)
    sitk.WriteImage(sitk.GetImageFromArray(values, isVector=True), str(tmp_path / "a.png"))
    image = read_image(tmp_path / "a.png")
    assert np.array_equal(image.data[0].numpy(), np.moveaxis(values, -1, 0))
    assert image.pixel_type == "uint16"


@pytest.mark.parametrize("upwards", [True, False])
@pytest.mark.parametrize("used", [True, False])
def test_the_fourth_byte_of_a_bmp_is_alpha_if_it_is_used(tmp_path, upwards, used):
    values = smooth(4)
    values[..., 3] *= used
    rows = values[::-1] if upwards else values
    size = struct.pack("<ii", SHAPE[1], SHAPE[0] if upwards else -SHAPE[0])
    head = struct.pack("<I", 40) + size + struct.pack("<HHIIiiII", 1, 32, 0, 0, 0, 0, 0, 0)
    body = rows[..., [2, 1, 0, 3]].tobytes()
    (tmp_path / "a.bmp").write_bytes(b"BM" + struct.pack("<IHHI", 54 + len(body), 0, 0, 54) + head + body)
    wanted = np.moveaxis(values if used else values[..., :3], -1, 0)
    assert np.array_equal(read_image(tmp_path / "a.bmp").data[0].numpy(), wanted)


@pytest.mark.parametrize("form", ["GIF", "WEBP", "PNG", "JPEG", "BMP", "JPEG2000"])
def test_lines_are_refused(tmp_path, form):
    PIL.new("L", (300, 1)).save(tmp_path / "a", form)
    with pytest.raises(InputError, match=r"a has size \[300, 1\]; give an image with at least two axes"):
        read_image(tmp_path / "a")


@pytest.mark.parametrize("form", ["GIF", "WEBP", "PNG"])
def test_films_are_refused(tmp_path, form):
    frames = [PIL.fromarray(np.roll(smooth(3), k, 0)) for k in range(3)]
    frames[0].save(tmp_path / "a", form, save_all=True, append_images=frames[1:])
    with pytest.raises(InputError, match="is a series of 3 pictures; save one of them"):
        read_image(tmp_path / "a")


def test_a_photograph_with_a_depth_map_is_the_photograph(tmp_path):
    first, second = PIL.fromarray(smooth(3)), PIL.fromarray(smooth(3)[::2, ::2])
    first.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[second], quality=97)
    assert read_image(tmp_path / "a.jpg").grid.shape == SHAPE


@pytest.mark.parametrize(
    ("ending", "mode", "channels"),
    [(".png", "L", 1), (".png", "RGB", 3), (".png", "LA", 4), (".png", "P", 3), (".jpg", "L", 1), (".jpg", "CMYK", 3)],
)
def test_sizes_are_known_without_the_pixels(tmp_path, ending, mode, channels):
    PIL.fromarray(smooth(3)).convert(mode).save(tmp_path / f"a{ending}")
    assert picture_size(tmp_path / f"a{ending}") == (SHAPE, channels)
    assert image_size(tmp_path / f"a{ending}") == (SHAPE, channels)
    assert read_image(tmp_path / f"a{ending}").data.shape[1:] == (channels, *SHAPE)


def png_chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width, height, *chunks, body=b""):
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    rest = png_chunk(b"IDAT", zlib.compress(body)) + png_chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunks) + rest


def jpeg(width, height):
    quantities = b"\xff\xdb\0\x43\0" + bytes([1] * 64)
    frame = b"\xff\xc0\0\x0b\x08" + struct.pack(">HH", height, width) + b"\1\1\x11\0"
    return b"\xff\xd8" + quantities + frame + b"\xff\xda\0\x08\1\1\0\0\x3f\0" + b"\xff\xd9"


HUGE = {
    "size.png": lambda: png(100_000, 100_000),
    "sides.png": lambda: png(2**31 - 1, 2**31 - 1),
    "size.jpg": lambda: jpeg(65_000, 65_000),
    "size.gif": lambda: b"GIF89a" + struct.pack("<HH", 65_535, 65_535) + b"\0\0\0,"
    + struct.pack("<HHHHB", 0, 0, 65_535, 65_535, 0) + b"\2\2\x4c\1\0;",
    "size.bmp": lambda: b"BM" + struct.pack("<IHHI", 64, 0, 0, 54)
    + struct.pack("<IiiHHIIiiII", 40, 40_000, 40_000, 1, 24, 0, 0, 0, 0, 0, 0) + bytes(10),
    "negative.bmp": lambda: b"BM" + struct.pack("<IHHI", 64, 0, 0, 54)
    + struct.pack("<IiiHHIIiiII", 40, -40_000, -40_000, 1, 24, 0, 0, 0, 0, 0, 0) + bytes(10),
    "size.webp": lambda: b"RIFF" + struct.pack("<I", 30) + b"WEBPVP8X" + struct.pack("<I", 10) + b"\0\0\0\0"
    + b"\xff\xff\xff" * 2 + b"VP8 " + bytes(4),
    "text.png": lambda: png(8, 8, png_chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(10**8))), body=bytes(200)),
}  # fmt: skip


@pytest.mark.parametrize("name", HUGE)
def test_what_a_header_announces_is_not_believed(tmp_path, capfd, name):
    (tmp_path / name).write_bytes(HUGE[name]())
    with pytest.raises(InputError) as error:
        read_image(tmp_path / name)
    assert str(error.value).startswith(str(tmp_path / name))
    assert "\n" not in str(error.value)
    assert image_size(tmp_path / name) in (None, ((8, 8), 3))
    assert capfd.readouterr() == ("", "")


def test_a_profile_that_is_a_bomb_does_no_harm(tmp_path):
    profile = png_chunk(b"iCCP", b"k\0\0" + zlib.compress(bytes(10**8)))
    (tmp_path / "a.png").write_bytes(png(8, 8, profile, body=bytes(200)))
    said = outcome(tmp_path / "a.png")
    assert not said or "export it again" in said


def test_pictures_larger_than_what_is_free_are_refused_before_they_are_read(tmp_path, monkeypatch):
    PIL.fromarray(smooth(3)).save(tmp_path / "a.png")
    monkeypatch.setattr(gate, "available", lambda: 10_000)
    with pytest.raises(InputError, match="of memory and 10 kB are free; crop it"):
        read_image(tmp_path / "a.png")


def test_a_picture_of_many_pixels_is_no_bomb(tmp_path):
    """Pillow refuses some 180 million pixels by itself; the limit here is memory, and the length of the file."""
    limit = PIL.MAX_IMAGE_PIXELS
    picture = PIL.new("1", (14_000, 13_500))
    picture.paste(PIL.fromarray(np.random.default_rng(0).random((1000, 1000)) < 0.5), (50, 60))
    picture.save(tmp_path / "a.png")
    assert picture_size(tmp_path / "a.png") == ((13_500, 14_000), 1)
    assert limit == PIL.MAX_IMAGE_PIXELS


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "photo", "a.bmp"])
@pytest.mark.parametrize("share", [0.3, 0.7, 0.97])
def test_what_is_cut_off_is_refused_under_any_name(tmp_path, capfd, name, share):
    values = np.random.default_rng(0).integers(0, 255, (60, 70)).astype(np.uint8)
    PIL.fromarray(values).save(tmp_path / name, "JPEG" if name == "photo" else None)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(len(content) * share)])
    with pytest.raises(InputError, match=name):
        read_image(tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_a_damaged_jpeg_prints_nothing(tmp_path, capfd):
    PIL.fromarray(smooth()).save(tmp_path / "a.jpg", quality=97)
    content = bytearray((tmp_path / "a.jpg").read_bytes())
    content[-40:-20] = bytes(20)
    (tmp_path / "a.jpg").write_bytes(content)
    assert "\n" not in outcome(tmp_path / "a.jpg")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("mode", ["L", "RGB", "I;16", "P", "1", "LA"])
@pytest.mark.parametrize("sound_sum", [True, False])
def test_a_png_with_a_damaged_byte_is_refused(tmp_path, mode, sound_sum):
    """Whether the checksum of its chunk fits or not; no pixel may be made up."""
    noise = np.random.default_rng(0).integers(0, 255, (40, 50), np.uint8)
    picture = PIL.fromarray(noise.astype(np.uint16) * 200) if mode == "I;16" else PIL.fromarray(noise).convert(mode)
    picture.save(tmp_path / "a.png")
    content = (tmp_path / "a.png").read_bytes()
    start = content.index(b"IDAT") + 4
    end = start + int.from_bytes(content[start - 8 : start - 4], "big")
    pixels = bytearray(content[start:end])
    pixels[len(pixels) // 2] ^= 255
    total = zlib.crc32(b"IDAT" + pixels).to_bytes(4, "big") if sound_sum else content[end : end + 4]
    (tmp_path / "a.png").write_bytes(content[:start] + pixels + total + content[end + 4 :])
    with pytest.raises(InputError, match=r"a\.png cannot be read as an image"):
        read_image(tmp_path / "a.png")
