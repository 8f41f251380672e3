"""Bare matrices in RAS and FreeSurfer's LTA, in either form, are maps in LPS from fixed to moving."""

import numpy as np
import pytest
import torch

from torchdeform.errors import InputError
from torchdeform.io.transforms import read_transform

RAS = np.array([[0.98, -0.2, 0.03, -3.0], [0.19, 0.97, 0.1, 2.0], [-0.05, -0.1, 1.01, 1.0], [0, 0, 0, 1]])
FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])
POINTS = np.random.default_rng(0).uniform(-80, 80, (20, 3))


def moved(matrix: np.ndarray) -> np.ndarray:
    """Return where a matrix of RAS takes points that are in LPS."""
    return (np.c_[POINTS, np.ones(len(POINTS))] @ FLIP @ matrix.T @ FLIP)[:, :3]


def agree(path, matrix) -> None:
    found = read_transform(path).points(torch.from_numpy(POINTS)).numpy()
    np.testing.assert_allclose(found, moved(matrix), atol=1e-9)


@pytest.mark.parametrize("form", ["%.18e", "%.15g"])
@pytest.mark.parametrize("name", ["greedy.mat", "affine.txt", "affine", "a.tfm"])
@pytest.mark.parametrize("title", ["", "a title"])
def test_a_bare_matrix_is_in_ras(tmp_path, name, form, title):
    np.savetxt(tmp_path / name, RAS, fmt=form, header=title)
    agree(tmp_path / name, RAS)


def test_a_matrix_of_2d(tmp_path):
    np.savetxt(tmp_path / "a.mat", [[0.8, -0.6, 5], [0.6, 0.8, 7], [0, 0, 1]])
    found = read_transform(tmp_path / "a.mat").points(torch.tensor([[1.0, 2.0]], dtype=torch.float64))
    np.testing.assert_allclose(found, [[0.8 - 1.2 - 5, 0.6 + 1.6 - 7]])


def test_a_matrix_of_fsl_leads_to_the_command(tmp_path):
    """FSL ends each row with two blanks; its numbers mean nothing without both images."""
    (tmp_path / "flirt.mat").write_text("".join("  ".join(map(str, row)) + "  \n" for row in RAS), encoding="ascii")
    with pytest.raises(InputError, match=r"matrix of FSL.*c3d_affine_tool .* flirt\.mat -fsl2ras -oitk"):
        read_transform(tmp_path / "flirt.mat")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n", "no affine matrix"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n1 0 0 1\n", "with the last row 0 .. 0 1"),
        ("1 0 0\n0 1 0\n", "no affine matrix"),
        ("1 0\n0 1\n", "no affine matrix"),
        ("1 0 0 1e999\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "no affine matrix"),
        ("1 0 0 1-e\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "damaged"),
        ("0 0 0 0\n0 0 0 0\n0 0 0 0\n0 0 0 1\n", "singular"),
    ],
)
def test_numbers_that_are_no_matrix(tmp_path, text, message):
    (tmp_path / "a.mat").write_text(text, encoding="ascii")
    with pytest.raises(InputError, match=message):
        read_transform(tmp_path / "a.mat")


def place(size, voxel, centre, turn=0.0) -> tuple[np.ndarray, str]:
    """Return a volume's matrix from voxels to RAS, and what an LTA says of it."""
    axes = np.array([[-1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    axes = axes @ [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    matrix = np.eye(4)
    matrix[:3, :3] = axes * voxel
    matrix[:3, 3] = centre - matrix[:3, :3] @ (np.array(size) / 2)
    lines = {"valid": "1  # volume info valid", "filename": "a.mgz", "volume": size, "voxelsize": voxel}
    lines |= {"xras": axes[:, 0], "yras": axes[:, 1], "zras": axes[:, 2], "cras": centre}
    texts = (f"{k} = {v if isinstance(v, str) else ' '.join(repr(float(x)) for x in v)}" for k, v in lines.items())
    return matrix, "\n".join(texts)


SRC, SRC_TEXT = place((256, 256, 180), (1.0, 1.0, 1.2), np.array([3.0, -20.0, 15.0]))
DST, DST_TEXT = place((200, 220, 240), (0.9, 0.8, 1.0), np.array([-2.0, 10.0, 5.0]), turn=0.3)


def lta(kind: int, matrix: np.ndarray, count: int = 1, source: str = SRC_TEXT) -> str:
    rows = "\n".join(" ".join(repr(float(x)) for x in row) for row in matrix)
    start = (
        f"# transform file a.lta\n# created by x\n\ntype      = {kind} # LINEAR\nnxforms   = {count}\nmean = 0 0 0\n"
    )
    end = f"src volume info\n{source}\ndst volume info\n{DST_TEXT}\nsubject x\nfscale 0.1\n"
    return f"{start}sigma     = 1.0\n1 4 4\n{rows}\n{end}"


@pytest.mark.parametrize("kind", [0, 1])
def test_an_lta_takes_moving_to_fixed(tmp_path, kind):
    """Between scanner positions, or between voxels of volumes whose place it says."""
    matrix = RAS if kind == 1 else np.linalg.inv(DST) @ RAS @ SRC
    (tmp_path / "a.lta").write_text(lta(kind, matrix), encoding="ascii")
    agree(tmp_path / "a.lta", np.linalg.inv(RAS))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (lta(14, RAS), "of another type.*lta_convert --inlta a.lta --outitk"),
        (lta(1, RAS, count=2), "of another type"),
        (lta(0, RAS, source="valid = 0"), "does not say where its src volume is; convert it with `lta_convert"),
        (lta(0, RAS).replace("cras", "craz"), "is damaged"),
        (lta(1, RAS).split("0.97")[0], "no affine matrix|damaged"),
        (lta(1, RAS).replace("1 4 4", ""), "is damaged"),
    ],
)
def test_an_lta_that_cannot_be_read(tmp_path, text, message):
    (tmp_path / "a.lta").write_text(text, encoding="ascii")
    with pytest.raises(InputError, match=message) as error:
        read_transform(tmp_path / "a.lta")
    assert "\n" not in str(error.value)
