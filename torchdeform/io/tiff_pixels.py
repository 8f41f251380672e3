"""Pixels of a TIFF: unpacked by tifffile, Pillow or ITK, whichever can; colours and white-is-zero as a viewer shows."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError
from torchdeform.io.files import native_stderr
from torchdeform.io.isolated import isolated
from torchdeform.io.itk_pixels import itk_pixels
from torchdeform.io.pictures import unlimited, upright

if TYPE_CHECKING:
    from tifffile import TiffPage, TiffPageSeries

    Series = Sequence[TiffPageSeries]

# Values of PhotometricInterpretation.
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _INKS, _YCBCR = 0, 1, 2, 3, 5, 6
_MASK, _LINEAR = 4, 34892
_KNOWN = (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _MASK, _INKS, _YCBCR, _LINEAR)
_COLOURS = {
    8: "CIELab",
    9: "ICCLab",
    10: "ITULab",
    32803: "the mosaic of a camera (CFA)",
    32844: "LogL",
    32845: "LogLuv",
}

_ORIENTATION, _INK_SET = 274, 332  # tags
_PLANES = 2  # of PlanarConfiguration
_PREMULTIPLIED, _UNSPECIFIED = 1, 0  # of ExtraSamples
_CMYK = 1  # of InkSet
_APERIO_YCBCR = 33003  # JPEG 2000 whose reader leaves YCbCr as it is
_EVERYWHERE = (1, 2, 3, 4, 5, 6, 7, 8, 32773, 32946)  # packings that every libtiff knows: CCITT, LZW, JPEG, deflate
_UNPACKED_COLOURS = (6, 7, 33003, 33004, 33005, 34712, 34892, 50001)  # JPEG, JPEG 2000, WebP: their readers give RGB
_BACK = {6: 8, 8: 6}  # orientations that undo each other; the others undo themselves


def require_colours(page: "TiffPage", path: Path) -> None:
    """Raise `InputError` unless the colours are stored in a way that is understood."""
    if int(page.photometric) not in _KNOWN:
        what = _COLOURS.get(int(page.photometric), f"kind {int(page.photometric)}")
        raise InputError(f"{path} stores its colours as {what}; save it as grey or RGB and give that")
    if page.dtype is None:
        raise InputError(
            f"{path} has numbers of {page.bitspersample} bits of an unknown kind; save it with 8 or 16 bits"
        )


def unpacked(series: "Series", path: Path) -> NDArray[Any]:
    """Return the pixels of series of one shape, one after another, as they are stored.

    Raises:
        InputError: packed in a way that nothing here can unpack.
    """
    for unpack in (_by_tifffile, _by_pillow, _by_itk):
        if (found := unpack(series, path)) is not None:
            return found
    page = series[0].keyframe
    packing = getattr(page.compression, "name", page.compression)
    raise InputError(
        f"{path} is packed as {packing}, {page.bitspersample} bits, which takes a package to read: "
        "pip install 'torchdeform[formats]', or save it uncompressed"
    )


def _by_tifffile(series: "Series", _path: Path) -> NDArray[Any] | None:
    """Return what tifffile unpacks; None where it lacks a package, or leaves colours as YCbCr."""
    page = series[0].keyframe
    if int(page.photometric) == _YCBCR and int(page.compression) not in _UNPACKED_COLOURS:
        return None
    try:
        with native_stderr():
            return np.stack([one.asarray() for one in series]) if len(series) > 1 else series[0].asarray()
    except (ImportError, NotImplementedError, ValueError) as error:
        if isinstance(error, ValueError) and "imagecodecs" not in str(error):
            raise
        return None


def _by_pillow(series: "Series", path: Path) -> NDArray[Any] | None:
    """Return what Pillow's libtiff unpacks; None where Pillow does not know the kind or would lose bits."""
    from PIL import Image as Picture

    with unlimited(), native_stderr():
        try:
            picture = Picture.open(path, formats=("TIFF",))
        except (OSError, SyntaxError):
            return None
        with picture:
            try:
                pages = [_stored(picture, page) for one in series for page in one.pages]
            except (OSError, SyntaxError):
                if int(series[0].keyframe.compression) in _EVERYWHERE:  # so the file is at fault
                    raise
                return None
    if any(page is None for page in pages):
        return None
    return np.reshape([page for page in pages if page is not None], (len(series), *series[0].shape))


def _stored(picture: Any, page: Any) -> NDArray[Any] | None:
    """Return one page as it is stored, undoing how Pillow shows it; None where Pillow has no room for its numbers."""
    if not isinstance(page.index, int):  # below another page
        return None
    picture.seek(page.index)
    first, kind = page.keyframe, str(picture.tile[0][3][0])
    values = np.asarray(picture.convert("RGB") if int(first.photometric) == _YCBCR else picture)
    if values.size != math.prod(first.shape) or values.itemsize < first.dtype.itemsize or "a" in kind:
        return None
    if orientation_of(first) != 1 and _ORIENTATION not in picture.tag_v2:
        values = _turned_back(values, orientation_of(first))
    if int(first.photometric) == _WHITE_IS_ZERO and "I" in kind.partition(";")[2]:
        values = ~values
    if first.bitspersample < 8 and picture.mode == "L":
        values = values // (255 // (2**first.bitspersample - 1))
    if int(first.planarconfig) == _PLANES and values.ndim == 3:
        values = np.moveaxis(values, -1, 0)
    return values.astype(first.dtype)


def orientation_of(page: "TiffPage") -> int:
    """Return the orientation tag, 1 (upright) where it says nothing."""
    found = page.tags.valueof(_ORIENTATION, 1)
    return int(found) if found in range(1, 9) else 1


def _turned_back(values: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Return the array ``(y, x)`` or ``(y, x, channels)`` that `upright` would show as ``values``."""
    return np.moveaxis(upright(np.moveaxis(np.atleast_3d(values), -1, 0), _BACK.get(orientation, orientation)), 0, -1)


def _by_itk(series: "Series", path: Path) -> NDArray[Any] | None:
    """Return what ITK unpacks, in another process; None but for plain grey and colours."""
    page = series[0].keyframe
    plain = int(page.photometric) in (_BLACK_IS_ZERO, _RGB) and page.bitspersample % 8 == 0
    if not plain or orientation_of(page) != 1:
        return None
    try:
        values = isolated(itk_pixels, str(path), path=path)
    except RuntimeError:
        return None
    if values.size != len(series) * math.prod(series[0].shape) or values.dtype != page.dtype:
        return None
    if int(page.planarconfig) == _PLANES and page.samplesperpixel > 1:
        values = np.moveaxis(values, -1, -3)
    return values.reshape(len(series), *series[0].shape)


def shown(pixels: NDArray[Any], page: "TiffPage") -> NDArray[Any]:
    """Return stored pixels ``(C, Z, Y, X)`` as a viewer shows them: white is bright, indices and inks are colours."""
    photometric = int(page.photometric)
    if photometric == _WHITE_IS_ZERO:
        pixels = _inverted(pixels, page)
    elif photometric == _PALETTE and page.colormap is not None and pixels.dtype.kind in "bu":
        pixels = _looked_up(pixels, page.colormap)
    elif photometric == _INKS and len(pixels) > 3 and page.tags.valueof(_INK_SET, _CMYK) == _CMYK:
        pixels = _printed(pixels[:4])
    elif int(page.compression) == _APERIO_YCBCR and len(pixels) == 3:
        pixels = _from_ycbcr(pixels)
    return _with_alpha(upright(pixels, orientation_of(page)), page)


def _inverted(pixels: NDArray[Any], page: "TiffPage") -> NDArray[Any]:
    """Return the negative: numbers keep the range of their type, or the range that they have."""
    if pixels.dtype.kind == "u":
        return (2**page.bitspersample - 1 - pixels.astype(np.uint64)).astype(pixels.dtype)
    if pixels.dtype.kind in "bi":
        return ~pixels
    return np.nanmin(pixels) + np.nanmax(pixels) - pixels


def _looked_up(pixels: NDArray[Any], table: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Return the colours ``(3, Z, Y, X)`` of indices; a table has 16 bits, but some programs write 8."""
    colours = table if table.max() < 256 else table // 256
    return colours.astype(np.uint8)[:, pixels[0].astype(np.intp)]


def _printed(inks: NDArray[Any]) -> NDArray[Any]:
    """Return cyan, magenta, yellow and black ``(4, …)`` on white paper as RGB."""
    top = np.iinfo(inks.dtype).max if inks.dtype.kind == "u" else 1.0
    paper = top - inks.astype(np.float64)
    colours = paper[:3] * paper[3:] / top
    return (np.rint(colours) if inks.dtype.kind == "u" else colours).astype(inks.dtype)


def _from_ycbcr(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return RGB of luminance and two differences of 8 bits (ITU-R BT.601, full range)."""
    luminance, blue, red = pixels.astype(np.float64) - np.array([0, 128, 128]).reshape(3, 1, 1, 1)
    colours = [luminance + 1.402 * red, luminance - 0.344136 * blue - 0.714136 * red, luminance + 1.772 * blue]
    return np.rint(colours).clip(0, 255).astype(np.uint8)


def _with_alpha(pixels: NDArray[Any], page: "TiffPage") -> NDArray[Any]:
    """Return RGB with straight alpha, without what is stored beside it; grey with alpha as RGBA."""
    extra = [int(kind) for kind in page.extrasamples] if page.samplesperpixel == len(pixels) else []
    if int(page.photometric) == _RGB and len(pixels) > 3 and extra:
        pixels = pixels[:3] if extra[0] == _UNSPECIFIED else pixels[:4]
    elif len(pixels) == 2 and extra and extra[0] != _UNSPECIFIED:
        pixels = pixels[[0, 0, 0, 1]]
    if len(pixels) == 4 and extra[:1] == [_PREMULTIPLIED] and not page.software.startswith("InsightToolkit"):
        alpha = np.maximum(pixels[3:], 1 if pixels.dtype.kind == "u" else np.finfo(np.float32).tiny)
        top = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1.0
        straight = (pixels[:3] * (top / alpha)).clip(0, top)
        pixels = np.concatenate([straight.astype(pixels.dtype), pixels[3:]])
    return pixels
