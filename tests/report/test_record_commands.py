"""The commands that a page shows: a shell takes them apart into what was meant."""

import shlex
from pathlib import Path

import pytest
from nested_settings import settings_of

from torchdeform.core.memory import parse_size
from torchdeform.pipeline.config import load_settings, parse_override, preset_names
from torchdeform.registration.settings import RegistrationSettings
from torchdeform.report.record import apply_commands, changed, repeat_command

FILES = {"fixed": "a b.png", "moving": "it's.png", "out": "$HOME", "fixed_points": "p.csv"}


@pytest.mark.parametrize(
    "settings",
    [
        *map(load_settings, preset_names()),
        settings_of(similarity={"lncc": 1.0, "mi": 0.5}, tolerance=1e-6, symmetric=True, length_scale=7.0),
        RegistrationSettings(tissues={1: "rigid", 12: {"div": 100.0, "strain": 10.0, "curl": 0.0}}, sliding=(3, 1)),
    ],
)
def test_the_settings_come_back(settings):
    words = shlex.split(repeat_command(FILES, settings, "cpu"))
    given = [words[k + 1] for k, word in enumerate(words) if word == "--set"]
    assert load_settings("default", None, dict(map(parse_override, given))) == settings


def test_the_files_come_back():
    words = shlex.split(repeat_command(FILES, RegistrationSettings(), "cuda", 3_000_000_001))
    assert words[:3] == ["register", "a b.png", "it's.png"]
    assert words[3:] == ["--out", "$HOME", "--fixed-points", "p.csv", "--device", "cuda", "--memory", "3000000001B"]
    assert parse_size(words[-1]) == 3_000_000_001


def test_only_what_differs_is_named():
    assert changed(RegistrationSettings()) == {}
    assert changed(settings_of(window=7)) == {"similarity.window": 7}


def test_the_result_can_be_applied():
    """Every line is one of a verb that exists, with options that it has."""
    from torchdeform.cli.main import VERBS

    for line in apply_commands(FILES, Path("my results")).values():
        words = shlex.split(line)
        assert words[0] == "torchdeform"
        assert words[1] in VERBS
        assert Path(words[2]).parent == Path("my results")
        options = [word for word in words if word.startswith("--")]
        known = {f"--{name}" for name in VERBS[words[1]].run.__annotations__}
        assert set(options) <= known
