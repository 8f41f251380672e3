"""Tables of numbers that are made once and kept, as long as torch computes with real numbers."""

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import ParamSpec, TypeVar

import torch

_Key = ParamSpec("_Key")
_Table = TypeVar("_Table")


def kept(most: int) -> Callable[[Callable[_Key, _Table]], Callable[_Key, _Table]]:
    """Return a decorator that keeps the last so many results of a function of hashable arguments.

    Args:
        most: how many.

    Notes:
        Results are shared, not to be written to. They want no gradient and are no inference tensors.
        Where something stands in for numbers (fake tensors, `torch.export`, `torch.func`) a table is of use there only:
        it is made anew and not kept.
    """

    def decorate(make: Callable[_Key, _Table]) -> Callable[_Key, _Table]:
        @wraps(make)
        def plain(*key: _Key.args, **named: _Key.kwargs) -> _Table:
            with torch.inference_mode(False), torch.no_grad():
                return make(*key, **named)

        remembered = lru_cache(maxsize=most)(plain)

        @wraps(make)
        def table(*key: _Key.args, **named: _Key.kwargs) -> _Table:
            return remembered(*key, **named) if numbers_are_real() else plain(*key, **named)

        return table

    return decorate


# What torch switches on where tensors go through a mode of Python, and through a transformation of `torch.func`.
_MODE, _TRANSFORMATION = torch._C.DispatchKey.Python, torch._C.DispatchKey.FuncTorchDynamicLayerFrontMode


def numbers_are_real() -> bool:
    """Tell whether a tensor made now holds numbers; the public way, to make one and look, takes ten times as long."""
    if torch.compiler.is_compiling():
        return False
    return not (torch._C._dispatch_tls_is_dispatch_key_included(_MODE) or in_transformation())


def in_transformation() -> bool:
    """Tell whether `torch.func` transforms what is computed: grad, jacrev, vmap and their like."""
    return not torch.compiler.is_compiling() and torch._C._dispatch_tls_is_dispatch_key_included(_TRANSFORMATION)
