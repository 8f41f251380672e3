"""The shell is pleasant: help that fits a screen, records for programs, completion, no colours in a pipe."""

import json
import os
import re
import shlex
import subprocess
import sys

import pytest
import torch

from torchdeform import __version__
from torchdeform.cli.main import VERBS, main, torchdeform
from torchdeform.core.transform import Transform
from torchdeform.io import write_displacement, write_image
from torchdeform.io.transforms import write_transform
from torchdeform.pipeline.config import preset_names

LINES, COLUMNS = 42, 100


@pytest.fixture
def screen(monkeypatch):
    """A screen of usual size."""
    for name in ("COLUMNS", "TERMINAL_WIDTH"):
        monkeypatch.setenv(name, str(COLUMNS))


@pytest.fixture
def folder(tmp_path, monkeypatch, make_image, make_displacement):
    """A working folder with two images, labels, and the transform between them."""
    monkeypatch.chdir(tmp_path)
    fixed, moving = make_image((24, 26), name="fixed"), make_image((25, 24), origin=(1.0, -1.0), name="moving")
    u = make_displacement(fixed.grid)
    for name, image in (("fixed", fixed), ("moving", moving)):
        write_image(image, f"{name}.nii.gz")
    labels = torch.zeros_like(fixed.data)
    labels[..., 8:16, 8:16] = 1
    write_image(make_image((24, 26)).__class__(labels, fixed.grid, pixel_type="uint8"), "labels.png")
    write_transform(Transform.from_displacement(u, fixed, moving=moving), "transform.h5")
    write_displacement(u, fixed, "displacement.nii.gz")
    return tmp_path


def test_every_verb_has_its_line_and_example():
    assert all(verb.summary and verb.example for verb in VERBS.values())


@pytest.mark.parametrize("verb", VERBS)
def test_help_fits_a_screen_and_has_an_example(verb, screen, capsys):
    assert torchdeform([verb, "--help"]) == 0
    lines = capsys.readouterr().out.strip("\n").splitlines()
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= COLUMNS
    assert any(line.strip().startswith("Example: ") for line in lines)


def test_the_list_of_verbs_has_a_line_each(screen, capsys):
    assert torchdeform(["--help"]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) <= LINES
    assert all(verb.summary in out for verb in VERBS.values())


@pytest.mark.parametrize("verb", VERBS)
def test_examples_parse(verb, tmp_path, monkeypatch, capsys):
    """They fail on their files, which are not there, not on their words."""
    monkeypatch.chdir(tmp_path)
    words = shlex.split(VERBS[verb].example)
    assert words[:2] == ["torchdeform", verb]
    assert torchdeform(words[1:]) == (0 if verb == "schema" else 2)
    assert "--help" not in capsys.readouterr().err


def test_the_short_command_has_a_short_example(screen, capsys):
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    assert "Example: register fixed" in out
    assert len(out.strip("\n").splitlines()) <= LINES


def test_version_names_what_results_depend_on(capsys):
    assert torchdeform(["--version"]) == 0
    out = capsys.readouterr().out.strip()
    assert re.fullmatch(
        rf"torchdeform {re.escape(__version__)}, torch {re.escape(torch.__version__)}, (cpu|cuda .+)", out
    )


def fresh(code: str, **variables: str) -> str:
    """Return what a fresh interpreter prints, in a pipe."""
    command = [sys.executable, "-c", f"import sys; from torchdeform.cli.main import torchdeform; {code}"]
    done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_completion_is_printed():
    """For the shell that is named: which one called is nothing that a test can know."""
    named = {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    script = fresh("sys.exit(torchdeform(['--show-completion', 'bash']))", **named)
    assert "complete -o default -F _torchdeform_completion torchdeform" in script


def test_no_colours_in_a_pipe(folder):
    lines = [["--help"], ["register", "--help"], ["check", "fixed.nii.gz", "moving.nii.gz"], ["check", "no.png", "x"]]
    text = fresh(f"[torchdeform(words) for words in {lines!r}]")
    assert "no.png" in text
    assert "\x1b[" not in text


@pytest.mark.parametrize("program", [main, torchdeform])
def test_version_and_help(program, capsys):
    assert program(["--version"]) == 0
    assert capsys.readouterr().out.startswith(f"torchdeform {__version__}, torch {torch.__version__}, ")
    assert program(["--help"]) == 0
    assert "Usage" in capsys.readouterr().out


def test_no_command_shows_the_help(capsys):
    assert torchdeform([]) == 2
    out, err = capsys.readouterr()
    assert "register" in out + err
    assert "Traceback" not in out + err


RECORDS = {
    "register fixed.nii.gz moving.nii.gz --out out --set 'optimiser.steps=[2]'": {
        "folds",
        "settings",
        "files",
        "out",
        "seconds",
    },
    "check fixed.nii.gz moving.nii.gz": {"fixed", "moving", "findings", "picture"},
    "check fixed.nii.gz moving.nii.gz --out o.png": {"fixed", "moving", "findings", "picture"},
    "jacobian transform.h5 --out j.nii.gz": {"determinant_min", "determinant_max", "determinant_mean", "folds", "out"},
    "invert transform.h5 --out i.h5": {"inverse_error_mean", "inverse_error_max", "out"},
    "grid fixed.nii.gz --out g": {"folds", "determinant_error_mean", "out"},
    "reconstruct displacement.nii.gz --out r": {"distance_max", "out"},
    "simulate labels.png --labels labels.png --volume 1=0.9 --out s": {"volumes", "out"},
}


@pytest.mark.parametrize(("line", "keys"), RECORDS.items(), ids=lambda v: v.split()[0] if isinstance(v, str) else "")
def test_records_for_programs(line, keys, folder, capsys):
    """One line of JSON on standard output, nothing else, also with --quiet."""
    for extra in ([], ["--quiet"] if not line.startswith("check") else []):
        assert torchdeform([*shlex.split(line), "--json", *extra]) == 0
        out, err = capsys.readouterr()
        assert out.count("\n") == 1
        assert err == ""
        record = json.loads(out)
        assert keys <= set(record)
    if line.startswith("register"):
        assert (folder / record["out"] / "result.json").is_file()


def test_an_error_is_no_record(folder, capsys):
    assert torchdeform(["check", "fixed.nii.gz", "labels.txt", "--json"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1


def test_completion_knows_values():
    """What bash asks when the tab key is pressed."""
    line = {"COMP_WORDS": "torchdeform register --preset ", "COMP_CWORD": "3"}
    found = fresh("sys.exit(torchdeform())", _TORCHDEFORM_COMPLETE="complete_bash", **line)
    assert found.split() == preset_names()


@pytest.mark.parametrize(("program", "before"), [(main, []), (torchdeform, ["check"])])
def test_an_empty_argument_is_not_the_folder_that_the_shell_is_in(program, before, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert program([*before, "", "moving.nii.gz", "--out", ""]) == 2
    assert f"argument {len(before) + 1}" in (said := capsys.readouterr().err)
    assert "is empty; check the variable or the quotes" in said
    assert not list(tmp_path.iterdir())
