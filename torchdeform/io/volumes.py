"""Volumes and what else ITK reads: each by the reader of its content, after checks of its header."""

from collections.abc import Callable
from pathlib import Path

from torchdeform.errors import InputError
from torchdeform.io.files import suffix
from torchdeform.io.headers import Header
from torchdeform.io.isolated import isolated
from torchdeform.io.kinds import ANALYZE, META, MGH, NIFTI, NRRD, kind_of, known_otherwise
from torchdeform.io.loading import read_by_itk, size_by_itk
from torchdeform.io.metaimage import metaimage_header
from torchdeform.io.mgh import mgh_size, read_mgh
from torchdeform.io.nifti import nifti_files, nifti_size, read_nifti
from torchdeform.io.nrrd import nrrd_header
from torchdeform.io.volume import Volume

# What reads the header, and the name of ITK's reader.
_TEXT_HEADERS: dict[str, tuple[Callable[[Path], Header], str]] = {
    META: (metaimage_header, "MetaImageIO"),
    NRRD: (nrrd_header, "NrrdImageIO"),
}
_PIXELS = (".raw", ".zraw", ".raw.gz", ".img", ".img.gz")
_SIZES = {NIFTI: nifti_size, ANALYZE: nifti_size, MGH: mgh_size}


def read_volume(path: Path, *, vectors: bool = False) -> Volume:
    """Read NIfTI, MGH, MetaImage, NRRD, Analyze, or another format that ITK knows.

    Args:
        path: a regular file, see `require_file`; either of the two of a pair.
        vectors: whether a fourth axis of D numbers holds vectors, instead of volumes of a series.

    Raises:
        InputError: damaged, of no known format, a series, or with a header that makes no sense.

    Notes:
        ITK reads in a process of its own, so that no file takes this one with it.
    """
    file = header_of_pair(path)
    kind = kind_of(file)
    if kind == NIFTI:
        return read_nifti(file, vectors=vectors)
    if kind == MGH:
        return read_mgh(file)
    if kind == ANALYZE:
        nifti_size(file)
        return isolated(read_by_itk, file, "NiftiImageIO", vectors, path=file)
    if kind not in _TEXT_HEADERS:
        _require_image(file)
        return isolated(read_by_itk, file, "", vectors, path=file)
    read_header, reader = _TEXT_HEADERS[kind]
    header = read_header(file)
    header.require_complete()
    return isolated(read_by_itk, file, reader, vectors, path=file, size=header.stored).in_units_of(*header.unit)


def volume_size(path: Path) -> tuple[tuple[int, ...], int] | None:
    """Return the size (x, y, z, ...) and the number of channels of a file that `read_volume` reads, None if unknown.

    Raises:
        InputError: the header makes no sense, or announces more than can be there.
    """
    file = header_of_pair(path)
    kind = kind_of(file)
    if kind in _SIZES:
        return _SIZES[kind](file)
    if kind not in _TEXT_HEADERS:
        return isolated(size_by_itk, file, path=file)
    header = _TEXT_HEADERS[kind][0](file)
    header.require_room()
    return header.size, header.channels


def volume_files(path: Path) -> tuple[Path, ...]:
    """Return the header and the files of pixels that a file which `read_volume` reads is made of.

    Raises:
        InputError: the header makes no sense.
    """
    file = header_of_pair(path)
    kind = kind_of(file)
    if kind in _TEXT_HEADERS:
        return file, *_TEXT_HEADERS[kind][0](file).files
    return (file, *nifti_files(file)) if kind in (NIFTI, ANALYZE) else (file,)


def header_of_pair(path: Path) -> Path:
    """Return the header beside the pixels of a pair (``.img``), the file itself in all other cases."""
    ending = suffix(path)
    if ending in (".img", ".img.gz"):
        for other in (".hdr", ".hdr.gz"):
            header = path.with_name(path.name[: -len(ending)] + other)
            if header.is_file():
                return header
    return path


def _require_image(path: Path) -> None:
    """Raise `InputError` for a file that is certainly something else, or pixels without their header."""
    if found := known_otherwise(path):
        raise InputError(f"{path} {found}")
    if suffix(path) not in _PIXELS:
        return
    name = path.name.removesuffix(suffix(path))
    for ending in (".mhd", ".nhdr", ".hdr"):
        if path.with_name(name + ending).is_file():
            raise InputError(f"{path} holds pixels only; give its header, {name}{ending}")
    raise InputError(f"{path} holds pixels only; put its header (.mhd, .nhdr or .hdr) beside it and give that")
