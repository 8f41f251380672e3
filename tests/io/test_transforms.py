"""The proof that others reproduce our images: SimpleITK and ANTs with the files we write, and we with theirs."""

import re
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk
import torch
from broken_files import SHAPE, bytes_of, save, volume

from torchdeform.core.image import resample
from torchdeform.core.transform import Affine, Displacement, Transform
from torchdeform.core.warp import compose, invert, max_voxels
from torchdeform.errors import InputError
from torchdeform.io import read_displacement, read_image, write_displacement, write_image, write_transform
from torchdeform.io.transforms import read_transform

SHAPES = {2: ((40, 52), (45, 38)), 3: ((18, 22, 26), (20, 17, 24))}


SPACINGS = {2: ((1.3, 0.7), (0.9, 1.1)), 3: ((2.2, 0.7, 1.1), (1.4, 1.3, 1.2))}


ORIGINS = {2: ((-8.0, 120.0), (-12.0, 117.0)), 3: ((-8.0, 120.0, 33.0), (-11.0, 117.0, 32.0))}


def _pair(make_image, dim, tilted, channels=1):
    fixed, moving = (
        make_image(shape, spacing, origin=origin, tilted=turn, channels=count)
        for shape, spacing, origin, turn, count in zip(
            SHAPES[dim], SPACINGS[dim], ORIGINS[dim], (tilted, False), (1, channels), strict=True
        )
    )
    return fixed, moving


def _resample(folder, fixed, moving, transform):
    write_image(fixed, folder / "fixed.nii.gz")
    write_image(moving, folder / "moving.nii.gz")
    like, image = (sitk.ReadImage(str(folder / f"{name}.nii.gz")) for name in ("fixed", "moving"))
    values = sitk.GetArrayFromImage(sitk.Resample(image, like, transform, sitk.sitkLinear, 0.0))
    return torch.from_numpy(values)


def _agree(ours, theirs):
    """Equal to 1e-3 of the intensity range, at every voxel."""
    assert (ours - theirs).abs().max() < 1e-3 * 200
    assert (ours == 0).any()  # some of the fixed grid looks past the moving image, as it often does
    assert (ours > 0).double().mean() > 0.3


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_displacement_file_gives_the_same_image_in_itk(tmp_path, make_image, make_displacement, dim, tilted):
    fixed, moving = _pair(make_image, dim, tilted)
    u = make_displacement(fixed.grid, 0.08)
    write_displacement(u, fixed, tmp_path / "displacement.nii.gz")
    field = sitk.ReadImage(str(tmp_path / "displacement.nii.gz"), sitk.sitkVectorFloat64)
    theirs = _resample(tmp_path, fixed, moving, sitk.DisplacementFieldTransform(field))
    _agree(resample(moving, fixed, u)[0, 0], theirs)


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_transform_file_gives_the_same_image_in_itk(tmp_path, make_image, make_displacement, dim, tilted):
    fixed, moving = _pair(make_image, dim, tilted)
    u = make_displacement(fixed.grid, 0.08)
    write_transform(u, fixed, tmp_path / "transform.h5")
    transform = sitk.ReadTransform(str(tmp_path / "transform.h5"))
    assert (transform.GetName(), transform.GetDimension()) == ("CompositeTransform", dim)
    _agree(resample(moving, fixed, u)[0, 0], _resample(tmp_path, fixed, moving, transform))


def test_colour_is_resampled_alike(tmp_path, make_image, make_displacement):
    fixed, moving = _pair(make_image, 2, True, channels=3)
    u = make_displacement(fixed.grid, 0.08)
    write_transform(u, fixed, tmp_path / "transform.h5")
    theirs = _resample(tmp_path, fixed, moving, sitk.ReadTransform(str(tmp_path / "transform.h5")))
    _agree(resample(moving, fixed, u)[0], theirs.movedim(-1, 0))


@pytest.mark.parametrize("dim", [2, 3])
def test_points_go_from_fixed_to_moving(tmp_path, make_image, make_displacement, dim):
    """A landmark of the fixed image goes to its world position plus the vector; the inverse brings it back."""
    fixed, _ = _pair(make_image, dim, tilted=True)
    u = make_displacement(fixed.grid, 0.05)
    index = (7, 9, 6)[:dim]
    points = fixed.grid.points(dtype=torch.float64)
    start, end = (fixed.to_world(p)[(0, slice(None), *index)].numpy() for p in (points, points + u))
    write_transform(u, fixed, tmp_path / "transform.h5")
    write_transform(invert(u, fixed.grid), fixed, tmp_path / "inverse.h5")
    forward, back = (sitk.ReadTransform(str(tmp_path / name)) for name in ("transform.h5", "inverse.h5"))
    np.testing.assert_allclose(forward.TransformPoint(start.tolist()), end, atol=1e-4)
    np.testing.assert_allclose(back.TransformPoint(end.tolist()), start, atol=0.02)


@pytest.mark.parametrize("ending", [".nii.gz", ".mha", ".nrrd"])
@pytest.mark.parametrize("dim", [2, 3])
def test_displacement_comes_back(tmp_path, make_image, make_displacement, dim, ending):
    fixed, _ = _pair(make_image, dim, tilted=True)
    u = make_displacement(fixed.grid, 0.08)
    write_displacement(u, fixed, tmp_path / f"u{ending}")
    back = read_displacement(tmp_path / f"u{ending}")
    torch.testing.assert_close(back.data, u, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(back.direction, fixed.direction, atol=1e-6)
    np.testing.assert_allclose(back.origin, fixed.origin, rtol=1e-6)


def test_displacement_of_itk_is_read_in_array_order(tmp_path, make_image):
    """ITK's own field of a pure shift along world x is a shift along the last array axis."""
    fixed = make_image((6, 8, 10), (3.0, 2.0, 1.0))
    field = np.zeros((6, 8, 10, 3))
    field[..., 0] = 2.5
    image = sitk.GetImageFromArray(field, isVector=True)
    image.SetSpacing(fixed.grid.spacing[::-1])
    sitk.WriteImage(image, str(tmp_path / "u.mha"))
    u = read_displacement(tmp_path / "u.mha").data
    assert u[0, :, 3, 3, 3].tolist() == [0.0, 0.0, 2.5]


def test_inverse_file_inverts(make_image, make_displacement):
    fixed, _ = _pair(make_image, 3, tilted=True)
    u = make_displacement(fixed.grid, 0.05)
    assert max_voxels(compose(u, invert(u, fixed.grid), fixed.grid), fixed.grid).item() < 1e-3


def test_wrong_fields_are_refused(tmp_path, make_image, make_displacement):
    fixed, _ = _pair(make_image, 2, tilted=False)
    u = make_displacement(fixed.grid)
    with pytest.raises(InputError, match="batch of 2"):
        write_displacement(torch.cat((u, u)), fixed, tmp_path / "u.nii.gz")
    with pytest.raises(InputError, match="must have shape"):
        write_transform(u[:, :, 1:], fixed, tmp_path / "u.h5")
    with pytest.raises(InputError, match=r"use the ending .h5"):
        write_transform(u, fixed, tmp_path / "u.xyz")
    write_image(fixed, tmp_path / "image.mha")
    with pytest.raises(InputError, match="no displacement field"):
        read_displacement(tmp_path / "image.mha")
    (tmp_path / "text.txt").write_text("hello", encoding="utf-8")
    with pytest.raises(InputError, match="no image of a known format"):
        read_displacement(tmp_path / "text.txt")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["image.mha", "text.txt"]


def _affine(dim, centre):
    numbers = torch.randn(dim, dim + 1, dtype=torch.float64, generator=torch.manual_seed(3))
    matrix = torch.eye(dim, dtype=torch.float64) + 0.08 * numbers[:, :-1]
    return Affine(matrix, centre - matrix @ centre + numbers[:, -1])


def _chain(make_image, make_displacement, dim, tilted=True):
    """Points of an oblique fixed grid through a displacement and an affine map to another grid."""
    fixed, moving = _pair(make_image, dim, tilted)
    nodes = fixed.to_world(fixed.grid.points(dtype=torch.float64))
    affine = _affine(dim, nodes.flatten(2)[0].mean(1))
    return Transform.from_displacement(make_displacement(fixed.grid, 0.06), fixed, affine=affine, moving=moving)


def _world(chain, count=200, beyond=0.2):
    """Return world points ``(N, D)`` of the fixed space, some outside its grid."""
    place, dim = chain.fixed, chain.dim
    unit = torch.rand(1, dim, count, dtype=torch.float64, generator=torch.manual_seed(1))
    sides = torch.tensor(place.grid.extent, dtype=torch.float64).view(1, dim, 1)
    return place.to_world((unit * (1 + 2 * beyond) - beyond) * sides)[0].T


def _itk_points(transform, points):
    return torch.tensor([transform.TransformPoint(p) for p in points.tolist()], dtype=torch.float64)


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_chain_file_moves_points_alike_in_itk(tmp_path, make_image, make_displacement, dim, tilted):
    chain = _chain(make_image, make_displacement, dim, tilted)
    points = _world(chain)
    for name, one in (("transform", chain), ("inverse", chain.inverse())):
        write_transform(one, tmp_path / f"{name}.h5")
        itk = sitk.ReadTransform(str(tmp_path / f"{name}.h5"))
        torch.testing.assert_close(one.points(points), _itk_points(itk, points), atol=1e-4, rtol=0)
        back = read_transform(tmp_path / f"{name}.h5")
        assert [type(stage) for stage in back.stages] == [type(stage) for stage in one.stages]
        torch.testing.assert_close(back.points(points), _itk_points(itk, points), atol=1e-9, rtol=0)


INTERPOLATORS = {"linear": sitk.sitkLinear, "nearest": sitk.sitkNearestNeighbor, "cubic": sitk.sitkBSpline}


@pytest.mark.parametrize("mode", INTERPOLATORS)
@pytest.mark.parametrize("dim", [2, 3])
def test_chain_file_gives_the_same_image_in_itk(tmp_path, make_image, make_displacement, dim, mode):
    chain = _chain(make_image, make_displacement, dim)
    fixed, moving = _pair(make_image, dim, True)
    write_transform(chain, tmp_path / "transform.h5")
    for image, name in ((fixed, "fixed"), (moving, "moving")):
        write_image(image, tmp_path / f"{name}.nrrd")
    like, image = (sitk.ReadImage(str(tmp_path / f"{name}.nrrd")) for name in ("fixed", "moving"))
    itk = sitk.ReadTransform(str(tmp_path / "transform.h5"))
    theirs = torch.from_numpy(sitk.GetArrayFromImage(sitk.Resample(image, like, itk, INTERPOLATORS[mode], 0.0)))
    ours = read_transform(tmp_path / "transform.h5").image(moving, mode=mode).data[0, 0]
    differ = (ours - theirs).abs() > 1e-3 * 200
    assert differ.double().mean() <= (1e-3 if mode == "nearest" else 0)  # points on the border of two voxels
    assert (ours > 0).double().mean() > 0.3


@pytest.mark.parametrize("ending", [".nii.gz", ".mha", ".nrrd"])
@pytest.mark.parametrize("dim", [2, 3])
def test_chain_as_one_displacement(tmp_path, make_image, make_displacement, dim, ending):
    chain = _chain(make_image, make_displacement, dim)
    write_transform(chain, tmp_path / f"all{ending}")
    field = sitk.ReadImage(str(tmp_path / f"all{ending}"), sitk.sitkVectorFloat64)
    itk, points = sitk.DisplacementFieldTransform(field), _world(chain, beyond=0.0)
    back = read_transform(tmp_path / f"all{ending}")
    torch.testing.assert_close(back.points(points), _itk_points(itk, points), atol=1e-4, rtol=0)
    torch.testing.assert_close(back.points(points), Transform((chain.flatten(),)).points(points), atol=1e-3, rtol=0)


@pytest.mark.parametrize("ending", [".h5", ".hdf5", ".tfm", ".txt", ".mat"])
@pytest.mark.parametrize("dim", [2, 3])
def test_affine_files(tmp_path, dim, ending):
    """Equal to ITK's to 1e-9, far from the origin too."""
    chain = Transform((_affine(dim, torch.full((dim,), 500.0).double()), _affine(dim, torch.zeros(dim).double())))
    write_transform(chain, tmp_path / f"affine{ending}")
    itk = sitk.ReadTransform(str(tmp_path / f"affine{ending}"))
    points = 1000 * torch.randn(50, dim, dtype=torch.float64, generator=torch.manual_seed(0))
    torch.testing.assert_close(chain.points(points), _itk_points(itk, points), atol=1e-9, rtol=0)
    torch.testing.assert_close(
        read_transform(tmp_path / f"affine{ending}").points(points), chain.points(points), atol=1e-9, rtol=0
    )


CENTRE, TURN = (10.0, -20.0, 30.0), (0.1, -0.2, 0.3)


LINEAR = {
    "identity": lambda dim: sitk.Transform(dim, sitk.sitkIdentity),
    "translation": lambda dim: sitk.TranslationTransform(dim, CENTRE[:dim]),
    "scale": lambda dim: sitk.ScaleTransform(dim, (1.1, 0.9, 1.2)[:dim]),
    "affine": lambda dim: sitk.AffineTransform((1.1 * np.eye(dim) + 0.05).ravel().tolist(), CENTRE[:dim], TURN[:dim]),
    "euler": lambda dim: {2: sitk.Euler2DTransform, 3: lambda c, a, t: sitk.Euler3DTransform(c, *TURN, t)}[dim](
        CENTRE[:dim], 0.3, TURN[:dim]
    ),
    "similarity": lambda dim: {
        2: lambda: sitk.Similarity2DTransform(1.2, 0.3, TURN[:2], CENTRE[:2]),
        3: lambda: sitk.Similarity3DTransform(1.2, (0.0, 0.6, 0.8), 0.4, TURN, CENTRE),
    }[dim](),
    "versor": lambda _: sitk.VersorTransform((0.0, 0.6, 0.8), 0.4, CENTRE),
    "versor rigid": lambda _: sitk.VersorRigid3DTransform((0.0, 0.6, 0.8), 0.4, TURN, CENTRE),
    "scale versor": lambda _: sitk.ScaleVersor3DTransform((1.1, 0.9, 1.2), (0.0, 0.6, 0.8), 0.4, TURN, CENTRE),
}


@pytest.mark.parametrize("ending", [".h5", ".tfm", ".mat"])
@pytest.mark.parametrize(("dim", "kind"), [(3, k) for k in LINEAR] + [(2, k) for k in list(LINEAR)[:6]])
def test_linear_transforms_of_itk_are_read(tmp_path, dim, kind, ending):
    itk, path = LINEAR[kind](dim), tmp_path / f"linear{ending}"
    sitk.WriteTransform(itk, str(path))
    points = 200 * torch.randn(30, dim, dtype=torch.float64, generator=torch.manual_seed(0))
    chain = read_transform(path)
    torch.testing.assert_close(chain.points(points), _itk_points(itk, points), atol=1e-9, rtol=0)
    torch.testing.assert_close(chain.inverse().points(chain.points(points)), points, atol=1e-9, rtol=0)


def test_matrix_offset_transform_as_ants_wrote_it(tmp_path):
    (tmp_path / "Affine.txt").write_text(
        "#Insight Transform File V1.0\n#Transform 0\nTransform: MatrixOffsetTransformBase_double_3_3\n"
        "Parameters: 1.1 0.1 0 0 0.9 0.05 0 0.02 1 1 2 3\nFixedParameters: 10 20 30\n"
    )
    end = read_transform(tmp_path / "Affine.txt").points(torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64))
    torch.testing.assert_close(end, torch.tensor([[-0.7, 4.45, 5.64]], dtype=torch.float64))


def test_long_composites_of_itk(tmp_path, make_image, make_displacement):
    """ITK applies what was added last first."""
    fixed, _ = _pair(make_image, 3, True)
    write_displacement(make_displacement(fixed.grid, 0.05), fixed, tmp_path / "u.mha")
    field = sitk.DisplacementFieldTransform(sitk.ReadImage(str(tmp_path / "u.mha"), sitk.sitkVectorFloat64))
    inner = sitk.CompositeTransform([LINEAR["euler"](3), field])
    outer = sitk.CompositeTransform([LINEAR["translation"](3), inner, LINEAR["similarity"](3)])
    points = _world(Transform((Affine.identity(3),), fixed=fixed))
    expected = _itk_points(outer, points)
    outer.FlattenTransform()  # no file holds composites within composites
    sitk.WriteTransform(outer, str(tmp_path / "outer.h5"))
    chain = read_transform(tmp_path / "outer.h5")
    assert [type(s) for s in chain.stages] == [Affine, Displacement, Affine, Affine]
    torch.testing.assert_close(chain.points(points), expected, atol=1e-9, rtol=0)


def test_the_reference_is_that_of_a_first_field(tmp_path, make_image, make_displacement):
    chain = _chain(make_image, make_displacement, 2)
    write_transform(chain, tmp_path / "t.h5")
    write_transform(chain.inverse(), tmp_path / "i.h5")
    back = read_transform(tmp_path / "t.h5").reference
    assert back.grid.shape == chain.fixed.grid.shape
    np.testing.assert_allclose(back.direction, chain.fixed.direction)
    assert read_transform(tmp_path / "i.h5").reference is None


def test_wrong_transforms_are_refused(tmp_path, make_image, make_displacement):
    chain = _chain(make_image, make_displacement, 2)
    for ending in (".tfm", ".txt", ".mat"):
        with pytest.raises(InputError, match="hold affine maps only"):
            write_transform(chain, tmp_path / f"t{ending}")
    with pytest.raises(InputError, match="no ending"):
        write_transform(chain, tmp_path / "t.xyz")
    with pytest.raises(InputError, match="needs a grid"):
        write_transform(Transform((Affine.identity(3),)), tmp_path / "t.nii.gz")
    with pytest.raises(InputError, match="does not exist"):
        read_transform(tmp_path / "t.h5")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", [".h5", ".tfm", ".txt", ".mat", ".nii.gz", ".mha"])
def test_damaged_transforms_are_refused(tmp_path, capfd, ending):
    path = tmp_path / f"bad{ending}"
    for content in (b"", b"hello", b"#Insight Transform File V1.0\nTransform: Nothing_double_3_3\n", bytes(600)):
        path.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(str(path))) as raised:
            read_transform(path)
        assert "\n" not in str(raised.value)
    assert capfd.readouterr() == ("", "")


def test_half_a_composite_file_is_refused(tmp_path, make_image, make_displacement):
    write_transform(_chain(make_image, make_displacement, 3), tmp_path / "t.h5")
    content = (tmp_path / "t.h5").read_bytes()
    (tmp_path / "half.h5").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="cannot be read"):
        read_transform(tmp_path / "half.h5")


def test_other_transforms_are_refused(tmp_path):
    flat = "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_2_2\n"
    (tmp_path / "flat.tfm").write_text(f"{flat}Parameters: 0 0 0 0 1 2\nFixedParameters: 0 0\n", encoding="utf-8")
    with pytest.raises(InputError, match="singular"):
        read_transform(tmp_path / "flat.tfm")
    one = f"{flat}Parameters: 1 0 0 1 1 2\nFixedParameters: 0 0\n"
    (tmp_path / "two.tfm").write_text(
        one + one.partition("\n")[2].replace("#Transform 0", "#Transform 1"), encoding="utf-8"
    )
    with pytest.raises(InputError, match="several transforms"):
        read_transform(tmp_path / "two.tfm")


@pytest.fixture(scope="module")
def ants():
    return pytest.importorskip("ants", reason="antspyx is not installed")


def _ants_points(ants, dim, points, files, **which):
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(points.numpy(), columns=list("xyz")[:dim])
    moved = ants.apply_transforms_to_points(dim, frame, [str(f) for f in files], **which)
    return torch.tensor(moved[list("xyz")[:dim]].to_numpy(), dtype=torch.float64)


def _ants_image(ants, fixed, moving, files):
    """Return what ANTs makes of two image files, in array order."""
    like, image = (ants.image_read(str(f)) for f in (fixed, moving))
    return torch.from_numpy(ants.apply_transforms(like, image, [str(f) for f in files]).numpy().T.copy())


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize("ending", [".h5", ".nii.gz"])
@pytest.mark.parametrize("dim", [2, 3])
def test_ants_gets_our_image_and_our_points(tmp_path, ants, make_image, make_displacement, dim, ending, tilted):
    chain = _chain(make_image, make_displacement, dim, tilted)
    images = dict(zip(("fixed", "moving"), _pair(make_image, dim, tilted), strict=True))
    for name, image in images.items():
        write_image(image, tmp_path / f"{name}.nii.gz")
    file = tmp_path / f"transform{ending}"
    write_transform(chain, file)
    ours = read_transform(file).image(read_image(tmp_path / "moving.nii.gz"), read_image(tmp_path / "fixed.nii.gz"))
    _agree(ours.data[0, 0], _ants_image(ants, tmp_path / "fixed.nii.gz", tmp_path / "moving.nii.gz", [file]))
    points = _world(chain, beyond=0.0)
    theirs = _ants_points(ants, dim, points, [file])
    torch.testing.assert_close(read_transform(file).points(points), theirs, atol=1e-3, rtol=0)
    if ending == ".h5":
        torch.testing.assert_close(chain.points(points), theirs, atol=1e-3, rtol=0)


@pytest.mark.parametrize("ending", [".mat", ".txt", ".tfm"])
@pytest.mark.parametrize("dim", [2, 3])
def test_ants_reads_our_affine_files(tmp_path, ants, dim, ending):
    chain = Transform((_affine(dim, torch.full((dim,), 30.0).double()),))
    write_transform(chain, tmp_path / f"a{ending}")
    points = 50 * torch.randn(30, dim, dtype=torch.float64, generator=torch.manual_seed(0))
    theirs = _ants_points(ants, dim, points, [tmp_path / f"a{ending}"])
    torch.testing.assert_close(chain.points(points), theirs, atol=1e-4, rtol=0)


PAIRS = {2: ("mindboggle_2d", "subject1", "subject2"), 3: ("hippocampus_3d", "hippocampus_001", "hippocampus_003")}


@pytest.mark.data
@pytest.mark.parametrize("composite", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_we_get_the_result_of_an_ants_registration(tmp_path, ants, data_folder, dim, composite):
    """From its warp and affine files, or its composites: its warped images both ways, and its points."""
    folder, *names = PAIRS[dim]
    fixed, moving = (data_folder / folder / f"{name}.nii.gz" for name in names)
    like, image = (ants.image_read(str(f)) for f in (fixed, moving))
    found = ants.registration(
        like, image, "SyN", outprefix=f"{tmp_path}/", reg_iterations=(8, 4), write_composite_transform=composite
    )
    ways = [found["fwdtransforms"], found["invtransforms"]]
    if composite:
        chains = [read_transform(file) for file in ways]
    else:
        forward = [read_transform(file) for file in ways[0]]
        back = [read_transform(ways[1][0]).inverse(), read_transform(ways[1][1])]
        chains = [one.then(other) for one, other in (forward, back)]
    images = [read_image(f) for f in (fixed, moving)]
    warped = [chains[0].image(images[1], images[0]), chains[1].image(images[0], images[1])]
    for ours, name in zip(warped, ("warpedmovout", "warpedfixout"), strict=True):
        theirs = torch.from_numpy(found[name].numpy().T.copy())
        assert (ours.data[0, 0] - theirs).abs().max() < 1e-3 * (theirs.max() - theirs.min())
    points = _world(replace(chains[0], fixed=images[0]), beyond=0.0)
    files = [ways[0]] if composite else ways[0]
    torch.testing.assert_close(chains[0].points(points), _ants_points(ants, dim, points, files), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("image.nii.gz", lambda p: save(volume(), p)),
        ("short.nii.gz", lambda p: p.write_bytes(bytes_of(".nii.gz")[:300])),
        ("picture.png", lambda p: save(volume("uint8", (30, 40)), p)),
        ("two.mha", lambda p: save(volume(shape=(*SHAPE, 2)), p, vector=True)),
        ("absent.nii.gz", lambda p: None),
    ],
)
def test_displacements_that_are_none(folder, capfd, name, make):
    make(folder / name)
    with pytest.raises(InputError, match=name) as error:
        read_displacement(folder / name)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")
