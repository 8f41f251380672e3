"""Pictures (PNG, JPEG, BMP, GIF, WebP, JPEG 2000): known by content, turned as a viewer shows them, in pixels."""

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image as Picture

from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import itk
from torchdeform.io.files import native_stderr, read_head
from torchdeform.io.gate import DAMAGED, reading, require_room
from torchdeform.io.loading import load

UNREADABLE = "cannot be read as an image; it may be damaged: export it again"

# What each begins with, and after four bytes where the length of the file comes first.
_STARTS = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"GIF8", b"BM", b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51")
_RIFF = (b"RIFF", b"WEBP")

_FORMATS = ("PNG", "JPEG", "BMP", "GIF", "WEBP", "JPEG2000")  # Pillow's names of what is read here
_SEVERAL = ("PNG", "GIF", "WEBP")  # where further pictures are a film

# What ITK reads, colours of 16 bits and the scale of PNG too. MPO is JPEG with more, such as a depth map, behind it.
_BY_ITK = {"PNG": "PNGImageIO", "JPEG": "JPEGImageIO", "MPO": "JPEGImageIO"}

# Modes of Pillow as they are read; what is missing here becomes RGB.
_KEPT = ("L", "LA", "RGB", "RGBA", "I", "I;16", "I;16L", "I;16B", "F")
_BECOME = {"1": "L", "PA": "RGBA", "La": "LA", "RGBa": "RGBA"}

_BYTES = 6  # of a number while it is read: as it is stored, up to 16 bits, and float32
_ORIENTATION = 274  # tag of EXIF and TIFF
_LIMIT = threading.Lock()


def is_picture(path: Path) -> bool:
    """Return whether the content of a file starts like a picture, whatever its name."""
    head = read_head(path, 12)
    return head.startswith(_STARTS) or (head[:4], head[8:]) == _RIFF


def read_picture(path: Path) -> Image:
    """Read a picture, as a viewer shows it.

    Args:
        path: the file.

    Raises:
        InputError: damaged, larger than what is free, or a film.

    Notes:
        Pixels are 1 apart: the dots per inch of a print say nothing about what it shows. A scale that a PNG holds in
        its sCAL chunk is taken.
    """
    with reading(path, UNREADABLE), _opened(path) as picture:
        _require_one(path, picture)
        form, orientation = picture.format or "", _orientation(picture)
        if form in ("JPEG", "MPO"):
            _require_end(path)
        image = _by_itk(path, _BY_ITK[form]) if form in _BY_ITK else None
        if image is None or image.grid.shape != picture.size[::-1]:
            with native_stderr():
                image = _image(_pixels(picture, path), str(path))
    shown = form == "PNG" and set(image.grid.spacing) != {1.0}
    spacing = image.grid.spacing if shown else (1.0, 1.0)
    data = torch.from_numpy(upright(image.data.numpy(), orientation))
    grid = Grid(tuple(data.shape[2:]), spacing[::-1] if orientation > 4 else spacing)
    return replace(image, data=data, grid=grid, unit="mm" if shown else "px")


def picture_size(path: Path) -> tuple[tuple[int, int], int]:
    """Return the shape (rows, columns) and the channels of a picture, from its header.

    Raises:
        InputError: as `read_picture`, as far as the header tells.

    Notes:
        PNG may say only behind its pixels how it is turned, so that is left out.
    """
    with reading(path, UNREADABLE), _opened(path) as picture:
        _require_one(path, picture)
        width, height = picture.size
        turned = picture.format != "PNG" and _orientation(picture) > 4
        shape, channels = (width, height) if turned else (height, width), Picture.getmodebands(_mode(picture))
        return shape, 4 if channels == 2 else channels


def upright(values: NDArray[np.generic], orientation: int) -> NDArray[np.generic]:
    """Return an array ``(…, y, x)`` turned and mirrored as the orientation tag of EXIF and TIFF says, 1 to 8."""
    if orientation not in range(2, 9):
        return values
    turned = values.swapaxes(-1, -2) if orientation > 4 else values
    rows, columns = -1 if orientation in (3, 4, 7, 8) else 1, -1 if orientation in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(turned[..., ::rows, ::columns])


@contextmanager
def unlimited() -> Iterator[None]:
    """Switch off Pillow's own limit of pixels, which knows neither the memory here nor the length of the file."""
    with _LIMIT:
        before, Picture.MAX_IMAGE_PIXELS = Picture.MAX_IMAGE_PIXELS, None
        try:
            yield
        finally:
            Picture.MAX_IMAGE_PIXELS = before


@contextmanager
def _opened(path: Path) -> Iterator[Picture.Image]:
    with unlimited(), Picture.open(path, formats=_FORMATS) as picture:
        yield picture


def _require_one(path: Path, picture: Picture.Image) -> None:
    """Raise `InputError` unless the file is one picture that can be in it and fits into memory."""
    if min(picture.size) < 2:
        raise InputError(f"{path} has size {list(picture.size)}; give an image with at least two axes")
    pixels, bits = math.prod(picture.size), 1 if picture.mode == "1" else 8 * len(picture.getbands())
    require_room(path, pixels * bits // 8, held=pixels * _BYTES * Picture.getmodebands(_mode(picture)))
    frames = getattr(picture, "n_frames", 1) if picture.format in _SEVERAL else 1
    if frames > 1:
        raise InputError(f"{path} is a series of {frames} pictures; save one of them and give that")


def _require_end(path: Path) -> None:
    """Raise `InputError` unless the end of a JPEG (FF D9) follows its last scan (FF DA): ITK makes up what is cut off.

    Neither occurs inside coded pixels.
    """
    content = path.read_bytes()
    if content.rfind(b"\xff\xd9") < content.rfind(b"\xff\xda"):
        raise InputError(f"{path} {DAMAGED}")


def _orientation(picture: Picture.Image) -> int:
    """Return how the picture must be turned, 1 (not at all) where its tags do not say or are damaged."""
    if picture.format == "PNG":
        picture.load()  # which reading the tags does too: its error would get lost below, and then come no more
    try:
        found = picture.getexif().get(_ORIENTATION, 1)
    except Exception:  # noqa: BLE001 - a viewer ignores tags that it cannot read
        return 1
    return found if found in range(1, 9) else 1


def _by_itk(path: Path, reader: str) -> Image | None:
    """Return what ITK reads, None where it refuses (for instance grey with alpha)."""
    try:
        return itk.to_image(load(path, reader), str(path))
    except RuntimeError:
        return None


def _mode(picture: Picture.Image) -> str:
    """Return the mode of Pillow in which the picture is read."""
    if picture.mode == "P":
        return "RGBA" if "transparency" in picture.info else "RGB"
    return picture.mode if picture.mode in _KEPT else _BECOME.get(picture.mode, "RGB")


def _pixels(picture: Picture.Image, path: Path) -> NDArray[np.generic]:
    """Return the pixels ``(y, x)`` or ``(y, x, channels)``."""
    mode = _mode(picture)
    pixels = np.asarray(picture if picture.mode == mode else picture.convert(mode))
    alpha = _bmp_alpha(path, picture)
    return pixels if alpha is None else np.dstack([pixels, alpha])


def _bmp_alpha(path: Path, picture: Picture.Image) -> NDArray[np.uint8] | None:
    """Return the fourth byte of the pixels of a BMP of 32 bits where it is in use: Pillow drops it."""
    head = read_head(path, 34)
    plain = head[:2] == b"BM" and picture.mode == "RGB" and head[28:34] == b"\x20\0\0\0\0\0"
    if not plain:
        return None
    size, start = (picture.height, picture.width, 4), int.from_bytes(head[10:14], "little")
    rows = np.fromfile(path, np.uint8, math.prod(size), offset=start).reshape(size)[..., 3]
    upwards = int.from_bytes(head[22:26], "little", signed=True) > 0
    return (rows[::-1] if upwards else rows) if rows.any() else None


def _image(values: NDArray[np.generic], name: str) -> Image:
    """Return pixels as an image. Grey with alpha becomes RGBA."""
    pixels = values.reshape(*values.shape, 1) if values.ndim == 2 else values
    if pixels.shape[-1] == 2:
        pixels = pixels[..., [0, 0, 0, 1]]
    data = torch.from_numpy(np.moveaxis(pixels, -1, 0).astype(np.float32)).unsqueeze(0)
    return Image(data, Grid(pixels.shape[:2]), name=name, pixel_type=values.dtype.name, unit="px")
