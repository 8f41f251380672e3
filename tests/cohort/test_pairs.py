"""Where pairs come from: which files are found, who is paired with whom, what goes along, and what is refused."""

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchdeform.cohort.learn2reg import submission_name
from torchdeform.cohort.names import clean, image_name, pair_name, select
from torchdeform.cohort.pairs import find_images, named_images, pair_specs
from torchdeform.cohort.patterns import fill, find, literal, only, part_names
from torchdeform.errors import InputError

_BIDS = [
    f"sub-{subject}/ses-{session}/anat/sub-{subject}_ses-{session}_T1w.nii.gz"
    for subject in ("01", "02")
    for session in (1, 2, 10)
]
_FILES = "'sub-{subject}/ses-{session}/anat/*_T1w.nii.gz'"


def _pairs(found):
    """Return (fixed, moving) by the names of the files, in order."""
    return [(pair.files["fixed"].name, pair.files["moving"].name) for pair in found]


def _session(number, subject="01"):
    return f"sub-{subject}_ses-{number}_T1w.nii.gz"


def _table(folder, text, name="pairs.csv"):
    (folder / name).write_text(text, encoding="utf-8")
    return f"pairs:\n  table: {{file: {name}}}\n"


# Patterns


def test_parts_are_found_and_sorted_by_their_numbers(touch):
    folder = touch([*_BIDS, "sub-01/ses-1/anat/sub-01_T2w.nii.gz", "sub-03/anat/x_T1w.nii.gz"])
    found = find(f"{folder}/sub-{{subject}}/ses-{{session}}/anat/*_T1w.nii.gz", {})
    assert [one.parts["subject"] + "/" + one.parts["session"] for one in found] == [
        "01/1", "01/2", "01/10", "02/1", "02/2", "02/10",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("*.png", ["a1.png", "a2.png", "b1.png"]),
        ("?1.png", ["a1.png", "b1.png"]),
        ("[!a]?.png", ["b1.png"]),
        ("[ab]2.png", ["a2.png"]),
        ("**/*.tif", ["c.tif", "d.tif"]),
        ("{x}/{x}.jpg", ["e.jpg"]),
        ("{x}.pn", []),
        (".*", [".hidden.png"]),
    ],
)
def test_patterns_are_those_of_a_shell(touch, pattern, names):
    folder = touch(["a1.png", "a2.png", "b1.png", "c.tif", "deep/er/d.tif", "e/e.jpg", "e/f.jpg", ".hidden.png"])
    assert [one.path.name for one in find(f"{folder}/{pattern}", {})] == names


def test_a_part_may_be_limited(touch):
    folder = touch(["s1.png", "s1_label.png", "sx.png"])
    assert [one.parts for one in find(f"{folder}/s{{n}}.png", {"n": "[0-9]+"})] == [{"n": "1"}]
    with pytest.raises(InputError, match="makes no regular expression"):
        find(f"{folder}/s{{n}}.png", {"n": "(?P<n>x)"})


@given(st.text(alphabet="ab*?[]{}!-.", min_size=1, max_size=8))
def test_literal_means_the_text_itself(text):
    assert only(f"/{literal(text)}").as_posix() == f"/{text}" or text.strip(".") == ""
    assert part_names(literal(text)) == ()


@given(st.text(alphabet="ab*?[{}", min_size=1, max_size=6))
def test_what_is_filled_in_is_taken_literally(text):
    assert only(fill("/x{part}.png", {"part": text})).as_posix() == f"/x{text}.png"


def test_one_file_must_match(touch):
    folder = touch(["a1.png", "a2.png"])
    assert only(f"{folder}/a1*").name == "a1.png"
    with pytest.raises(InputError, match="must match one file, and 2 files match"):
        only(f"{folder}/a*")
    with pytest.raises(InputError, match="must match one file, and no file matches"):
        only(f"{folder}/b*")


# Pairings


def test_consecutive_sessions_within_each_subject(touch, cohort_of):
    touch(_BIDS)
    found = pair_specs(cohort_of(f"pairs: {{pattern: {{files: {_FILES}, pairing: consecutive, within: [subject]}}}}\n"))
    assert _pairs(found) == [(_session(a, s), _session(b, s)) for s in ("01", "02") for a, b in ((1, 2), (2, 10))]
    assert found[0].name == "sub-01_from-ses2_to-ses1"
    assert found[0].subject == "sub-01"


def test_order_is_that_of_a_part(touch, cohort_of):
    touch(["a_3.png", "b_2.png", "c_10.png"])
    text = "pairs: {pattern: {files: '{who}_{visit}.png', pairing: consecutive, order: visit}}\n"
    assert _pairs(pair_specs(cohort_of(text))) == [("b_2.png", "a_3.png"), ("a_3.png", "c_10.png")]


@pytest.mark.parametrize(("both", "count"), [("false", 3), ("true", 6)])
def test_every_two(touch, cohort_of, both, count):
    touch(["1.png", "2.png", "3.png"])
    found = pair_specs(cohort_of(f"pairs: {{pattern: {{files: '{{n}}.png', pairing: all, both_ways: {both}}}}}\n"))
    assert len(set(_pairs(found))) == len({pair.name for pair in found}) == count
    assert _pairs(found)[0] == ("1.png", "2.png")


def test_each_to_a_member_of_its_group(touch, cohort_of):
    touch([*_BIDS, "sub-03/ses-2/anat/sub-03_ses-2_T1w.nii.gz"])
    text = f"files: {_FILES}, pairing: group, within: [subject], reference: {{session: '1'}}"
    *found, lonely = pair_specs(cohort_of(f"pairs: {{pattern: {{{text}}}}}\n"))
    assert _pairs(found) == [(_session(1, s), _session(k, s)) for s in ("01", "02") for k in (2, 10)]
    assert (lonely.name, lonely.files) == ("sub-03", {})
    assert "0 of its 1 images have session 1, and one must" in lonely.problem


def test_all_to_a_template_but_itself(touch, cohort_of):
    touch(["1.png", "2.png", "3.png", "labels/1.tif", "labels/3.tif", "mask.png"])
    text = "files: '{n}.png', parts: {n: '[0-9]'}, pairing: template, fixed: 2.png, fixed_mask: mask.png"
    found = pair_specs(cohort_of(f"pairs: {{pattern: {{{text}, labels: 'labels/{{n}}.tif', fixed_labels: l.tif}}}}\n"))
    assert _pairs(found) == [("2.png", "1.png"), ("2.png", "3.png")]
    assert {key: path.name for key, path in found[1].files.items()} == {
        "fixed": "2.png", "fixed_labels": "l.tif", "fixed_mask": "mask.png",
        "moving": "3.png", "moving_labels": "3.tif",
    }  # fmt: skip
    assert found[0].name == "n-1"


def test_a_template_of_each_subject(touch, cohort_of):
    touch(_BIDS)
    text = f"files: {_FILES}, pairing: template, fixed: 'sub-{{subject}}/base.nii.gz'"
    found = pair_specs(cohort_of(f"pairs: {{pattern: {{{text}}}}}\n"))
    assert {pair.files["fixed"].parent.name for pair in found} == {"sub-01", "sub-02"}
    assert found[2].name == "sub-01_ses-10"


def test_what_goes_along_is_no_image_of_its_own(touch, cohort_of):
    touch(["s1.png", "s1_label.png", "s2.png", "s2_label.png", "s1_m1.png", "s2_m1.png", "s1.csv", "s2.csv"])
    text = "files: 's{n}.png', labels: 's{n}_label.png', masks: 's{n}_m*.png', points: 's{n}.csv', pairing: all"
    (found,) = pair_specs(cohort_of(f"pairs: {{pattern: {{{text}}}}}\n"))
    assert {key: path.name for key, path in found.files.items()} == {
        "fixed": "s1.png", "fixed_labels": "s1_label.png", "fixed_mask": "s1_m1.png", "fixed_points": "s1.csv",
        "moving": "s2.png", "moving_labels": "s2_label.png", "moving_mask": "s2_m1.png", "moving_points": "s2.csv",
    }  # fmt: skip


def test_a_mask_that_cannot_be_told_is_a_problem_of_its_pair(touch, cohort_of):
    touch(["1.png", "2.png", "3.png", "m1a.tif", "m2a.tif", "m2b.tif", "m3a.tif"])
    found = pair_specs(cohort_of("pairs: {pattern: {files: '{n}.png', masks: 'm{n}*.tif', pairing: all}}\n"))
    assert [bool(pair.problem) for pair in found] == [True, False, True]
    assert "m2*.tif must match one file, and 2 files match" in found[0].problem


def test_a_regular_expression_finds_images_too(touch, cohort_of):
    touch(["x/p1/pre.png", "x/p1/post.png", "x/p2/post.png", "x/p2/pre.png", "x/p2/other.png"])
    text = "expression: 'p(?P<subject>[0-9])/(?P<phase>pre|post)\\.png', folder: x, pairing: group"
    found = pair_specs(cohort_of(f"pairs: {{pattern: {{{text}, within: [subject], reference: {{phase: pre}}}}}}\n"))
    assert _pairs(found) == [("pre.png", "post.png")] * 2
    assert found[0].name == "sub-1_from-phasepost_to-phasepre"


def test_nothing_found_is_refused(cohort_of):
    with pytest.raises(InputError, match=r"no file matches .*/nothing"):
        pair_specs(cohort_of("pairs: {pattern: {files: 'nothing*.png', pairing: all}}\n"))
    with pytest.raises(InputError, match="names no pairs"):
        pair_specs(cohort_of("device: cpu\n"))
    with pytest.raises(InputError, match="comes to no pair at all"):
        pair_specs(cohort_of("pairs: {list: []}\n"))


def test_several_patterns_and_plain_files(touch, cohort_of):
    touch(["a/1.png", "b/2.png", "a/3.png"])
    found = find_images(cohort_of("images: {files: [a/1.png, 'b/*.png', 'a/*.png']}\n").images)
    assert [one.path.name for one in found] == ["1.png", "2.png", "3.png"]


# Lists and tables


def test_listed_pairs_keep_their_order_and_names(cohort_of):
    text = "pairs:\n  list:\n    - {fixed: x/a.nii.gz, moving: b.mha, moving_mask: m.png}\n"
    first, second = pair_specs(
        cohort_of(text + "    - {name: other, fixed: a.png, moving: b.png, settings: {window: 5}}\n")
    )
    assert (first.name, second.name) == ("from-b_to-a", "other")
    assert set(first.files) == {"fixed", "moving", "moving_mask"}
    assert second.settings == {"window": 5}


@pytest.mark.parametrize(("name", "separator"), [("pairs.csv", ","), ("pairs.tsv", "\t"), ("PAIRS.TSV", "\t")])
def test_tables(cohort_of, tmp_path, monkeypatch, name, separator):
    monkeypatch.setenv("IMAGES", "/data")
    rows = [
        ["name", "fixed", "moving", "fixed_labels", "settings.window", "settings.steps"],
        ["one", "a.png", "$IMAGES/b.png", "n/a", "7", "[5  10]" if separator == "," else "[5, 10]"],
        ["", "a.png", "c.png", "", "", ""],
        ["", "", "", "", "", ""],
    ]
    text = "\n".join(separator.join(row) for row in rows).replace("[5  10]", '"[5, 10]"')
    first, second = pair_specs(cohort_of(_table(tmp_path, f"\ufeff{text}\n", name)))
    assert first.files == {"fixed": tmp_path / "a.png", "moving": type(tmp_path)("/data/b.png")}
    assert first.settings == {"window": 7, "steps": [5, 10]}
    assert (first.name, second.name, second.settings) == ("one", "from-c_to-a", {})
    assert second.where.endswith("line 3")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("fixed,moving,fixd_mask\n", "line 1: there is no column 'fixd_mask'; did you mean 'fixed_mask'?"),
        ("fixed,movng\n", "line 1: there is no column 'movng'; did you mean 'moving'?"),
        ("fixed\n", "line 1: the column 'moving' is missing"),
        ("", "line 1: the column 'fixed' is missing"),
        ("fixed,moving,fixed\n", "line 1: the column 'fixed' stands there twice"),
        ("fixed,moving\na.png\n", "line 2: it has 1 cells and the first line 2"),
        ("fixed,moving\na.png,b.png,c.png\n", "line 2: it has 3 cells"),
        ("fixed,moving\na.png,b.png\n,b.png\n", "line 3: fixed is empty"),
        ("fixed,moving,name\na.png,b.png,../x\n", "line 2: a name has letters"),
        ("fixed,moving\na.png,$NOWHERE_SET/b\n", "line 2: the environment variable NOWHERE_SET"),
        ("fixed,moving,settings.window\na,b,[\n", "line 2: --set window"),
        ("fixed,moving\n", "comes to no pair at all"),
    ],
)
def test_wrong_tables(cohort_of, tmp_path, text, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)):
        pair_specs(cohort_of(_table(tmp_path, text)))


def test_files_that_are_no_table(cohort_of, tmp_path):
    with pytest.raises(InputError, match="No such file"):
        pair_specs(cohort_of("pairs: {table: {file: no.csv}}\n"))
    with pytest.raises(InputError, match="the ending of a table"):
        pair_specs(cohort_of("pairs: {table: {file: no.xlsx}}\n"))
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is no text"):
        pair_specs(cohort_of("pairs: {table: {file: binary.csv}}\n"))


# Learn2Reg


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
    ("text", "sentence"), [("{", "is no valid JSON"), ("[]", "no data set"), (None, "No such file")]
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


# Names


@given(st.text(max_size=300), st.text(max_size=300))
def test_names_made_of_anything_stay_in_their_folder(tmp_path_factory, one, other):
    root = tmp_path_factory.getbasetemp()
    fixed, moving = root / "f.png", root / "m.png"
    for name in (clean(one), image_name(fixed, {"subject": one}), pair_name(fixed, moving, {"a": one}, {"a": other})):
        assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,299}", name)


def test_selection_is_by_name_beginning_or_pattern():
    names = ["sub-1", "sub-1_ses-2", "sub-10", "sub-2_ses-1"]
    assert select(names, "sub-1") == names[:2]
    assert select(names, "sub-1*") == names[:3]
    assert select(names, "*_ses-?") == [names[1], names[3]]
    assert select(names, "sub") == []


# Images of a template


def test_images_of_a_template_are_named(touch, cohort_of):
    touch(["s1.png", "s2.png", "m1.png", "m2.png"])
    named = named_images(cohort_of("images: {files: 's{subject}.png', masks: 'm{subject}.png'}\n"))
    assert list(named) == ["sub-1", "sub-2"]
    assert {key: path.name for key, path in named["sub-2"].items()} == {"image": "s2.png", "mask": "m2.png"}


def test_images_of_one_name_are_refused(touch, cohort_of):
    touch(["a/s1.png", "b/s1.png"])
    with pytest.raises(InputError, match="would both be called sub-1; name the part that differs"):
        named_images(cohort_of("images: {files: '*/s{subject}.png'}\n"))
    with pytest.raises(InputError, match="names no images"):
        named_images(cohort_of("device: cpu\n"))
