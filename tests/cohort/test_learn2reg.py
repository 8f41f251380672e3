"""Data sets of the Learn2Reg challenge: which pairs they list, what goes along, how submissions are called."""

import json

import pytest

from torchdeform.cohort.learn2reg import submission_name
from torchdeform.cohort.pairs import pair_specs
from torchdeform.errors import InputError


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
        ({"registration_val": [5]}, "must name a fixed and a moving image"),
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
    ("fixed", "moving", "name"),
    [
        ("A_0001_0000.nii.gz", "A_0002_0000.nii.gz", "disp_0001_0002.nii.gz"),
        ("A_0001_0000.nii.gz", "A_0001_0001.nii.gz", "disp_0001_0001.nii.gz"),
        ("A_0001_0001.nii.gz", "A_0001_0000.nii.gz", "disp_0001_0001_0001_0000.nii.gz"),
        ("A_0001_0000.nii.gz", "A_0001_0002.nii.gz", "disp_0001_0000_0001_0002.nii.gz"),
    ],
)
def test_submissions_are_called_as_the_evaluation_looks_for_them(tmp_path, fixed, moving, name):
    assert submission_name(tmp_path / fixed, tmp_path / moving) == name


def test_other_names_cannot_be_submitted(tmp_path):
    with pytest.raises(InputError, match=r"must end in _CASE_MODALITY.nii.gz"):
        submission_name(tmp_path / "a.nii.gz", tmp_path / "A_0001_0000.nii.gz")
