"""DICOM files for tests, written with pydicom: one volume as single files, or as frames of one enhanced file."""

from pathlib import Path
from typing import Any

import numpy as np
from pydicom import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, EnhancedMRImageStorage, ExplicitVRLittleEndian, SecondaryCaptureImageStorage

AXES = np.array([[0.936293363584, -0.275095847318, 0.218350663146],
                 [0.289629477625, 0.956425085849, -0.036957013525],
                 [-0.198669330795, 0.097843395007, 0.975170327202]])  # fmt: skip
SPACING, ORIGIN, SIZE = (0.7, 0.9, 2.5), np.array([-31.0, 22.0, 140.0]), (40, 30)  # x, y, z


def volume(count: int = 10, seed: int = 0) -> np.ndarray:
    """Return random pixels ``(count, 30, 40)``."""
    return np.random.default_rng(seed).integers(0, 1000, (count, *SIZE[::-1])).astype(np.uint16)


def place(index: float, sideways: float = 0.0) -> list[float]:
    """Return the position of slice ``index``."""
    return [round(float(x), 6) for x in ORIGIN + AXES[:, 2] * SPACING[2] * index + AXES[:, 1] * sideways * index]


def picture(values: np.ndarray, kind: str = SecondaryCaptureImageStorage, **elements: Any) -> Dataset:
    """Return a data set with pixels ``(rows, columns[, 3])`` or, of several frames, ``(frames, rows, columns)``."""
    colour = values.ndim > 2 and values.shape[-1] == 3
    rows, columns = values.shape[-3:-1] if colour else values.shape[-2:]
    data, frames = Dataset(), values.size // (rows * columns * (3 if colour else 1))
    data.SOPClassUID, data.SOPInstanceUID, data.SeriesInstanceUID = kind, "1.2.3.9", "1.2.3"
    data.Modality, data.SeriesDescription = "OT", "scan"
    data.SamplesPerPixel, data.PhotometricInterpretation = (3, "RGB") if colour else (1, "MONOCHROME2")
    if colour:
        data.PlanarConfiguration = 0
    if frames > 1:
        data.NumberOfFrames = frames
    data.Rows, data.Columns = rows, columns
    data.BitsAllocated = data.BitsStored = 8 * values.itemsize
    data.HighBit, data.PixelRepresentation = data.BitsStored - 1, int(values.dtype.kind == "i")
    data.add_new("PixelData", "OW" if values.itemsize > 1 else "OB", values.tobytes())
    for keyword, value in elements.items():
        setattr(data, keyword, value)
    return data


def save(data: Dataset, path: Path, syntax: str = ExplicitVRLittleEndian) -> Path:
    """Write a data set as a DICOM file."""
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = syntax
    data.file_meta.MediaStorageSOPClassUID, data.file_meta.MediaStorageSOPInstanceUID = (
        data.SOPClassUID,
        data.SOPInstanceUID,
    )
    data.save_as(path, enforce_file_format=True)
    return path


def orientation() -> list[float]:
    """Return the directions of rows and columns."""
    return [round(float(x), 9) for x in (*AXES[:, 0], *AXES[:, 1])]


def single(folder: Path, values: np.ndarray, **elements: Any) -> Path:
    """Write the slices of a volume as files."""
    folder.mkdir(exist_ok=True)
    for k, pixels in enumerate(values):
        data = picture(pixels, CTImageStorage, SOPInstanceUID=f"1.2.3.9.{k}", ImagePositionPatient=place(k))
        data.ImageOrientationPatient, data.PixelSpacing = orientation(), [SPACING[1], SPACING[0]]
        for keyword, value in elements.items():
            setattr(data, keyword, value)
        save(data, folder / f"{(7 * k) % 31:02d}.dcm")
    return folder


def item(**elements: Any) -> list[Dataset]:
    """Return a sequence of one item."""
    data = Dataset()
    for keyword, value in elements.items():
        setattr(data, keyword, value)
    return [data]


def enhanced(
    path: Path,
    values: np.ndarray,
    positions: list[list[float]] | None = None,
    frames: list[dict[str, Any]] | None = None,
) -> Path:
    """Write an enhanced file; ``frames`` has more sequences for the group of each frame."""
    data = picture(values, EnhancedMRImageStorage)
    shared = item(
        PlaneOrientationSequence=item(ImageOrientationPatient=orientation()),
        PixelMeasuresSequence=item(PixelSpacing=[SPACING[1], SPACING[0]], SliceThickness=9.0, SpacingBetweenSlices=7.0),
    )
    data.SharedFunctionalGroupsSequence = shared
    positions = positions or [place(k) for k in range(len(values))]
    data.PerFrameFunctionalGroupsSequence = [
        item(PlanePositionSequence=item(ImagePositionPatient=position), **(frames[k] if frames else {}))[0]
        for k, position in enumerate(positions)
    ]
    return save(data, path)
