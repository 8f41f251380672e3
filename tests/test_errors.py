"""Errors: their kinds, and what they suggest."""

import errno
import os
import pickle

import pytest

from torchdeform.errors import (
    ComputationError,
    InputError,
    MachineError,
    TorchdeformError,
    explain,
    nearest_name,
    of_machine,
    require_choice,
)


def test_errors_say_what_was_meant():
    assert issubclass(InputError, TorchdeformError)
    assert issubclass(InputError, ValueError)
    assert issubclass(ComputationError, RuntimeError)
    assert nearest_name("linaer", ["linear", "nearest"]) == "; did you mean 'linear'?"
    assert nearest_name("zzz", ["linear", "nearest"]) == ""
    require_choice(2, (2, 4), "order")
    with pytest.raises(InputError, match=r"^order must be one of 2, 4, got 3$"):
        require_choice(3, (2, 4), "order")
    with pytest.raises(InputError, match=r"^mode must be .* got 'linaer'; did you mean 'linear'\?$"):
        require_choice("linaer", ("linear", "nearest"), "mode")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.ESTALE])
def test_what_the_machine_fails_at_is_found_behind_other_errors(number):
    disk = OSError(number, os.strerror(number), "/data/a.png")
    error = InputError("/data/a.png is damaged")
    error.__cause__ = disk
    assert of_machine(error) is disk
    assert explain(error) == (f"/data/a.png: {os.strerror(number)}; {_ADVICE}", 1)
    assert of_machine(MachineError("no room")) is not None
    assert explain(MachineError("no room")) == ("no room", 1)


_ADVICE = "mend that, or make room, and run the same command again"


def test_other_errors_are_not_the_machine_s():
    for error in (OSError(errno.ENOENT, "x"), InputError("x"), PermissionError(errno.EACCES, "x"), OSError("x"), None):
        assert of_machine(error) is None
    error = InputError("about something else, raised from None")
    error.__context__, error.__suppress_context__ = OSError(errno.EIO, "Input/output error"), True
    assert of_machine(error) is None
    error.__suppress_context__ = False
    assert of_machine(error) is not None


def test_a_failure_of_the_machine_crosses_processes():
    again = pickle.loads(pickle.dumps(MachineError("no room")))
    assert isinstance(again, MachineError)
    assert str(again) == "no room"
