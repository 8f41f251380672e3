"""Programs for images in files: TorchScript, and what ``torch.export`` saves."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import torch
from torch import Tensor

from torchdeform.errors import InputError
from torchdeform.io.gate import DAMAGED, reading, require_file

# What archives begin with.
_ARCHIVE = b"PK"

Program = Callable[[Tensor], Tensor]

# In the archive of an exported program, but in none of TorchScript: names of files, of which one is there.
_EXPORTED = ("archive_format", "models/model.json", "serialized_exported_program.json")


def load_program(path: Path, device: torch.device) -> Program:
    """Return the program in a file, ready to be called with tensors on ``device``.

    Args:
        path: what ``torch.jit.save`` or ``torch.export.save`` wrote.
        device: where it is to run.

    Raises:
        InputError: the file is missing, damaged, or holds something else, such as weights without a program.

    Notes:
        A program is run with all rights of this process: take it only from where you would take software.
    """
    require_file(path, "program of features")
    names = _names(path)
    if not any(name.startswith("code/") or name.endswith(_EXPORTED) for name in names):
        raise InputError(
            f"{path} holds no program; save the network by torch.jit.save(torch.jit.script(network), ..), or by "
            "torch.export.save"
        )
    with reading(path), quiet():
        if any(name.endswith(_EXPORTED) for name in names):
            return torch.export.load(path).module().to(device)
        return torch.jit.load(path, map_location=device).eval()


@contextmanager
def quiet() -> Iterator[None]:
    """Keep what torch says about its own future from those who run a program."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _names(path: Path) -> list[str]:
    """Return the names in an archive below its own folder; none where it is no archive."""
    with path.open("rb") as file:
        if file.read(len(_ARCHIVE)) != _ARCHIVE:
            return []
    try:
        with ZipFile(path) as archive:
            names = archive.namelist()
    except BadZipFile as error:
        raise InputError(f"{path} {DAMAGED}") from error
    return [name.partition("/")[2] for name in names]
