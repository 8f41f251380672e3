"""Patterns of file names: which files are found, with which parts, and what text means itself."""

import pytest
from cohort_files import BIDS
from hypothesis import given
from hypothesis import strategies as st

import torchdeform.cohort.patterns as patterns
from torchdeform.cohort.patterns import fill_parts, find, literal, part_names, search, single_file
from torchdeform.errors import InputError


def test_parts_are_found_and_sorted_by_their_numbers(touch):
    folder = touch([*BIDS, "sub-01/ses-1/anat/sub-01_T2w.nii.gz", "sub-03/anat/x_T1w.nii.gz"])
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
    with pytest.raises(InputError, match="is no regular expression"):
        find(f"{folder}/s{{n}}.png", {"n": "(?P<n>x)"})


@given(st.text(alphabet="ab*?[]{}!-.", min_size=1, max_size=8))
def test_literal_means_the_text_itself(text):
    assert single_file(f"/{literal(text)}").as_posix() == f"/{text}" or text.strip(".") == ""
    assert part_names(literal(text)) == ()


@given(st.text(alphabet="ab*?[{}", min_size=1, max_size=6))
def test_what_is_filled_in_is_taken_literally(text):
    assert single_file(fill_parts("/x{part}.png", {"part": text})).as_posix() == f"/x{text}.png"


def test_one_file_must_match(touch):
    folder = touch(["a1.png", "a2.png"])
    assert single_file(f"{folder}/a1*").name == "a1.png"
    with pytest.raises(InputError, match="must match one file, but 2 files match"):
        single_file(f"{folder}/a*")
    with pytest.raises(InputError, match="must match one file, but no file matches"):
        single_file(f"{folder}/b*")


def test_repetitions_in_repetitions_take_bounded_time(touch, monkeypatch):
    """Python's own matching of this takes years."""
    monkeypatch.setattr(patterns, "_SECONDS", 0.5)
    folder = touch(["a" * 60 + ".png"])
    with pytest.raises(InputError, match=r"'\(a\+\)\+\$' takes too long to match; write it without repetitions"):
        search(folder, "(a+)+$")
    assert [one.path.name for one in search(folder, r"(?P<x>a)a+\.png")] == ["a" * 60 + ".png"]


@pytest.mark.parametrize("expression", ["(", "a{99999999999}", "(" * 5000 + ")" * 5000, "(?P<1>a)", "a" * 20_000])
def test_expressions_that_are_none(touch, expression):
    with pytest.raises(InputError, match="is no regular expression|write a shorter expression") as raised:
        search(touch(["a.png"]), expression)
    assert len(str(raised.value)) < 300


def test_expressions_that_python_warns_of(touch):
    assert [one.path.name for one in search(touch(["[a.png"]), r"[[]a\.png")] == ["[a.png"]
