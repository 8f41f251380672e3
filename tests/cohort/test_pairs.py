"""Where pairs come from: who is paired with whom, what goes along, and what is refused."""

import re

import pytest
from cohort_files import BIDS

from torchdeform.cohort.pairs import find_images, named_images, pair_specs
from torchdeform.errors import InputError

_FILES = "'sub-{subject}/ses-{session}/anat/*_T1w.nii.gz'"


def _pairs(found):
    """Return (fixed, moving) by the names of the files, in order."""
    return [(pair.files["fixed"].name, pair.files["moving"].name) for pair in found]


def _session(number, subject="01"):
    return f"sub-{subject}_ses-{number}_T1w.nii.gz"


def _table(folder, text, name="pairs.csv"):
    (folder / name).write_text(text, encoding="utf-8")
    return f"pairs:\n  table: {{file: {name}}}\n"


def test_consecutive_sessions_within_each_subject(touch, cohort_of):
    touch(BIDS)
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
    touch([*BIDS, "sub-03/ses-2/anat/sub-03_ses-2_T1w.nii.gz"])
    text = f"files: {_FILES}, pairing: group, within: [subject], reference: {{session: '1'}}"
    *found, lonely = pair_specs(cohort_of(f"pairs: {{pattern: {{{text}}}}}\n"))
    assert _pairs(found) == [(_session(1, s), _session(k, s)) for s in ("01", "02") for k in (2, 10)]
    assert (lonely.name, lonely.files) == ("sub-03", {})
    assert "0 of its 1 images have session 1, not one" in lonely.problem


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
    touch(BIDS)
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


@pytest.mark.parametrize(
    ("pairing", "tissues"),
    [
        ("all, both_ways: true", {("1", "2"): "t1", ("2", "1"): "t2"}),
        ("consecutive", {("1", "2"): "t1"}),
        ("group, reference: {n: '2'}", {("2", "1"): "t2"}),
        ("template, fixed: 2.png", {("2", "1"): "t1"}),  # as all files of a template's pair, by the moving image
    ],
)
def test_tissue_is_of_the_fixed_image_and_no_image_of_its_own(touch, cohort_of, pairing, tissues):
    touch(["1.png", "2.png", "t1.png", "t2.png"])
    found = pair_specs(
        cohort_of(f"pairs: {{pattern: {{files: '{{n}}.png', tissue: 't{{n}}.png', pairing: {pairing}}}}}\n")
    )
    assert {
        tuple(pair.files[side].stem for side in ("fixed", "moving")): pair.files["tissue"].stem for pair in found
    } == (tissues)
    assert all(len(pair.files) == 3 for pair in found)


def test_tissue_may_be_missing_where_it_is_not_needed(touch, cohort_of):
    touch(["1.png", "2.png", "3.png", "t1a.png"])
    found = pair_specs(cohort_of("pairs: {pattern: {files: '{n}.png', tissue: 't{n}*.png', pairing: consecutive}}\n"))
    assert [pair.files.get("tissue") is not None for pair in found] == [True, False]
    assert "t2*.png must match one file, but no file matches" in found[1].problem
    with pytest.raises(InputError, match="tissue: there is no part 'm'"):
        cohort_of("pairs: {pattern: {files: '{n}.png', tissue: 't{m}.png', pairing: all}}\n")


def test_a_mask_that_cannot_be_told_is_a_problem_of_its_pair(touch, cohort_of):
    touch(["1.png", "2.png", "3.png", "m1a.tif", "m2a.tif", "m2b.tif", "m3a.tif"])
    found = pair_specs(cohort_of("pairs: {pattern: {files: '{n}.png', masks: 'm{n}*.tif', pairing: all}}\n"))
    assert [bool(pair.problem) for pair in found] == [True, False, True]
    assert "m2*.tif must match one file, but 2 files match" in found[0].problem


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
    with pytest.raises(InputError, match="gives no pair at all"):
        pair_specs(cohort_of("pairs: {list: []}\n"))


def test_several_patterns_and_plain_files(touch, cohort_of):
    touch(["a/1.png", "b/2.png", "a/3.png"])
    found = find_images(cohort_of("images: {files: [a/1.png, 'b/*.png', 'a/*.png']}\n").images)
    assert [one.path.name for one in found] == ["1.png", "2.png", "3.png"]


def test_listed_pairs_keep_their_order_and_names(cohort_of):
    text = "pairs:\n  list:\n    - {fixed: x/a.nii.gz, moving: b.mha, moving_mask: m.png}\n"
    first, second = pair_specs(
        cohort_of(text + "    - {name: other, fixed: a.png, moving: b.png, settings: {similarity.window: 5}}\n")
    )
    assert (first.name, second.name) == ("from-b_to-a", "other")
    assert set(first.files) == {"fixed", "moving", "moving_mask"}
    assert second.settings == {"similarity.window": 5}


@pytest.mark.parametrize(("name", "separator"), [("pairs.csv", ","), ("pairs.tsv", "\t"), ("PAIRS.TSV", "\t")])
def test_tables(cohort_of, tmp_path, monkeypatch, name, separator):
    monkeypatch.setenv("IMAGES", "/data")
    rows = [
        ["name", "fixed", "moving", "fixed_labels", "settings.similarity.window", "settings.optimiser.steps"],
        ["one", "a.png", "$IMAGES/b.png", "n/a", "7", "[5  10]" if separator == "," else "[5, 10]"],
        ["", "a.png", "c.png", "", "", ""],
        ["", "", "", "", "", ""],
    ]
    text = "\n".join(separator.join(row) for row in rows).replace("[5  10]", '"[5, 10]"')
    first, second = pair_specs(cohort_of(_table(tmp_path, f"\ufeff{text}\n", name)))
    assert first.files == {"fixed": tmp_path / "a.png", "moving": type(tmp_path)("/data/b.png")}
    assert first.settings == {"similarity.window": 7, "optimiser.steps": [5, 10]}
    assert (first.name, second.name, second.settings) == ("one", "from-c_to-a", {})
    assert second.where.endswith("line 3")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("fixed,moving,fixd_mask\n", "line 1: there is no column 'fixd_mask'; did you mean 'fixed_mask'?"),
        ("fixed,movng\n", "line 1: there is no column 'movng'; did you mean 'moving'?"),
        ("fixed\n", "line 1: the column 'moving' is missing"),
        ("\n", "line 1: the column 'fixed' is missing"),
        ("", "pairs.csv is empty"),
        ("fixed,moving\na.png,~nosuchuser/b\n", "line 2: '~nosuchuser/b': there is no user of this name"),
        ("fixed,moving\na.png," + "../" * 3000 + "\n", "... is longer than a path can be"),
        ('fixed,moving\na.png,"' + "b" * 200_000, "line 2: field larger than field limit"),
        ("fixed,moving,fixed\n", "line 1: the column 'fixed' occurs twice"),
        ("fixed,moving\na.png\n", "line 2: it has 1 cells but the first line 2"),
        ("fixed,moving\na.png,b.png,c.png\n", "line 2: it has 3 cells"),
        ("fixed,moving\na.png,b.png\n,b.png\n", "line 3: fixed is empty"),
        ("fixed,moving,name\na.png,b.png,../x\n", "line 2: a name has letters"),
        ("fixed,moving\na.png,$NOWHERE_SET/b\n", "line 2: the environment variable NOWHERE_SET"),
        ("fixed,moving,settings.similarity.window\na,b,[\n", "line 2: --set similarity.window"),
        ("fixed,moving\n", "gives no pair at all"),
    ],
)
def test_wrong_tables(cohort_of, tmp_path, text, sentence):
    with pytest.raises(InputError, match=re.escape(sentence)):
        pair_specs(cohort_of(_table(tmp_path, text)))


def test_files_that_are_no_table(cohort_of, tmp_path):
    with pytest.raises(InputError, match=r"no\.csv does not exist"):
        pair_specs(cohort_of("pairs: {table: {file: no.csv}}\n"))
    with pytest.raises(InputError, match="the ending of a table"):
        pair_specs(cohort_of("pairs: {table: {file: no.xlsx}}\n"))
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is no text"):
        pair_specs(cohort_of("pairs: {table: {file: binary.csv}}\n"))


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
