"""Data sets of the Learn2Reg challenge: which pairs they list, what goes along, how submissions are called."""

import errno
import json

import nibabel
import numpy as np
import pytest

from torchdeform.cohort.learn2reg import submission_names
from torchdeform.cohort.pairs import pair_specs
from torchdeform.cohort.plan import plan, register_job
from torchdeform.errors import InputError
from torchdeform.io import write_image


def _dataset(folder, **content):
    one, two = ("./imagesTr/Lung_0001_0000.nii.gz", "./imagesTr/Lung_0001_0001.nii.gz")
    beside = {key: f"./{key}sTr/Lung_0001_0000" for key in ("label", "mask", "keypoints", "landmarks")}
    whole = {
        "name": "Lung",
        "training": [{"image": one, **beside}, {"image": two, "mask": "./m1", "landmarks": "./l1"}],
        "test": ["./imagesTs/Lung_0002_0000.nii.gz"],
        "training_paired_images": [{"fixed": one, "moving": two}],
        "registration_val": [{"fixed": one, "moving": two}, {"fixed": two, "moving": one}],
        **content,
    }
    (folder / "Lung_dataset.json").write_text(json.dumps(whole), encoding="utf-8")


def test_learn2reg_pairs_with_what_both_images_have(cohort_of, tmp_path):
    _dataset(tmp_path)
    found = pair_specs(cohort_of("pairs: {learn2reg: {file: Lung_dataset.json}}\n"))
    assert len(found) == 2
    assert found[0].files == {
        "fixed": tmp_path / "imagesTr/Lung_0001_0000.nii.gz",
        "moving": tmp_path / "imagesTr/Lung_0001_0001.nii.gz",
        "fixed_mask": tmp_path / "masksTr/Lung_0001_0000",
        "moving_mask": tmp_path / "m1",
        "fixed_points": tmp_path / "landmarkssTr/Lung_0001_0000",
        "moving_points": tmp_path / "l1",
    }
    assert len(pair_specs(cohort_of("pairs: {learn2reg: {file: Lung_dataset.json, split: train}}\n"))) == 1


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({"registration_val": []}, "names no pairs for the split val"),
        ({"registration_val": "x"}, "names no pairs for the split val"),
        ({"registration_val": [{"fixed": "a"}]}, r"registration_val\[0\] must name a fixed and a moving image"),
        ({"registration_val": [5], "training": 5}, "must name a fixed and a moving image"),
    ],
)
def test_wrong_data_sets(cohort_of, tmp_path, content, sentence):
    _dataset(tmp_path, **content)
    with pytest.raises(InputError, match=sentence):
        pair_specs(cohort_of("pairs: {learn2reg: {file: Lung_dataset.json}}\n"))


@pytest.mark.parametrize(
    ("text", "sentence"), [("{", "is no valid JSON"), ("[]", "no data set"), (None, "does not exist")]
)
def test_files_that_are_no_data_set(cohort_of, tmp_path, text, sentence):
    if text is not None:
        (tmp_path / "d.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=sentence):
        pair_specs(cohort_of("pairs: {learn2reg: {file: d.json}}\n"))


@pytest.mark.parametrize(
    ("fixed", "moving", "names"),
    [
        ("A_0001_0000.nii.gz", "A_0002_0000.nii.gz", ("disp_0001_0002.nii.gz", "disp_0001_0000_0002_0000.nii.gz")),
        ("A_0001_0001.nii.gz", "A_0002_0001.nii.gz", ("disp_0001_0002.nii.gz", "disp_0001_0001_0002_0001.nii.gz")),
        ("A_0001_0000.nii.gz", "A_0001_0001.nii.gz", ("disp_0001_0001.nii.gz", "disp_0001_0000_0001_0001.nii.gz")),
        ("A_0001_0001.nii.gz", "A_0001_0000.nii.gz", ("disp_0001_0001_0001_0000.nii.gz",)),
        ("A_0001_0000.nii.gz", "A_0001_0002.nii.gz", ("disp_0001_0000_0001_0002.nii.gz",)),
    ],
)
def test_submissions_are_called_as_the_evaluation_looks_for_them(tmp_path, fixed, moving, names):
    assert submission_names(tmp_path / fixed, tmp_path / moving) == names


def _parts(pair: dict[str, str]) -> tuple[str, str, str, str]:
    """Case and modality of the fixed and of the moving image, by the places of their digits in the names."""
    fixed, moving = pair["fixed"].split("/")[-1], pair["moving"].split("/")[-1]
    return fixed[-16:-12], fixed[-11:-7], moving[-16:-12], moving[-11:-7]


def _looks_for(pair: dict[str, str]) -> str:
    """The name by the rule of 2025-02-10: the modalities are left out for 0000 and 0001 only."""
    case, modality, other, another = _parts(pair)
    short = (modality, another) == ("0000", "0001")
    return f"disp_{case}_{other}.nii.gz" if short else f"disp_{case}_{modality}_{other}_{another}.nii.gz"


def _looked_for(pair: dict[str, str]) -> str:
    """The name by the rule of older copies: the modalities are left out where they are the same."""
    case, modality, other, another = _parts(pair)
    return f"disp_{case}_{other}.nii.gz" if modality == another else f"disp_{case}_{modality}_{other}_{another}.nii.gz"


_SETS = {
    "HippocampusMR": ((10, 12, 14), [((1, 0), (3, 0)), ((3, 0), (5, 0))]),
    "OASIS": ((16, 18, 12), [((395, 0), (396, 0)), ((396, 0), (397, 0))]),
    "ThoraxCBCT": ((12, 10, 14), [((11, 1), (11, 0)), ((12, 2), (12, 0))]),
    "AbdomenMRCT": ((12, 14, 10), [((1, 0), (1, 1)), ((2, 0), (2, 1))]),
    "LungCT": ((14, 12, 10), [((1, 0), (1, 1))]),
}


@pytest.mark.parametrize("linked", [True, False])
@pytest.mark.parametrize("name", _SETS)
def test_every_version_of_the_evaluation_finds_every_file(cohort_of, make_image, tmp_path, monkeypatch, name, linked):
    shape, pairs = _SETS[name]
    listed = []
    for pair in pairs:
        files = [f"imagesTr/{name}_{case:04}_{modality:04}.nii.gz" for case, modality in pair]
        for file in files:
            write_image(make_image(shape), tmp_path / file)
        listed.append(dict(zip(("fixed", "moving"), files, strict=True)))
    content = {"name": name, "training": [], "registration_val": listed}
    (tmp_path / f"{name}_dataset.json").write_text(json.dumps(content), encoding="utf-8")
    if not linked:
        monkeypatch.setattr("pathlib.Path.hardlink_to", _no_links)
    settings = "settings: {align: none, similarity: ssd, optimiser: {steps: [1]}}"
    source = f"pairs: {{learn2reg: {{file: {name}_dataset.json}}}}"
    for job in plan(cohort_of(f"layout: learn2reg\nreport: none\n{settings}\n{source}\n")).jobs:
        register_job(job)
    folder = tmp_path / "results" / "submission"
    for pair in listed:
        for rule in (_looks_for, _looked_for):
            found = nibabel.load(folder / rule(pair))
            assert found.shape == (*nibabel.load(tmp_path / pair["fixed"]).shape, 3)
            assert np.isfinite(found.get_fdata()).all()


def _no_links(*_: object) -> None:
    raise OSError(errno.EPERM, "Operation not permitted")


def test_other_names_cannot_be_submitted(tmp_path):
    with pytest.raises(InputError, match=r"must end in _CASE_MODALITY.nii.gz"):
        submission_names(tmp_path / "a.nii.gz", tmp_path / "A_0001_0000.nii.gz")
