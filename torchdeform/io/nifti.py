"""NIfTI-1 and NIfTI-2 under any name, packed or not, in one file or two. ITK takes a part of them only."""

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError
from torchdeform.io.files import suffix
from torchdeform.io.gate import DAMAGED, require_beside, require_room
from torchdeform.io.packed import Stream, is_packed, opened, read_tail
from torchdeform.io.volume import NOT_FINITE, SINGULAR, Volume, independence, is_stack, require_one

_CHUNK = 1 << 22  # bytes read at once

# Name, type and position of fields of the header, by the number that it starts with, which is its length.
_FIELDS = {
    348: (
        ("dim", "8i2", 40), ("intent", "i2", 68), ("datatype", "i2", 70), ("pixdim", "8f4", 76), ("offset", "f4", 108),
        ("slope", "f4", 112), ("inter", "f4", 116), ("units", "u1", 123), ("qform", "i2", 252), ("sform", "i2", 254),
        ("quatern", "3f4", 256), ("qoffset", "3f4", 268), ("rows", "(3,4)f4", 280), ("magic", "S4", 344),
    ),
    540: (
        ("magic", "S4", 4), ("datatype", "i2", 12), ("dim", "8i8", 16), ("pixdim", "8f8", 104), ("offset", "i8", 168),
        ("slope", "f8", 176), ("inter", "f8", 184), ("qform", "i4", 344), ("sform", "i4", 348), ("quatern", "3f8", 352),
        ("qoffset", "3f8", 376), ("rows", "(3,4)f8", 400), ("units", "i4", 500), ("intent", "i4", 504),
    ),
}  # fmt: skip

# Numbers of a pixel and their type, by NIfTI's code.
_TYPES = {
    2: (1, "u1"), 4: (1, "i2"), 8: (1, "i4"), 16: (1, "f4"), 64: (1, "f8"), 128: (3, "u1"), 256: (1, "i1"),
    512: (1, "u2"), 768: (1, "u4"), 1024: (1, "i8"), 1280: (1, "u8"), 2304: (4, "u1"),
}  # fmt: skip
_COMPLEX = (32, 1792, 2048)

# Length of 1 in mm and the unit to show, by the last three bits of NIfTI's code for units.
_UNITS = {1: (1e3, "mm"), 3: (1e-3, "µm")}

_LPS = np.array([[-1.0], [-1.0], [1.0]])  # signs that take RAS, NIfTI's world, to LPS

_ROUNDED = 5e-3  # share by which two lengths of a header may differ that are the same but for rounding
_NO_ROTATION = 1.01  # squared length of a quaternion's last three numbers that rounding does not explain
_APART = 0.25  # of a voxel, by which qform and sform may differ in silence


@dataclass(frozen=True)
class _Header:
    """The fields of a header by name, the file of the pixels, and whether a fourth axis may hold vectors."""

    path: Path
    data: Path
    fields: Any
    vectors: bool = False

    @property
    def size(self) -> tuple[int, ...]:
        """Sizes of all axes; those of one sample behind the third are left out."""
        rank, *sizes = map(int, self.fields["dim"])
        kept = sizes[:rank]
        while len(kept) > 3 and kept[-1] == 1:
            del kept[-1]
        return tuple(kept)

    @property
    def stacked(self) -> bool:
        """Whether the fourth axis holds the numbers of a pixel."""
        return self.vectors and is_stack(self.size)

    @property
    def vector(self) -> int:
        """Numbers of a pixel on the fifth axis, or on the fourth."""
        fifth = self.size[4] if len(self.size) == 5 and self.size[3] == 1 else 1
        return self.size[3] if self.stacked else fifth

    @property
    def space(self) -> tuple[int, ...]:
        """The size without the numbers of a pixel."""
        return self.size[:3] if self.vector > 1 else self.size

    @property
    def numbers(self) -> tuple[int, np.dtype[Any]]:
        """Numbers of a pixel that the type has, and their type."""
        count, kind = _TYPES[int(self.fields["datatype"])]
        return count, np.dtype(self.fields["dim"].dtype.str[0] + kind)

    @property
    def start(self) -> int:
        """Bytes before the pixels; headers of one file may leave them out."""
        offset = int(self.fields["offset"])
        return offset if self.data != self.path else max(offset, self.fields.dtype.itemsize + 4)

    @property
    def length(self) -> int:
        """Bytes of the pixels."""
        count, kind = self.numbers
        return math.prod(self.size) * count * kind.itemsize


def nifti_size(path: Path) -> tuple[tuple[int, ...], int]:
    """Return the size (x, y, z, ...) and the number of channels of a NIfTI or Analyze file from its header.

    Raises:
        InputError: the header makes no sense, or announces more than can be there.
    """
    header = _read_header(path)
    return header.space, header.vector * header.numbers[0]


def nifti_files(path: Path) -> tuple[Path, ...]:
    """Return the files of pixels beside a NIfTI or Analyze header, none where the pixels follow it."""
    header = _read_header(path)
    return () if header.data == path else (header.data,)


def read_nifti(path: Path, *, vectors: bool = False) -> Volume:
    """Read a NIfTI file.

    Args:
        path: the file, or the header of a pair.
        vectors: whether a fourth axis that can hold vectors does.

    Raises:
        InputError: damaged, a series, complex numbers, pixels that are NaN or infinite, or a header without sense.

    Notes:
        Its place is the sform's if it has one, as in nibabel, FSL and SPM, else the qform's; a remark says where both
        disagree. Without either it starts at 0 along the world's axes, as in ITK.
        Lengths become mm by the unit of the file; pixels are scaled as the header says.
    """
    header = replace(_read_header(path), vectors=vectors)
    require_one(path, header.space, endings=(".nii.gz",) if is_packed(path) else (".nii", ".hdr", ".img"))
    with opened(header.data, path) as file:
        values = _pixels(file, header)
    with np.errstate(all="ignore"):  # what is not finite is refused
        return _volume(values, header)


def _volume(stored: NDArray[np.generic], header: _Header) -> Volume:
    """Return scaled pixels in their place."""
    values, (rows, remarks) = _scaled(stored, header), _rows(header)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError(f"{header.path} {NOT_FINITE}")
    volume = place(values, rows, header.path)
    volume = replace(volume, remarks=remarks, intent=int(header.fields["intent"]), stacked=header.stacked)
    volume = _with_pixdim(volume, header)
    return volume.in_units_of(*_UNITS.get(int(header.fields["units"]) & 7, (1.0, "mm")))


def _read_header(path: Path) -> _Header:
    with opened(path) as file:
        head = file.read(540)
    for order in ("<", ">"):
        length = int(np.frombuffer(head[:4].ljust(4), f"{order}i4")[0])
        if length in _FIELDS and len(head) >= length:
            names, formats, offsets = zip(*_FIELDS[length], strict=True)
            layout: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": length}
            fields = np.frombuffer(head[:length], np.dtype(layout).newbyteorder(order))[0]
            return _require_sense(_Header(path, path, fields))
    raise InputError(f"{path} {DAMAGED}")


def _require_sense(header: _Header) -> _Header:
    """Return the header with its file of pixels; `InputError` unless its sizes and spacings can be."""
    path, fields = header.path, header.fields
    rank, *sizes = map(int, fields["dim"])
    if not 1 <= rank <= 7 or min(sizes[:rank]) < 1:
        raise InputError(f"{path} has the size {sizes[: min(max(rank, 0), 7)]} in its header; correct the header")
    spacing = [float(h) for h, n in zip(fields["pixdim"][1:4], sizes[: min(rank, 3)], strict=False) if n > 1]
    if not all(math.isfinite(h) and h != 0 for h in spacing):
        raise InputError(f"{path} has the spacing {spacing} in its header; correct the header")
    if not (math.isfinite(fields["offset"]) and fields["offset"] >= 0):
        raise InputError(f"{path} {DAMAGED}")
    if int(fields["datatype"]) in _COMPLEX:
        raise InputError(f"{path} holds complex numbers; save their magnitude and give that")
    if int(fields["datatype"]) not in _TYPES:
        raise InputError(
            f"{path} has pixels of the type {int(fields['datatype'])}, which is unknown; correct the header"
        )
    found = header if fields["magic"][:2] == b"n+" else replace(header, data=_pixels_beside(path))
    require_room(path, found.start + found.length, stored=found.data.stat().st_size)
    return found


def _pixels_beside(path: Path) -> Path:
    """Return the file of pixels that belongs to a header of a pair."""
    name = path.name.removesuffix(suffix(path)) if suffix(path) in (".hdr", ".hdr.gz") else path.name
    found = [path.with_name(name + ending) for ending in (".img", ".img.gz", ".IMG")]
    for data in found:
        if os.path.lexists(data):
            require_beside(data, path)
            return data
    raise InputError(
        f"{path} is the header of two files, and {found[0].name}, its pixels, is missing; put it beside it"
    )


def _pixels(file: Stream, header: _Header) -> NDArray[np.generic]:
    """Return the pixels ``(*S, C)`` as they are stored; memory is taken as they come, whatever the header says."""
    file.seek(header.start)
    content = bytearray()
    while len(content) < header.length and (part := file.read(min(_CHUNK, header.length - len(content)))):
        content += part
    if len(content) < header.length:
        raise InputError(f"{header.path} {DAMAGED}")
    read_tail(file)
    count, kind = header.numbers
    values = np.frombuffer(content, kind).reshape(header.vector, *header.space[::-1], count)
    values = np.moveaxis(values, 0, -2).reshape(*header.space[2::-1], -1)
    return values.astype(kind.newbyteorder("="), copy=False)


def _scaled(values: NDArray[np.generic], header: _Header) -> NDArray[np.generic]:
    """Return slope · value + intercept; a slope of 0 or NaN means that there is none. Colours are not scaled."""
    slope, inter = float(header.fields["slope"]), float(header.fields["inter"])
    if header.numbers[0] > 1 or not math.isfinite(slope) or slope == 0 or (slope, inter) == (1, 0):
        return values
    if not math.isfinite(inter):
        raise InputError(f"{header.path} has the intercept {inter} in its header; correct the header")
    found = slope * values.astype(np.float64) + inter
    return found if values.dtype.itemsize > 4 else found.astype(np.float32)


def _rows(header: _Header) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Return the affine ``(3, 4)`` to the world in RAS, and what is to be said about it."""
    fields = header.fields
    sform, qform = fields["rows"].astype(np.float64), None
    if fields["sform"] <= 0:
        return (_qform(header) if fields["qform"] > 0 else _without_place(header)), ()
    if fields["qform"] > 0:
        try:
            qform = _qform(header)
        except InputError:  # the sform is what counts
            return sform, ()
    if qform is not None and not _spans(sform, header.space):
        return qform, (f"{header.path} has an sform without sense; the qform is used: correct its header",)
    apart = 0.0 if qform is None else _apart(sform, qform, header)
    if not apart > _APART:
        return sform, ()
    text = (
        f"{header.path} has an sform and a qform that place it up to {apart:.3g} voxels apart; the sform is used here, "
        "as in nibabel, FSL and SPM, and tools of ITK may use the qform: correct its header"
    )
    return sform, (text,)


def _spans(rows: NDArray[np.float64], size: tuple[int, ...]) -> bool:
    """Return whether an affine gives every axis of several samples a direction of its own."""
    columns = rows[:, [k for k, n in enumerate(size[:3]) if n > 1]]
    units = columns / np.linalg.norm(columns, axis=0)
    finite = bool(np.isfinite(rows).all() and np.isfinite(units).all())
    return finite and np.linalg.matrix_rank(units, 1e-3) == units.shape[1]


def _apart(one: NDArray[np.float64], other: NDArray[np.float64], header: _Header) -> float:
    """Return how many voxels the corners of the image are apart by two affines, at most."""
    ends = [(0.0, float(n - 1)) for n in (*header.space, 1, 1)[:3]]
    corners = np.array([*np.meshgrid(*ends, indexing="ij"), np.ones((2, 2, 2))]).reshape(4, -1)
    least = min(abs(float(h)) for h, n in zip(header.fields["pixdim"][1:4], header.space, strict=False) if n > 1)
    return float(np.linalg.norm((one - other) @ corners, axis=0).max() / least)


def _qform(header: _Header) -> NDArray[np.float64]:
    """Return the affine of the rotation by a unit quaternion (a, b, c, d), of which b, c and d are stored."""
    fields = header.fields
    imaginary = fields["quatern"].astype(np.float64)
    square = float(imaginary @ imaginary)
    if not square <= _NO_ROTATION:  # NaN too
        raise InputError(f"{header.path} has a qform that is no rotation; correct its header")
    a, (b, c, d) = math.sqrt(max(0.0, 1 - square)), imaginary / max(1.0, math.sqrt(square))
    rotation: NDArray[np.float64] = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    handed = np.array([1.0, 1.0, -1.0 if fields["pixdim"][0] < 0 else 1.0])
    lengths = np.abs(fields["pixdim"][1:4].astype(np.float64))
    return np.column_stack([rotation * handed * lengths, fields["qoffset"]])


def _without_place(header: _Header) -> NDArray[np.float64]:
    lengths = np.abs(header.fields["pixdim"][1:4].astype(np.float64))
    return np.column_stack([np.diag(lengths * _LPS[:, 0]), np.zeros(3, np.float64)]).astype(np.float64)


def place(values: NDArray[np.generic], rows: NDArray[np.float64], path: Path) -> Volume:
    """Return pixels ``(*S, C)`` where an affine ``(3, 4)`` to RAS mm puts them.

    Raises:
        InputError: the affine is singular or not finite.

    Notes:
        An axis of one sample may have no direction; it gets the one at right angles to the others.
    """
    size = (*values.shape[-2::-1], 1, 1)[:3]
    columns, origin = _LPS * rows[:, :3] + 0.0, (_LPS[:, 0] * rows[:, 3] + 0.0).tolist()  # no −0
    if not (np.isfinite(columns).all() and np.isfinite(origin).all()):
        raise InputError(f"{path} has NaN or infinite numbers in its affine; correct its header")
    for axis in range(3):
        if size[axis] == 1 and not columns[:, axis].any():
            columns[:, axis] = np.cross(columns[:, axis - 2], columns[:, axis - 1])
            columns[:, axis] /= max(np.linalg.norm(columns[:, axis]), np.finfo(float).tiny)
    lengths = np.linalg.norm(columns, axis=0)
    if not independence(columns) > SINGULAR:
        raise InputError(f"{path} has an affine that is singular; correct its header")
    values = values.reshape(*size[::-1], -1)
    return Volume(values, tuple(lengths.tolist()), tuple(origin), columns / lengths)


def _with_pixdim(volume: Volume, header: _Header) -> Volume:
    """Return the volume with the spacing of ``pixdim``, which has more digits, or say that the affine has another."""
    stored = np.abs(header.fields["pixdim"][1:4].astype(np.float64))
    found, used = np.array(volume.spacing), np.array(volume.size) > 1
    if (np.abs(found - stored) <= _ROUNDED * found)[used].all():
        return replace(volume, spacing=tuple(np.where(used, stored, found).tolist()))
    sizes = ["×".join(f"{h:.4g}" for h in lengths[used]) for lengths in (found, stored)]
    text = f"{header.path} has voxels of {sizes[0]} by its sform and of {sizes[1]} by its pixdim; the sform is used"
    return replace(volume, remarks=(*volume.remarks, f"{text}: correct its header if the other is right"))
