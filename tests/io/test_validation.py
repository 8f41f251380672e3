"""A hundred and more files that something is wrong with: one sentence, an exit code, nothing left behind."""

import gzip
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchdeform.cli.main import main
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.errors import InputError
from torchdeform.io import read_displacement, read_image, write_image
from torchdeform.pipeline.preflight import preflight

SHAPE = (9, 10, 11)
Make = Callable[[Path], None]


def _volume(kind: str = "float32", shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    values = np.random.default_rng(0).random(shape) * 200
    return values.astype(kind)


def _itk(values: np.ndarray, *, vector: bool = False) -> sitk.Image:
    return sitk.GetImageFromArray(values, isVector=vector)


def _save(values: np.ndarray, path: Path, *, packed: bool = False, vector: bool = False) -> None:
    sitk.WriteImage(_itk(values, vector=vector), str(path), packed)


def _dicom(path: Path) -> None:
    sitk.WriteImage(_itk(_volume("int16", (30, 40))), str(path))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a sound volume and a sound picture; nothing else may be in it after a failure."""
    monkeypatch.chdir(tmp_path)
    write_image(Image(torch.from_numpy(_volume())[None, None], Grid(SHAPE)), "sound.nii.gz")
    values = torch.from_numpy(_volume("float32", (30, 40)))[None, None]
    write_image(Image(values, Grid((30, 40)), pixel_type="uint8"), "sound.png")
    return tmp_path


def _left(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def _refused(folder: Path, capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run the command, and return the one sentence that it says; nothing may be written."""
    before, threads = _left(folder), torch.get_num_threads()
    code = main([*arguments, "--out", "out"])
    out, err = capfd.readouterr()
    assert code in (1, 2), err
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("register: ")
    assert "Traceback" not in err
    assert "unexpected" not in err
    assert "; " in err or "to " in err  # what to do about it
    assert _left(folder) == before
    assert not (folder / "out").exists()
    assert torch.get_num_threads() == threads
    return err


# --- files that break off -------------------------------------------------------------------------------------------

WHOLE: dict[str, Make] = {
    "a.nii": lambda p: _save(_volume(), p),
    "a.nii.gz": lambda p: _save(_volume(), p),
    "a.mha": lambda p: _save(_volume(), p),
    "packed.mha": lambda p: _save(_volume(), p, packed=True),
    "a.nrrd": lambda p: _save(_volume(), p),
    "packed.nrrd": lambda p: _save(_volume(), p, packed=True),
    "a.png": lambda p: _save(_volume("uint8", (30, 40)), p),
    "deep.png": lambda p: _save(_volume("uint16", (30, 40)), p),
    "a.jpg": lambda p: _save(_volume("uint8", (30, 40)), p),
    "a.bmp": lambda p: _save(_volume("uint8", (30, 40)), p),
    "a.tif": lambda p: _save(_volume("uint16", (30, 40)), p),
    "pages.tif": lambda p: _save(_volume("uint16"), p, packed=True),
    "a.dcm": _dicom,
    "a.mha.gz": lambda p: p.write_bytes(gzip.compress(_bytes_of(".mha"))),
}


def _bytes_of(ending: str) -> bytes:
    path = Path(f"whole{ending}")
    _save(_volume(), path)
    content = path.read_bytes()
    path.unlink()
    return content


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.7, 0.97])
@pytest.mark.parametrize("name", WHOLE)
def test_a_file_that_breaks_off(folder, capfd, name, share):
    path = folder / name
    WHOLE[name](path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    partner = "sound.nii.gz" if name.partition(".")[2] not in ("png", "jpg", "bmp", "dcm") else "sound.png"
    assert name in _refused(folder, capfd, partner, name)


# --- headers that make no sense --------------------------------------------------------------------------------------


def _meta(**changes: str) -> bytes:
    fields = {
        "ObjectType": "Image", "NDims": "3", "BinaryData": "True", "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False", "TransformMatrix": "1 0 0 0 1 0 0 0 1", "Offset": "0 0 0",
        "ElementSpacing": "1 1 1", "DimSize": "11 10 9", "ElementType": "MET_FLOAT", "ElementDataFile": "LOCAL",
    } | changes  # fmt: skip
    return "".join(f"{key} = {value}\n" for key, value in fields.items()).encode() + _volume().tobytes()


def _nrrd(**changes: str) -> bytes:
    fields = {
        "type": "float", "dimension": "3", "space": "left-posterior-superior", "sizes": "11 10 9",
        "space directions": "(1,0,0) (0,1,0) (0,0,1)", "kinds": "domain domain domain", "endian": "little",
        "encoding": "raw", "space origin": "(0,0,0)",
    } | {key.replace("_", " "): value for key, value in changes.items()}  # fmt: skip
    head = "NRRD0004\n" + "".join(f"{key}: {value}\n" for key, value in fields.items()) + "\n"
    return head.encode() + _volume().tobytes()


META = {
    "zero spacing": {"ElementSpacing": "0 1 1"},
    "NaN spacing": {"ElementSpacing": "nan 1 1"},
    "infinite spacing": {"ElementSpacing": "1 inf 1"},
    "NaN origin": {"Offset": "nan 0 0"},
    "infinite origin": {"Offset": "0 0 inf"},
    "words for numbers": {"Offset": "a b c"},
    "singular direction": {"TransformMatrix": "1 0 0 1 0 0 0 0 1"},
    "zero direction": {"TransformMatrix": "0 0 0 0 0 0 0 0 0"},
    "NaN direction": {"TransformMatrix": "nan 0 0 0 1 0 0 0 1"},
    "sheared axes": {"TransformMatrix": "1 0 0 0.3 1 0 0 0 1"},
    "huge size": {"DimSize": "100000 100000 100000"},
    "size beyond the data": {"DimSize": "1100 1000 900"},
    "negative size": {"DimSize": "-11 10 9"},
    "empty axis": {"DimSize": "0 10 9"},
    "size in words": {"DimSize": "x y z"},
    "size of another rank": {"DimSize": "11 10"},
    "a line": {"DimSize": "990 1 1"},
    "unknown type": {"ElementType": "MET_NOTHING"},
    "data elsewhere": {"ElementDataFile": "absent.raw"},
    "compressed, but not": {"CompressedData": "True"},
    "four axes": {
        "NDims": "4", "DimSize": "11 10 3 3", "Offset": "0 0 0 0", "ElementSpacing": "1 1 1 1",
        "TransformMatrix": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1",
    },
}  # fmt: skip

NRRD = {
    "singular direction": {"space_directions": "(1,0,0) (1,0,0) (0,0,1)"},
    "zero spacing": {"space_directions": "(0,0,0) (0,1,0) (0,0,1)"},
    "NaN direction": {"space_directions": "(nan,0,0) (0,1,0) (0,0,1)"},
    "sheared axes": {"space_directions": "(1,0,0) (0.3,1,0) (0,0,1)"},
    "NaN origin": {"space_origin": "(nan,0,0)"},
    "huge size": {"sizes": "100000 100000 100000"},
    "size beyond the data": {"sizes": "1100 1000 90"},
    "negative size": {"sizes": "-11 10 9"},
    "empty axis": {"sizes": "11 0 9"},
    "size of another rank": {"sizes": "11 10"},
    "unknown type": {"type": "nothing"},
    "unknown encoding": {"encoding": "magic"},
    "packed, but not": {"encoding": "bzip2"},
    "data elsewhere": {"data_file": "absent.raw"},
}

# Position in the header of NIfTI-1, format, values.
NIFTI = {
    "huge size": (40, "<8h", (3, 30000, 30000, 30000, 1, 1, 1, 1)),
    "size beyond the data": (40, "<8h", (3, 110, 100, 90, 1, 1, 1, 1)),
    "negative size": (40, "<8h", (3, -11, 10, 9, 1, 1, 1, 1)),
    "empty axis": (40, "<8h", (3, 11, 0, 9, 1, 1, 1, 1)),
    "too many axes": (40, "<8h", (9, 11, 10, 9, 1, 1, 1, 1)),
    "no axes": (40, "<8h", (0, 11, 10, 9, 1, 1, 1, 1)),
    "several volumes": (40, "<8h", (4, 11, 10, 3, 3, 1, 1, 1)),
    "unknown type": (70, "<h", (999,)),
    "zero spacing": (76, "<8f", (1, 0, 1, 1, 1, 1, 1, 1)),
    "NaN spacing": (76, "<8f", (1, float("nan"), 1, 1, 1, 1, 1, 1)),
    "infinite spacing": (76, "<8f", (1, 1, float("inf"), 1, 1, 1, 1, 1)),
    "data far off": (108, "<f", (1e9,)),
    "data nowhere": (108, "<f", (float("nan"),)),
    "data before the file": (108, "<f", (-5.0,)),
    "singular direction": (252, "<2h", (0, 1)),  # and rows of zeros
    "NaN direction": (280, "<f", (float("nan"),)),
    "NaN origin": (292, "<f", (float("nan"),)),
    "sheared axes": (280, "<12f", (1, 0.3, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)),
}


@pytest.mark.parametrize("wrong", META)
def test_a_metaimage_header_without_sense(folder, capfd, wrong):
    (folder / "bad.mha").write_bytes(_meta(**META[wrong]))
    assert "bad.mha" in _refused(folder, capfd, "bad.mha", "sound.nii.gz")


@pytest.mark.parametrize("wrong", NRRD)
def test_an_nrrd_header_without_sense(folder, capfd, wrong):
    (folder / "bad.nrrd").write_bytes(_nrrd(**NRRD[wrong]))
    assert "bad.nrrd" in _refused(folder, capfd, "sound.nii.gz", "bad.nrrd")


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("wrong", NIFTI)
def test_a_nifti_header_without_sense(folder, capfd, wrong, packed):
    name = "bad.nii.gz" if packed else "bad.nii"
    _save(_volume(), folder / "bad.nii")
    content = bytearray((folder / "bad.nii").read_bytes())
    struct.pack_into("<2h", content, 252, 0, 1)  # the matrix is what counts
    position, form, values = NIFTI[wrong]
    if wrong == "singular direction":
        struct.pack_into("<12f", content, 280, *[0.0] * 12)
    struct.pack_into(form, content, position, *values)
    (folder / "bad.nii").unlink()
    (folder / name).write_bytes(gzip.compress(bytes(content)) if packed else bytes(content))
    assert name in _refused(folder, capfd, "sound.nii.gz", name)


def test_the_headers_are_sound_but_for_what_is_changed(folder):
    (folder / "a.mha").write_bytes(_meta())
    (folder / "a.nrrd").write_bytes(_nrrd())
    for name in ("a.mha", "a.nrrd"):
        assert torch.equal(read_image(name).data[0, 0], torch.from_numpy(_volume()))


# --- contents that cannot be registered -------------------------------------------------------------------------------


def _with(value: float) -> np.ndarray:
    values = _volume()
    values[3, 4, 5] = value
    return values


CONTENT: dict[str, Make] = {
    "nan.nii.gz": lambda p: _save(_with(np.nan), p),
    "nan.mha": lambda p: _save(_with(np.nan), p),
    "nan.nrrd": lambda p: _save(_with(np.nan), p),
    "nan.tif": lambda p: _save(_with(np.nan), p),
    "inf.nii.gz": lambda p: _save(_with(np.inf), p),
    "inf.mha": lambda p: _save(_with(-np.inf), p),
    "inf.nrrd": lambda p: _save(_with(np.inf), p),
    "constant.mha": lambda p: _save(np.full(SHAPE, 7.0, np.float32), p),
    "zero.nii.gz": lambda p: _save(np.zeros(SHAPE, np.float32), p),
    "complex.nii.gz": lambda p: _save(_volume("complex64"), p),
    "thin.mha": lambda p: _save(_volume(shape=(1, 1, 90)), p),
    "line.nrrd": lambda p: _save(_volume(shape=(1, 90)), p),
    "point.mha": lambda p: _save(_volume(shape=(1, 1, 1)), p),
    "slice.mha": lambda p: _save(_volume(shape=(1, 10, 11)), p),
    "picture.mha": lambda p: _save(_volume(shape=(10, 11)), p),
    "colour.png": lambda p: _save(_volume("uint8", (30, 40, 4)), p, vector=True),
    "frames.nii.gz": lambda p: _save(_volume(shape=(3, *SHAPE)), p),
    "frames.nrrd": lambda p: _save(_volume(shape=(3, *SHAPE)), p),
    "sizes.tif": lambda p: _two_sizes(p),
    "moments.tif": lambda p: _moments(p),
}


def _two_sizes(path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    with tifffile.TiffWriter(path) as file:
        file.write(_volume("uint8", (30, 40)))
        file.write(_volume("uint8", (15, 20)))


def _moments(path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(path, _volume("uint8", (3, 9, 30, 40)), imagej=True, metadata={"axes": "TZYX"})


@pytest.mark.parametrize("name", CONTENT)
def test_contents_that_cannot_be_registered(folder, capfd, name):
    CONTENT[name](folder / name)
    assert name in _refused(folder, capfd, "sound.nii.gz", name)


@pytest.mark.parametrize("kind", ["uint8", "int16", "uint16", "int32", "float64"])
def test_every_kind_of_number_is_read(folder, kind):
    _save(_volume(kind), folder / "a.nii.gz")
    image = read_image("a.nii.gz")
    assert image.pixel_type == kind
    np.testing.assert_allclose(image.data[0, 0].numpy(), _volume(kind).astype(np.float32))


@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_black_and_white_is_an_image(folder, ending):
    pil = pytest.importorskip("PIL.Image")
    values = _volume(shape=(30, 40)) > 100
    pil.fromarray(values).save(folder / f"a{ending}")
    data = read_image(f"a{ending}").data[0, 0]
    assert torch.equal(data == data.max(), torch.from_numpy(values))


# --- names, folders, places -------------------------------------------------------------------------------------------

NAMES: dict[str, Make] = {
    "nrrd.png": lambda p: p.write_bytes(_nrrd()),
    "nrrd.nii": lambda p: p.write_bytes(_nrrd()),
    "meta.tif": lambda p: p.write_bytes(_meta()),
    "meta.dcm": lambda p: p.write_bytes(_meta()),
    "meta.nii.gz": lambda p: p.write_bytes(_meta()),
    "picture.nii": lambda p: p.write_bytes(_png()),
    "picture.mha": lambda p: p.write_bytes(_png()),
    "plain.nii.gz": lambda p: p.write_bytes(_bytes_of(".nii")),
    "packed.nii": lambda p: p.write_bytes(gzip.compress(_bytes_of(".nii"))),
    "words.png": lambda p: p.write_text("no picture"),
    "words.nii.gz": lambda p: p.write_text("no picture"),
    "words.mha": lambda p: p.write_text("no picture"),
    "words.tif": lambda p: p.write_text("no picture"),
    "words.dcm": lambda p: p.write_text("no picture"),
    "words": lambda p: p.write_text("no picture"),
    "noise.jpg": lambda p: p.write_bytes(_volume("uint8").tobytes()),
    "noise.nrrd": lambda p: p.write_bytes(_volume("uint8").tobytes()),
    "noise.gz": lambda p: p.write_bytes(gzip.compress(_volume("uint8").tobytes())),
    "absent.nii.gz": lambda p: None,
    "empty-folder": lambda p: p.mkdir(),
    "loop.nii.gz": lambda p: p.symlink_to(p),
    "pipe.nii": lambda p: os.mkfifo(p),
}


def _png() -> bytes:
    path = Path("whole.png")
    _save(_volume("uint8", (30, 40)), path)
    content = path.read_bytes()
    path.unlink()
    return content


@pytest.mark.parametrize("name", NAMES)
def test_names_that_do_not_fit_what_is_there(folder, capfd, name):
    if name == "pipe.nii" and not hasattr(os, "mkfifo"):
        pytest.skip("no pipes here")
    NAMES[name](folder / name)
    assert name in _refused(folder, capfd, "sound.nii.gz", name)
    assert name in _refused(folder, capfd, name, "sound.nii.gz")


@pytest.mark.parametrize("out", ["sound.nii.gz", "sound.nii.gz/deeper", "/proc/nothing/here", "/dev/null"])
def test_places_that_cannot_be_written(folder, capfd, out):
    _save(_volume(), folder / "moving.mha")
    before = _left(folder)
    assert main(["sound.nii.gz", "moving.mha", "--out", out]) == 2
    assert "cannot write to" in capfd.readouterr().err
    assert _left(folder) == before


# --- masks, labels and fields -----------------------------------------------------------------------------------------


def _mask(values: torch.Tensor, **how) -> Image:
    return Image(values.float().expand(1, 1, *SHAPE), Grid(SHAPE), name="mask.nii.gz", **how)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (lambda: _mask(torch.zeros(SHAPE)), "mask.nii.gz is empty"),
        (lambda: _mask(torch.full(SHAPE, torch.nan)), "mask.nii.gz has pixels that are NaN"),
        (lambda: _mask(torch.ones(SHAPE), origin=(1e4, 0, 0)), "mask.nii.gz excludes all of"),
        (lambda: Image(torch.ones(1, 1, 30, 40), Grid((30, 40)), name="mask.nii.gz"), "mask.nii.gz is 2D"),
        (lambda: Image(torch.ones(1, 3, *SHAPE), Grid(SHAPE), name="mask.nii.gz"), "3 channels"),
    ],
)
def test_masks_that_cannot_be_used(folder, mask, message):
    image = read_image("sound.nii.gz")
    with pytest.raises(InputError, match=message):
        preflight(image, image, fixed_mask=mask()).require_ok()


def _labels(offset: int = 0, kind: str = "uint8") -> np.ndarray:
    """Two slabs, labelled 1 and 2 and what is added to them."""
    values = np.zeros(SHAPE, kind)
    values[2:4], values[5:7] = 1 + offset, 2 + offset
    return values


def _moved_away(path: Path) -> None:
    image = _itk(_labels())
    image.SetOrigin((1e4, 0.0, 0.0))
    sitk.WriteImage(image, str(path))


LABELS: dict[str, tuple[Make, str]] = {
    "none in common": (lambda p: _save(_labels(7), p), "no label in common"),
    "nothing": (lambda p: _save(np.zeros(SHAPE, np.uint8), p), "no label in common"),
    "fractions": (lambda p: _save(_labels(kind="float32") * np.float32(0.5), p), "must hold whole numbers"),
    "NaN": (lambda p: _save(np.full(SHAPE, np.nan, np.float32), p), "NaN or infinite"),
    "infinite": (lambda p: _save(np.full(SHAPE, np.inf, np.float32), p), "NaN or infinite"),
    "a picture": (lambda p: _save(_labels()[3], p), "must be 3D"),
    "two channels": (lambda p: _save(np.stack([_labels()] * 2, -1), p, vector=True), "one channel"),
    "cut off": (lambda p: p.write_bytes(_bytes_of(".nii")[:300]), "bad.nii"),
    "absent": (lambda p: None, "does not exist"),
}


@pytest.mark.parametrize("side", ["fixed", "moving"])
@pytest.mark.parametrize("wrong", LABELS)
def test_labels_that_do_not_fit(folder, capfd, wrong, side):
    """Found out before the registration, by file name."""
    make, message = LABELS[wrong]
    make(folder / "bad.nii")
    _save(_labels(), folder / "good.nii")
    names = {"fixed": "good.nii", "moving": "good.nii", side: "bad.nii"}
    options = [word for key, name in names.items() for word in (f"--{key}-labels", name)]
    said = _refused(folder, capfd, "sound.nii.gz", "sound.nii.gz", *options)
    assert "bad.nii" in said
    assert message in said


def test_labels_of_one_image_only_or_of_another_place(folder, capfd):
    _save(_labels(), folder / "good.nii")
    _moved_away(folder / "bad.nii")
    assert "--moving-labels" in _refused(folder, capfd, "sound.nii.gz", "sound.nii.gz", "--fixed-labels", "good.nii")
    options = ["--fixed-labels", "bad.nii", "--moving-labels", "good.nii"]
    assert "no label in common" in _refused(folder, capfd, "sound.nii.gz", "sound.nii.gz", *options)


@pytest.mark.parametrize("name", ["absent_mask.nii.gz", "sound.nii"])
def test_a_mask_that_is_not_there_is_an_error(folder, name):
    with pytest.raises(InputError, match="does not exist"):
        read_image(name)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("image.nii.gz", lambda p: _save(_volume(), p)),
        ("short.nii.gz", lambda p: p.write_bytes(_bytes_of(".nii.gz")[:300])),
        ("picture.png", lambda p: _save(_volume("uint8", (30, 40)), p)),
        ("two.mha", lambda p: _save(_volume(shape=(*SHAPE, 2)), p, vector=True)),
        ("absent.nii.gz", lambda p: None),
    ],
)
def test_displacements_that_are_none(folder, capfd, name, make):
    make(folder / name)
    with pytest.raises(InputError, match=name) as error:
        read_displacement(folder / name)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_there_are_a_hundred():
    count = 5 * len(WHOLE) + len(META) + len(NRRD) + 2 * len(NIFTI) + len(CONTENT) + len(NAMES)
    assert count >= 100
