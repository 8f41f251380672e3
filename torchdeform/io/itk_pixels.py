"""What ITK reads of a file, without torch: for a process of its own, see `isolated`."""

from typing import Any

from numpy.typing import NDArray

from torchdeform.io.files import native_stderr
from torchdeform.io.loading import no_warnings

# What libtiff prints, instead of failing, where it makes up what it cannot read.
_MADE_UP = ("TIFFFillStrip", "TIFFFillTile", "TIFFReadEncoded", "Read error", "not read completely")


def itk_pixels(path: str) -> NDArray[Any]:
    """Return the pixels of a file, channels last.

    Raises:
        RuntimeError: ITK cannot read it.
        ValueError: it is damaged.
    """
    import SimpleITK as sitk

    with native_stderr(stdout=True) as printed, no_warnings():
        values = sitk.GetArrayFromImage(sitk.ReadImage(path))
    if any(sign in line for line in printed for sign in _MADE_UP):
        raise ValueError(printed[0])
    return values
