"""Tables are made once and shared; what stands in for numbers is never kept."""

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from torchdeform.core.grid import Grid
from torchdeform.core.tables import kept
from torchdeform.core.warp import warp
from torchdeform.deformation.monitors import smooth
from torchdeform.fem.div_curl import solve_div_curl
from torchdeform.metrics.correlation import lncc
from torchdeform.nn import DivCurlVelocity
from torchdeform.registration.affine.lie import rotations

GRID = Grid((11, 13), (1.1, 0.9))


@pytest.fixture
def made():
    """Return a table and the list of the arguments that it was made for."""
    calls: list[int] = []

    @kept(2)
    def count(n: int) -> torch.Tensor:
        calls.append(n)
        return torch.arange(n, dtype=torch.float32)

    return count, calls


def test_a_table_is_made_once_and_the_last_few_are_kept(made):
    count, calls = made
    assert count(3) is count(3)
    count(4), count(5), count(3)
    assert calls == [3, 4, 5, 3]
    assert count.__name__ == "count"


def test_whoever_asks_first_a_table_can_be_used_with_gradients(made):
    count, _ = made
    with torch.inference_mode():
        first = count(3)
    assert not first.is_inference()
    assert not first.requires_grad
    x = torch.ones(3, requires_grad=True)
    (x * count(3)).sum().backward()
    assert torch.equal(x.grad, torch.arange(3.0))


def test_fake_tables_stay_in_their_mode(made):
    count, _ = made
    with FakeTensorMode():
        assert type(count(3)) is not torch.Tensor
    assert type(count(3)) is torch.Tensor
    with FakeTensorMode():
        assert type(count(3)) is not torch.Tensor


def test_tables_of_a_transformation_are_not_kept(made):
    count, calls = made
    torch.func.grad(lambda x: (x * count(3)).sum())(torch.ones(3))
    count(3)
    assert calls == [3, 3]


def test_a_look_with_fake_tensors_leaves_the_library_as_it_was():
    """The first call of all is a fake one: memory estimates and `torch.export` make such calls."""
    image = torch.rand(1, 1, *GRID.shape)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        fake = mode.from_tensor(image)
        for call in _calls(fake):
            try:
                call()
            except RuntimeError:  # what looks at numbers cannot be faked
                continue
    for call in _calls(image):
        value = call()
        assert type(value) is torch.Tensor
        assert value.isfinite().all()


def _calls(image: torch.Tensor):
    return (
        lambda: lncc(image, image.flip(2)),
        lambda: solve_div_curl(image, None, GRID).value,
        lambda: solve_div_curl(image, None, GRID, solver="cg").value,
        lambda: DivCurlVelocity(GRID)(image),
        lambda: smooth(image, GRID, 1.0),
        lambda: warp(image, image.expand(-1, 2, -1, -1) * 0, GRID),
        lambda: rotations(3),
    )
