"""YAML, JSON and tables: what PyYAML and json read, and one sentence, soon, for what would stop them."""

import json
import math

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from torchdeform.errors import InputError
from torchdeform.io.texts import csv_rows, parse_json, parse_yaml, read_json, yaml_lines

TEXTS = st.text(st.characters(codec="utf-8", exclude_characters="\0"))
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False, allow_infinity=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=20,
)


@given(PLAIN)
def test_plain_values_come_back(value):
    """What PyYAML and json write is read as they read it."""
    text = yaml.safe_dump(value, allow_unicode=True)
    assert parse_yaml(text, "a") == yaml.safe_load(text)
    assert parse_json(json.dumps(value), "a", "file") == value
    assert parse_json(json.dumps(value, ensure_ascii=False), "a", "file") == value


@pytest.mark.parametrize(
    "text",
    [
        "",
        "# nothing",
        "a: yes\nb: off\nc: ~\nd: 0x1f\ne: 1_000\nf: .5\ng: 1e-6\nh: 1.5e+3",
        "a: &x {k: 1, l: 2}\nb: {<<: *x, l: 3}\nc:\n  <<: *x\n  m: 4",
        "a: &x {k: 1}\nb: &y {k: 2, l: 3}\nc: {<<: [*x, *y], m: 5}\nd: {m: 1, <<: *y}",
        "a: &x {k: {n: 1}}\nb: &y {<<: *x, l: 1}\nc: {<<: *y}",
        "- &a [1, 2]\n- *a\n- {b: *a}",
        "a: !!str 5\nb: !!float 3\nc: !!int '7'",
        "a: |\n  two\n  lines\nb: >\n  one\n  line",
        "{a: [1, {b: [2, {c: [3]}]}]}",
    ],
)
def test_yaml_as_pyyaml_reads_it(text):
    assert parse_yaml(text, "a") == yaml.safe_load(text)


def test_values_that_are_texts_here():
    """Dates, sound ones too, and a lone =, which PyYAML makes objects of or refuses."""
    assert parse_yaml("[2024-12-31, 2024-31-12, 2024-12-31 10:00:00, =]", "a") == [
        "2024-12-31", "2024-31-12", "2024-12-31 10:00:00", "=",
    ]  # fmt: skip
    assert math.isinf(parse_yaml(".inf", "a"))
    assert math.isnan(parse_yaml(".nan", "a"))


def test_whole_numbers_as_keys_are_texts():
    """As labels are written; nothing else that YAML reads is a name."""
    assert parse_yaml("{1: a, 0x10: {2: b}, '3': c}", "a") == {"1": "a", "16": {"2": "b"}, "3": "c"}


def multiplied(levels: int) -> str:
    first = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]"
    return "\n".join([first, *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, levels))])


def merged(levels: int) -> str:
    first = "a0: &a0 {" + ", ".join(f"k{n}: 1" for n in range(10)) + "}"
    return "\n".join([first, *(f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 10)}]}}" for k in range(1, levels))])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (multiplied(12), "line 6: there are more than 1000000 entries"),
        (merged(12), "there are more than 1000000 entries"),
        ("a: &a [*a]", r"line 1: \*a stands inside of itself"),
        ("a: &a\n  b: {<<: *a}", r"line 2: \*a stands inside of itself"),
        ("a: " + "[" * 100_000, "line 1: there are more than 50 levels"),
        ("- " * 100_000, "line 1: there are more than 50 levels"),
        ("a: 1\nb: 2\na: 3", "at line 3: a is given twice"),
        ("a: {b: 1, b: 2}", "at line 1: b is given twice"),
        ("x: &x {a: 1}\ny: {<<: *x, <<: *x}", "at line 2: << is given twice"),
        ("a: {<<: 5}", "<< takes a mapping"),
        ("a: " + "9" * 400, "at line 1: a number of too many digits is too large a number"),
        ("a: " + "9" * 5000, "a number of 5000 digits is too long"),
        ("a: 0x" + "f" * 100_000, "digits is too long"),
        ("a: 1" + ":59" * 100_000, "digits is too long"),
        ("a: 18446744073709551616", "18446744073709551616 is too large a number"),
        ("true: 1", "the key True is no text; write it in quotes"),
        ("5.5: 1", "the key 5.5 is no text"),
        ("5: 1\n'5': 2", "5 is given twice"),
        ("? [a, b]\n: c", "the key .* is no text"),
        ("? {a: b}\n: c", "the key .* is no text"),
        ('a: "\\0"', "has a character that no file and no name can have"),
        ("a: \udcff", "file.yaml has a character that no file and no name can have"),
        ('a: "\\ud800"', "is no valid YAML at line 1"),
        ("a: \x07", "control characters are not allowed|special characters"),
        ("a: !!python/object/apply:os.system [ls]", "is an object of a program; write plain values"),
        ("!!python/name:os.system a", "is an object of a program"),
        ("a: !!binary aGVsbG8=", "is an object of a program"),
        ("a: !!timestamp 2024-31-12", "is an object of a program"),
        ("a: !!set {b, c}", "is an object of a program"),
        ("a: !include x", "is an object of a program"),
        ("a: !!int x", "'x' is no int"),
        ("a: !!float x", "'x' is no float"),
        ("a: !!bool x", "'x' is no bool"),
        ("a: *b", "at line 1: found undefined alias"),
        ("a: [1\n\n\n", "at line 1: "),
        ("a: 1\n---\nb: 2", "another document"),
        ("a: b: c", "mapping values are not allowed"),
    ],
    ids=range(37),
)
def test_yaml_that_is_refused(text, sentence):
    with pytest.raises(InputError, match=sentence) as raised:
        parse_yaml(text, "file.yaml")
    assert str(raised.value).startswith("file.yaml")
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 200


def test_lines_of_keys_and_items():
    lines = yaml_lines("a: &b\n  c: 1\nd:\n  - e\n  - <<: *b\n    f: 2\n", "a")
    assert lines == {
        ("a",): 1, ("a", "c"): 2, ("d",): 3, ("d", 0): 4, ("d", 1): 5, ("d", 1, "f"): 6, ("d", 1, "c"): 2,
    }  # fmt: skip
    assert yaml_lines("", "a") == {}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "Expecting value"),
        ("{", "Expecting property name"),
        ("[" * 100_000, "too many levels"),
        ('{"a": ' * 100_000, "too many levels"),
        ("9" * 400, "a number of 400 digits"),
        ("9" * 5000, "a number of 5000 digits"),
        ("1e999", "'1e999' is no finite number"),
        ("NaN", "'NaN' is no finite number"),
        ("[-Infinity]", "'-Infinity' is no finite number"),
        ('["\\ud800"]', "has a character that no file and no name can have"),
        ('{"\\ud800": 1}', "has a character"),
        ('{"a": ["\\u0000"]}', "has a character"),
    ],
    ids=range(12),
)
def test_json_that_is_refused(tmp_path, text, sentence):
    path = tmp_path / "a.json"
    path.write_text(text + "\n", encoding="utf-8")
    with pytest.raises(InputError, match=rf"a.json is no valid JSON \(.*{sentence}.*\); give a result.json$") as raised:
        read_json(path, "result.json")
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 300


def test_rows_with_their_lines():
    text = 'a,b\r\n\r\n"x\ny",2\n , \n3\n'
    assert list(csv_rows(text, "t.csv", ",")) == [(1, ["a", "b"]), (4, ["x\ny", "2"]), (6, ["3"])]
    with pytest.raises(InputError, match=r"t.csv line \d+: field larger than field limit .*; check the quotes there"):
        list(csv_rows("a,b\n1," + '"' + "x" * 200_000, "t.csv", ","))
