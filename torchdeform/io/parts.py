"""The files that an image is made of: what identifies it is the content of every one of them."""

import re
from pathlib import Path

from torchdeform.errors import InputError
from torchdeform.io.dicom import is_dicom
from torchdeform.io.files import is_tiff
from torchdeform.io.gate import require_beside, require_file
from torchdeform.io.volumes import volume_files

_OME_NAMES = re.compile(r'(?:FileName|MetadataFile)="([^"]{1,255})"')


def files_of(path: Path) -> list[Path]:
    """Return all files that an image is read from, sorted: the file itself and those that its header names.

    Args:
        path: an image file, or a folder with a DICOM series.

    Returns:
        Regular files only; of a header also its files of pixels, of an OME-TIFF also those of its XML, of a DICOM file
        or folder all DICOM files of the folder. A file that is damaged, or names others that are not there or lead
        away from it, is returned alone or with those that can be read: reading it tells what is wrong.

    Raises:
        InputError: ``path`` is neither a regular file nor a folder, or cannot be opened.
        OSError: the disk failed.
    """
    require_file(path, "image file", folder=True)
    if path.is_dir():
        return sorted(file for file in path.iterdir() if file.is_file() and is_dicom(file))
    if is_dicom(path):
        return files_of(path.parent)
    named = _named_by_tiff(path) if is_tiff(path) else _named_by_header(path)
    return sorted({path, *(file for file in named if _is_beside(file, path))})


def _named_by_header(path: Path) -> list[Path]:
    try:
        return list(volume_files(path))
    except InputError:
        return []


def _named_by_tiff(path: Path) -> list[Path]:
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            text = file.pages.first.description
    except Exception as error:
        if isinstance(error, OSError) and error.errno:
            raise
        return []
    return [path.parent / name for name in _OME_NAMES.findall(text)] if "<OME" in text else []


def _is_beside(data: Path, header: Path) -> bool:
    try:
        require_beside(data, header)
    except InputError:
        return False
    return True
