"""Pixels of DICOM, in a process of its own: stored values by pydicom, what is compressed is unpacked by GDCM."""

import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError
from torchdeform.io.dicom_header import SECONDS, packing, read
from torchdeform.io.files import native_stderr
from torchdeform.io.gate import DAMAGED, reading, require_room
from torchdeform.io.isolated import isolated

if TYPE_CHECKING:
    from pydicom import Dataset

# What describes pixels and nothing else.
_MODULE = [
    "SamplesPerPixel", "PlanarConfiguration", "NumberOfFrames", "Rows", "Columns",
    "BitsAllocated", "BitsStored", "HighBit", "PixelRepresentation", "PixelData",
]  # fmt: skip
_SAMPLES = ("PixelData", "FloatPixelData", "DoubleFloatPixelData")
_SUBSAMPLED = {"YBR_FULL_422": 2 / 3}  # stored numbers for each number of a pixel


def pixels(path: Path) -> NDArray[np.generic]:
    """Return the stored values of a file ``(frames, rows, columns, samples)``, as a viewer shows them.

    Raises:
        InputError: pixels that are cut off, missing, or packed in a way that cannot be unpacked here.

    Notes:
        Palettes and other colours become RGB; where white is zero (MONOCHROME1) values are turned around.
    """
    return isolated(_pixels, path, path=path, seconds=SECONDS)


def _pixels(path: Path) -> NDArray[np.generic]:
    with reading(path):
        return _shown(path, read(path))


def _shown(path: Path, header: "Dataset") -> NDArray[np.generic]:
    from pydicom.pixels import apply_color_lut

    stored = _unpacked(path, header) if header.file_meta.TransferSyntaxUID.is_compressed else _native(path, header)
    meaning = header.get("PhotometricInterpretation", "")
    if meaning == "PALETTE COLOR":
        stored = apply_color_lut(stored, header)
    elif meaning == "MONOCHROME1" and np.issubdtype(stored.dtype, np.integer):
        low, high = _range(header)
        stored = (low + high - stored.astype(np.int64)).astype(stored.dtype)
    shape = int(header.get("NumberOfFrames") or 1), int(header.Rows), int(header.Columns)
    return stored.reshape(*shape, -1)


def _range(header: "Dataset") -> tuple[int, int]:
    """Return the least and the greatest value that a pixel can store."""
    bits = int(header.BitsStored)
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if header.get("PixelRepresentation") else (0, (1 << bits) - 1)


def _native(path: Path, header: "Dataset") -> NDArray[np.generic]:
    from pydicom.pixels import pixel_array

    stored = next((header[name].value for name in _SAMPLES if name in header), b"")
    share = _SUBSAMPLED.get(header.get("PhotometricInterpretation", ""), 1.0)
    if len(stored) < _numbers(header) * int(header.BitsAllocated) * share // 8:
        raise InputError(f"{path} {DAMAGED}")
    found = pixel_array(header)
    return found.astype(found.dtype.newbyteorder("="), copy=False)  # ITK would take it for this machine's order


def _numbers(header: "Dataset") -> int:
    frames, samples = (int(header.get(name) or 1) for name in ("NumberOfFrames", "SamplesPerPixel"))
    return frames * samples * int(header.Rows) * int(header.Columns)


def _unpacked(path: Path, header: "Dataset") -> NDArray[np.generic]:
    require_room(path, _numbers(header) * math.ceil(int(header.BitsAllocated) / 8))
    found = _by_gdcm(header)
    if found is None or found.size != _numbers(header):
        _, name = packing(header)
        raise InputError(
            f"{path} is packed as {name}, which cannot be unpacked here, or is damaged; unpack it first, for instance "
            f"with `gdcmconv --raw {path.name} unpacked.dcm` or `dcm2niix`"
        )
    return found


def _by_gdcm(header: "Dataset") -> NDArray[np.generic] | None:
    """Unpack pixels, None if that fails. GDCM sees a file of the pixels alone, so no other content."""
    import SimpleITK as sitk

    with tempfile.TemporaryDirectory() as folder:
        _write_pixels(header, alone := Path(folder) / "pixels.dcm")
        reader = sitk.ImageFileReader()
        reader.SetImageIO("GDCMImageIO")
        reader.SetFileName(str(alone))
        with native_stderr():
            try:
                return sitk.GetArrayFromImage(reader.Execute())
            except RuntimeError:
                return None


def _write_pixels(header: "Dataset", path: Path) -> None:
    """Write a file that holds pixels and what describes them; a pixel that is one number is written as grey."""
    from pydicom import Dataset, FileMetaDataset
    from pydicom.uid import SecondaryCaptureImageStorage, generate_uid

    alone = Dataset()
    for keyword in _MODULE:
        if keyword in header:
            alone[keyword] = header[keyword]
    grey = int(header.get("SamplesPerPixel") or 1) == 1
    alone.PhotometricInterpretation = "MONOCHROME2" if grey else header.PhotometricInterpretation
    alone.file_meta = FileMetaDataset()
    alone.file_meta.TransferSyntaxUID = header.file_meta.TransferSyntaxUID
    alone.SOPClassUID = alone.file_meta.MediaStorageSOPClassUID = SecondaryCaptureImageStorage
    alone.SOPInstanceUID = alone.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    alone.save_as(path, enforce_file_format=True)
