"""The benchmark against other tools: its judgement against SimpleITK and plain numpy, its runs, its table."""

import json
from argparse import Namespace
from dataclasses import asdict, replace
from itertools import product

import numpy as np
import peers
import pytest
import SimpleITK as sitk
import torch
from judge import folds, landmarks, nearest, quality, to_array
from pairs import Pair
from peer_tools import TOOLS, Job, by_displacement

import torchdeform as td
from torchdeform.io.images import read_labels

SHAPES = [(23, 31), (11, 14, 17)]


def rotation(dim: int) -> np.ndarray:
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(dim, dim)))[0]
    return turn * np.sign(np.linalg.det(turn))


def placed(array: np.ndarray, seed: int) -> sitk.Image:
    """An image in a place of its own: origin, spacing and direction are unlike those of any other seed."""
    image, rng = sitk.GetImageFromArray(array), np.random.default_rng(seed)
    dim = array.ndim
    image.SetOrigin(rng.uniform(-9, 9, dim).tolist())
    image.SetSpacing(rng.uniform(0.6, 1.8, dim).tolist())
    image.SetDirection(np.linalg.matrix_power(rotation(dim), seed % 3).ravel().tolist())
    return image


def blobs(shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Labels 0 to 4 in patches."""
    coarse = np.random.default_rng(seed).integers(0, 5, [n // 4 + 1 for n in shape])
    for axis, n in enumerate(shape):
        coarse = coarse.repeat(4, axis).take(range(n), axis)
    return coarse.astype(np.uint8)


def onto(fixed: sitk.Image, moving: sitk.Image) -> sitk.AffineTransform:
    """An affine map that takes the middle of one image near that of the other, so that part of it lies outside."""
    dim, rng = fixed.GetDimension(), np.random.default_rng(8)
    middles = [i.TransformContinuousIndexToPhysicalPoint([n / 2 for n in i.GetSize()]) for i in (fixed, moving)]
    matrix = np.eye(dim) + 0.1 * rng.normal(size=(dim, dim))
    shift = np.array(middles[1]) - middles[0] + rng.normal(size=dim)
    return sitk.AffineTransform(matrix.ravel().tolist(), shift.tolist(), middles[0])


def moved(fixed: sitk.Image, transform: sitk.Transform) -> np.ndarray:
    """Where each voxel goes, point by point."""
    positions = np.empty((*fixed.GetSize()[::-1], fixed.GetDimension()))
    for index in np.ndindex(positions.shape[:-1]):
        positions[index] = transform.TransformPoint(fixed.TransformIndexToPhysicalPoint(index[::-1]))
    return positions


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_labels_are_carried_and_compared_as_simpleitk_does(shape, tmp_path):
    fixed, moving = placed(blobs(shape, 1), 1), placed(blobs(tuple(n + 3 for n in shape), 2), 2)
    transform = onto(fixed, moving)
    files = [tmp_path / f"{name}.mha" for name in ("fixed", "moving")]
    for image, file in zip((fixed, moving), files, strict=True):
        sitk.WriteImage(image, str(file))
    carried = sitk.Resample(moving, fixed, transform, sitk.sitkNearestNeighbor, 0)
    measures = sitk.LabelOverlapMeasuresImageFilter()
    measures.Execute(fixed, carried)
    expected = [measures.GetDiceCoefficient(label) for label in range(1, 5)]
    positions = moved(fixed, transform)
    np.testing.assert_array_equal(nearest(read_labels(files[1]), positions), sitk.GetArrayFromImage(carried))
    pair = Pair("one", *files, *files)
    found = quality(pair, td.read_image(files[0]), positions)
    assert found["dice"] == pytest.approx(np.mean(expected))
    measures.Execute(fixed > 0, carried > 0)
    assert found["union"] == pytest.approx(measures.GetDiceCoefficient(1))
    some = quality(replace(pair, counted=(2, 3)), td.read_image(files[0]), positions)
    assert some == pytest.approx({"dice": np.mean(expected[1:3]), "union": found["union"]})
    assert 0.05 < np.mean(expected) < 0.95


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_landmarks_go_where_the_map_takes_them(shape, tmp_path):
    fixed, moving = placed(blobs(shape, 1), 1), placed(blobs(shape, 2), 2)
    transform, rng, dim = onto(fixed, moving), np.random.default_rng(3), len(shape)
    points = [
        fixed.TransformContinuousIndexToPhysicalPoint((rng.uniform(size=dim) * (np.array(shape[::-1]) - 1)).tolist())
        for _ in range(9)
    ]
    partners = [np.array(transform.TransformPoint(p)) + rng.normal(size=dim) for p in points]
    files = [tmp_path / f"{name}.txt" for name in ("fixed", "moving")]
    for rows, file in zip((points, partners), files, strict=True):
        file.write_text("\n".join(["point", "9", *(" ".join(map(repr, map(float, row))) for row in rows)]) + "\n")
    errors = [np.linalg.norm(np.array(transform.TransformPoint(p)) - q) for p, q in zip(points, partners, strict=True)]
    sitk.WriteImage(fixed, str(tmp_path / "fixed.mha"))
    found = landmarks((files[0], files[1]), td.read_image(tmp_path / "fixed.mha"), moved(fixed, transform))
    assert found["landmark_mean"] == pytest.approx(np.mean(errors))
    assert found["landmark_median"] == pytest.approx(np.median(errors))


def smallest_simplices(u: np.ndarray) -> np.ndarray:
    """Smallest signed volume of the moved simplices at every node; u ``(D, *S)`` in voxels goes on as at the border."""
    dim, shape = u.shape[0], u.shape[1:]
    wide = np.pad(u, [(0, 0), *[(1, 1)] * dim], mode="edge")

    def edge(step: np.ndarray) -> np.ndarray:
        window = tuple(slice(1 + s, 1 + s + n) for s, n in zip(step, shape, strict=True))
        return wide[(slice(None), *window)] - u + step.reshape(-1, *[1] * dim)

    unit = np.eye(dim, dtype=int)
    frames = [[sign * e for sign, e in zip(signs, unit, strict=True)] for signs in product((1, -1), repeat=dim)]
    if dim == 3:
        faces = [np.array(f) for f in ((1, 1, 0), (0, 1, 1), (1, 0, 1))]
        frames += [[sign * f for f in faces] for sign in (1, -1)]
    volumes = []
    for frame in frames:
        moved_frame = np.stack([edge(step) for step in frame], axis=0)
        volumes.append(np.linalg.det(np.moveaxis(moved_frame, (0, 1), (-2, -1))) / np.linalg.det(np.array(frame)))
    return np.min(volumes, axis=0)


def central(u: np.ndarray, order: int) -> np.ndarray:
    """det ∇(id + u) by central differences."""
    dim = u.shape[0]
    slopes = [np.stack(np.gradient(u[k], edge_order=order)) for k in range(dim)]
    matrix = np.stack(slopes) + np.eye(dim).reshape(dim, dim, *[1] * dim)
    return np.linalg.det(np.moveaxis(matrix, (0, 1), (-2, -1)))


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_folds_are_those_of_a_computation_by_hand(shape, tmp_path):
    dim = len(shape)
    fixed = placed(np.zeros(shape, np.float32), 4)
    u = 0.6 * np.random.default_rng(6).normal(size=(dim, *shape))
    steps = (u[::-1] * np.array(fixed.GetSpacing()).reshape(-1, *[1] * dim)).reshape(dim, -1)
    turned = np.array(fixed.GetDirection()).reshape(dim, dim) @ steps
    still = moved(fixed, sitk.Transform(dim, sitk.sitkIdentity))
    sitk.WriteImage(fixed, str(tmp_path / "fixed.mha"))
    found = folds(td.read_image(tmp_path / "fixed.mha"), still + turned.T.reshape(*shape, dim))
    inner = (slice(None), *[slice(1, -1)] * dim)
    wide = np.pad(u, [(0, 0), *[(1, 1)] * dim], mode="edge")
    assert found["folds"] == (smallest_simplices(u) <= 0).sum() > 0
    assert found["central_folds"] == (central(wide, 1)[inner[1:]] <= 0).sum() > 0
    assert found["log_det_std"] == pytest.approx(np.log(central(u, 2).clip(1e-9)).std(ddof=1), rel=1e-6)


def test_a_displacement_is_added_to_where_the_voxels_are(tmp_path):
    image = placed(np.zeros((5, 6), np.float32), 1)
    sitk.WriteImage(image, str(tmp_path / "fixed.nii"))
    job = Job(tmp_path / "fixed.nii", tmp_path / "fixed.nii", tmp_path)
    frame = job.frame()
    still = moved(frame, sitk.Transform(2, sitk.sitkIdentity))
    np.testing.assert_allclose(by_displacement(job), still)
    np.testing.assert_allclose(by_displacement(job, np.ones_like(still)), still + 1)


@pytest.fixture
def pair(tmp_path) -> Pair:
    """Two images, the second shifted by two voxels, and their labels."""
    files = {}
    for shift, name in ((0, "fixed"), (2, "moving")):
        for what in ("", "_labels"):
            files[name + what] = tmp_path / f"{name}{what}.mha"
            sitk.WriteImage(sitk.GetImageFromArray(np.roll(blobs((40, 48), 1), shift, 1)), str(files[name + what]))
    return Pair("one", **files)


@pytest.fixture
def options(tmp_path, monkeypatch, pair) -> Namespace:
    monkeypatch.setitem(peers.SETS, "synthetic", lambda _: [pair])
    how = {"data": tmp_path, "sets": ["synthetic"], "pairs": None, "device": "cpu", "threads": 1, "limit": 120.0}
    return Namespace(tools=["unregistered", "torchdeform_fast", "missing"], **how)


def test_a_run_is_a_row_a_failure_too_and_nothing_runs_twice(options, tmp_path, monkeypatch):
    monkeypatch.setitem(peers.TOOLS, "missing", replace(TOOLS["unregistered"], package="none"))
    file = tmp_path / "runs.json"
    peers.run_all(options, peers.Book(file))  # a fresh process knows no tool of that name
    still, ours, missing = json.loads(file.read_text(encoding="utf-8"))
    assert still["folds"] == 0
    assert ours["folds"] == 0
    assert ours["dice"] > still["dice"] > 0
    assert ours["seconds"] > 0 < ours["startup"]
    assert "KeyError" in missing["failed"]
    monkeypatch.setattr(peers, "run_apart", lambda *_: pytest.fail("it was run again"))
    book = peers.Book(file)
    peers.run_all(options, book)
    lines = peers.table(book.rows).splitlines()
    assert len(lines) == 2 + 3
    assert "KeyError" in lines[-1]
    assert all(name in peers.circumstances(book.rows) for name in options.tools)


def test_a_shift_of_the_moving_file_is_taken_off_again(pair, tmp_path, monkeypatch):
    """Nothing moves: where voxels go in the file that is shifted, less the shift, is where they are."""
    monkeypatch.setattr(peers, "limit_threads", lambda _: None)
    job = peers.prepare(pair, tmp_path, shift=(0.3, -0.2))
    here, there = td.read_image(pair.moving), td.read_image(job.moving)
    assert there.origin == pytest.approx([x + d for x, d in zip(here.origin, (0.3, -0.2), strict=True)])
    monkeypatch.setitem(peers.TOOLS, "follows", replace(TOOLS["unregistered"], register=_follow))
    order = {"tool": "follows", "pair": asdict(pair), "job": asdict(job), "started": 0.0, "shift": [0.3, -0.2]}
    still = quality(pair, here, to_array(here.to_world(here.grid.points(dtype=torch.float64))))
    found = peers.run_here(json.loads(json.dumps(order, default=str)))
    assert {key: found[key] for key in still} == still


def _follow(job: Job):
    by = np.array(td.read_image(job.moving).origin) - td.read_image(job.fixed).origin
    return lambda: by_displacement(job) + by


def test_what_is_not_installed_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(peers, "limit_threads", lambda _: None)  # this process is needed as it is
    monkeypatch.setitem(peers.TOOLS, "absent", replace(TOOLS["unregistered"], imports=("no_such_module",)))
    job = {"fixed": "fixed.nii", "moving": "moving.nii", "folder": str(tmp_path)}
    found = peers.run_here({"tool": "absent", "job": job, "pair": {"name": "one"}, "started": 0.0})
    assert found == {"failed": "not installed: No module named 'no_such_module'"}
