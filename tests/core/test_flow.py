"""Flows against closed forms: orders, inverses, boundaries, gradients."""

import math
import subprocess
import sys
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core import flow
from torchdeform.core.diagnostics import inverse_error
from torchdeform.core.flow import TABLEAUX, OdeSolver, integrate, integrate_points, integrate_rate, runge_kutta
from torchdeform.core.grid import Grid
from torchdeform.core.warp import compose, max_voxels, sample, warp
from torchdeform.errors import ComputationError, InputError

UNTIMED = settings(deadline=None, max_examples=15)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SPACING = (0.5, 2.0, 1.2)
ORDERS = {"euler": 1, "midpoint": 2, "rk4": 4}
METHODS = [*ORDERS, "dopri5"]


def inward(grid: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """Return x − centre, a matrix A of a spiral towards the centre, and v = A (x − centre), which never leaves Ω."""
    x = grid.points(dtype=torch.float64)
    x = x - grid.along([e / 2 for e in grid.extent], x)
    matrix = torch.tensor([[-1.2, -0.5, 0.1], [0.4, -0.9, 0.2], [0.0, -0.3, -1.0]], dtype=torch.float64)
    matrix = matrix[: grid.dim, : grid.dim]
    scale = torch.tensor(grid.extent, dtype=torch.float64)
    matrix = matrix * scale.view(-1, 1) / scale  # the same spiral in units of the box, whatever its sides
    return x, matrix, apply(matrix, x)


def apply(matrix: Tensor, x: Tensor) -> Tensor:
    return torch.einsum("ij,bj...->bi...", matrix, x)


def slip(grid: Grid, voxels: float, seed: int = 0) -> Tensor:
    """Return a smooth velocity with n · v = 0 on the boundary: component k vanishes on the faces of axis k only."""
    unit = grid.points(dtype=torch.float64) / grid.along(grid.extent, torch.zeros(1).double())
    weights = torch.randn(grid.dim, grid.dim, generator=torch.manual_seed(seed)).double()
    parts = []
    for k in range(grid.dim):
        waves = torch.cos(math.pi * (unit + weights[k].view(1, -1, *[1] * grid.dim))).prod(dim=1, keepdim=True)
        parts.append(torch.sin(math.pi * unit[:, k : k + 1]) * waves)
    v = torch.cat(parts, dim=1)
    return v * (voxels / float(v.abs().max())) * grid.along(grid.spacing, v)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_flow_of_a_linear_field_is_the_matrix_exponential(method, dim):
    """v = A x is interpolated exactly, so only the method's error is left: it falls with the method's order."""
    grid = Grid((9, 7, 8)[:dim], SPACING[:dim])
    x, matrix, v = inward(grid)
    exact = apply(torch.linalg.matrix_exp(matrix), x) - x

    def error(steps: int, **how) -> float:
        return float(max_voxels(integrate(v, grid, steps, method, **how) - exact, grid))

    if method == "dopri5":
        assert error(1, atol=1e-9) < 1e-7 < error(1, atol=1e-3) < 1e-2
    else:
        assert math.log2(error(16) / error(32)) == pytest.approx(ORDERS[method], abs=0.1)


@pytest.mark.parametrize("method", METHODS)
def test_a_negative_time_goes_backwards(method):
    """It is the flow of −v, and the length of time scales like the velocity."""
    grid = Grid((9, 7), SPACING[:2])
    v = slip(grid, 2.0)
    torch.testing.assert_close(integrate(v, grid, 6, method, time=-0.5), integrate(-0.5 * v, grid, 6, method))
    assert integrate(v, grid, 6, method, time=0.0).abs().max() == 0


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("method", list(ORDERS))
def test_backwards_after_forwards_is_the_identity_to_the_order_of_the_method(method, dim):
    """In the middle of the box, whose points and their neighbours stay inside, so that interpolation is exact."""
    grid = Grid((13, 14, 13)[:dim], SPACING[:dim])
    x, _, v = inward(grid)
    middle = (x.abs() < grid.along(grid.extent, x) / 6).all(dim=1, keepdim=True)

    def error(steps: int) -> float:
        there, back = (integrate(v, grid, steps, method, time=t) for t in (0.4, -0.4))
        return float(max_voxels(compose(back, there, grid) * middle, grid))

    # Where the order is even, the leading errors there and back cancel.
    order = ORDERS[method] + (ORDERS[method] % 2 == 0)
    assert math.log2(error(8) / error(16)) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_inverse_flow_inverts_the_map(dim):
    """On the grid what is left is the interpolation error, which falls as h²."""

    def errors(nodes: int) -> tuple[float, float]:
        grid = Grid((nodes, nodes + 1, nodes - 1)[:dim], SPACING[:dim])
        v = slip(grid, (nodes - 1) / 12)
        mean, largest = inverse_error(integrate(v, grid), integrate(v, grid, time=-1.0), grid)
        return float(mean) / nodes, float(largest)

    (coarse, _), (fine, largest) = (errors(nodes) for nodes in {2: (33, 129), 3: (13, 49)}[dim])
    assert largest < 0.02
    assert math.log(coarse / fine) / math.log(4) == pytest.approx(2, abs=0.25)


@UNTIMED
@given(s=st.floats(-1, 1), t=st.floats(-1, 1))
def test_group_property(s, t):
    """φ_s ∘ φ_t = φ_(s+t), exactly so for a velocity that interpolation reproduces."""
    grid = Grid((9, 9), SPACING[:2])
    _, _, v = inward(grid)
    v, s, t = 0.3 * v, abs(s), abs(t)  # towards the centre, where no point leaves the box
    joined = compose(integrate(v, grid, time=s), integrate(v, grid, time=t), grid)
    torch.testing.assert_close(joined, integrate(v, grid, time=s + t), atol=1e-5, rtol=0)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_boundary_points_slide_on_the_boundary(method, dim):
    grid = Grid((9, 8, 7)[:dim], SPACING[:dim])
    u = integrate(slip(grid, 3.0), grid, 4, method)
    for k in range(dim):
        for end in (0, -1):
            assert u[:, k].select(k + 1, end).abs().max() < 1e-12
    assert u.abs().max() > 0.1


@UNTIMED
@given(seed=st.integers(0, 999), dim=st.sampled_from([2, 3]), dtype=st.sampled_from([torch.float32, torch.float64]))
def test_no_point_leaves_the_box(seed, dim, dtype):
    grid = Grid((5, 6, 4)[:dim], SPACING[:dim])
    v = (4 * torch.randn(2, dim, *grid.shape, generator=torch.manual_seed(seed))).to(dtype)
    u = integrate(v, grid, 3)
    moved = grid.points(dtype=dtype) + u
    assert u.dtype == dtype
    assert moved.min() >= 0
    assert (moved <= grid.along(grid.extent, moved) * (1 + 1e-6)).all()


@pytest.mark.parametrize("adjoint", [False, True])
@pytest.mark.parametrize("method", list(ORDERS))
def test_a_batch_equals_its_items(method, adjoint):
    grid = Grid((7, 8), SPACING[:2])
    v = torch.cat([slip(grid, 1.0), slip(grid, 30.0, 1), slip(grid, 0.0, 2)])
    together = integrate(v, grid, 5, method, adjoint=adjoint)
    alone = [integrate(item[None], grid, 5, method, adjoint=adjoint) for item in v]
    assert torch.equal(together, torch.cat(alone))


def test_dopri5_is_as_fine_as_the_worst_item_needs():
    grid = Grid((9, 8), SPACING[:2])
    v = torch.cat([slip(grid, 0.5), slip(grid, 6.0, 1)])
    alone = torch.cat([integrate(item[None], grid, method="dopri5", atol=1e-6) for item in v])
    torch.testing.assert_close(integrate(v, grid, method="dopri5", atol=1e-6), alone, atol=1e-3, rtol=0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("method", METHODS)
def test_type_and_device_stay(method, dtype, device):
    grid = Grid((6, 5, 7), SPACING)
    v = slip(grid, 2.0)
    u = integrate(v.to(device, dtype), grid, method=method)
    assert (u.dtype, u.device.type) == (dtype, device)
    close = {"atol": 2e-3 if method == "dopri5" else 2e-5, "rtol": 0}  # dopri5 may choose other steps
    torch.testing.assert_close(u.cpu().double(), integrate(v, grid, method=method), **close)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("method", METHODS)
def test_gradients(method, dim):
    """The velocity points inwards, so that no point is put back on the boundary, where the derivative jumps."""
    grid = Grid((4, 3, 3)[:dim], SPACING[:dim])
    v = 0.3 * inward(grid)[2]
    v = (v + 0.01 * torch.randn(v.shape, dtype=v.dtype, generator=torch.manual_seed(0))).requires_grad_()
    assert gradcheck(lambda w: integrate(w, grid, 2, method, atol=10.0), (v,), atol=1e-4)


@pytest.mark.parametrize("method", METHODS)
def test_adjoint_gradient_tends_to_the_plain_one(method):
    grid = Grid((9, 8), SPACING[:2])
    target = slip(grid, 1.0, 5)

    def gradient(steps: int, adjoint: bool) -> Tensor:
        v = slip(grid, 2.0).requires_grad_()
        loss = ((integrate(v, grid, steps, method, adjoint=adjoint, atol=1e-7) - target) ** 2).sum()
        return torch.autograd.grad(loss, v)[0]

    exact = gradient(64, False)
    coarse, fine = (float((gradient(steps, True) - gradient(steps, False)).norm()) for steps in (8, 64))
    assert fine < 0.01 * float(exact.norm()) * (3 if method == "euler" else 1)
    assert fine < 0.3 * coarse or method == "dopri5"


@pytest.mark.parametrize(("method", "stages"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
@pytest.mark.parametrize("adjoint", [False, True])
def test_the_first_stage_costs_no_sampling(method, stages, adjoint, monkeypatch):
    grid, calls = Grid((5, 6)), []
    monkeypatch.setattr(flow, "warp", lambda *arguments: calls.append(arguments) or warp(*arguments))
    for steps in (1, 3):
        calls.clear()
        integrate(slip(grid, 1.0).requires_grad_(), grid, steps, method, adjoint=adjoint)
        assert len(calls) == stages * steps - 1


def test_adjoint_keeps_no_steps():
    """What backward needs to keep is counted: with the adjoint it does not grow with the steps."""
    grid = Grid((8, 8))

    def kept(steps: int, adjoint: bool) -> int:
        sizes: list[int] = []
        with torch.autograd.graph.saved_tensors_hooks(lambda x: (sizes.append(x.numel()), x)[1], lambda x: x):
            integrate(slip(grid, 1.0).requires_grad_(), grid, steps, adjoint=adjoint)
        return sum(sizes)

    assert kept(4, True) == kept(32, True) < kept(4, False) < kept(32, False) / 4


def test_points_follow_a_velocity_in_time():
    """dp/dt = t · c: a parabola, at all times asked for, forwards and backwards, for any set of points."""
    grid = Grid((5, 5), (10.0, 10.0))
    points = torch.rand(2, 2, 7, dtype=torch.float64, generator=torch.manual_seed(0)) * 20 + 5
    c = torch.tensor([3.0, -4.0], dtype=torch.float64).view(1, 2, 1)
    for method in ("midpoint", "rk4", "dopri5"):
        for times in ([0.0, 0.3, 1.0], [1.0, 0.2]):
            found = integrate_points(lambda t, p: t * c + 0 * p, points, times, grid, OdeSolver(method=method, steps=2))
            expected = torch.stack([points + c * (t**2 - times[0] ** 2) / 2 for t in times])
            torch.testing.assert_close(found, expected)
            assert torch.equal(found[0], points)


def test_points_are_clamped_to_the_box():
    grid = Grid((5, 5), (1.0, 0.5))
    found = integrate_points(lambda _, p: torch.full_like(p, 9.0), grid.points(), (0.0, 1.0), grid)
    assert found[1].flatten(2)[0].amax(dim=1).tolist() == [4.0, 2.0]
    assert found[1].min() == 2.0


def test_points_and_parameters_get_gradients():
    """Plain and adjoint, through points and through what the rate uses."""
    grid = Grid((7, 7))
    gradients = []
    for adjoint in (False, True):
        points = (torch.rand(1, 2, 5, dtype=torch.float64, generator=torch.manual_seed(0)) * 3 + 1.5).requires_grad_()
        v = slip(grid, 1.0).requires_grad_()
        solver = OdeSolver(steps=32, adjoint=adjoint)
        end = integrate_points(lambda t, p, v=v: (1 + t) * sample(v, p, grid), points, (0, 1), grid, solver, (v,))[-1]
        gradients.append(torch.autograd.grad((end**2).sum(), (points, v)))
    for plain, adjoint in zip(*gradients, strict=True):
        assert float((plain - adjoint).norm()) < 1e-3 * float(plain.norm())


def test_wrong_input_is_refused():
    grid = Grid((4, 5))
    v = torch.zeros(1, 2, 4, 5)
    with pytest.raises(InputError, match="method must be one of euler, midpoint, rk4, dopri5, squaring, got 'rk5'"):
        integrate(v, grid, method="rk5")
    for steps in (0, -1, 2.5):
        with pytest.raises(InputError, match="steps must be a whole number, at least 1"):
            integrate(v, grid, steps=steps)  # type: ignore[arg-type]
    for atol in (0.0, math.nan):
        with pytest.raises(InputError, match="atol must be a positive number"):
            integrate(v, grid, atol=atol)
    with pytest.raises(InputError, match="time must be finite"):
        integrate(v, grid, time=math.inf)
    with pytest.raises(InputError, match="integrate: v must have shape"):
        integrate(v[:, :1], grid)
    with pytest.raises(InputError, match="squaring has no adjoint"):
        integrate(v, grid, method="squaring", adjoint=True)
    with pytest.raises(InputError, match="squaring follows a stationary velocity"):
        integrate_points(lambda _, p: p, grid.points(), (0, 1), grid, OdeSolver(method="squaring"))
    for times in ([0.0], [0.0, 1.0, 0.5], [1.0, 1.0]):
        with pytest.raises(InputError, match="times must be two or more, increasing or decreasing"):
            integrate_points(lambda _, p: p, grid.points(), times, grid)
    with pytest.raises(InputError, match=r"points must have shape \(B, 2, \*T\)"):
        integrate_points(lambda _, p: p, torch.zeros(1, 3, 7), [0, 1], grid)


def test_a_velocity_that_is_not_finite_is_named():
    grid = Grid((4, 5))
    v = torch.zeros(1, 2, 4, 5)
    v[0, 0, 1, 1] = math.nan
    with pytest.raises(ComputationError, match="check the velocity for NaN"):
        integrate(v, grid, method="dopri5")
    assert integrate(v, grid).isnan().any()


@pytest.mark.parametrize(("method", "dim", "steps"), list(product(TABLEAUX, (2, 3), (1, 3))))
def test_the_tableaux_are_the_methods_of_torchdiffeq(method, dim, steps):
    """To rounding, forwards and backwards in time, for a rate that changes with time."""
    grid = Grid((7, 6, 5)[:dim], SPACING[:dim])
    v, start = slip(grid, 2.0), 0.1 * slip(grid, 1.0, seed=1)

    def rate(t, u):
        return warp(v, u, grid) * (1 + t) ** 2 - 0.3 * u

    for times in ((0.0, 1.0), (0.0, 0.4, 1.1), (0.5, -0.5)):
        ours = runge_kutta(rate, start, times, TABLEAUX[method], steps)
        theirs = integrate_rate(rate, start, times, grid, OdeSolver(method=method, steps=steps))
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("method", TABLEAUX)
def test_flows_are_traced_by_their_tableaux(monkeypatch, method):
    """Where torch.compile looks on, torchdiffeq is not called, and the flow is the same, gradients too."""
    grid = Grid((6, 7), (0.5, 1.0))
    v = slip(grid, 1.0).requires_grad_()
    plain = integrate(v, grid, steps=2, method=method)
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    monkeypatch.setattr(flow, "_torchdiffeq", lambda: pytest.fail("torchdiffeq was called"))
    traced = integrate(v, grid, steps=2, method=method)
    torch.testing.assert_close(traced, plain, rtol=1e-12, atol=1e-12)
    grads = [torch.autograd.grad(u.square().sum(), v)[0] for u in (plain, traced)]
    torch.testing.assert_close(*grads, rtol=1e-10, atol=1e-10)


def test_torchdiffeq_is_whole_though_scipys_integrators_are_not_imported():
    """Its ``scipy_solver`` works, and so does the module that a stand-in took the place of for a moment."""
    code = (
        "import sys, torch, torchdeform as td\n"
        "td.integrate(torch.zeros(1, 2, 4, 4), td.Grid((4, 4)))\n"
        "assert 'torchdiffeq' in sys.modules and 'scipy.integrate' not in sys.modules\n"
        "from torchdiffeq import odeint\n"
        "t = torch.tensor([0.0, 1.0])\n"
        "y = odeint(lambda t, y: -y, torch.ones(1), t, method='scipy_solver', options={'solver': 'LSODA'})\n"
        "assert abs(float(y[-1]) - 0.367879) < 1e-4, y\n"
        "import scipy.integrate\n"
        "assert abs(scipy.integrate.quad(lambda x: x, 0, 1)[0] - 0.5) < 1e-9\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_stand_in_gives_way_to_the_module():
    """As another thread finds it that imports scipy.integrate at that moment."""
    stand_in = flow._StandIn("scipy.integrate")
    assert stand_in.quad(lambda x: 2 * x, 0, 1)[0] == pytest.approx(1.0)
    assert not isinstance(sys.modules["scipy.integrate"], flow._StandIn)


def test_dopri5_gives_up_in_bounded_time():
    """10⁴ voxels a unit of time along a shear that turns at every node: it would go on for hours."""
    grid = Grid((6, 6))
    v = 1e4 * torch.sin(2 * grid.points()).flip(1)
    with pytest.raises(
        ComputationError, match=f"dopri5 is not there after {flow.MOST_STEPS} steps.*raise atol, or take"
    ):
        integrate(v, grid, method="dopri5")
    assert integrate(v, grid, method="rk4").isfinite().all()


def test_torchdiffeq_may_be_imported_under_a_mode():
    """Its tables would be fake, or on the default device, for good."""
    code = (
        "import torch, torchdeform as td\n"
        "from torch._subclasses.fake_tensor import FakeTensorMode\n"
        "grid, v = td.Grid((8, 8)), torch.rand(1, 2, 8, 8)\n"
        "with FakeTensorMode(allow_non_fake_inputs=True), torch.device('meta'):\n"
        "    try:\n"
        "        td.integrate(v, grid, method='dopri5')\n"
        "    except RuntimeError:\n"
        "        pass\n"
        "assert td.integrate(v, grid, method='dopri5').isfinite().all()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
