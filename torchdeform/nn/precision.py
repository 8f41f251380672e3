"""Numbers of at least 32 bits inside mixed-precision training: solves and correlations are beyond fewer."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from torchdeform.metrics.base import at_least_float32

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def full_precision(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return the function with autocast switched off, floating tensors of fewer bits being taken to float32 before."""

    @wraps(function)
    def careful(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        given = [_widened(a) for a in arguments]
        named = {name: _widened(a) for name, a in options.items()}
        device = next((a.device.type for a in (*given, *named.values()) if isinstance(a, Tensor)), "cpu")
        with torch.autocast(device, enabled=False):
            return function(*given, **named)  # type: ignore[arg-type]

    return careful


def _widened(argument: object) -> object:
    return at_least_float32(argument) if isinstance(argument, Tensor) and argument.is_floating_point() else argument
