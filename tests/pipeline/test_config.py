"""Settings: every way to give them, and every way to give them wrongly."""

from dataclasses import asdict

import pytest

from torchdeform.errors import InputError
from torchdeform.pipeline.config import (
    configs_folder,
    load_settings,
    merged_settings,
    parse_override,
    preset_names,
    read_yaml,
    read_yaml_lines,
)
from torchdeform.registration.settings import RegistrationSettings


def _file(folder, text):
    path = folder / "settings.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_default_preset_is_the_librarys_default():
    assert load_settings() == RegistrationSettings()


def test_default_preset_shows_every_setting():
    """The file is also the list of what can be set."""
    shown = read_yaml(configs_folder() / "presets" / "default.yaml")
    known = asdict(RegistrationSettings())
    assert set(shown) == set(known)
    for name, group in known.items():
        if isinstance(group, dict):
            assert set(shown[name]) == set(group)


@pytest.mark.parametrize("name", preset_names())
def test_presets_load(name):
    assert isinstance(load_settings(name), RegistrationSettings)


def test_later_layers_win(tmp_path):
    file = _file(tmp_path, "similarity: {window: 7}\noptimiser: {steps: [5, 5], momentum: 0.1}\nflow: rk4")
    settings = load_settings("fast", file, {"optimiser.steps": [3], "flow.steps": 2})
    assert (settings.similarity.window, settings.optimiser.steps, settings.optimiser.momentum) == (7, (3,), 0.1)
    assert (settings.flow.method, settings.flow.steps) == ("rk4", 2)


@pytest.mark.parametrize(
    ("given", "tissues"),
    [
        ({}, {1: {"div": 3.0, "strain": 5.0}, 2: "stiff"}),
        ({"tissues.1": "rigid"}, {1: "rigid", 2: "stiff"}),
        ({"tissues.1": {"div": 9}}, {1: {"div": 9.0}, 2: "stiff"}),
        ({"tissues.1.div": "1e4"}, {1: {"div": 1e4, "strain": 5.0}, 2: "stiff"}),
        ({"tissues.2.div": 9, "tissues.2.strain": 1}, {1: {"div": 3.0, "strain": 5.0}, 2: {"div": 9.0, "strain": 1.0}}),
        ({"tissues": {"1": {"div": 9}, 3: "free"}}, {1: {"div": 9.0}, 2: "stiff", 3: "free"}),
    ],
)
def test_a_label_is_one_whoever_names_it(tmp_path, given, tissues):
    """In YAML, after a dot, and in Python; prices that are given as a whole take the place of others."""
    file = _file(tmp_path, "tissues: {1: {div: 3, strain: 5}, 2: stiff}\nsliding: 2")
    settings = load_settings(file=file, overrides=given)
    assert (settings.tissues, settings.sliding) == (tissues, (2,))
    merged = merged_settings({"tissues": {"1": {"div": 3, "strain": 5}, "2": "stiff"}}, given)
    assert load_settings(overrides=merged).tissues == tissues


@pytest.mark.parametrize("label", [True, 1.5, None, 10**30, "1.5", "", " 1"])
def test_only_whole_numbers_are_labels(label):
    with pytest.raises(InputError, match=r"settings: tissues: .* is no label"):
        load_settings(overrides={"tissues": {label: "rigid"}})


def test_empty_file_changes_nothing(tmp_path):
    assert load_settings(file=_file(tmp_path, "# nothing\n")) == RegistrationSettings()


@pytest.mark.parametrize(
    ("text", "value"),
    [("3", 3), ("1e-6", "1e-6"), ("[40, 20]", [40, 20]), ("ssd", "ssd"), ("true", True), ("0.5", 0.5)],
)
def test_overrides_are_yaml(text, value):
    assert parse_override(f"some.key={text}") == ("some.key", value)


def test_numbers_that_yaml_takes_for_text_are_numbers():
    assert load_settings(overrides={"similarity.window": "7"}).similarity.window == 7


@pytest.mark.parametrize("text", ["window", "=3", "window=[1"])
def test_malformed_overrides(text):
    with pytest.raises(InputError, match="--set"):
        parse_override(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("similarity: {windw: 5}", r"yaml: there is no setting 'similarity.windw'; did you mean 'similarity.window'\?"),
        ("windw: 5", r"settings.yaml: there is no setting 'windw'; did you mean 'similarity.window'\?"),
        ("steps: [5]", r"settings.yaml: there is no setting 'steps'; did you mean 'optimiser.steps'\?"),
        ("metric: 5", r"settings.yaml: metric is a group of settings \(weight_div, .*got 5"),
        ("solver: {methd: cg}", r"settings.yaml: there is no setting 'solver.methd'; did you mean 'solver.method'\?"),
        ("solver: gc", r"settings.yaml: solver must be one of auto.*did you mean 'cg'"),
        ("similarity: {window: abc}", r"settings.yaml: similarity.window = 'abc'"),
        ("similarity: {window: 5.5}", r"settings.yaml: similarity.window = 5.5"),
        ("similarity: {window: 4}", "settings.yaml: similarity.window must be an odd number"),
        ("similarity: lnc", "similarity"),
        ("optimiser: {steps: [10, a]}", r"optimiser.steps.1 = 'a'"),
        ("window: 5\nwindow: 7", r"settings.yaml is no valid YAML at line 2: window is given twice"),
        ("window: [5", r"settings.yaml is no valid YAML at line 1"),
        ("optimiser: {steps: 2024-31-12}", r"optimiser.steps = '2024-31-12'"),
        ("optimiser: {step_length: .inf}", "optimiser.step_length must"),
        ("optimiser: {step_length: .nan}", "optimiser.step_length must"),
        ("optimiser: {step_length: 1e999}", "optimiser.step_length must"),
        (f"optimiser: {{step_length: {'9' * 400}}}", "is too large a number"),
        (f"{'a.' * 300}b: 1", r"there is no setting 'a'"),
        ("- window", "must hold 'key: value' lines"),
        ("5: window", "settings.yaml: there is no setting '5'"),
        ("5.5: window", "at line 1: the key 5.5 is no text; write it in quotes"),
        ("keypoints: {reach: 5}", r"settings.yaml: keypoints.reach = 5: Input should be a list, such as \[40, 20\]"),
        ("similarity: {lncc: x}", r"settings.yaml: similarity.measure.lncc = 'x': Input should be a valid number"),
        ("tissues: rigid", r"settings.yaml: tissues gives each label its kind, such as \{1: rigid\}, got 'rigid'"),
        ("tissues:", "settings.yaml: tissues gives each label its kind, .*, got None"),
        ("tissues: {bone: rigid}", "settings.yaml: tissues: 'bone' is no label, which is a whole number from 1"),
        ("tissues: {-1: rigid}", "settings.yaml: tissues: '-1' is no label"),
        ("tissues: {0: rigid}", "settings.yaml: tissues: labels are whole numbers from 1"),
        ("tissues: {1: rigd}", r"settings.yaml: tissues: label 1 must be one of .*; did you mean 'rigid'\?"),
        ("tissues: {1: [rigid]}", r"settings.yaml: tissues: label 1 is one of free, .*, got \['rigid'\]"),
        ("tissues: {1: {dvi: 3}}", r"tissues: label 1 must be one of div, strain, curl, .*did you mean 'div'\?"),
        ("tissues: {1: {div: x}}", "settings.yaml: tissues.1.div = 'x': Input should be a valid number"),
        ("tissues: {1: {div: -1}}", "settings.yaml: tissues: label 1: div must be finite and positive, got -1"),
        ("tissues: {1: rigid, '1': free}", "at line 1: 1 is given twice"),
        ("sliding: [lung]", "settings.yaml: sliding.0 = 'lung': Input should be a valid integer"),
        ("sliding: [0]", "settings.yaml: sliding: labels are whole numbers from 1"),
        ("window: !!python/object/apply:os.getcwd []", "is no valid YAML"),
    ],
)
def test_wrong_files_are_explained(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        load_settings(file=_file(tmp_path, text))


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(InputError, match=r"no\.yaml does not exist"):
        load_settings(file=tmp_path / "no.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"binary.yaml is no text"):
        load_settings(file=tmp_path / "binary.yaml")


def test_unknown_names_get_the_nearest():
    with pytest.raises(InputError, match="did you mean 'fast'"):
        load_settings("fst")
    with pytest.raises(InputError, match=r"window = \{'size': 3\}"):
        load_settings(overrides={"similarity.window.size": 3})
    with pytest.raises(InputError, match="did you mean 'similarity'"):
        load_settings(overrides={"similarty": "ssd"})


def test_lines_of_keys(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("a: &b\n  c: 1\nd:\n  - e\n  - <<: *b\n    f: 2\n", encoding="utf-8")
    lines = read_yaml_lines(path)
    assert lines[("a",)] == 1
    assert lines[("a", "c")] == 2
    assert lines[("d", 1)] == 5
    assert lines[("d", 1, "f")] == 6
    assert lines[("d", 1, "c")] == 2
