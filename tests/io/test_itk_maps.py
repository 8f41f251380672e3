"""ITK's transform files as plain numbers, whatever is in them, without a crash."""

import random
import re
from contextlib import suppress

import numpy as np
import pytest
import SimpleITK as sitk

from torchdeform.errors import InputError
from torchdeform.io.itk_maps import read
from torchdeform.io.maps import Linear, Spline
from torchdeform.io.volume import Volume

KNOWN = "a transform of ITK"
HEADER = "#Insight Transform File V1.0\n#Transform 0\n"


def parts():
    spline = sitk.BSplineTransform(2, 3)
    spline.SetTransformDomainMeshSize([4, 5])
    spline.SetParameters(np.random.default_rng(0).normal(size=len(spline.GetParameters())).tolist())
    field = sitk.GetImageFromArray(np.random.default_rng(1).normal(size=(5, 6, 2)), isVector=True)
    field.SetSpacing((2.0, 3.0))
    return spline, sitk.DisplacementFieldTransform(field), sitk.Euler2DTransform((1, 2), 0.3, (4, 5))


@pytest.mark.parametrize("ending", [".h5", ".hdf5", ".tfm", ".txt"])
def test_parts_come_in_the_order_points_go_through_them(tmp_path, ending):
    spline, field, euler = parts()
    composite = sitk.CompositeTransform([euler, sitk.DisplacementFieldTransform(field), spline])
    sitk.WriteTransform(composite, str(tmp_path / f"a{ending}"))
    found = read(tmp_path / f"a{ending}", KNOWN)
    assert [type(part) for part in found] == [Spline, Volume, Linear]
    assert found[0].coefficients.values.shape == (8, 7, 2)
    np.testing.assert_allclose(np.moveaxis(found[0].coefficients.values, -1, 0).ravel(), spline.GetParameters())
    np.testing.assert_allclose(found[1].values, sitk.GetArrayFromImage(parts()[1].GetDisplacementField()))
    np.testing.assert_allclose(found[1].spacing, (2.0, 3.0))
    np.testing.assert_allclose(found[2].matrix.ravel(), euler.GetMatrix())


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_the_order_of_a_spline(tmp_path, order):
    transform = sitk.BSplineTransform(2, order)
    sitk.WriteTransform(transform, str(tmp_path / "a.tfm"))
    assert read(tmp_path / "a.tfm", KNOWN)[0].order == order


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Transform: BSplineTransform_double_3_3\nParameters: 0\nFixedParameters: 1000000 1000000 1000000 0 0 0 1 1 1 "
         "1 0 0 0 1 0 0 0 1\n", "damaged"),
        ("Transform: DisplacementFieldTransform_double_2_2\nParameters: 0 0\nFixedParameters: 90000 90000 0 0 1 1 "
         "1 0 0 1\n", "damaged"),
        ("Transform: BSplineTransform_double_3_3\nParameters: 0\nFixedParameters: nan\n", "not finite"),
        ("Transform: BSplineTransform_double_3_3\nParameters: 0\nFixedParameters: 4 x 4\n", "damaged"),
        ("Transform: ThinPlateSplineKernelTransform_double_3_3\nParameters: 0\nFixedParameters: 0\n",
         "holds a ThinPlateSplineKernelTransform_double_3_3, which ITK cannot read"),
        ("Transform: AffineTransform_double_4_4\nParameters: 1\nFixedParameters: 0\n", "cannot be read|of 4D"),
        ("Transform: AffineTransform_double_2_2\nParameters: 1 x\nFixedParameters: 0 0\n", "damaged"),
        ("Transform: Euler2DTransform_double_2_2\nParameters: nan 2 3\nFixedParameters: 4 5\n", "a.tfm holds numbers "
         "that are not finite; make it again"),
        ("Transform: ComposeScaleSkewVersor3DTransform_double_3_3\nParameters: 0 0 0 0 0 0 1 1 1 0 0 0\n"
         "FixedParameters: 0 0 0\n", "holds a transform that SimpleITK has no class for"),
        ("Transform: AffineTransform_double_2_\udcff\nParameters: 1 0\nFixedParameters: 0 0\n", "damaged"),
        ("hello\n", "cannot be read as a transform; give a transform of ITK"),
    ],
)  # fmt: skip
def test_texts_that_are_no_transform(tmp_path, capfd, text, message):
    (tmp_path / "a.tfm").write_bytes((HEADER + text).encode(errors="surrogateescape"))
    with pytest.raises(InputError, match=message) as error:
        read(tmp_path / "a.tfm", KNOWN)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


LINEAR = [
    *(sitk.AffineTransform(dim) for dim in (2, 3)), *(sitk.TranslationTransform(dim) for dim in (2, 3)),
    *(sitk.ScaleTransform(dim) for dim in (2, 3)), sitk.Euler2DTransform(), sitk.Similarity2DTransform(),
    sitk.Euler3DTransform(), sitk.VersorTransform(), sitk.VersorRigid3DTransform(), sitk.Similarity3DTransform(),
    sitk.ScaleVersor3DTransform(), sitk.ScaleSkewVersor3DTransform(),
]  # fmt: skip


@pytest.mark.parametrize("transform", LINEAR, ids=lambda t: f"{t.GetName()}{t.GetDimension()}")
def test_every_linear_transform_is_read_whole_or_not_at_all(tmp_path, transform):
    """Where its text breaks off, or has a number too few, ITK would take the identity, or 0."""
    values = np.array(transform.GetParameters()) + np.linspace(0.01, 0.02, transform.GetNumberOfParameters())
    transform.SetParameters(values.tolist())
    path = tmp_path / "a.tfm"
    sitk.WriteTransform(transform, str(path))
    (found,), text = read(path, KNOWN), path.read_text(encoding="utf-8")
    point = [3.0, -2.0, 5.0][: transform.GetDimension()]
    np.testing.assert_allclose(found.matrix @ point + found.offset, transform.TransformPoint(point), atol=1e-9)
    fixed = text.index("FixedParameters")
    for part in (text[:fixed], text[: fixed - 30], _one_less(text)):
        path.write_text(part, encoding="utf-8")
        with pytest.raises(InputError, match=r"is damaged or incomplete|cannot be read"):
            read(path, KNOWN)


def _one_less(text):
    return re.sub(r"(?m)^(Parameters:.*) \S+$", r"\1", text)


def test_a_transform_without_a_form_here_leads_to_a_field(tmp_path):
    """The advice is a command that works."""
    field = sitk.Image([4, 4, 3], sitk.sitkVectorFloat64, 2)
    text = f"{HEADER}Transform: VelocityFieldTransform_double_2_2\nParameters: {'0 ' * 96}\nFixedParameters: 4 4 3 "
    (tmp_path / "a.tfm").write_text(text + "0 0 0 1 1 1 1 0 0 0 1 0 0 0 1 0 1 10\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.tfm (holds a \w+, which|cannot be read|makes its reader)"):
        read(tmp_path / "a.tfm", KNOWN)
    assert field.GetDimension() == 3


@pytest.mark.parametrize("ending", [".h5", ".tfm", ".mat"])
@pytest.mark.parametrize("seed", range(12))
def test_mutated_files_are_read_or_refused(tmp_path, capfd, ending, seed):
    draw, path = random.Random(seed), tmp_path / f"a{ending}"
    spline, field, euler = parts()
    sitk.WriteTransform(euler if ending == ".mat" else sitk.CompositeTransform([euler, field, spline]), str(path))
    content = bytearray(path.read_bytes())
    for _ in range(draw.choice((1, 8, 64))):
        content[draw.randrange(len(content))] = draw.choice((0, 255, draw.randrange(256)))
    path.write_bytes(content)
    with suppress(InputError):
        assert all(isinstance(part, Linear | Spline | Volume) for part in read(path, KNOWN))
    assert re.fullmatch("", "".join(capfd.readouterr()))
