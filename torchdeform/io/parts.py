"""The files that an image is made of: what identifies it is the content of every one of them."""

from collections.abc import Callable, Iterable
from pathlib import Path

from torchdeform.errors import InputError
from torchdeform.io import dicom
from torchdeform.io.dicom_header import is_dicom, may_be_dicom
from torchdeform.io.files import is_tiff
from torchdeform.io.gate import require_beside, require_file
from torchdeform.io.tiff import tiff_parts
from torchdeform.io.volumes import volume_files


def files_of(path: Path) -> list[Path]:
    """Return all files that an image is read from, sorted: the file itself and those that its header names.

    Args:
        path: an image file, or a folder with a DICOM series.

    Returns:
        Regular files only; of a header also its files of pixels, of an OME-TIFF also those of its XML, of a DICOM file
        those of its series, of a folder all DICOM files in it. A file that is damaged, or names others that are not
        there or lead away from it, is returned without those: reading it tells what is wrong.

    Raises:
        InputError: ``path`` is neither a regular file nor a folder, or cannot be opened.
        OSError: the disk failed.
    """
    require_file(path, "image file", folder=True)
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file() and is_dicom(file))
    named = dicom.files if may_be_dicom(path) else tiff_parts if is_tiff(path) else volume_files
    return sorted({path, *(file for file in _found(named, path) if _is_beside(file, path))})


def _found(named: Callable[[Path], Iterable[Path]], path: Path) -> list[Path]:
    try:
        return list(named(path))
    except InputError:
        return []


def _is_beside(data: Path, header: Path) -> bool:
    try:
        require_beside(data, header)
    except InputError:
        return False
    return True
