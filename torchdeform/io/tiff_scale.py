"""Scale of a TIFF: the distances of its pixels where the file means one. The dots per inch of a print are none."""

import math
import re
from collections.abc import Callable
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

# Distances of pages (NaN where the file does not say), rows and columns in mm or pixels, and the unit to show them in.
Scale = tuple[tuple[float, float, float], str]
NO_SCALE: Scale = ((1.0, 1.0, 1.0), "px")

# Length of a unit in millimetres, by the names that ImageJ and OME write. Shorter ones than 0.1 mm are shown in µm.
_MILLIMETRES = {
    "pm": 1e-9, "Å": 1e-7, "å": 1e-7, "nm": 1e-6, "nanometer": 1e-6, "um": 1e-3, "µm": 1e-3, "μm": 1e-3,
    "\\u00b5m": 1e-3, "micron": 1e-3, "microns": 1e-3, "micrometer": 1e-3, "mm": 1.0, "millimeter": 1.0, "cm": 10.0,
    "centimeter": 10.0, "dm": 100.0, "m": 1e3, "thou": 0.0254, "pt": 25.4 / 72, "in": 25.4, "ft": 304.8,
}  # fmt: skip
_INCHES = ("inch", "inches", "in")  # ImageJ's unit for a picture that it was given with dots per inch

# By the resolution tag's unit, inch or cm: its length, and below which size a pixel is meant: scanners and prints have
# up to 4800 dots per inch, and far fewer than 500 per cm; microscopes write cm.
_INCH, _CM = 2, 3
_RESOLUTION_UNITS = {_INCH: (25.4, 5e-3), _CM: (10.0, 20e-3)}
_ONE = 1e-6  # mm by which sizes of pixels may differ from 1 and count as none
_ITK = "InsightToolkit"  # which writes mm as dots per inch

# What scanners of slides write into a description or into XML: micrometres, or millimetres.
_SLIDES = {
    "svs": (re.compile(r"\bMPP\s*=\s*([\d.]+)"), 1e-3),
    "bif": (re.compile(r"\bScanRes\s*=\s*[\"']([\d.]+)"), 1e-3),
    "philips": (re.compile(r"DICOM_PIXEL_SPACING[^>]*>\s*(?:&quot;|\")([\d.eE+-]+)"), 1.0),
}
_XMP = 700  # tag


def scale(file: "TiffFile", page: "TiffPage") -> Scale:
    """Return the scale of an image whose first page is ``page``.

    Notes:
        The first of: OME; ImageJ; the description of a slide scanner or an electron microscope; and the resolution tags
        if they were written by ITK, or if they are finer than prints and scans on paper are.
    """
    finders: tuple[Callable[[TiffFile, TiffPage], Scale | None], ...] = (_ome, _imagej, _slide, _microscope, _tagged)
    return next((found for find in finders if (found := find(file, page)) and _positive(found)), NO_SCALE)


def _positive(found: Scale) -> bool:
    depth, down, across = found[0]
    return all(0 < size < math.inf for size in (down, across)) and not (depth <= 0 or depth == math.inf)


def _shown(millimetres: float | None) -> str:
    """Return the unit to show lengths in, by the length of the file's unit."""
    return "px" if millimetres is None else "µm" if millimetres < 0.1 else "mm"


def _ome(file: "TiffFile", _page: "TiffPage") -> Scale | None:
    """PhysicalSizeZ, Y, X of the first image."""
    try:
        pixels = ElementTree.fromstring(file.ome_metadata or "").find(".//{*}Pixels")
    except ElementTree.ParseError:
        return None
    if pixels is None or "PhysicalSizeX" not in pixels.attrib:
        return None
    known = {axis: _MILLIMETRES.get(pixels.get(f"PhysicalSize{axis}Unit", "µm")) for axis in "ZYX"}
    down, across = (float(pixels.get(f"PhysicalSize{axis}", "nan")) * (known[axis] or 1.0) for axis in "YX")
    depth = float(pixels.get("PhysicalSizeZ", "nan")) * (known["Z"] or 1.0)
    comparable = depth > 0 and (known["Z"] is None) == (known["X"] is None)
    return (depth if comparable else math.nan, down, across), _shown(known["X"])


def _imagej(file: "TiffFile", page: "TiffPage") -> Scale | None:
    """The unit and the distance of pages in the description, the others in the resolution tags."""
    about: dict[str, Any] = file.imagej_metadata or {}
    unit = str(about.get("unit", "")).lower()
    if not unit or unit in _INCHES:
        return None
    known = _MILLIMETRES.get(unit)
    down, across = _sizes(page)
    length = known or 1.0
    return (abs(float(about.get("spacing", 1.0)) * length) or 1.0, down * length, across * length), _shown(known)


def _slide(file: "TiffFile", page: "TiffPage") -> Scale | None:
    """Micrometres per pixel in the words of slide scanners."""
    for kind, (pattern, unit) in _SLIDES.items():
        if kind in file.flags:
            packet = page.tags.valueof(_XMP, b"")
            text = page.description + (packet.decode(errors="replace") if isinstance(packet, bytes) else str(packet))
            if sizes := [float(number) * unit for number in pattern.findall(text)]:
                return (math.nan, min(sizes), min(sizes)), "µm"  # smaller levels may be in it too
    return None


def _microscope(file: "TiffFile", _page: "TiffPage") -> Scale | None:
    """Metres of Zeiss' confocal and of FEI's electron microscopes."""
    voxel, scan = file.lsm_metadata or {}, (file.fei_metadata or {}).get("Scan", {})
    if "VoxelSizeX" in voxel:
        depth, down, across = (1e3 * float(voxel[f"VoxelSize{axis}"]) for axis in "ZYX")
        return (depth or math.nan, down, across), "µm"
    if "PixelWidth" in scan:
        return (math.nan, 1e3 * float(scan["PixelHeight"]), 1e3 * float(scan["PixelWidth"])), "µm"
    return None


def _tagged(_file: "TiffFile", page: "TiffPage") -> Scale | None:
    """Resolution tags that are meant."""
    if "XResolution" not in page.tags or int(page.resolutionunit) not in _RESOLUTION_UNITS:
        return None
    length, finest = _RESOLUTION_UNITS[int(page.resolutionunit)]
    down, across = (size * length for size in _sizes(page))
    if page.software.startswith(_ITK):  # 1 mm where an image has none
        return None if abs(down - 1) + abs(across - 1) < _ONE else ((1.0, down, across), "mm")
    return ((math.nan, down, across), "µm") if max(down, across) < finest else None


def _sizes(page: "TiffPage") -> tuple[float, float]:
    """Return the distances of rows and columns in the unit of the resolution tags, 1 without them."""
    across, down = (1 / value if 0 < value < math.inf else 1.0 for value in page.resolution)
    return down, across
