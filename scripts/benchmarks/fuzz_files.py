"""Tiny valid files of every format that is read, made in code, and the public reader of each."""

import gzip
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

# Axes z, y, x. Small, but every axis is long enough for an image to be registered.
VOLUME, PICTURE = (8, 9, 10), (12, 14)

Numbers = Iterator[float]
_Coding = tuple[Callable[[bytes], bytes], Callable[[bytes], bytes]]


@dataclass(frozen=True)
class Format:
    """A format: how a tiny valid file is made, and how it is read.

    Attributes:
        file: name of the file that is mutated.
        write: writes it, and what it needs beside it.
        read: reads it as the package's users do, and yields numbers that must be finite.
        coding: takes away and puts back what hides the content from mutations: a packing, or checksums.
    """

    file: str
    write: Callable[[Path], None]
    read: Callable[[Path], Numbers]
    coding: _Coding | None = None


def values(shape: tuple[int, ...], kind: str = "float32") -> np.ndarray[Any, Any]:
    """Return a smooth pattern with noise, between 0 and 200."""
    axes = np.meshgrid(*(np.linspace(0, 3, n) for n in shape), indexing="ij")
    noise = np.random.default_rng(0).random(shape)
    return (90 + 80 * np.prod([np.cos(x + k) for k, x in enumerate(axes)], axis=0) + 30 * noise).astype(kind)


# Readers.


def read_image(path: Path) -> Numbers:
    """Read an image and check it, as every command does before it works with it."""
    from torchdeform.io import read_image
    from torchdeform.pipeline.preflight import preflight

    image = read_image(path)
    preflight(image, image).require_ok()
    yield from (float(end) for end in image.data.aminmax())
    yield from (*image.origin, *image.grid.spacing, *(entry for row in image.direction for entry in row))


def read_labels(path: Path) -> Numbers:
    """Read labels."""
    from torchdeform.io.images import read_labels

    image = read_labels(path)
    yield from (float(end) for end in image.data.aminmax())
    yield from (*image.origin, *image.grid.spacing)


def read_transform(path: Path) -> Numbers:
    """Read a transform, and map points with it."""
    import torch

    from torchdeform.io import read_transform

    chain = read_transform(path)
    points = torch.linspace(-5, 5, 8 * chain.dim, dtype=torch.float64).view(8, chain.dim)
    yield from chain.points(points).flatten().tolist()


def read_points(path: Path) -> Numbers:
    """Read points; voxels are those of a made-up image."""
    import torch

    from torchdeform.core.grid import Grid
    from torchdeform.core.image import Image
    from torchdeform.io.points import read_points

    yield from read_points(path, Image(torch.zeros(1, 1, *VOLUME), Grid(VOLUME))).positions.flatten().tolist()


def read_settings(path: Path) -> Numbers:
    """Read settings."""
    from torchdeform.pipeline.config import load_settings

    yield from _numbers(asdict(load_settings(file=path)))


def read_record(path: Path) -> Numbers:
    """Read the settings in the record of a result."""
    from torchdeform.cli.cite import recorded_settings

    yield from _numbers(asdict(recorded_settings(path)))


def read_cohort(path: Path) -> Numbers:
    """Read a cohort file and plan its pairs."""
    from torchdeform.cohort.plan import plan
    from torchdeform.cohort.schema import read_cohort

    cohort = read_cohort(path)
    yield from _numbers(asdict(cohort.resolve()))
    if cohort.pairs is not None:
        yield from (number for job in plan(cohort).jobs for number in _numbers(asdict(job.settings)))


def read_around(key: str, path: Path) -> Numbers:
    """Read a table, or the JSON of a data set, by the cohort file beside it."""
    cohort = path.parent / "around.yaml"
    cohort.write_text(f"out: out\npairs:\n  {key}:\n    file: {path.name}\n", encoding="utf-8")
    yield from read_cohort(cohort)


def read_journal(path: Path) -> Numbers:
    """Open the journal of a cohort."""
    from torchdeform.cohort.journal import Journal

    with Journal(path.parent) as journal:
        yield from (float(len(record.name)) for record in journal.records.values())


def _numbers(tree: object) -> Numbers:
    """Yield the numbers in mappings and lists."""
    if isinstance(tree, Mapping):
        tree = list(tree.values())
    if isinstance(tree, list | tuple):
        for part in tree:
            yield from _numbers(part)
    elif isinstance(tree, float):
        yield tree


# Codings.


def _png_unpacked(content: bytes) -> bytes:
    """Return the chunks of a PNG without their checksums, and pixels unpacked."""
    parts, at = [content[:8]], 8
    while at < len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        body = content[at + 8 : at + 8 + length]
        body = zlib.decompress(body) if kind == b"IDAT" else body
        parts += [struct.pack(">I4s", len(body), kind), body]
        at += length + 12
    return b"".join(parts)


def _png_packed(content: bytes) -> bytes:
    """Return a PNG made of such chunks, as far as they can be told apart."""
    parts, at = [content[:8]], 8
    while at + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        body = content[at + 8 : at + 8 + length]
        packed = zlib.compress(body) if kind == b"IDAT" else body
        parts += [struct.pack(">I4s", len(packed), kind), packed, struct.pack(">I", zlib.crc32(kind + packed))]
        at += length + 8
    return b"".join(parts)


_GZIP = (gzip.decompress, partial(gzip.compress, mtime=0))
_PNG = (_png_unpacked, _png_packed)


# Images.


def _by_itk(path: Path, kind: str = "float32", shape: tuple[int, ...] = VOLUME, *, packed: bool = False) -> None:
    import SimpleITK as sitk

    image = sitk.GetImageFromArray(values(shape, kind))
    image.SetSpacing([1.5, 1.25, 2.0][: len(shape)])
    image.SetOrigin([-5.0, 6.0, 7.5][: len(shape)])
    sitk.WriteImage(image, str(path), packed)


def _by_pillow(path: Path, mode: str = "RGB", **options: Any) -> None:
    from PIL import Image

    grey = values(PICTURE, "uint8")
    picture = Image.fromarray(np.stack([grey, 255 - grey, grey // 2], -1) if mode == "RGB" else grey)
    picture.convert(mode).save(path, **options)


def _by_tifffile(path: Path, shape: tuple[int, ...] = PICTURE, kind: str = "uint16", **options: Any) -> None:
    import tifffile

    tifffile.imwrite(path, values(shape, kind), **options)


def _slide(path: Path) -> None:
    import tifffile

    grey, text = values((64, 96), "uint8"), "Aperio Image Library v11.2.1\r\n96x64 "
    base, about = np.stack([grey, 255 - grey, grey // 2], -1), "[0,0 96x64] (16x16) |AppMag = 20|MPP = 0.4990"
    with tifffile.TiffWriter(path) as file:
        file.write(base, photometric="rgb", metadata=None, tile=(16, 16), description=text + about)
        file.write(base[::4, ::4], photometric="rgb", metadata=None, description=text + "-> 24x16 - |AppMag = 20")
        file.write(base[:20, :30], photometric="rgb", metadata=None, subfiletype=1)


def _by_nibabel(path: Path, name: str) -> None:
    import nibabel

    affine = np.diag([-1.0, -1.2, 2.0, 1])
    nibabel.save(getattr(nibabel, name)(values(VOLUME).T, affine), path)


def _gzipped(path: Path) -> None:
    plain = path.with_suffix("")
    _by_itk(plain)
    path.write_bytes(gzip.compress(plain.read_bytes(), mtime=0))
    plain.unlink()


def _dicom(path: Path) -> None:
    _by_itk(path, "int16", PICTURE)


def _enhanced_dicom(path: Path) -> None:
    import pydicom
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.sequence import Sequence
    from pydicom.uid import EnhancedMRImageStorage, ExplicitVRLittleEndian, generate_uid

    pixels = values((8, 12, 14), "uint16")
    data = Dataset()
    data.file_meta = FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID = EnhancedMRImageStorage
    data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID = generate_uid(entropy_srcs=["file"])
    data.SeriesInstanceUID, data.Modality = generate_uid(entropy_srcs=["series"]), "MR"
    data.NumberOfFrames, data.Rows, data.Columns = pixels.shape
    data.SamplesPerPixel, data.PhotometricInterpretation, data.PixelRepresentation = 1, "MONOCHROME2", 0
    data.BitsAllocated, data.BitsStored, data.HighBit = 16, 16, 15
    orientation, measures = Dataset(), Dataset()
    orientation.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    measures.PixelSpacing, measures.SliceThickness = [1.5, 1.25], 2
    shared = Dataset()
    shared.PlaneOrientationSequence, shared.PixelMeasuresSequence = Sequence([orientation]), Sequence([measures])
    data.SharedFunctionalGroupsSequence = Sequence([shared])
    data.PerFrameFunctionalGroupsSequence = Sequence(_frame(k) for k in range(len(pixels)))
    data.PixelData = pixels.tobytes()
    pydicom.dcmwrite(path, data, enforce_file_format=True)


def _frame(k: int) -> Any:
    from pydicom.dataset import Dataset
    from pydicom.sequence import Sequence

    place, content, frame = Dataset(), Dataset(), Dataset()
    place.ImagePositionPatient = [-20, -30, -40 + 2 * k]
    content.DimensionIndexValues, content.InStackPositionNumber, content.StackID = [1, k + 1], k + 1, "1"
    frame.PlanePositionSequence, frame.FrameContentSequence = Sequence([place]), Sequence([content])
    return frame


# Transforms.


def _transform(path: Path, name: str = "euler") -> None:
    import SimpleITK as sitk

    euler = sitk.Euler3DTransform((1, 2, 3), 0.1, -0.05, 0.2, (3, -2, 1))
    spline = sitk.BSplineTransform(3, 3)
    spline.SetTransformDomainMeshSize((1, 1, 1))
    spline.SetParameters([0.1 * (k % 7) for k in range(len(spline.GetParameters()))])
    field = sitk.DisplacementFieldTransform(sitk.Cast(_field(), sitk.sitkVectorFloat64))
    affine = sitk.AffineTransform(np.diag([1.1, 0.9, 1]).flatten().tolist(), (3, -2, 1))
    kinds = {"euler": euler, "affine": affine, "spline": spline, "field": sitk.CompositeTransform([euler, field])}
    sitk.WriteTransform(kinds[name], str(path))


def _field() -> Any:
    import SimpleITK as sitk

    return sitk.GetImageFromArray(np.stack([values((5, 6, 7)) / 100] * 3, -1), isVector=True)


def _warp(path: Path) -> None:
    import SimpleITK as sitk

    sitk.WriteImage(_field(), str(path))


def _words(text: str) -> Callable[[Path], None]:
    """Return what writes a text."""
    return lambda path: _write(path, text)


def _write(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


_ELASTIX = """\
(Transform "EulerTransform")
(NumberOfParameters 6)
(TransformParameters 0.1 -0.05 0.2 3 -2 1)
(InitialTransformParametersFileName "NoInitialTransform")
(HowToCombineTransforms "Compose")
(FixedImageDimension 3)
(MovingImageDimension 3)
(Size 56 48 24)
(Index 0 0 0)
(Spacing 1.2 1.0 2.0)
(Origin -30 -20 -24)
(Direction 1 0 0 0 1 0 0 0 1)
(CenterOfRotationPoint 0 0 0)
(ComputeZYX "false")
"""

# Points.

_ROWS = ((1, 2, 3), (10.5, -5, 4), (-8, 7, 1e1))
_COMMAS = "".join(f"P{k},{x},{y},{z}\n" for k, (x, y, z) in enumerate(_ROWS))
_FCSV = "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n# columns = label,x,y,z,sel,vis\n" + "".join(
    f"P{k},{x},{y},{z},1,1\n" for k, (x, y, z) in enumerate(_ROWS)
)
_OUTPUT = "".join(
    f"Point\t{k}\t; InputIndex = [ 1 2 3 ]\t; InputPoint = [ 1 2 3 ]\t; OutputIndexFixed = [ 1 1 1 ]\t; "
    f"OutputPoint = [ {x} {y} {z} ]\t; Deformation = [ 1 2 3 ]\n"
    for k, (x, y, z) in enumerate(_ROWS)
)
_MARKUPS = json.dumps(
    {
        "markups": [
            {
                "type": "Fiducial",
                "coordinateSystem": "RAS",
                "coordinateUnits": "mm",
                "controlPoints": [{"label": f"P{k}", "position": row} for k, row in enumerate(_ROWS)],
            }
        ]
    },
    indent=1,
)

# Tables, settings and records.

_TABLE = """\
name,fixed,moving,settings.similarity.window,settings.optimiser.steps
a,x.nii,y.nii,5,"[3, 2]"
b,~/x.nii,$HOME/z.nii,n/a,
"""
_SETTINGS = """\
similarity: {measure: lncc, window: 5}
optimiser:
  tolerance: 1e-5
  steps: [40, 20, 10]
align: rigid
outside: 0.0
"""
_COHORT = """\
out: results
pairs:
  list:
    - &first {fixed: a.nii, moving: b.nii, name: one, settings: {similarity: ssd}}
    - {<<: *first, name: two, moving: ~/c.nii}
memory: 4GB
engine: {timeout: 3600.0, workers: 2}
"""
_PATTERN = r"""out: results
pairs:
  pattern:
    expression: (?P<subject>[a-z]+\d{2,4})_(?P<session>ses-(\d+|x))_T1w\.nii(\.gz)?
    folder: .
    pairing: all
    within: [subject]
settings: {optimiser.steps: [3, 2]}
"""
_LEARN2REG = json.dumps(
    {
        "name": "Tiny",
        "numTraining": 2,
        "training": [
            {"image": f"./imagesTr/T_000{k}_0000.nii.gz", "label": f"./labelsTr/T_000{k}_0000.nii.gz"} for k in (1, 2)
        ],
        "registration_val": [{"fixed": "./imagesTr/T_0001_0000.nii.gz", "moving": "./imagesTr/T_0002_0000.nii.gz"}],
    },
    indent=1,
)
_RECORD = json.dumps(
    {"settings": {"similarity": {"measure": "lncc", "window": 5}, "optimiser": {"steps": [40, 20]}}}, indent=1
)
_JOURNAL = "\n".join(
    json.dumps(line)
    for line in (
        {"file": "/a/x.nii", "size": 352, "mtime_ns": 1700000000000000000, "digest": "ab" * 32},
        {"pair": "a", "key": "cd" * 32, "status": "done", "files": ["result.json"], "seconds": 1.5},
    )
)


def _pattern(path: Path) -> None:
    """Write a cohort file, and beside it the images that it finds."""
    _write(path, _PATTERN)
    for session in "12":
        _write(path.with_name(f"ab12_ses-{session}_T1w.nii.gz"), "no image")


def _tiff(**options: Any) -> Callable[[Path], None]:
    return partial(_by_tifffile, **options)


FORMATS: dict[str, Format] = {
    "PNG": Format("a.png", _by_pillow, read_image, _PNG),
    "PNG, palette": Format("a.png", partial(_by_pillow, mode="P"), read_image, _PNG),
    "JPEG": Format("a.jpg", _by_pillow, read_image),
    "JPEG of CMYK": Format("a.jpeg", partial(_by_pillow, mode="CMYK", dpi=(300, 300)), read_image),
    "BMP": Format("a.bmp", _by_pillow, read_image),
    "GIF": Format("a.gif", partial(_by_pillow, mode="L"), read_image),
    "WebP": Format("a.webp", partial(_by_pillow, lossless=True), read_image),
    "TIFF": Format("a.tif", _by_tifffile, read_image),
    "TIFF, deflate": Format("a.tif", _tiff(compression="deflate", predictor=True), read_image),
    "TIFF, LZW": Format("a.tif", partial(_by_pillow, compression="tiff_lzw"), read_image),
    "TIFF, JPEG": Format("a.tif", partial(_by_pillow, compression="jpeg"), read_image),
    "TIFF, Group 4": Format("a.tif", partial(_by_pillow, mode="1", compression="group4"), read_image),
    "TIFF, tiles, big": Format("a.tif", _tiff(shape=(40, 50), tile=(16, 16), bigtiff=True), read_image),
    "TIFF, pages": Format("a.tif", _tiff(shape=VOLUME, kind="float32", imagej=True), read_image),
    "OME-TIFF": Format("a.ome.tif", _tiff(shape=VOLUME, metadata={"axes": "ZYX", "PhysicalSizeX": 0.5}), read_image),
    "SVS": Format("a.svs", _slide, read_image),
    "NIfTI": Format("a.nii", _by_itk, read_image),
    "NIfTI, gzip": Format("a.nii.gz", _by_itk, read_image, _GZIP),
    "NIfTI, labels": Format("a.nii.gz", partial(_by_itk, kind="int16"), read_labels, _GZIP),
    "NIfTI-2": Format("a.nii", partial(_by_nibabel, name="Nifti2Image"), read_image),
    "MGZ": Format("a.mgz", partial(_by_nibabel, name="MGHImage"), read_image, _GZIP),
    "Analyze": Format("a.hdr", partial(_by_nibabel, name="AnalyzeImage"), read_image),
    "MetaImage": Format("a.mha", partial(_by_itk, kind="int16"), read_image),
    "MetaImage, packed": Format("a.mha", partial(_by_itk, packed=True), read_image),
    "MetaImage, two files": Format("a.mhd", _by_itk, read_image),
    "NRRD": Format("a.nrrd", _by_itk, read_image),
    "NRRD, gzip": Format("a.nrrd", partial(_by_itk, packed=True), read_image),
    "NRRD, two files": Format("a.nhdr", _by_itk, read_image),
    "VTK": Format("a.vtk", _by_itk, read_image),
    "GIPL": Format("a.gipl", partial(_by_itk, kind="int16"), read_image),
    "HDF5 image": Format("a.h5", _by_itk, read_image),
    "DICOM": Format("a.dcm", _dicom, read_image),
    "DICOM, enhanced": Format("a.dcm", _enhanced_dicom, read_image),
    "gzip of MetaImage": Format("a.mha.gz", _gzipped, read_image, _GZIP),
    "transform, text": Format("a.tfm", _transform, read_transform),
    "transform, B-spline": Format("a.tfm", partial(_transform, name="spline"), read_transform),
    "transform, Matlab": Format("a.mat", partial(_transform, name="affine"), read_transform),
    "transform, HDF5": Format("a.h5", partial(_transform, name="field"), read_transform),
    "transform, elastix": Format("TransformParameters.0.txt", _words(_ELASTIX), read_transform),
    "displacement": Format("a.nii.gz", _warp, read_transform, _GZIP),
    "points, csv": Format("a.csv", _words(f"name,x,y,z\n{_COMMAS}"), read_points),
    "points, csv of voxels": Format("a.csv", _words("i;j;k\n1;2;3\n3,5;2,5;1\n"), read_points),
    "points, tsv": Format("a.tsv", _words(f"name\tx\ty\tz\n{_COMMAS}".replace(",", "\t")), read_points),
    "points, elastix": Format("a.txt", _words("index\n2\n1 2 3\n4 5.5 6\n"), read_points),
    "points, transformix": Format("outputpoints.txt", _words(_OUTPUT), read_points),
    "points, fcsv": Format("a.fcsv", _words(_FCSV), read_points),
    "points, markups": Format("a.mrk.json", _words(_MARKUPS), read_points),
    "table": Format("a.csv", _words(_TABLE), partial(read_around, "table")),
    "Learn2Reg": Format("T_dataset.json", _words(_LEARN2REG), partial(read_around, "learn2reg")),
    "settings": Format("a.yaml", _words(_SETTINGS), read_settings),
    "cohort": Format("cohort.yaml", _words(_COHORT), read_cohort),
    "cohort, expression": Format("cohort.yaml", _pattern, read_cohort),
    "record": Format("result.json", _words(_RECORD), read_record),
    "journal": Format("journal.jsonl", _words(_JOURNAL), read_journal),
}
