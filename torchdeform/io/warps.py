"""Fields of vectors stored as images, with the components where tools put them."""

from pathlib import Path

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.volume import Volume
from torchdeform.io.volumes import read_volume

# NIfTI's intents of warps that FSL writes: fields and coefficients.
_FSL = (2006, 2007, 2008, 2009)
# Vectors that miss the places of their voxels by a smaller share of the places' spread are positions.
_POSITIONS = 0.2


def read_vectors(path: Path) -> Volume:
    """Read a field of vectors, whose components may also stand on a fourth axis of a NIfTI file ``(x, y, z, 3)``.

    Args:
        path: a regular file, see `require_file`.

    Raises:
        InputError: as `read_volume`; a warp of FSL; positions instead of displacements on a fourth axis.
    """
    volume = read_volume(path, vectors=True)
    if volume.intent in _FSL:
        raise InputError(
            f"{path} is a warp of FSL; convert it with `wb_command -convert-warpfield -from-fnirt {path.name} "
            "moving.nii.gz -to-itk field.nii.gz`"
        )
    if volume.stacked:
        _require_displacements(volume, path)
    return volume


def _require_displacements(volume: Volume, path: Path) -> None:
    """Raise `InputError` if vectors are rather the positions that nodes go to, in LPS or RAS, than displacements."""
    index = np.stack(np.meshgrid(*map(np.arange, volume.size), indexing="ij"), axis=-1)
    places = np.transpose(index * volume.spacing @ volume.direction.T, (2, 1, 0, 3))[..., :2]
    values = volume.values[..., :2].astype(np.float64)
    for positions in (places, -places):
        apart = (values - positions).reshape(-1, 2).std(axis=0).max()
        if apart < _POSITIONS * positions.reshape(-1, 2).std(axis=0).max():
            raise InputError(f"{path} holds positions, not displacements; subtract from each voxel its place in LPS mm")
