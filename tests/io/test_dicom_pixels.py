"""Stored values of every packing and meaning of pixels; what cannot be unpacked is named."""

import io

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from dicom_files import picture, save
from PIL import Image as Picture
from pydicom.encaps import encapsulate
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    HTJ2KLossless,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGBaseline8Bit,
    RLELossless,
)

from torchdeform.errors import InputError
from torchdeform.io import read_image
from torchdeform.io.dicom_pixels import pixels

GREY = np.random.default_rng(0).integers(-300, 1000, (30, 40)).astype(np.int16)
SMOOTH = (128 + 100 * np.sin(np.add.outer(np.arange(32.0), np.arange(40.0)) / 9)).astype(np.uint8)
COLOUR = np.stack((SMOOTH, SMOOTH[::-1], 255 - SMOOTH), axis=-1)


@pytest.mark.parametrize("kind", ["uint8", "int8", "uint16", "int16", "uint32", "int32"])
@pytest.mark.parametrize(
    "syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian, DeflatedExplicitVRLittleEndian]
)
def test_plain_values(tmp_path, syntax, kind):
    values = np.arange(1200).reshape(30, 40).astype(kind)
    data = picture(values)
    if syntax == ExplicitVRBigEndian:
        data.PixelData = values.byteswap().tobytes()
    found = pixels(save(data, tmp_path / "a.dcm", syntax))
    assert found.dtype == kind
    assert np.array_equal(found[0, :, :, 0], values)


@pytest.mark.parametrize("signed", [0, 1])
def test_bits_that_are_not_stored_do_not_count(tmp_path, signed):
    """Twelve bits of sixteen; the other four hold an overlay."""
    values = np.random.default_rng(0).integers(-2048 * signed, 2048, (30, 40))
    data = picture((values & 0x0FFF).astype(np.uint16) | 0x5000, BitsStored=12, HighBit=11, PixelRepresentation=signed)
    assert np.array_equal(pixels(save(data, tmp_path / "a.dcm"))[0, :, :, 0], values)


def test_floating_point(tmp_path):
    data, values = picture(GREY), GREY.astype(np.float32) / 7
    del data.PixelData, data.BitsStored, data.HighBit, data.PixelRepresentation
    data.BitsAllocated, data.FloatPixelData = 32, values.tobytes()
    assert np.array_equal(pixels(save(data, tmp_path / "a.dcm"))[0, :, :, 0], values)


def test_what_is_not_finite_is_refused(tmp_path):
    with pytest.raises(InputError, match="has pixels that are NaN or infinite"):
        read_image(save(picture(GREY, RescaleSlope="1e300", RescaleIntercept=0), tmp_path / "a.dcm"))


@pytest.mark.parametrize(("kind", "bits"), [("uint8", 8), ("uint16", 12), ("int16", 16)])
def test_where_white_is_zero_bright_is_bright(tmp_path, kind, bits):
    values = np.random.default_rng(0).integers(0, 200, (30, 40)).astype(kind)
    data = picture(values, PhotometricInterpretation="MONOCHROME1", BitsStored=bits, HighBit=bits - 1)
    found = read_image(save(data, tmp_path / "a.dcm")).data[0, 0].numpy()
    assert np.array_equal(found, (-1 if kind == "int16" else 2**bits - 1) - values.astype(float))


def test_a_palette_is_colour(tmp_path):
    table = np.random.default_rng(0).integers(0, 2**16, (3, 256)).astype(np.uint16)
    data = picture(SMOOTH, PhotometricInterpretation="PALETTE COLOR")
    for name, column in zip(("Red", "Green", "Blue"), table, strict=True):
        setattr(data, f"{name}PaletteColorLookupTableDescriptor", [256, 0, 16])
        setattr(data, f"{name}PaletteColorLookupTableData", column.tobytes())
    found = read_image(save(data, tmp_path / "a.dcm")).data[0].numpy()
    assert np.array_equal(found, table[:, SMOOTH])


@pytest.mark.parametrize("planar", [0, 1])
@pytest.mark.parametrize("meaning", ["RGB", "YBR_FULL"])
def test_colours(tmp_path, planar, meaning):
    stored = COLOUR if meaning == "RGB" else np.asarray(Picture.fromarray(COLOUR).convert("YCbCr"))
    data = picture(np.ascontiguousarray(stored), PhotometricInterpretation=meaning, PlanarConfiguration=planar)
    if planar:
        data.PixelData = np.moveaxis(stored, -1, 0).tobytes()
    found = read_image(save(data, tmp_path / "a.dcm")).data[0].numpy()
    assert np.abs(found - np.moveaxis(COLOUR, -1, 0).astype(float)).max() <= (0 if meaning == "RGB" else 4)


def test_colours_of_half_resolution(tmp_path):
    y, b, r = np.moveaxis(np.asarray(Picture.fromarray(COLOUR).convert("YCbCr")), -1, 0)
    stored = np.stack((y[:, ::2], y[:, 1::2], b[:, ::2], r[:, ::2]), axis=-1)
    data = picture(COLOUR, PhotometricInterpretation="YBR_FULL_422", PixelData=stored.tobytes())
    found = read_image(save(data, tmp_path / "a.dcm")).data[0].numpy()
    assert np.abs(found - np.moveaxis(COLOUR, -1, 0).astype(float)).max() <= 25


def packed(values, codec, **options):
    stream = io.BytesIO()
    Picture.fromarray(values).save(stream, codec, **options)
    return encapsulate([stream.getvalue()])


def of_gdcm(values, folder, codec):
    """Return the packed stream that GDCM writes."""
    writer = sitk.ImageFileWriter()
    writer.SetImageIO("GDCMImageIO")
    writer.SetFileName(str(folder / "packed.dcm"))
    writer.UseCompressionOn()
    writer.SetCompressor(codec)
    writer.Execute(sitk.GetImageFromArray(values[None]))
    data = pydicom.dcmread(folder / "packed.dcm")
    return data.PixelData, data.file_meta.TransferSyntaxUID


@pytest.mark.parametrize("codec", ["JPEG", "JPEG2000", "JPEGLS"])
@pytest.mark.parametrize("kind", ["uint8", "int16"])
def test_packed_without_loss(tmp_path, codec, kind):
    values = GREY.astype(kind)
    stream, syntax = of_gdcm(values, tmp_path, codec)
    assert syntax.is_compressed
    data = picture(values, RescaleSlope=3, RescaleIntercept=-7)
    data.PixelData, data["PixelData"].VR = stream, "OB"
    found = read_image(save(data, tmp_path / "a.dcm", syntax))
    assert np.array_equal(found.data[0, 0].numpy(), 3.0 * values - 7)


def test_packed_frames_and_palettes(tmp_path):
    """GDCM sees the pixels alone: scales, meanings and palettes are applied here."""
    from pydicom.pixels import compress

    values = np.stack([GREY + k for k in range(4)])
    data = picture(values, PhotometricInterpretation="MONOCHROME1")
    data.file_meta = pydicom.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    compress(data, RLELossless)
    assert np.array_equal(pixels(save(data, tmp_path / "a.dcm", RLELossless))[..., 0], -1 - values)


@pytest.mark.parametrize("meaning", ["YBR_FULL_422", "YBR_FULL", "RGB"])
def test_packed_colours(tmp_path, meaning):
    data = picture(COLOUR, PhotometricInterpretation=meaning)
    how = {"keep_rgb": True} if meaning == "RGB" else {"subsampling": "4:2:2" if "422" in meaning else "4:4:4"}
    data.PixelData = packed(COLOUR, "JPEG", quality=95, **how)
    found = read_image(save(data, tmp_path / "a.dcm", JPEGBaseline8Bit)).data[0].numpy()
    assert np.abs(found - np.moveaxis(COLOUR, -1, 0).astype(float)).max() <= 25


@pytest.mark.parametrize("meaning", ["YBR_RCT", "RGB"])
def test_packed_colours_without_loss(tmp_path, meaning):
    data = picture(COLOUR, PhotometricInterpretation=meaning)
    data.PixelData = packed(COLOUR, "JPEG2000", no_jp2=True, mct=int(meaning == "YBR_RCT"))
    found = read_image(save(data, tmp_path / "a.dcm", JPEG2000Lossless)).data[0].numpy()
    assert np.array_equal(found, np.moveaxis(COLOUR, -1, 0))


def test_what_cannot_be_unpacked_is_named(tmp_path, capfd):
    data = picture(GREY, PixelData=encapsulate([b"\xff\x4f\xff\x51" + bytes(200)]))
    data["PixelData"].VR = "OB"
    for syntax, name in ((HTJ2KLossless, "High-Throughput JPEG 2000"), (JPEG2000Lossless, "JPEG 2000")):
        path = save(data, tmp_path / "a.dcm", syntax)
        with pytest.raises(InputError, match=rf"a\.dcm is packed as {name}.*gdcmconv --raw a\.dcm") as error:
            read_image(path)
        assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_pixels_that_are_cut_off(tmp_path, share):
    path = save(picture(GREY), tmp_path / "a.dcm")
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"a\.dcm is damaged or incomplete"):
        read_image(path)


def test_a_file_without_pixels(tmp_path):
    data = picture(GREY)
    del data.PixelData
    with pytest.raises(InputError, match=r"a\.dcm is damaged or incomplete"):
        read_image(save(data, tmp_path / "a.dcm"))


def test_padding_stays_as_it_is_stored(tmp_path):
    """As ITK leaves it: files name values as padding that mean something."""
    path = save(picture(GREY, PixelPaddingValue=-300), tmp_path / "a.dcm")
    assert np.array_equal(read_image(path).data[0, 0].numpy(), sitk.GetArrayFromImage(sitk.ReadImage(str(path)))[0])


def test_values_against_the_standard_are_read_without_a_word(tmp_path, capfd):
    path = save(picture(GREY, PixelSpacing=[0.5, 0.5], AcquisitionTime="120000"), tmp_path / "a.dcm")
    path.write_bytes(path.read_bytes().replace(b"120000", b"nooon!"))
    assert read_image(path).grid.spacing == (0.5, 0.5)
    assert capfd.readouterr() == ("", "")
