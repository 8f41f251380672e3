"""Headers of DICOM, read in Python: every slice of a file, be it the whole file or a frame, with place and scale."""

import math
import re
import zlib
from collections.abc import Iterator, Mapping, MutableSequence, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError
from torchdeform.io.files import read_head
from torchdeform.io.gate import DAMAGED, reading, require_room
from torchdeform.io.isolated import isolated

if TYPE_CHECKING:
    from pydicom import Dataset

# Files without the preamble start with an element of group 2 or 8: its number, then a VR or a short length.
_MAGIC = 128, b"DICM"
_BARE = re.compile(rb"[\x02\x08]\0(..(AE|CS|DA|DT|IS|LO|OB|PN|SH|SQ|TM|UI|UL|US)|[\0-\x3f]\0[\0-\x40]\0{3})", re.DOTALL)
_LIKE = (b"DICM", b"\x02\0", b"\x08\0")
_GIPL = (b"\xef\xff\xe9\xb0", b"\x2a\xe3\x89\xb8")  # a format of volumes whose width may look like that
_META = 144  # where the first elements begin, after the length of them

# Kinds of DICOM files without an image: directories, presentation states, reports, documents, plans, raw data.
_NO_IMAGE = re.compile(r"1\.2\.840\.10008\.(1\.3\.10|5\.1\.4\.1\.1\.(11|88|104|66|481\.[3458])(\.|$))")
_ADVICE = {
    "1.2.840.10008.5.1.4.1.1.66.4": "a segmentation, no image; convert it to labels with `segimage2itkimage` of dcmqi",
    "1.2.840.10008.5.1.4.1.1.481.3": "contours, no image; convert them to labels with `plastimatch convert`",
}
_SLIDE = "1.2.840.10008.5.1.4.1.1.77.1.6"
_DEFLATED = b"1.2.840.10008.1.2.1.99"
_VIDEO = ("1.2.840.10008.1.2.4.10", "1.2.840.10008.1.2.7.")  # how their transfer syntaxes start
_CHUNK = 1 << 20  # bytes unpacked at once

SECONDS = 8.0  # that a file may take, beside what its length adds

DCM2NIIX = "convert it with `dcm2niix` and give one volume of the result"

_ROUNDED = 0.05  # by which directions in a header may miss unit length and right angles
_CENTIMETRES = 3.0  # DICOM's code for the unit of an ultrasound region
_GROUPS = "PerFrameFunctionalGroupsSequence"

# Where values stand, as (sequence, keyword): of a frame in the sequence of a group, else in the header itself.
_POSITION = (
    ("PlanePositionSequence", "ImagePositionPatient"),
    ("DetectorInformationSequence", "ImagePositionPatient"),
    ("PlanePositionVolumeSequence", "ImagePositionVolume"),
)
_ORIENTATION = (
    ("PlaneOrientationSequence", "ImageOrientationPatient"),
    ("DetectorInformationSequence", "ImageOrientationPatient"),
    ("PlaneOrientationVolumeSequence", "ImageOrientationVolume"),
)
_SPACINGS = ("PixelSpacing", "ImagerPixelSpacing", "NominalScannedPixelSpacing")
_PASSES = ("NumberOfTimeSlots", "NumberOfPhases", "NumberOfEnergyWindows", "NumberOfDetectors", "NumberOfRotations")
_MOMENT = (
    ("", "TriggerTime"),
    ("", "AcquisitionTime"),
    ("FrameContentSequence", "FrameAcquisitionDateTime"),
    ("CardiacSynchronizationSequence", "NominalCardiacTriggerDelayTime"),
)
# What tells volumes of one series or file apart: always, and where several images are at one position.
_ALWAYS = {
    "stack": (("FrameContentSequence", "StackID"),),
    "echo": (("", "EchoNumbers"),),
    "time point": (("", "TemporalPositionIdentifier"),),
}
_WHERE_DOUBLE = {
    "time point": (("FrameContentSequence", "TemporalPositionIndex"),),
    "time": (("TemporalPositionSequence", "TemporalPositionTimeOffset"),),
    "echo time": (("MREchoSequence", "EffectiveEchoTime"), ("", "EchoTime")),
    "inversion time": (("MRModifierSequence", "InversionTimes"), ("", "InversionTime")),
    "b-value": (("MRDiffusionSequence", "DiffusionBValue"),),
    "gradient": (("MRDiffusionSequence", "DiffusionGradientOrientation"),),
    "component": (("MRImageFrameTypeSequence", "ComplexImageComponent"),),
    "kind of image": (
        ("MRImageFrameTypeSequence", "FrameType"),
        ("CTImageFrameTypeSequence", "FrameType"),
        ("PETFrameTypeSequence", "FrameType"),
        ("", "ImageType"),
    ),
}
_KEYWORDS = [
    "SOPClassUID", "ImageType", "Modality", "SeriesInstanceUID", "SeriesDescription", "ConcatenationUID",
    "NumberOfFrames", "Rows", "Columns", "SamplesPerPixel", "BitsAllocated", "SliceThickness",
    "SpacingBetweenSlices", "RescaleSlope", "RescaleIntercept", "DoseGridScaling", "GridFrameOffsetVector",
    "ImagePositionPatient", "ImageOrientationPatient", "FrameTime", "FrameTimeVector",
    "DetectorInformationSequence", "SequenceOfUltrasoundRegions", "SharedFunctionalGroupsSequence",
    "DiffusionBValue", "DiffusionGradientOrientation", "TriggerTime", "AcquisitionTime", "EchoNumbers", "EchoTime",
    "InversionTime", "TemporalPositionIdentifier", "PixelSpacing", "ImagerPixelSpacing",
    "NominalScannedPixelSpacing",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Slice:
    """What a header says of one slice.

    Attributes:
        path: the file.
        frame: index of the slice in the file.
        frames: slices of the file.
        series: names and values that all slices of one volume share.
        kind: names and values that tell volumes at the same positions apart.
        title: the series' description.
        size: rows, columns and numbers of a pixel.
        spacing: of columns and rows (x, y), mm; None where the header has none.
        position: world position of the first pixel, mm.
        placed: whether the header has a position.
        moment: when it was acquired, as the header writes it.
        axes: world directions of x, y and z as columns ``(3, 3)``.
        scale: slope and intercept of the stored values.
    """

    path: Path
    frame: int
    frames: int
    series: tuple[tuple[str, object], ...]
    kind: tuple[tuple[str, object], ...]
    title: str
    size: tuple[int, int, int]
    spacing: tuple[float, float] | None
    position: NDArray[np.float64]
    placed: bool
    moment: tuple[str, ...]
    axes: NDArray[np.float64]
    scale: tuple[float, float]

    @property
    def height(self) -> float:
        """Position along the normal of the slice, mm."""
        return float(self.axes[:, 2] @ self.position)

    @property
    def label(self) -> str:
        """The file's name, or the frame's number from 1."""
        return self.path.name if self.frames == 1 else f"frame {self.frame + 1}"


def is_dicom(path: Path) -> bool:
    """Return whether a file is DICOM by its content, whatever its name; old files lack the magic bytes."""
    start, magic = _MAGIC
    head = read_head(path, start + len(magic))
    return head[start:] == magic or _BARE.match(head) is not None


def may_be_dicom(path: Path) -> bool:
    """Return whether a file is DICOM, or so like it that ITK would look for DICOM in it, by GDCM, which may crash."""
    head = read_head(path, 256)
    return is_dicom(path) or (head.startswith(_LIKE) and head[252:] not in _GIPL)


def slices(path: Path) -> list[Slice]:
    """Return the slices of a DICOM file in the order of the file; none if it holds no image.

    Raises:
        InputError: a damaged header; frames that are no volume: a cine, a mosaic, a slide.

    Notes:
        Read in a process of its own, since some headers of a few kilobytes keep pydicom busy for minutes.
    """
    return isolated(_slices, path, path=path, seconds=SECONDS)


def no_image(path: Path) -> str:
    """Return the sentence for a DICOM file without an image."""
    kind = isolated(_kind, path, path=path, seconds=SECONDS)
    what = _ADVICE.get(kind, "no DICOM image; give an image file, or the folder of the series")
    return f"{path} holds {what}"


def _kind(path: Path) -> str:
    with reading(path):
        return str(read(path, ["SOPClassUID"]).get("SOPClassUID", ""))


def read(path: Path, keywords: Sequence[str] = ()) -> "Dataset":
    """Return the elements of a file that are asked for, or all with the pixels."""
    from pydicom import dcmread
    from pydicom.uid import ExplicitVRBigEndian, ExplicitVRLittleEndian, ImplicitVRLittleEndian

    _require_inflatable(path)
    header = dcmread(path, force=True, stop_before_pixels=bool(keywords), specific_tags=list(keywords) or None)
    if "TransferSyntaxUID" not in header.file_meta:  # files without first elements are not compressed
        plain, little = header.original_encoding
        explicit = ExplicitVRLittleEndian if little else ExplicitVRBigEndian
        header.file_meta.TransferSyntaxUID = ImplicitVRLittleEndian if plain else explicit
    return header


def _require_inflatable(path: Path) -> None:
    """Raise `InputError` if a file that is packed behind its first elements becomes larger than the memory."""
    head = read_head(path, 1024)
    if _DEFLATED not in head:
        return
    unpacker, length = zlib.decompressobj(-zlib.MAX_WBITS), 0
    with path.open("rb") as file:
        file.seek(_META + int.from_bytes(head[_META - 4 : _META], "little"))
        while chunk := unpacker.decompress(unpacker.unconsumed_tail or file.read(_CHUNK), _CHUNK):
            length += len(chunk)
            require_room(path, length)


class _Frame:
    """What a header says of one frame: in the frame's own group, in the group of all frames, or plainly."""

    def __init__(self, header: "Dataset", index: int) -> None:
        own = header.get("PerFrameFunctionalGroupsSequence") or []
        shared = header.get("SharedFunctionalGroupsSequence") or []
        self.header, self.groups = header, [*own[index : index + 1], *shared[:1], header]

    def find(self, *places: tuple[str, str]) -> Any:
        """Return the first value that is there, None if none is; a place is a sequence and a keyword."""
        for sequence, keyword in places:
            for item in self._items(sequence):
                if item.get(keyword) not in (None, ""):
                    return item.get(keyword)
        return None

    def _items(self, sequence: str) -> "Iterator[Dataset]":
        for group in self.groups if sequence else ():
            for item in group.get(sequence) or ():
                yield item
                yield from item.get("DiffusionGradientDirectionSequence") or ()
        yield self.header

    def numbers(self, count: int, *places: tuple[str, str]) -> tuple[float, ...] | None:
        """Return ``count`` finite numbers, None if they are not there."""
        value = self.find(*places)
        if value is None:
            return None
        found = tuple(map(float, value)) if isinstance(value, MutableSequence) else (float(value),)
        if len(found) != count or not all(map(math.isfinite, found)):
            raise ValueError(f"{places}: {value}")
        return found

    def named(self, table: Mapping[str, tuple[tuple[str, str], ...]]) -> tuple[tuple[str, object], ...]:
        """Return the names of a table with what stands at their places."""
        return tuple((name, str(self.find(*places))) for name, places in table.items())


def _slices(path: Path) -> list[Slice]:
    with reading(path):
        return _of_header(path, read(path, [*_KEYWORDS, *_PASSES, _GROUPS]))


def _of_header(path: Path, header: "Dataset") -> list[Slice]:
    if _NO_IMAGE.match(str(header.get("SOPClassUID", ""))) or "Rows" not in header:
        return []
    size = int(header.Rows), int(header.Columns), int(header.get("SamplesPerPixel") or 1)
    frames, described = int(header.get("NumberOfFrames") or 1), len(header.get(_GROUPS) or ())
    if min(frames, *size) < 1 or frames > path.stat().st_size or (described and described != frames):
        raise InputError(f"{path} {DAMAGED}")
    require_room(path, frames * math.prod(size) * int(header.get("BitsAllocated") or 16) // 8)
    _require_still(path, header, frames)
    offsets = [0.0] * frames if frames == 1 or described else _offsets(path, header, frames)
    return [_slice(path, _Frame(header, k), (k, frames), size, offset) for k, offset in enumerate(offsets)]


def _require_still(path: Path, header: "Dataset", frames: int) -> None:
    """Raise `InputError` for films, mosaics and slides, whose frames or tiles are no slices one after the other."""
    kind = str(header.get("SOPClassUID", ""))
    if "MOSAIC" in (header.get("ImageType") or ()):
        raise InputError(f"{path} is a mosaic, all slices tiled in one picture; {DCM2NIIX}")
    if kind == _SLIDE:
        raise InputError(f"{path} is a slide in tiles; convert it to TIFF, for instance with `vips copy`")
    film = "FrameTime" in header or "FrameTimeVector" in header or any((header.get(n) or 1) > 1 for n in _PASSES)
    if packing(header)[0].startswith(_VIDEO) or (frames > 1 and film and not header.get(_GROUPS)):
        raise InputError(f"{path} is a cine of {frames} frames; export one frame and give that")


def packing(header: "Dataset") -> tuple[str, str]:
    """Return UID and name of the syntax in which pixels are stored; files without the first elements have none."""
    uid = header.file_meta.get("TransferSyntaxUID", "")
    return str(uid), str(getattr(uid, "name", uid))


def _offsets(path: Path, header: "Dataset", frames: int) -> list[float]:
    """Return how far, in mm along the normal, the frames of a file without groups are from its position."""
    if header.get("GridFrameOffsetVector"):
        given = [float(value) for value in header.GridFrameOffsetVector]
        if len(given) != frames or not all(map(math.isfinite, given)):
            raise InputError(f"{path} {DAMAGED}")
        return [value - given[0] for value in given]
    nuclear = header.get("Modality") in ("NM", "PT")
    step = header.get("SpacingBetweenSlices") or (header.get("SliceThickness") if nuclear else None)
    if step is None and _spacing(_Frame(header, 0)) is not None:
        raise InputError(f"{path} does not say how far apart its {frames} frames are; {DCM2NIIX}")
    return [k * float(step or 1.0) for k in range(frames)]


def _slice(path: Path, frame: _Frame, place: tuple[int, int], size: tuple[int, int, int], offset: float) -> Slice:
    axes, spacing = _axes(path, frame), _spacing(frame)
    position = frame.numbers(3, *_POSITION)
    if spacing is not None and min(spacing) <= 0:
        raise InputError(f"{path} has the pixel spacing {spacing} in its header; correct the header")
    together = frame.find(("", "ConcatenationUID")) or (path.name if place[1] > 1 else "")
    return Slice(
        path=path,
        frame=place[0],
        frames=place[1],
        series=(
            ("series", str(frame.find(("", "SeriesInstanceUID")))),
            ("file", str(together)),
            ("size", size),
            ("orientation", tuple(np.round(axes[:, :2], 3).ravel() + 0.0)),
            ("pixel spacing", spacing and tuple(round(h, 4) for h in spacing)),
            *frame.named(_ALWAYS),
        ),
        kind=frame.named(_WHERE_DOUBLE),
        title=str(frame.find(("", "SeriesDescription")) or "without a name"),
        size=size,
        spacing=spacing,
        position=np.array(position or (0.0, 0.0, 0.0)) + offset * axes[:, 2],
        placed=position is not None,
        moment=tuple(str(frame.find(place)) for place in _MOMENT),
        axes=axes,
        scale=_scale(frame),
    )


def _axes(path: Path, frame: _Frame) -> NDArray[np.float64]:
    """Return the directions of rows, columns and normal as columns, at right angles whatever was rounded."""
    given = np.reshape(frame.numbers(6, *_ORIENTATION) or (1, 0, 0, 0, 1, 0), (2, 3))
    lengths = np.linalg.norm(given, axis=1)
    if np.abs(lengths - 1).max() > _ROUNDED or abs(given[0] @ given[1]) > _ROUNDED:
        raise InputError(f"{path} has an orientation in its header that is no plane; correct the header")
    row = given[0] / lengths[0]
    column = given[1] - (given[1] @ row) * row
    column /= np.linalg.norm(column)
    return np.stack((row, column, np.cross(row, column)), axis=1)


def _spacing(frame: _Frame) -> tuple[float, float] | None:
    """Return the distances of columns and of rows (x, y) in mm, None if the header has none."""
    for keyword in _SPACINGS:
        if (found := frame.numbers(2, ("PixelMeasuresSequence", keyword))) is not None:
            return found[1], found[0]
    region = ("PhysicalDeltaX", "PhysicalDeltaY", "PhysicalUnitsXDirection")
    x, y, unit = (frame.numbers(1, ("SequenceOfUltrasoundRegions", keyword)) for keyword in region)
    return (10 * abs(x[0]), 10 * abs(y[0])) if x and y and unit == (_CENTIMETRES,) else None


def _scale(frame: _Frame) -> tuple[float, float]:
    """Return slope and intercept; a slope of 0, which would leave nothing, counts as none."""
    slope, intercept = (
        frame.numbers(1, ("PixelValueTransformationSequence", keyword))
        for keyword in ("RescaleSlope", "RescaleIntercept")
    )
    slope = slope or frame.numbers(1, ("", "DoseGridScaling"))
    return (slope[0] if slope and slope[0] != 0 else 1.0), (intercept[0] if intercept else 0.0)
