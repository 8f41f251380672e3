"""Boundary conditions face by face."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.boundary import (
    FIXES,
    Face,
    constrain,
    faces,
    fixed_unknowns,
    normal_is_given,
    outward_flux,
    resolve_boundary,
)


@pytest.mark.parametrize("dim", [2, 3])
def test_each_kind_gives_its_components(dim):
    grid = Grid((4,) * dim)
    inner = (slice(1, -1),) * (dim - 1)
    for kind, normal, tangential in (
        ("slip", True, False),
        ("no_slip_tangential", False, True),
        ("dirichlet", True, True),
        ("free", False, False),
    ):
        mask = fixed_unknowns(kind, grid)
        assert mask.shape == (1, dim, *grid.shape)
        assert mask.dtype == torch.bool
        assert not mask[(0, slice(None), *[slice(1, -1)] * dim)].any()
        for axis in range(dim):
            for k in range(dim):
                for end in (0, -1):
                    face = mask[0, k].select(axis, end)[inner]
                    assert bool((face == (normal if k == axis else tangential)).all())


def test_kinds_may_differ_from_face_to_face():
    kinds = dict.fromkeys(faces(2), "free") | {Face(0, 1): "slip", Face(1, 0): "dirichlet"}
    mask = fixed_unknowns(kinds, Grid((3, 4)))[0]
    want = torch.zeros(2, 3, 4, dtype=torch.bool)
    want[0, -1, :] = True
    want[:, :, 0] = True
    assert torch.equal(mask, want)
    assert torch.equal(fixed_unknowns({tuple(f): k for f, k in kinds.items()}, Grid((3, 4)))[0], want)


def test_where_the_normal_is_given_all_around():
    assert normal_is_given("slip", 3)
    assert normal_is_given("dirichlet", 2)
    assert not normal_is_given("no_slip_tangential", 3)
    assert not normal_is_given("free", 2)
    mixed = resolve_boundary("slip", 2) | {Face(1, 1): "dirichlet"}
    assert normal_is_given(mixed, 2)
    assert not normal_is_given(mixed | {Face(0, 0): "free"}, 2)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(2, 6), min_size=2, max_size=3), st.lists(st.floats(0.1, 5.0), min_size=3, max_size=3))
def test_the_flux_of_a_linear_field_is_its_divergence_times_the_volume(shape, spacing):
    grid = Grid(tuple(shape), tuple(spacing[: len(shape)]))
    matrix = torch.randn(grid.dim, grid.dim, dtype=torch.float64)
    v = torch.einsum("ij,bj...->bi...", matrix, grid.points(dtype=torch.float64)) + 3.0
    torch.testing.assert_close(outward_flux(v, grid), (matrix.trace() * grid.volume).view(1))


def test_a_constrained_operator_neither_reads_nor_writes_what_is_fixed():
    mask = fixed_unknowns("slip", Grid((3, 3)))
    v = torch.randn(1, 2, 3, 3)
    projected = constrain(lambda w: 2 * w + 1, mask)(v)
    assert not projected[mask].any()
    torch.testing.assert_close(projected[~mask], 2 * v[~mask] + 1)


@pytest.mark.parametrize(
    ("boundary", "message"),
    [
        ("slipp", "did you mean 'slip'"),
        ({Face(0, 0): "slip"}, r"no kind for face \(0, 1\)"),
        (resolve_boundary("slip", 3), "unknown face"),
        (resolve_boundary("slip", 2) | {Face(1, 1): "dirichlett"}, r"face \(1, 1\) must be one of .* 'dirichlet'"),
    ],
)
def test_wrong_boundaries_are_refused(boundary, message):
    with pytest.raises(InputError, match=message):
        resolve_boundary(boundary, 2)


def test_the_table_holds_every_kind():
    assert set(FIXES) == {"slip", "no_slip_tangential", "dirichlet", "free"}
