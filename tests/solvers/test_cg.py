"""Conjugate gradients against dense solves: stopping, freezing, failures as values, implicit derivatives."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.errors import InputError
from torchdeform.solvers.base import Status
from torchdeform.solvers.cg import Operator, conjugate_gradient

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def spd(size: int, condition: float = 100.0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Return a random symmetric matrix with eigenvalues from 1 to ``condition``."""
    basis = torch.linalg.qr(torch.randn(size, size, dtype=torch.float64)).Q
    values = torch.logspace(0, math.log10(condition), size, dtype=torch.float64)
    return ((basis * values) @ basis.T).to(dtype)


def product(x: Tensor, matrix: Tensor) -> Tensor:
    """Apply the matrix to every item, one product each, so that an item does not feel its batch.

    To the last bit, as items of 8, 40 or so numbers in float64 start at multiples of 64 bytes in a batch as they do
    alone: the kernel of a product may depend on that.
    """
    return torch.stack([(matrix @ item.flatten()).view(item.shape) for item in x])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_solves_what_a_dense_solver_solves(dtype, device):
    matrix = spd(30, dtype=dtype).to(device)
    b = torch.randn(4, 5, 6, dtype=dtype, device=device)
    solution = conjugate_gradient(lambda x: product(x, matrix), b)
    want = torch.linalg.solve(matrix, b.flatten(1).T).T.view(b.shape)
    tolerance = {torch.float32: 1e-3, torch.float64: 1e-8}[dtype]
    torch.testing.assert_close(solution.value, want, atol=tolerance, rtol=tolerance)
    assert solution.ok
    assert solution.value.dtype == dtype
    assert bool((solution.residual <= {torch.float32: 1e-5, torch.float64: 1e-10}[dtype]).all())


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 20), st.integers(1, 4), st.floats(1.0, 1e4), st.integers(-30, 30), st.randoms())
def test_the_stopping_rule_holds_for_every_item_at_any_scale(size, batch, condition, exponent, random):
    torch.manual_seed(random.randrange(10**6))
    matrix, b = spd(size, condition), torch.randn(batch, size, dtype=torch.float64) * 10.0**exponent
    solution = conjugate_gradient(lambda x: product(x, matrix), b, rtol=1e-9)
    residual = (b - product(solution.value, matrix)).norm(dim=1) / b.norm(dim=1)
    assert solution.ok
    assert bool((residual <= 1.01e-9).all())
    torch.testing.assert_close(solution.residual, residual, rtol=0.1, atol=1e-13)


def test_float32_survives_loads_whose_squares_vanish_or_overflow():
    matrix = spd(10, 10.0, torch.float32)
    for scale in (1e-30, 1e30):
        b = torch.randn(2, 10) * scale
        solution = conjugate_gradient(lambda x: product(x, matrix), b)
        assert solution.ok
        torch.testing.assert_close(product(solution.value, matrix) / scale, b / scale, rtol=1e-4, atol=1e-4)


def test_a_batch_equals_its_items_one_by_one_with_a_hard_one_among_them():
    matrix = spd(40, 1e4)
    easy = torch.linalg.eigh(matrix).eigenvectors[:, 3]
    b = torch.stack([easy, torch.randn(40, dtype=torch.float64), torch.zeros(40, dtype=torch.float64), easy * 1e3])
    b = torch.cat([b, torch.randn(3, 40, dtype=torch.float64)])
    jacobi = 1 / matrix.diagonal()
    for preconditioner in (None, lambda r: r * jacobi):
        together = conjugate_gradient(lambda x: product(x, matrix), b, preconditioner=preconditioner)
        for i in range(len(b)):
            alone = conjugate_gradient(lambda x: product(x, matrix), b[i : i + 1], preconditioner=preconditioner)
            assert torch.equal(together.value[i], alone.value[0])
            assert together.steps[i] == alone.steps[0]
            assert together.residual[i] == alone.residual[0]
            assert together.status[i] is alone.status[0]
    assert len(set(together.steps.tolist())) > 2


def test_zero_gives_zero_in_no_step_wherever_it_starts():
    matrix = spd(5)
    solution = conjugate_gradient(lambda x: product(x, matrix), torch.zeros(2, 5, dtype=torch.float64))
    assert solution.ok
    assert solution.steps.tolist() == [0, 0]
    assert not solution.value.any()
    start = torch.randn(2, 5, dtype=torch.float64)
    solution = conjugate_gradient(lambda x: product(x, matrix), torch.zeros_like(start), x0=start)
    assert solution.ok
    assert solution.steps.tolist() == [0, 0]
    assert not solution.value.any()


def test_a_start_at_the_solution_takes_no_step():
    matrix, x = spd(6), torch.randn(2, 6, dtype=torch.float64)
    solution = conjugate_gradient(lambda v: product(v, matrix), product(x, matrix), x0=x)
    assert solution.ok
    assert solution.steps.tolist() == [0, 0]
    assert torch.equal(solution.value, x)


def test_an_absolute_tolerance_stops_too():
    matrix, b = spd(20), torch.randn(1, 20, dtype=torch.float64)
    strict = conjugate_gradient(lambda x: product(x, matrix), b, rtol=1e-12)
    loose = conjugate_gradient(lambda x: product(x, matrix), b, rtol=0.0, atol=1e-2)
    assert loose.ok
    assert int(loose.steps) < int(strict.steps)
    assert float((b - product(loose.value, matrix)).norm()) <= 1e-2


def test_it_says_when_steps_run_out():
    matrix, b = spd(30, 1e4), torch.randn(2, 30, dtype=torch.float64)
    solution = conjugate_gradient(lambda x: product(x, matrix), b, max_steps=3)
    assert solution.status == (Status.MAX_STEPS, Status.MAX_STEPS)
    assert not solution.ok
    assert solution.steps.tolist() == [3, 3]
    want = (b - product(solution.value, matrix)).norm(dim=1) / b.norm(dim=1)
    torch.testing.assert_close(solution.residual, want)
    none = conjugate_gradient(lambda x: product(x, matrix), b, max_steps=0)
    assert none.status == (Status.MAX_STEPS, Status.MAX_STEPS)
    assert not none.value.any()


def test_an_indefinite_operator_breaks_down_and_leaves_the_others_alone():
    signs = torch.ones(3, 8, dtype=torch.float64)
    signs[1, ::2] = -1.0
    b = torch.ones(3, 8, dtype=torch.float64)
    solution = conjugate_gradient(lambda x: x * signs, b)
    assert solution.status == (Status.CONVERGED, Status.BREAKDOWN, Status.CONVERGED)
    assert bool(torch.isfinite(solution.value).all())
    torch.testing.assert_close(solution.value[[0, 2]], b[[0, 2]])


def test_an_indefinite_preconditioner_breaks_down():
    matrix, b = spd(8), torch.randn(1, 8, dtype=torch.float64)
    solution = conjugate_gradient(lambda x: product(x, matrix), b, preconditioner=lambda r: -r)
    assert solution.status == (Status.BREAKDOWN,)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_an_item_that_is_not_finite_is_nan_and_leaks_nowhere(bad):
    matrix, b = spd(8), torch.randn(3, 8, dtype=torch.float64)
    clean = conjugate_gradient(lambda x: product(x, matrix), b)
    b[1, 2] = bad
    solution = conjugate_gradient(lambda x: product(x, matrix), b)
    assert solution.status == (Status.CONVERGED, Status.NON_FINITE, Status.CONVERGED)
    assert bool(solution.value[1].isnan().all())
    assert int(solution.steps[1]) == 0
    assert torch.equal(solution.value[[0, 2]], clean.value[[0, 2]])
    start = torch.zeros_like(b).index_fill(0, torch.tensor([2]), bad)
    assert conjugate_gradient(lambda x: product(x, matrix), b, x0=start).status[2] is Status.NON_FINITE


def test_an_operator_that_is_not_finite_on_one_item_leaks_nowhere():
    weights = torch.ones(3, 8, dtype=torch.float64)
    weights[1, 3] = math.nan
    b = torch.randn(3, 8, dtype=torch.float64)
    solution = conjugate_gradient(lambda x: x * weights, b)
    assert solution.status == (Status.CONVERGED, Status.NON_FINITE, Status.CONVERGED)
    assert torch.equal(solution.value[[0, 2]], b[[0, 2]])


def test_rounding_is_called_so_when_a_tolerance_is_out_of_reach():
    matrix, b = spd(30, 1e4, torch.float32), torch.randn(1, 30)
    solution = conjugate_gradient(lambda x: product(x, matrix), b, rtol=1e-12, max_steps=500)
    assert solution.status == (Status.ROUNDING,)
    assert float(solution.residual) < 1e-2
    assert conjugate_gradient(lambda x: x, b, rtol=0.0).ok


def test_starting_again_mends_what_the_recurrence_lost():
    matrix, b = spd(30), torch.randn(1, 30, dtype=torch.float64)
    # From so far away, rounding on the way is above the tolerance.
    start = 1e9 * torch.randn(1, 30, dtype=torch.float64)
    solution = conjugate_gradient(lambda x: product(x, matrix), b, x0=start, rtol=1e-12)
    assert solution.ok
    assert float((b - product(solution.value, matrix)).norm() / b.norm()) <= 1.01e-12


@pytest.mark.parametrize("preconditioned", [False, True])
def test_first_and_second_derivatives_by_right_hand_side_and_parameters(preconditioned):
    torch.manual_seed(0)
    factor = torch.randn(4, 4, dtype=torch.float64, requires_grad=True)
    shift = torch.rand(2, 4, dtype=torch.float64).add_(1.0).requires_grad_()
    b = torch.randn(2, 4, dtype=torch.float64, requires_grad=True)
    preconditioner = (lambda r: r / 3) if preconditioned else None

    def solve(b: Tensor, factor: Tensor, shift: Tensor) -> Tensor:
        operator = Operator(lambda x, f, s: product(product(x, f), f.T) + s * x, (factor, shift))
        return conjugate_gradient(operator, b, rtol=1e-14, atol=1e-14, preconditioner=preconditioner).value

    assert gradcheck(solve, (b, factor, shift), atol=1e-6)
    assert gradgradcheck(solve, (b, factor, shift), atol=1e-5)


def test_derivatives_equal_those_through_a_dense_solve():
    root = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
    matrix, b = spd(6), torch.randn(2, 6, dtype=torch.float64)
    # Two parameters made from one tensor, one of them from the other: nothing may be counted twice.
    first = root**2
    second = first.sin() + 2
    operator = Operator(lambda x, p, q: product(x, matrix) * p + q * x, (first, second))
    value = conjugate_gradient(operator, b, rtol=1e-13).value.square().sum()
    dense = torch.linalg.solve(matrix * first + second * torch.eye(6, dtype=torch.float64), b.T).T.square().sum()
    got = torch.autograd.grad(value, root, create_graph=True)
    want = torch.autograd.grad(dense, root, create_graph=True)
    torch.testing.assert_close(got, want)
    torch.testing.assert_close(*(torch.autograd.grad(g[0], root, retain_graph=True) for g in (got, want)))


def test_a_gradient_that_does_not_converge_warns():
    matrix, b = spd(30, 1e6), torch.randn(1, 30, dtype=torch.float64, requires_grad=True)
    solution = conjugate_gradient(lambda x: product(x, matrix), b, max_steps=3)
    with pytest.warns(RuntimeWarning, match="solving for a gradient: stopped at max_steps"):
        solution.value.sum().backward()


def test_no_gradient_where_none_is_wanted():
    matrix = spd(4).requires_grad_()
    b = torch.randn(1, 4, dtype=torch.float64, requires_grad=True)
    with torch.no_grad():
        assert not conjugate_gradient(lambda x: product(x, matrix), b).value.requires_grad


def test_a_hidden_parameter_is_refused():
    matrix = spd(4).requires_grad_()
    with pytest.raises(InputError, match=r"Operator\.parameters"):
        conjugate_gradient(lambda x: product(x, matrix), torch.randn(1, 4, dtype=torch.float64))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"b": torch.zeros(3)}, "b must be"),
        ({"b": torch.zeros(2, 3, dtype=torch.int64)}, "b must be"),
        ({"b": torch.zeros(2, 3, dtype=torch.float16)}, "b must be"),
        ({"x0": torch.zeros(2, 4)}, "x0 must be like b"),
        ({"x0": torch.zeros(2, 3, dtype=torch.float64)}, "x0 must be like b"),
        ({"rtol": -1.0}, "must not be negative"),
        ({"atol": -1.0}, "must not be negative"),
        ({"max_steps": -1}, "must not be negative"),
    ],
)
def test_wrong_input_is_refused(change, message):
    arguments = {"b": torch.zeros(2, 3), **change}
    with pytest.raises(InputError, match=message):
        conjugate_gradient(lambda x: x, **arguments)


@pytest.mark.parametrize("factor", [1.0, 0.5, -3.0])
def test_a_guess_goes_first_and_is_checked(factor):
    """One that is right leaves nothing to do, one that is not is mended, and items that are done are not asked for."""
    diagonal, asked = torch.tensor([1.0, 4.0, 9.0], dtype=torch.float64), []

    def guess(b, tolerance, max_steps):
        asked.append(b.clone())
        return factor * b / diagonal, torch.full((len(b),), 2), torch.tensor([factor == 1.0] * len(b))

    b = torch.tensor([[1.0, 2.0, 3.0], [3.0, 1.0, 1.0]], dtype=torch.float64)
    start = torch.stack([b[0] / diagonal, torch.zeros(3, dtype=torch.float64)])
    solution = conjugate_gradient(lambda x: x * diagonal, b, x0=start, guess=guess)
    assert solution.ok
    torch.testing.assert_close(solution.value, b / diagonal)
    assert not asked[0][0].any()
    assert int(solution.steps[1]) == (2 if factor == 1.0 else solution.steps[1])
