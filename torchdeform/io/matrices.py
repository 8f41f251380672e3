"""Linear maps as text: a bare matrix, as greedy, c3d and ITK-SNAP write it, and FreeSurfer's LTA."""

import re
from pathlib import Path

import numpy as np

from torchdeform.errors import InputError
from torchdeform.io.gate import DAMAGED, read_text
from torchdeform.io.maps import Linear, Numbers

_LONGEST = 4096  # bytes of a bare matrix
_BARE = re.compile(rb"(?:[ \t]*#[^\n]*\n)*[\s\d.eE+-]+")
_LTA = re.compile(rb"(?m)^type\s*=\s*\d+")
_BETWEEN_VOXELS, _BETWEEN_WORLDS = 0, 1  # types of LTA
_GAP = re.compile(r"[^\n]*\S  ")  # how FSL ends the rows of a matrix


def is_matrix(head: bytes) -> bool:
    """Return whether a file that starts like this is a bare matrix or an LTA."""
    return _LTA.search(head) is not None or (len(head) < _LONGEST and _BARE.fullmatch(head) is not None)


def read(path: Path) -> list[Linear]:
    """Return the map of a bare matrix or an LTA, which takes fixed to moving points in LPS mm.

    Raises:
        InputError: no affine matrix, a matrix of FSL, or an LTA that does not say where its volumes are.

    Notes:
        A bare matrix takes fixed to moving points in RAS mm. FSL's takes voxels in mm to such voxels and needs both
        images. An LTA takes moving (src) to fixed (dst) points.
    """
    text = read_text(path, "transform file")
    try:
        ras = _of_lta(path, text) if _LTA.search(text.encode()) else _of_rows(path, text)
    except (ValueError, KeyError, IndexError, np.linalg.LinAlgError) as error:
        raise InputError(f"{path} {DAMAGED}") from error
    flip = np.ones(len(ras))
    flip[:2] = -1
    lps = flip[:, None] * ras * flip
    return [Linear(lps[:-1, :-1], lps[:-1, -1])]


def _of_rows(path: Path, text: str) -> Numbers:
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    matrix = _square(path, [line.split() for line in lines])
    if all(map(_GAP.fullmatch, lines)):
        raise InputError(
            f"{path} is a matrix of FSL, which needs both images; convert it with `c3d_affine_tool -ref fixed.nii.gz "
            f"-src moving.nii.gz {path.name} -fsl2ras -oitk transform.txt`"
        )
    return matrix


def _square(path: Path, rows: list[list[str]]) -> Numbers:
    """Return an affine matrix ``(D + 1, D + 1)``."""
    sizes = {len(rows), *map(len, rows)}
    matrix = np.array(rows, dtype=np.float64) if sizes in ({3}, {4}) else np.zeros((1, 1))
    if not np.isfinite(matrix).all() or not np.allclose(matrix[-1], np.eye(len(matrix))[-1], atol=1e-6):
        raise InputError(f"{path} is no affine matrix of 3 × 3 or 4 × 4 numbers with the last row 0 .. 0 1; correct it")
    return matrix


def _of_lta(path: Path, text: str) -> Numbers:
    """Return the matrix from fixed to moving points in RAS mm."""
    kind, count = (int(re.findall(rf"(?m)^{name}\s*=\s*(\d+)", text)[0]) for name in ("type", "nxforms"))
    if kind not in (_BETWEEN_VOXELS, _BETWEEN_WORLDS) or count != 1:
        raise InputError(
            f"{path} is an LTA of another type than between voxels or scanner positions; convert it with "
            f"`lta_convert --inlta {path.name} --outitk transform.txt`"
        )
    rows = text.split("1 4 4", 1)[1].strip().splitlines()[:4]
    matrix = _square(path, [row.split() for row in rows])
    if kind == _BETWEEN_VOXELS:
        moving, fixed = (_place(path, text, name) for name in ("src", "dst"))
        matrix = fixed @ matrix @ np.linalg.inv(moving)
    return np.linalg.inv(matrix)


def _place(path: Path, text: str, name: str) -> Numbers:
    """Return the matrix from voxels of a volume to RAS mm."""
    found = re.search(rf"(?s)^{name} volume info$(.*?)(?=^(?:src|dst) volume info$|\Z)", text, re.MULTILINE)
    values = dict(re.findall(r"(?m)^(\w+)\s*=\s*([^#\n]*)", found[1] if found else ""))
    if values.get("valid", "0").strip() != "1":
        raise InputError(
            f"{path} does not say where its {name} volume is; convert it with `lta_convert --inlta {path.name} "
            "--src moving.nii.gz --trg fixed.nii.gz --outitk transform.txt`"
        )
    axes = np.array([values[key].split() for key in ("xras", "yras", "zras")], dtype=np.float64).T
    size, voxel, centre = (np.array(values[key].split(), dtype=np.float64) for key in ("volume", "voxelsize", "cras"))
    place = np.eye(4)
    place[:3, :3] = axes * voxel
    place[:3, 3] = centre - place[:3, :3] @ (size / 2)
    return place
