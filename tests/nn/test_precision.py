"""Inside mixed precision: at least float32 goes in, autocast is off, whole numbers and wider types stay."""

import pytest
import torch

from torchdeform.nn.precision import full_precision


@full_precision
def product(a: torch.Tensor, b: torch.Tensor, *, shift: torch.Tensor | None = None) -> torch.Tensor:
    return a @ b if shift is None else a @ b + shift


@pytest.mark.parametrize(
    ("given", "inside"),
    [(torch.bfloat16, torch.float32), (torch.float16, torch.float32), (torch.float64, torch.float64)],
)
def test_at_least_float32_goes_in(given, inside):
    a = torch.ones(2, 2, dtype=given)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert (a @ a).dtype in (torch.bfloat16, torch.float64)
        assert product(a, a).dtype == inside
        assert product(a, b=a, shift=a).dtype == inside


def test_whole_numbers_and_the_name_stay():
    assert full_precision(lambda labels: labels)(torch.ones(2, dtype=torch.int16)).dtype == torch.int16
    assert product.__name__ == "product"
