"""The direct solver against dense solves of the brute-force system."""

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rounding import assert_same_to_rounding, condition_of_a_solve, terms_of_a_solve
from torch.autograd import gradcheck, gradgradcheck

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.assembly import assemble
from torchdeform.fem.boundary import Face, constrain, faces, fixed_unknowns
from torchdeform.fem.fast_transform import FastTransform, TransformFactor, solve_poisson, transform_is_exact
from torchdeform.fem.form import div_curl_form, gradient_form
from torchdeform.fem.operator import apply_form
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights
from torchdeform.solvers import sine_cosine as transforms

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
GRIDS = [Grid((5, 7), (0.5, 1.3)), Grid((3, 4), (2.0, 0.3)), Grid((4, 3, 5), (0.7, 1.0, 1.4)), Grid((2, 5, 3))]


def mixed(dim: int) -> dict[Face, str]:
    """Slip across the first axis, tangential across the others."""
    return {face: "no_slip_tangential" if face.axis else "slip" for face in faces(dim)}


def transform(grid, weights, boundary="slip", *, dtype=torch.float32, device="cpu") -> TransformFactor:
    like = torch.empty(0, dtype=dtype, device=device)
    return FastTransform(approximate=True).init(DivCurlSystem(grid, weights, boundary), like)


def dense_inverse(matrix, fixed, load):
    free = ~fixed.flatten()
    out = torch.zeros_like(load.flatten(1))
    out[:, free] = torch.linalg.solve(matrix[free][:, free], load.flatten(1)[:, free].T).T
    return out.view_as(load)


def close(got, want):
    torch.testing.assert_close(got, want, atol=1e-11 * float(want.abs().max()), rtol=0)


CASES = [
    (grid, weights, boundary)
    for grid in GRIDS
    for weights in [(1.0, 1.0, 0.0), (2.0, 2.0, 0.3), (3.0, 0.5, 0.0), (0.2, 4.0, 0.6)]
    for boundary in ["slip", "no_slip_tangential", "dirichlet", mixed(grid.dim)]
]
EXACT = [case for case in CASES if transform_is_exact(case[0], Weights(*case[1]), case[2])]


@pytest.mark.parametrize(("grid", "weights", "boundary"), CASES)
def test_given_unknowns_stay_zero(grid, weights, boundary):
    load = torch.randn(2, grid.dim, *grid.shape, dtype=torch.float64)
    value = transform(grid, Weights(*weights), boundary, dtype=torch.float64)(load)
    assert not value[fixed_unknowns(boundary, grid).expand_as(value)].any()


@pytest.mark.parametrize(("grid", "weights", "boundary"), EXACT)
def test_where_it_is_exact_it_inverts_the_brute_force_matrix(brute, grid, weights, boundary):
    solver = transform(grid, Weights(*weights), boundary, dtype=torch.float64)
    fixed = fixed_unknowns(boundary, grid)
    load = torch.randn(2, grid.dim, *grid.shape, dtype=torch.float64)
    value = solver(load)
    oracle = brute(grid.shape, grid.spacing, points=2)
    stiffness = oracle.matrix(oracle.div_curl(*weights), grid.dim)
    close(value, dense_inverse(stiffness, fixed, load))
    mass = oracle.matrix(lambda e, q: [(1.0, [(k, None, 1.0)]) for k in range(grid.dim)], grid.dim)
    # (M⁻¹K)⁻² M⁻¹ = K⁻¹ M K⁻¹ on the free unknowns.
    again = (value.flatten(1) @ mass).view_as(value)
    close(solver(load, power=2), dense_inverse(stiffness, fixed, again))


def test_most_cases_are_exact():
    assert len(EXACT) >= len(CASES) / 2


def test_where_it_is_exact():
    grid = Grid((5, 5))
    equal, unequal = Weights(2.0, 2.0), Weights(1.0, 2.0)
    assert all(transform_is_exact(grid, equal, b) for b in ("slip", "no_slip_tangential", "dirichlet"))
    assert all(transform_is_exact(grid, unequal, b) for b in ("slip", "no_slip_tangential"))
    assert not transform_is_exact(grid, unequal, "dirichlet")
    assert not transform_is_exact(grid, equal, "free")
    assert not transform_is_exact(grid, Weights(torch.rand(1, 1, 4, 4) + 1), "slip")
    one_face = dict.fromkeys(faces(2), "slip") | {Face(0, 0): "dirichlet"}
    assert not transform_is_exact(grid, equal, one_face)
    # A constant flow along the channel costs nothing unless w_zero > 0.
    assert not transform_is_exact(grid, equal, mixed(2))
    assert transform_is_exact(grid, Weights(2.0, 2.0, 0.1), mixed(2))


@pytest.mark.parametrize("boundary", ["slip", "dirichlet", "free", "one face"])
@pytest.mark.parametrize("weights", [(1.0, 1.0, 0.0), (3.0, 0.5, 0.1)])
def test_everywhere_else_it_is_a_symmetric_positive_preconditioner(weights, boundary):
    grid = Grid((4, 5), (1.0, 0.6))
    faces_ = dict.fromkeys(faces(2), "slip") | {Face(0, 0): "free"} if boundary == "one face" else boundary
    solver = transform(grid, Weights(*weights), faces_, dtype=torch.float64)
    fixed = fixed_unknowns(faces_, grid)
    unit = torch.eye(fixed.numel(), dtype=torch.float64).view(-1, 2, 4, 5)
    matrix = constrain(solver, fixed)(unit).flatten(1)[~fixed.flatten()][:, ~fixed.flatten()]
    torch.testing.assert_close(matrix, matrix.T, atol=1e-12, rtol=0)
    assert float(torch.linalg.eigvalsh(matrix).min()) > 0


@settings(max_examples=25, deadline=None)
@example([2, 3], [1.0, 1.0, 1.0], (1.0, 2.0, 2e-313), "slip", False)
@example([2, 3], [1.0, 1.0, 1.0], (1.0, 1.0, 2e-313), "slip", False)
@given(
    st.lists(st.integers(2, 12), min_size=2, max_size=3),
    st.lists(st.floats(0.2, 5.0), min_size=3, max_size=3),
    st.tuples(st.floats(0.1, 10.0), st.floats(0.1, 10.0), st.floats(0.0, 1.0)),
    st.sampled_from(["slip", "no_slip_tangential"]),
    st.booleans(),
)
def test_the_operator_takes_it_back_to_the_load(shape, spacing, weights, boundary, single):
    grid = Grid(tuple(shape), tuple(spacing[: len(shape)]))
    dtype, tolerance = (torch.float32, 2e-3) if single else (torch.float64, 1e-10)
    fixed = fixed_unknowns(boundary, grid)
    load = torch.randn(1, grid.dim, *grid.shape, dtype=dtype).masked_fill(fixed, 0)
    value = transform(grid, Weights(*weights), boundary, dtype=dtype)(load)
    back = constrain(lambda v: apply_form(div_curl_form(grid.dim, Weights(*weights)), v, grid), fixed)(value)
    torch.testing.assert_close(back, load, atol=tolerance * max(1.0, float(load.abs().max())), rtol=0)


@pytest.mark.parametrize("device", DEVICES)
def test_long_axes_go_through_the_fft(device, monkeypatch):
    grid, weights = Grid((9, 12), (1.0, 0.5)), Weights(2.0, 0.5, 0.1)
    load = torch.randn(2, 2, 9, 12, dtype=torch.float64, device=device)
    want = transform(grid, weights, dtype=torch.float64, device=device)(load)
    monkeypatch.setattr(transforms, "DENSE_LIMIT", 0)
    close(transform(grid, weights, dtype=torch.float64, device=device)(load), want)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("weights", [Weights(), Weights(2.0, 0.5, 0.1)])
def test_a_batch_gives_its_items(weights, dtype, device):
    grid = Grid((6, 9, 7))
    solver = transform(grid, weights, dtype=dtype, device=device)
    load = torch.randn(3, 3, *grid.shape, dtype=dtype, device=device)
    together = solver(load)
    for i in range(3):
        alone = solver(load[i : i + 1])
        assert_same_to_rounding(together[i : i + 1], alone, terms_of_a_solve(grid), condition_of_a_solve(grid, 4.0))


def test_weights_may_differ_from_item_to_item():
    grid = Grid((5, 6))
    div, zero = torch.tensor([1.0, 2.0, 5.0]).view(3, 1, 1, 1), torch.tensor([0.1, 0.0, 1.0]).view(3, 1, 1, 1)
    load = torch.randn(3, 2, 5, 6)
    for curl in (2.0, div):
        solver = transform(grid, Weights(div, curl, zero))
        together, spread = solver(load), solver(load[:1])
        for i in range(3):
            alone = Weights(float(div[i]), float(div[i]) if curl is div else 2.0, float(zero[i]))
            single = transform(grid, alone)
            torch.testing.assert_close(together[i : i + 1], single(load[i : i + 1]), atol=1e-5, rtol=1e-5)
            torch.testing.assert_close(spread[i : i + 1], single(load[:1]), atol=1e-5, rtol=1e-5)


def test_results_stay_when_the_solver_goes_on():
    solver = transform(Grid((5, 6)), Weights(1.0, 2.0))
    first, load = torch.randn(1, 2, 5, 6), torch.randn(1, 2, 5, 6)
    untouched, value = first.clone(), solver(first)
    kept = value.clone()
    solver(load)
    assert torch.equal(value, kept)
    assert torch.equal(first, untouched)
    with torch.inference_mode():
        solver(torch.randn(4, 2, 5, 6))
    load.requires_grad_()
    solver(load).sum().backward()
    assert torch.equal(solver(first), kept)


@pytest.mark.parametrize("weights", [Weights(), Weights(2.0, 0.5, 0.1)])
@pytest.mark.parametrize("power", [1, 2])
def test_derivatives_by_the_load(weights, power):
    solver = transform(Grid((3, 4), (1.0, 0.7)), weights, dtype=torch.float64)
    load = torch.randn(2, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lambda b: solver(b, power=power), load)
    assert gradgradcheck(lambda b: solver(b, power=power).square().sum(), load)


@pytest.mark.parametrize("weights", [(2.0, 2.0, 0.3), (9.0, 1.0, 0.3), (0.4, 3.0, 0.1)])
@pytest.mark.parametrize("grid", [Grid((3, 4), (1.0, 0.7)), Grid((3, 2, 3), (1.0, 0.7, 1.2))])
def test_derivatives_by_the_weights(grid, weights):
    tensors = [torch.tensor(w, dtype=torch.float64, requires_grad=True) for w in weights]
    load = torch.randn(1, grid.dim, *grid.shape, dtype=torch.float64, requires_grad=True)

    def solve(b, *weights):
        return transform(grid, Weights(*weights), dtype=torch.float64)(b)

    # Where w_div = w_curl their derivatives differ all the same.
    assert gradcheck(solve, (load, *tensors))
    assert gradgradcheck(lambda *t: solve(*t).square().sum(), (load, *tensors), fast_mode=True)


@pytest.mark.parametrize("grid", GRIDS)
def test_poisson_inverts_the_laplacian(grid):
    load = torch.randn(2, 1, *grid.shape, dtype=torch.float64)
    fixed = torch.ones(1, 1, *grid.shape, dtype=torch.bool)
    fixed[(..., *[slice(1, -1)] * grid.dim)] = False
    matrix = assemble(gradient_form(grid.dim), grid).to_dense()
    torch.testing.assert_close(solve_poisson(load, grid), dense_inverse(matrix, fixed, load), atol=1e-12, rtol=1e-10)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: FastTransform().init(
                DivCurlSystem(Grid((4, 4)), Weights(torch.rand(1, 1, 3, 3) + 1)), torch.zeros(1)
            ),
            "transform is not exact",
        ),
        (lambda: transform(Grid((4, 4)), Weights(), "slid"), "did you mean 'slip'"),
        (lambda: transform(Grid((4, 4)), Weights())(torch.zeros(1, 3, 4, 4)), "load must have shape"),
        (
            lambda: transform(Grid((4, 4)), Weights())(torch.zeros(1, 2, 4, 4).double()),
            "made for torch.float32",
        ),
        (
            lambda: transform(Grid((4, 4)), Weights())(torch.zeros(1, 2, 4, 4), power=0),
            "power must be at least 1",
        ),
        (lambda: solve_poisson(torch.zeros(1, 1, 4, 5), Grid((4, 4))), "solve_poisson: load must have shape"),
    ],
)
def test_wrong_input_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
