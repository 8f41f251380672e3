"""Files that break off, contradict themselves or hold something else: how each is made, by name."""

import gzip
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch

from torchdeform.cli.main import main
from torchdeform.errors import InputError
from torchdeform.io import read_image

SHAPE = (9, 10, 11)


def volume(kind: str = "float32", shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    values = np.random.default_rng(0).random(shape) * 200
    return values.astype(kind)


def outcome(path: Path) -> str:
    """Return why a file is refused, nothing where it is read, with pixels that are finite."""
    try:
        assert bool(read_image(path).data.isfinite().all())
    except InputError as error:
        return str(error)
    return ""


Make = Callable[[Path], None]


def itk_image(values: np.ndarray, *, vector: bool = False) -> sitk.Image:
    return sitk.GetImageFromArray(values, isVector=vector)


def save(values: np.ndarray, path: Path, *, packed: bool = False, vector: bool = False) -> None:
    sitk.WriteImage(itk_image(values, vector=vector), str(path), packed)


def write_dicom(path: Path) -> None:
    sitk.WriteImage(itk_image(volume("int16", (30, 40))), str(path))


def files_in(folder: Path) -> dict[str, int]:
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def refused(folder: Path, capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run the command, and return the one sentence that it says; nothing may be written."""
    before, threads = files_in(folder), torch.get_num_threads()
    code = main([*arguments, "--out", "out"])
    out, err = capfd.readouterr()
    assert code in (1, 2), err
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("register: ")
    assert "Traceback" not in err
    assert "unexpected" not in err
    assert "; " in err or "to " in err  # what to do about it
    assert files_in(folder) == before
    assert not (folder / "out").exists()
    assert torch.get_num_threads() == threads
    return err


WHOLE: dict[str, Make] = {
    "a.nii": lambda p: save(volume(), p),
    "a.nii.gz": lambda p: save(volume(), p),
    "a.mha": lambda p: save(volume(), p),
    "packed.mha": lambda p: save(volume(), p, packed=True),
    "a.nrrd": lambda p: save(volume(), p),
    "packed.nrrd": lambda p: save(volume(), p, packed=True),
    "a.png": lambda p: save(volume("uint8", (30, 40)), p),
    "deep.png": lambda p: save(volume("uint16", (30, 40)), p),
    "a.jpg": lambda p: save(volume("uint8", (30, 40)), p),
    "a.bmp": lambda p: save(volume("uint8", (30, 40)), p),
    "a.tif": lambda p: save(volume("uint16", (30, 40)), p),
    "pages.tif": lambda p: save(volume("uint16"), p, packed=True),
    "a.dcm": write_dicom,
    "a.mha.gz": lambda p: p.write_bytes(gzip.compress(bytes_of(".mha"))),
}


def bytes_of(ending: str) -> bytes:
    path = Path(f"whole{ending}")
    save(volume(), path)
    content = path.read_bytes()
    path.unlink()
    return content


def meta_image(**changes: str) -> bytes:
    fields = {
        "ObjectType": "Image", "NDims": "3", "BinaryData": "True", "BinaryDataByteOrderMSB": "False",
        "CompressedData": "False", "TransformMatrix": "1 0 0 0 1 0 0 0 1", "Offset": "0 0 0",
        "ElementSpacing": "1 1 1", "DimSize": "11 10 9", "ElementType": "MET_FLOAT", "ElementDataFile": "LOCAL",
    } | changes  # fmt: skip
    fields["ElementDataFile"] = fields.pop("ElementDataFile")  # always the last
    return "".join(f"{key} = {value}\n" for key, value in fields.items()).encode() + volume().tobytes()


def nrrd_image(**changes: str) -> bytes:
    fields = {
        "type": "float", "dimension": "3", "space": "left-posterior-superior", "sizes": "11 10 9",
        "space directions": "(1,0,0) (0,1,0) (0,0,1)", "kinds": "domain domain domain", "endian": "little",
        "encoding": "raw", "space origin": "(0,0,0)",
    } | {key.replace("_", " "): value for key, value in changes.items()}  # fmt: skip
    head = "NRRD0004\n" + "".join(f"{key}: {value}\n" for key, value in fields.items()) + "\n"
    return head.encode() + volume().tobytes()


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


def _with(value: float) -> np.ndarray:
    values = volume()
    values[3, 4, 5] = value
    return values


CONTENT: dict[str, Make] = {
    "nan.nii.gz": lambda p: save(_with(np.nan), p),
    "nan.mha": lambda p: save(_with(np.nan), p),
    "nan.nrrd": lambda p: save(_with(np.nan), p),
    "nan.tif": lambda p: save(_with(np.nan), p),
    "inf.nii.gz": lambda p: save(_with(np.inf), p),
    "inf.mha": lambda p: save(_with(-np.inf), p),
    "inf.nrrd": lambda p: save(_with(np.inf), p),
    "constant.mha": lambda p: save(np.full(SHAPE, 7.0, np.float32), p),
    "zero.nii.gz": lambda p: save(np.zeros(SHAPE, np.float32), p),
    "complex.nii.gz": lambda p: save(volume("complex64"), p),
    "thin.mha": lambda p: save(volume(shape=(1, 1, 90)), p),
    "line.nrrd": lambda p: save(volume(shape=(1, 90)), p),
    "point.mha": lambda p: save(volume(shape=(1, 1, 1)), p),
    "slice.mha": lambda p: save(volume(shape=(1, 10, 11)), p),
    "picture.mha": lambda p: save(volume(shape=(10, 11)), p),
    "colour.png": lambda p: save(volume("uint8", (30, 40, 4)), p, vector=True),
    "frames.nii.gz": lambda p: save(volume(shape=(3, *SHAPE)), p),
    "frames.nrrd": lambda p: save(volume(shape=(3, *SHAPE)), p),
    "sizes.tif": lambda p: _two_sizes(p),
    "moments.tif": lambda p: _moments(p),
}


def _two_sizes(path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    with tifffile.TiffWriter(path) as file:
        file.write(volume("uint8", (30, 40)))
        file.write(volume("uint8", (15, 20)))


def _moments(path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(path, volume("uint8", (3, 9, 30, 40)), imagej=True, metadata={"axes": "TZYX"})


NAMES: dict[str, Make] = {
    "picture.nii": lambda p: p.write_bytes(_png()),
    "picture.mha": lambda p: p.write_bytes(_png()),
    "words.png": lambda p: p.write_text("no picture"),
    "words.nii.gz": lambda p: p.write_text("no picture"),
    "words.mha": lambda p: p.write_text("no picture"),
    "words.tif": lambda p: p.write_text("no picture"),
    "words.dcm": lambda p: p.write_text("no picture"),
    "words": lambda p: p.write_text("no picture"),
    "noise.jpg": lambda p: p.write_bytes(volume("uint8").tobytes()),
    "noise.nrrd": lambda p: p.write_bytes(volume("uint8").tobytes()),
    "noise.gz": lambda p: p.write_bytes(gzip.compress(volume("uint8").tobytes())),
    "absent.nii.gz": lambda p: None,
    "empty-folder": lambda p: p.mkdir(),
    "loop.nii.gz": lambda p: p.symlink_to(p),
    "pipe.nii": lambda p: os.mkfifo(p),
}


def _png() -> bytes:
    path = Path("whole.png")
    save(volume("uint8", (30, 40)), path)
    content = path.read_bytes()
    path.unlink()
    return content
