"""Chains of maps: what they do to points and images, forth and back, by formula, by autograd, by invariants."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.autograd import gradcheck

from torchdeform.core import grid as grids
from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image, resample, surroundings
from torchdeform.core.transform import Affine, Displacement, Transform
from torchdeform.core.warp import invert
from torchdeform.errors import InputError

UNTIMED = settings(deadline=None, max_examples=30)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
SHAPES = {2: ((30, 36), (33, 28)), 3: ((14, 17, 19), (15, 13, 18))}
SPACINGS = {2: ((1.3, 0.7), (0.9, 1.1)), 3: ((2.2, 0.7, 1.1), (1.4, 1.3, 1.2))}


def affine(dim: int, *, strength: float = 0.1, shift: float = 2.0, seed: int = 3) -> Affine:
    numbers = torch.randn(dim, dim + 1, dtype=torch.float64, generator=torch.manual_seed(seed))
    return Affine(torch.eye(dim).double() + strength * numbers[:, :-1], shift * numbers[:, -1])


def world(place: Image, count: int = 50, seed: int = 0) -> Tensor:
    """Return points ``(N, D)`` of the world inside an image."""
    unit = torch.rand(1, place.grid.dim, count, dtype=torch.float64, generator=torch.manual_seed(seed))
    sides = torch.tensor(place.grid.extent, dtype=torch.float64).view(1, -1, 1)
    return place.to_world(unit * sides)[0].T


@pytest.fixture(params=[2, 3])
def spaces(request, make_image):
    """A fixed and a moving image of other grids, the first oblique."""
    dim = request.param
    return tuple(
        make_image(shape, spacing, origin=(-8.0, 120.0, 33.0)[:dim], tilted=turn)
        for shape, spacing, turn in zip(SHAPES[dim], SPACINGS[dim], (True, False), strict=True)
    )


@pytest.fixture
def chain(spaces, make_displacement):
    """Points go through a displacement on the fixed grid, then through an affine map about the image."""
    fixed, moving = spaces
    u = make_displacement(fixed.grid, 0.06).double()
    middle = world(fixed, 1000).mean(0)
    about = affine(fixed.grid.dim)
    centred = Affine(about.matrix, about.offset + middle - about.matrix @ middle)
    return Transform.from_displacement(u, fixed, affine=centred, moving=moving)


def test_points_go_through_the_stages_in_order(spaces, chain):
    """At nodes, A(x + u(x)) by hand; in float32 as in float64; whatever shape they come in."""
    fixed, _ = spaces
    displacement, last = chain.stages
    nodes = fixed.grid.points(dtype=torch.float64)
    expected = last(fixed.to_world(nodes + displacement.field.data))
    torch.testing.assert_close(chain.points(fixed.to_world(nodes)), expected, atol=1e-9, rtol=0)
    rows = fixed.to_world(nodes).flatten(2)[0].T
    torch.testing.assert_close(chain.points(rows), expected.flatten(2)[0].T, atol=1e-9, rtol=0)
    assert chain.points(rows.float()).dtype == torch.float32
    batch = torch.stack([world(fixed, seed=s).T for s in range(3)])
    torch.testing.assert_close(chain.points(batch), torch.cat([chain.points(b.unsqueeze(0)) for b in batch]))


def test_outside_its_grid_a_displacement_does_nothing(spaces):
    fixed, _ = spaces
    u = torch.ones(1, fixed.grid.dim, *fixed.grid.shape)
    far = world(fixed) + 1000.0
    moved = Transform.from_displacement(u, fixed).points(far)
    torch.testing.assert_close(moved, far, atol=1e-9, rtol=0)


def test_a_displacement_goes_on_around_its_nodes_as_far_as_its_margin():
    place = Image(torch.zeros(1, 1, 4, 5), Grid((4, 5), (2.0, 3.0)))
    field = replace(place, data=torch.ones(1, 2, 4, 5, dtype=torch.float64))
    points = torch.tensor([[0.0, 0.0], [12.0, 6.0], [-0.1, 0.0], [12.1, 6.0], [-1.4, 3.0], [-1.6, 3.0]]).double()
    for margin, moved in ((0.5, [1, 1, 1, 1, 1, 0]), (1e-6, [1, 1, 0, 0, 0, 0])):
        stage = Displacement(field, margin=margin).to("cpu")
        found = Transform((stage,)).points(points) - points
        assert found.round().tolist() == [[m, m] for m in moved]


def test_the_image_is_pulled_back(spaces, chain):
    """With the displacement alone this is `resample`; with the chain it is moving(φ(x)), which is known by formula."""
    fixed, moving = spaces
    displacement, _ = chain.stages
    only = Transform((displacement,))
    torch.testing.assert_close(
        only.image(moving, fixed).data, resample(moving, fixed, displacement.field.data), atol=1e-4, rtol=0
    )
    warped, cubic = chain.image(moving), chain.image(moving, mode="cubic")
    assert (warped.grid, warped.origin, warped.direction) == (fixed.grid, fixed.origin, fixed.direction)
    nodes = chain.points(fixed.to_world(fixed.grid.points(dtype=torch.float64)))
    waves = torch.stack([torch.cos(0.11 * (k + 1) * nodes[:, k]) for k in range(nodes.shape[1])], dim=1)
    known = 100 + 100 * waves.prod(dim=1, keepdim=True)
    inside = (warped.data != 0) & (cubic.data != 0)
    assert inside.double().mean() > 0.3
    errors = [(image.data - known)[inside].abs().median() for image in (warped, cubic)]
    assert errors[1] < 0.5 * errors[0] < 1  # of 200; at the borders the spline is no better


def test_slabs_do_not_show(spaces, chain, monkeypatch):
    _, moving = spaces
    whole = chain.image(moving).data, chain.flatten().field.data, chain.jacobian_determinant().data
    monkeypatch.setattr(grids, "_SLAB_NODES", {"cpu": 1})
    parts = chain.image(moving).data, chain.flatten().field.data, chain.jacobian_determinant().data
    for one, other in zip(whole, parts, strict=True):
        torch.testing.assert_close(one, other, atol=1e-10, rtol=1e-6)


def test_labels_keep_their_values(spaces, chain):
    _, moving = spaces
    values = torch.randint(0, 2**31, moving.data.shape, generator=torch.manual_seed(0)).double()
    labels = replace(moving, data=values, pixel_type="uint32")
    found = chain.labels(labels)
    assert found.pixel_type == "uint32"
    assert set(found.data.unique().tolist()) <= {0.0, *values.unique().tolist()}
    assert (found.data > 0).double().mean() > 0.3


def test_channels_and_the_value_outside(spaces, chain):
    _, moving = spaces
    both = replace(moving, data=torch.cat((moving.data, -moving.data), dim=1))
    one, other = chain.image(both, outside=-1.0).data.unbind(1)
    assert (one == -1).any()
    torch.testing.assert_close(one[one != -1], -other[one != -1])
    assert (chain.image(moving, outside=None).data >= moving.data.min()).all()


@pytest.mark.parametrize("mode", ["linear", "cubic", "nearest", "label"])
def test_outside_is_what_surrounds_the_image_and_0_for_labels(spaces, chain, mode):
    _, moving = spaces
    both = replace(moving, data=torch.cat((moving.data.round() + 100, 50 - moving.data.round()), dim=1))
    known, found = (
        chain.image(both, mode=mode, outside=float("nan")).data,
        chain.image(both, mode=mode, outside="auto").data,
    )
    beyond = known.isnan()
    assert beyond.any()
    assert torch.equal(found[~beyond], known[~beyond])
    wanted = surroundings(both) if mode in ("linear", "cubic") else torch.zeros(2)
    for channel in range(2):
        assert found[:, channel][beyond[:, channel]].unique().tolist() == [wanted[channel].item()]


@pytest.mark.parametrize("known", [False, True])
def test_inverse_undoes(spaces, chain, known):
    fixed, moving = spaces
    displacement, last = chain.stages
    u = displacement.field.data
    w = invert(u, fixed.grid)
    if known:
        chain = Transform.from_displacement(u, fixed, inverse=w, affine=last, moving=moving)
    back = chain.inverse()
    if known:
        assert back.stages[-1].field.data is w
    assert back.inverse() is chain
    assert chain.inverse() is back
    assert back.fixed.grid == moving.grid
    assert back.moving.grid == fixed.grid
    torch.testing.assert_close(back.stages[-1].field.data, w)
    points = world(fixed, 300)
    # between nodes two linear interpolations are not each other's inverse: second order in the spacing
    assert (back.points(chain.points(points)) - points).norm(dim=1).mean() < 0.02 * min(fixed.grid.spacing)
    nodes = fixed.to_world(fixed.grid.points(dtype=torch.float64))
    torch.testing.assert_close(Transform(back.stages[1:]).points(nodes), fixed.to_world(
        fixed.grid.points(dtype=torch.float64) + w), atol=1e-9, rtol=0)  # fmt: skip


def test_inverse_of_one_flat_field_with_a_large_shift(spaces, chain):
    """A field that holds an affine part too leaves its grid; it is inverted all the same."""
    fixed, _ = spaces
    far = Transform((*chain.stages, Affine(torch.eye(chain.dim).double(), torch.full((chain.dim,), 40.0).double())))
    flat = Transform((far.flatten(fixed),))
    back = flat.inverse()
    assert [type(stage) for stage in back.stages] == [Affine, Displacement]
    points = world(fixed, 300)
    inner = fixed.to_grid(points.T.unsqueeze(0))[0].T
    sides = torch.tensor(fixed.grid.extent)
    inner = ((inner > 0.1 * sides) & (inner < 0.9 * sides)).all(dim=1)
    error = (back.points(flat.points(points)) - points)[inner].norm(dim=1)
    assert error.mean() < 0.05 * min(fixed.grid.spacing)
    assert back.inverse() is flat


@UNTIMED
@given(st.sampled_from([2, 3]), st.integers(0, 1000), st.floats(0.0, 0.2))
def test_affine_chains_invert_exactly(dim, seed, strength):
    first, second = affine(dim, strength=strength, seed=seed), affine(dim, strength=strength, seed=seed + 1)
    chain = Transform((first,)).then(Transform((second,)))
    points = 100 * torch.randn(20, dim, dtype=torch.float64, generator=torch.manual_seed(seed))
    torch.testing.assert_close(chain.points(points), second(first(points.T[None]))[0].T)
    torch.testing.assert_close(chain.inverse().points(chain.points(points)), points, atol=1e-8, rtol=0)


def test_then_is_composition(spaces, chain):
    fixed, _ = spaces
    back = chain.inverse()
    there_and_back, points = chain.then(back), world(fixed)
    torch.testing.assert_close(there_and_back.points(points), back.points(chain.points(points)))
    assert (there_and_back.fixed.grid, there_and_back.moving.grid) == (fixed.grid, fixed.grid)
    three = chain.then(back).then(chain)
    torch.testing.assert_close(three.points(points), chain.then(back.then(chain)).points(points))
    undone = there_and_back.inverse()
    torch.testing.assert_close(undone.points(points), chain.inverse().points(chain.points(points)), atol=0.1, rtol=0)


def test_flattening_keeps_the_map_at_the_nodes(spaces, chain):
    fixed, moving = spaces
    flat = Transform((chain.flatten(),))
    nodes = fixed.to_world(fixed.grid.points(dtype=torch.float64))
    torch.testing.assert_close(flat.points(nodes), chain.points(nodes), atol=1e-9, rtol=0)
    torch.testing.assert_close(flat.image(moving).data, chain.image(moving).data, atol=1e-3, rtol=0)


def test_determinants(spaces, chain):
    """Of an affine map exactly, of a field those of its own grid, of a chain their product."""
    fixed, _ = spaces
    displacement, last = chain.stages
    det = torch.linalg.det(last.matrix)
    alone = Transform((last,), fixed=fixed).jacobian_determinant().data
    torch.testing.assert_close(alone, det.expand_as(alone))
    own = jacobian_determinant(displacement.field.data, fixed.grid)
    torch.testing.assert_close(Transform((displacement,)).jacobian_determinant().data, own, atol=1e-9, rtol=0)
    torch.testing.assert_close(chain.jacobian_determinant().data, det * own, atol=1e-9, rtol=0)


def test_determinant_converges_to_that_of_the_smooth_map(make_image):
    """x + a sin(x) on finer and finer grids, read on a grid of another direction; the order is 2."""

    def error(n: int) -> float:
        grid = Grid((n + 1, n + 1), (8 / n, 8 / n))
        place = Image(torch.zeros(1, 1, *grid.shape), grid)
        u = 0.5 * torch.sin(grid.points(dtype=torch.float64).flip(1))
        other = make_image((9, 9), (0.3, 0.3), origin=(3.0, 2.0), tilted=True)
        found = Transform.from_displacement(u, place).jacobian_determinant(other).data
        x, y = other.to_world(other.grid.points(dtype=torch.float64)).unbind(1)
        return float((found[0] - (1 - 0.25 * x.cos() * y.cos())).abs().max())

    assert math.log2(error(32) / error(64)) == pytest.approx(2, abs=0.25)


@pytest.mark.parametrize("device", DEVICES)
def test_devices(spaces, chain, device):
    fixed, moving = spaces
    there, points = chain.to(device), world(fixed)
    torch.testing.assert_close(there.points(points.to(device)).cpu(), chain.points(points))
    assert there.image(moving.to(device)).data.device.type == device
    assert there.flatten().field.data.device.type == device
    assert there.jacobian_determinant().data.device.type == device
    torch.testing.assert_close(there.inverse().points(points.to(device)).cpu(), chain.inverse().points(points))


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients(dim, make_image):
    fixed = make_image((4, 5, 4)[:dim], (1.1, 0.9, 1.3)[:dim], tilted=True)
    moving = make_image((6, 6, 6)[:dim], origin=(-1.3, -1.7, -0.9)[:dim])
    generator = torch.manual_seed(0)
    u = 0.1 * torch.randn(1, dim, *fixed.grid.shape, dtype=torch.float64, generator=generator)
    linear, points = affine(dim, strength=0.02, shift=0.05), world(fixed, 3)
    pixels = torch.randn(moving.data.shape, dtype=torch.float64, generator=generator)

    def build(u, matrix, offset):
        return Transform.from_displacement(u, fixed, affine=Affine(matrix, offset))

    numbers = [t.clone().requires_grad_() for t in (u, linear.matrix, linear.offset)]
    assert gradcheck(lambda p, *n: build(*n).points(p), (points.requires_grad_(), *numbers))
    assert gradcheck(lambda *n: build(*n).jacobian_determinant().data, numbers)
    for mode in ("linear", "cubic"):
        assert gradcheck(
            lambda x, *n, mode=mode: build(*n).image(replace(moving, data=x), mode=mode, outside=None).data,
            (pixels.requires_grad_(), *numbers),
            fast_mode=True,
        )


def test_only_places_are_kept(spaces, chain):
    fixed, _ = spaces
    assert chain.fixed.data.untyped_storage().nbytes() == 4
    assert chain.fixed.origin == fixed.origin
    assert chain.reference.grid == fixed.grid
    assert Transform(chain.stages).reference.grid == fixed.grid
    assert Transform(chain.stages[1:]).reference is None


def test_what_does_not_fit_is_refused(spaces, chain, make_image):
    fixed, moving = spaces
    dim = chain.dim
    away = replace(moving, origin=(9000.0,) * dim, name="away")
    other = make_image((8,) * (5 - dim))
    with pytest.raises(InputError, match="one stage at least"):
        Transform(())
    with pytest.raises(InputError, match="2D, 3D"):
        Transform((Affine.identity(2), Affine.identity(3)))
    with pytest.raises(InputError, match="batch of 2"):
        Displacement(replace(fixed, data=torch.zeros(2, dim, *fixed.grid.shape)))
    with pytest.raises(InputError, match="must have shape"):
        Displacement(fixed)
    with pytest.raises(InputError, match="inverse must be"):
        Displacement(chain.stages[0].field, replace(other, data=torch.zeros(1, 5 - dim, *other.grid.shape)))
    with pytest.raises(InputError, match="points must have shape"):
        chain.points(torch.zeros(4, dim + 1))
    with pytest.raises(InputError, match="does not know its fixed grid"):
        Transform(chain.stages[1:]).image(moving)
    with pytest.raises(InputError, match="the transform's moving space lie apart"):
        chain.image(away)
    with pytest.raises(InputError, match="the transform's fixed space lie apart"):
        chain.image(moving, away)
    with pytest.raises(InputError, match=f"image is {5 - dim}D but the transform is {dim}D"):
        chain.image(other)
    with pytest.raises(InputError, match=f"image is {5 - dim}D but the transform is {dim}D"):
        chain.flatten(other)
    with pytest.raises(InputError, match="give the transform applied first first"):
        chain.then(Transform((Affine.identity(dim),), fixed=away))
    with pytest.raises(InputError, match="interpolation must be one of"):
        chain.image(moving, mode="spline")
