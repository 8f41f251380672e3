"""Errors: their kinds, and what they suggest."""

import pytest

from torchdeform.errors import ComputationError, InputError, TorchdeformError, nearest_name, require_choice


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
