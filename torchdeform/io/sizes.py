"""How large an image is, from its header alone."""

from pathlib import Path

from torchdeform.io import itk


def image_size(path: Path) -> tuple[tuple[int, ...], int] | None:
    """Return the shape (z, y, x; axes of one sample dropped) and the channels of an image file, None if unknown.

    Args:
        path: a file, or a folder of DICOM slices, all of which are taken for one series.

    Notes:
        Reads no pixels, so a file may turn out damaged later. What ITK does not know is unknown here.
    """
    import SimpleITK as sitk

    files = sorted(p for p in path.iterdir() if p.is_file()) if path.is_dir() else [path]
    reader = sitk.ImageFileReader()

    def look() -> tuple[tuple[int, ...], int]:
        reader.SetFileName(str(files[0]))
        reader.ReadImageInformation()
        return reader.GetSize(), reader.GetNumberOfComponents()

    found = itk.quietly(look) if files else None
    if found is None or isinstance(found, RuntimeError):
        return None
    size, channels = found
    slices = (len(files),) if len(files) > 1 else ()
    shape = tuple(n for n in (*slices, *size[::-1]) if n > 1)
    return (shape, channels) if len(shape) in (2, 3) else None
