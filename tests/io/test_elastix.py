"""Parameter files of elastix move points as the transforms of ITK that they stand for; elastix itself agreed."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchdeform.core.transform import Affine, Displacement
from torchdeform.errors import InputError
from torchdeform.io.transforms import read_transform

CENTRE = (3.0, -2.0, 5.0)
TURNED = {2: np.array([[0.8, -0.6], [0.6, 0.8]]), 3: np.linalg.qr(np.arange(9.0).reshape(3, 3) + np.eye(3))[0]}


def write(path: Path, kind: str, parameters, dim: int, **more) -> Path:
    values = {
        "Transform": kind, "NumberOfParameters": len(parameters),
        "TransformParameters": [repr(float(value)) for value in parameters],
        "InitialTransformParametersFileName": "NoInitialTransform", "HowToCombineTransforms": "Compose",
        "FixedImageDimension": dim, "MovingImageDimension": dim, "Size": [8] * dim, "Index": [0] * dim,
        "Spacing": [1.5] * dim, "Origin": [-6] * dim, "Direction": list(map(repr, TURNED[dim].T.ravel().tolist())),
        "UseDirectionCosines": "true", "CenterOfRotationPoint": CENTRE[:dim],
    } | more  # fmt: skip
    lines = ["// elastix", ""]
    for key, value in values.items():
        items = value if isinstance(value, list | tuple) else [value]
        if value is not None:
            texts = [f'"{v}"' if isinstance(v, str) and not v[-1].isdigit() else str(v) for v in items]
            lines.append(f"({key} {' '.join(texts)})")
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def agree(path: Path, itk: sitk.Transform, atol: float = 1e-9) -> None:
    dim = itk.GetDimension()
    points = np.random.default_rng(0).uniform(-9, 9, (100, dim))
    expected = [itk.TransformPoint(point) for point in points.tolist()]
    np.testing.assert_allclose(read_transform(path).points(torch.from_numpy(points)).numpy(), expected, atol=atol)


def linear(kind: str, dim: int) -> tuple[list[float], sitk.Transform]:
    centre, matrix = CENTRE[:dim], np.eye(dim) + 0.1 * np.arange(dim * dim).reshape(dim, dim) % 0.3
    match kind, dim:
        case "TranslationTransform", _:
            return [1, 2, 3][:dim], sitk.TranslationTransform(dim, (1, 2, 3)[:dim])
        case "AffineTransform", _:
            shift = (1, 2, 3)[:dim]
            return [*matrix.ravel(), *shift], sitk.AffineTransform(matrix.ravel().tolist(), shift, centre)
        case "EulerTransform", 2:
            return [0.3, 1, 2], sitk.Euler2DTransform(centre, 0.3, (1, 2))
        case "EulerTransform", _:
            return [0.1, -0.2, 0.3, 1, 2, 3], sitk.Euler3DTransform(centre, 0.1, -0.2, 0.3, (1, 2, 3))
        case _, 2:
            return [1.2, 0.3, 1, 2], sitk.Similarity2DTransform(1.2, 0.3, (1, 2), centre)
    similar = sitk.Similarity3DTransform(1.1, (0.0, 0.6, 0.8), 0.4, (1, 2, 3), centre)
    return list(similar.GetParameters()), similar


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["TranslationTransform", "AffineTransform", "EulerTransform", "SimilarityTransform"])
def test_linear_transforms(tmp_path, kind, dim):
    parameters, itk = linear(kind, dim)
    agree(write(tmp_path / "TransformParameters.0.txt", kind, parameters, dim), itk)


def test_the_other_order_of_angles(tmp_path):
    parameters, itk = linear("EulerTransform", 3)
    itk.SetComputeZYX(True)
    agree(write(tmp_path / "T.txt", "EulerTransform", parameters, 3, ComputeZYX="true"), itk)


def test_a_matrix_by_its_logarithm(tmp_path):
    shear = [0.0, 0.25, 0.0, 0.0]  # exp is I + shear
    itk = sitk.AffineTransform((1, 0.25, 0, 1), (1, 2), CENTRE[:2])
    agree(write(tmp_path / "T.txt", "AffineLogTransform", [*shear, 1, 2], 2), itk)


def test_a_centre_that_is_an_index(tmp_path):
    """As files of old versions have it."""
    index = np.array([2.0, 3.0])
    itk = sitk.Euler2DTransform((np.full(2, -6) + TURNED[2] @ (1.5 * index)).tolist(), 0.3, (1, 2))
    more = {"CenterOfRotationPoint": None, "CenterOfRotation": [2, 3]}
    agree(write(tmp_path / "T.txt", "EulerTransform", [0.3, 1, 2], 2, **more), itk)


def spline(path: Path, dim: int, order: int = 3, **more) -> sitk.Transform:
    """Write a spline on a turned grid and return ITK's."""
    size, vectors = 7, np.random.default_rng(2).normal(size=(dim, 7**dim))
    origin = TURNED[dim] @ np.full(dim, -12.0)
    grid = {"GridSize": [size] * dim, "GridIndex": [0] * dim, "GridSpacing": [4] * dim, "GridOrigin": origin.tolist(),
            "GridDirection": list(map(repr, TURNED[dim].T.ravel().tolist())), "BSplineTransformSplineOrder": order,
            "UseCyclicTransform": "false"}  # fmt: skip
    write(path, "BSplineTransform", vectors.ravel(), dim, **(grid | more))
    images = [sitk.GetImageFromArray(part.reshape((size,) * dim)) for part in vectors]
    for image in images:
        image.SetOrigin(origin.tolist())
        image.SetSpacing([4.0] * dim)
        image.SetDirection(TURNED[dim].ravel().tolist())
    return sitk.BSplineTransform(images, order)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("dim", [2, 3])
def test_splines(tmp_path, dim, order):
    agree(tmp_path / "T.txt", spline(tmp_path / "T.txt", dim, order), atol=0.02)


@pytest.mark.parametrize("key", ["InitialTransformParametersFileName", "InitialTransformParameterFileName"])
@pytest.mark.parametrize("name", ["T.0.txt", "./T.0.txt", "/else/where/T.0.txt", "C:\\scans\\T.0.txt", "../T.0.txt"])
def test_a_chain_is_where_its_last_file_is(tmp_path, name, key):
    """elastix writes where it was; the folder may have moved since, and nothing outside of it is read."""
    parameters, euler = linear("EulerTransform", 2)
    (tmp_path / "here").mkdir()
    write(tmp_path / "here" / "T.0.txt", "EulerTransform", parameters, 2)
    write(tmp_path / "T.0.txt", "TranslationTransform", [50, 50], 2)
    own = spline(tmp_path / "here" / "T.1.txt", 2, **({"InitialTransformParametersFileName": None} | {key: name}))
    agree(tmp_path / "here" / "T.1.txt", sitk.CompositeTransform([own, euler]), atol=0.02)
    stages = read_transform(tmp_path / "here" / "T.1.txt").stages
    assert [type(stage) for stage in stages] == [Affine, Displacement]


@pytest.mark.parametrize("second", ["spline", "affine"])
def test_a_sum_of_transforms(tmp_path, second):
    parameters, first = linear("EulerTransform", 2)
    write(tmp_path / "a.txt", "EulerTransform", parameters, 2)
    more = {"InitialTransformParametersFileName": "a.txt", "HowToCombineTransforms": "Add"}
    if second == "spline":
        own = spline(tmp_path / "b.txt", 2, **more)
    else:
        values, own = linear("AffineTransform", 2)
        write(tmp_path / "b.txt", "AffineTransform", values, 2, **more)
    points = np.random.default_rng(0).uniform(-9, 9, (100, 2))
    expected = [np.add(first.TransformPoint(p), own.TransformPoint(p)) - p for p in points.tolist()]
    found = read_transform(tmp_path / "b.txt").points(torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"Transform": "SplineKernelTransform"}, "holds a SplineKernelTransform of elastix.*transformix -def all -tp"),
        ({"UseCyclicTransform": "true"}, "which cannot be read here"),
        ({"UseDirectionCosines": "false"}, "leaves out the direction"),
        ({"FixedImageDimension": 4}, "is a transform of 4D"),
        ({"MovingImageDimension": 3}, "give one of 2D or 3D"),
        ({"NumberOfParameters": 4}, "lacks values of its transform, or has some that do not fit"),
        ({"TransformParameters": [0.1, 1, "x"]}, "lacks values"),
        ({"TransformParameters": [0.1, 1, "nan0"]}, "lacks values"),
        ({"TransformParameters": [0.1, 1, "1e999"]}, "lacks values"),
        ({"CenterOfRotationPoint": None}, "lacks values"),
        ({"InitialTransformParametersFileName": "absent.txt"}, r"absent\.txt does not exist"),
        ({"InitialTransformParametersFileName": "T.txt"}, "builds on itself"),
        ({"InitialTransformParametersFileName": ".."}, "is a folder|does not exist"),
        ({"InitialTransformParametersFileName": "a.txt", "HowToCombineTransforms": "Mix"}, "by 'Mix'"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_leads_on(tmp_path, more, message):
    write(tmp_path / "a.txt", "TranslationTransform", [1, 2], 2)
    write(tmp_path / "T.txt", "EulerTransform", [0.3, 1, 2], 2, **more)
    with pytest.raises(InputError, match=message) as error:
        read_transform(tmp_path / "T.txt")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("more", [{"GridSize": [10**9, 10**9]}, {"GridSpacing": ["x", 1]}, {"GridIndex": None}])
def test_grids_that_do_not_fit(tmp_path, more):
    spline(tmp_path / "T.txt", 2, **more)
    with pytest.raises(InputError, match="lacks values of its transform"):
        read_transform(tmp_path / "T.txt")


@pytest.mark.parametrize("content", ['(Transform "Euler\nhello', "(Transform)", "(A 1)\n(", "(A 1)"])
def test_texts_that_are_no_parameters(tmp_path, content):
    (tmp_path / "T.txt").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=r"T\.txt (has the line|lacks values|cannot be read)"):
        read_transform(tmp_path / "T.txt")
