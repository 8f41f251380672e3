"""Learn2Reg: the pairs in the JSON of a data set, and the names of displacement fields in a submission."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchdeform.cohort.names import PairSpec, pair_name
from torchdeform.cohort.schema import Learn2Reg
from torchdeform.errors import InputError
from torchdeform.io.texts import read_json

_PAIRS = {"train": "training_paired_images", "val": "registration_val", "test": "registration_test"}
_LISTS = ("training", "test")
# Companions of an image by their name in a pair, with their keys in the JSON; the first that exists is used.
_COMPANIONS = {"labels": ("label",), "mask": ("mask",), "points": ("landmarks", "keypoints")}
_BOTH = ("labels", "points")  # useful only if both images have them
_CASE = re.compile(r"_(\d{4})_(\d{4})\.nii\.gz$")


def learn2reg_pairs(source: Learn2Reg) -> list[PairSpec]:
    """Return the pairs of one split of a data set.

    Raises:
        InputError: the file is missing or no JSON of a data set, or the split has no pairs.
    """
    content = _read(source.file)
    key = _PAIRS[source.split]
    pairs = content.get(key)
    if not isinstance(pairs, list) or not pairs:
        raise InputError(f"{source.file} names no pairs for the split {source.split} ('{key}'); choose another split")
    images = {_normal(image["image"]): image for image in _images(content)}
    return [_pair_spec(pair, images, source.file, f"{key}[{n}]") for n, pair in enumerate(pairs)]


def submission_names(fixed: Path, moving: Path) -> tuple[str, ...]:
    """Return the names that evaluations of the challenge look for, the best known one first.

    Args:
        fixed: image named ``..._CASE_MODALITY.nii.gz``, four digits each.
        moving: likewise.

    Raises:
        InputError: another name.

    Notes:
        The evaluation of 2025-02-10 looks for ``disp_0001_0002.nii.gz`` where the modalities are 0000 and 0001, and
        for ``disp_0001_0000_0002_0000.nii.gz`` elsewhere; older copies look for the short name where both modalities
        are the same. Wherever one of them may look for the short name there are both.
    """
    cases = []
    for path in (fixed, moving):
        found = _CASE.search(path.name)
        if found is None:
            raise InputError(f"{path.name} must end in _CASE_MODALITY.nii.gz, four digits each, for a submission")
        cases.append((found[1], found[2]))
    (one, other), modalities = (case[0] for case in cases), tuple(case[1] for case in cases)
    whole = f"disp_{one}_{modalities[0]}_{other}_{modalities[1]}.nii.gz"
    if modalities[0] == modalities[1] or modalities == ("0000", "0001"):
        return f"disp_{one}_{other}.nii.gz", whole
    return (whole,)


def _read(path: Path) -> dict[str, Any]:
    content = read_json(path, "NAME_dataset.json of a data set")
    if not isinstance(content, dict):
        raise InputError(f"{path} describes no data set; give its NAME_dataset.json")
    return content


def _images(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the entries of the image lists that are more than a name."""
    listed = [image for key in _LISTS if isinstance(images := content.get(key), list) for image in images]
    return [image for image in listed if isinstance(image, dict) and isinstance(image.get("image"), str)]


def _normal(name: str) -> str:
    return Path(name).as_posix()


def _pair_spec(pair: object, images: Mapping[str, Mapping[str, Any]], file: Path, where: str) -> PairSpec:
    if not isinstance(pair, dict) or not all(isinstance(pair.get(side), str) for side in ("fixed", "moving")):
        raise InputError(f"{file}: {where} must name a fixed and a moving image")
    folder = file.absolute().parent
    files = {side: folder / pair[side] for side in ("fixed", "moving")}
    for side in ("fixed", "moving"):
        for what, key in _companions(images.get(_normal(pair[side]), {})):
            files[f"{side}_{what}"] = folder / key
    for what in _BOTH:
        if len({f"fixed_{what}", f"moving_{what}"} & files.keys()) == 1:
            files = {key: path for key, path in files.items() if not key.endswith(what)}
    name = pair_name(files["fixed"], files["moving"], {}, {})
    return PairSpec(name=name, files=files, where=f"{file}: {where}", voxels=True)


def _companions(image: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the companions of an image and their paths."""
    found = ((what, next((image[key] for key in keys if image.get(key)), None)) for what, keys in _COMPANIONS.items())
    return [(what, path) for what, path in found if isinstance(path, str)]
