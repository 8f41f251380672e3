"""The programs say that they load, on a terminal only, and take it back."""

import os
import subprocess
import sys

import pytest

pty = pytest.importorskip("pty")


def shown(*arguments: str, **environment: str) -> str:
    """Run the program with a terminal as its standard error, and return what that shows."""
    ours, theirs = pty.openpty()
    line = "import sys; from torchdeform.cli.start import torchdeform; sys.exit(torchdeform())"
    command = [sys.executable, "-c", line, *arguments]
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=theirs, env=os.environ | environment, check=True)
    os.write(theirs, b"|")
    found = ""
    while not found.endswith("|"):
        found += os.read(ours, 4096).decode()
    os.close(ours)
    os.close(theirs)
    return found


def test_loading_is_shown_and_taken_back():
    assert shown("--version") == "loading ...\r\x1b[K|"


def test_nothing_is_shown_where_nobody_looks():
    assert shown("apply", "--quiet", "--help") == "|"
    assert shown(_TORCHDEFORM_COMPLETE="source_bash") == "|"


def test_a_pipe_gets_no_word(capfd):
    from torchdeform.cli.start import _loading

    with _loading():
        pass
    assert capfd.readouterr() == ("", "")
