"""MGH and MGZ, the volumes of FreeSurfer, by nibabel."""

import math
import struct
from pathlib import Path

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.gate import DAMAGED, reading, require_room
from torchdeform.io.nifti import place
from torchdeform.io.packed import is_packed, opened, read_tail
from torchdeform.io.volume import NOT_FINITE, Volume, require_one

_WIDTHS = {0: 1, 1: 4, 3: 4, 4: 2}  # bytes of a number, by FreeSurfer's code of its type


def mgh_size(path: Path) -> tuple[tuple[int, ...], int]:
    """Return the size (x, y, z, frames) of an MGH file from its header, and one channel.

    Raises:
        InputError: the header announces more than can be there.
    """
    with opened(path) as file:
        _, *size, kind = struct.unpack(">6i", file.read(24).ljust(24, b"\0"))
    if min(size) < 1 or kind not in _WIDTHS:
        raise InputError(f"{path} {DAMAGED}")
    require_room(path, math.prod(size) * _WIDTHS[kind])
    return tuple(size if size[3] > 1 else size[:3]), 1


def read_mgh(path: Path) -> Volume:
    """Read an MGH or MGZ file, whatever its name.

    Raises:
        InputError: damaged, of several frames, or with pixels that are NaN or infinite.
    """
    require_one(path, mgh_size(path)[0], endings=(".mgz",) if is_packed(path) else (".mgh",))
    from nibabel.fileholders import FileHolder
    from nibabel.freesurfer.mghformat import MGHImage

    with reading(path), opened(path) as file, np.errstate(all="ignore"):  # what is not finite is refused
        image = MGHImage.from_file_map({"image": FileHolder(fileobj=file)}, mmap=False)
        values = np.asarray(image.dataobj)
        read_tail(file)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise InputError(f"{path} {NOT_FINITE}")
        values = values.reshape(values.shape[:3]).T[..., None]
        native = values.astype(values.dtype.newbyteorder("="), copy=False)
        return place(native, np.asarray(image.affine)[:3], path)
