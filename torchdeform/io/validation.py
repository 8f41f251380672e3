"""Checks for faults of pictures that ITK reads over silently: files cut off."""

from collections.abc import Callable
from pathlib import Path

from torchdeform.errors import InputError
from torchdeform.io.files import read_head
from torchdeform.io.gate import DAMAGED
from torchdeform.io.kinds import BMP, JPEG


def require_sound_picture(path: Path, kind: str) -> None:
    """Raise `InputError` if a picture is visibly cut off."""
    if not _CHECKS.get(kind, lambda _: True)(path):
        raise InputError(f"{path} {DAMAGED}")


def _is_whole_jpeg(path: Path) -> bool:
    """The end of the image (FF D9) must follow the last scan (FF DA). Neither occurs inside coded pixels."""
    content = path.read_bytes()
    return content.rfind(b"\xff\xd9") > content.rfind(b"\xff\xda")


def _is_whole_bmp(path: Path) -> bool:
    """The header holds the size of the file."""
    return int.from_bytes(read_head(path, 6)[2:], "little") <= path.stat().st_size


_CHECKS: dict[str, Callable[[Path], bool]] = {JPEG: _is_whole_jpeg, BMP: _is_whole_bmp}
