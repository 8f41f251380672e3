"""Tissue: what it costs by element, how it comes to coarser grids, and that shapes and volumes are kept in the end."""

from itertools import product

import numpy as np
import pytest
import torch
from nested_settings import settings_of
from pictures import bend, disc
from tissues import kabsch_residual
from torch import Tensor

from torchdeform.core.diagnostics import diagnose
from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.weights import Weights
from torchdeform.registration.settings import TISSUES
from torchdeform.registration.tissue import Tissue

PLACES = [Grid((26, 30), (1.0, 0.5)), Grid((14, 16, 12), (0.5, 1.0, 0.8))]
OWN = {"div": 7.0, "strain": 3.0, "curl": 0.0}
BASE = Weights(0.5, 1.0, 0.01)


def labels_on(shape: tuple[int, ...], items: int = 1) -> Tensor:
    """Labels 0, 1, 2, 3 in boxes, other ones in every item."""
    generator = torch.Generator().manual_seed(1)
    coarse = torch.randint(0, 4, (items, 1, *[-(-n // 4) for n in shape]), generator=generator)
    for axis in range(len(shape)):
        coarse = coarse.repeat_interleave(4, dim=axis + 2)
    return coarse[(..., *[slice(n) for n in shape])]


def tissue_of(labels: Tensor, tissues: dict, sliding: tuple[int, ...] = ()) -> Tissue:
    return Tissue.of(labels, settings_of(tissues=tissues, sliding=sliding), torch.zeros(1))


def balls(shape: tuple[int, ...], kinds: int = 2, offset: float = 0.0, divisor: float = 3.2) -> Tensor:
    """A ball for each label, apart from each other along the first axis."""
    labels = torch.zeros(1, 1, *shape)
    for k in range(kinds):
        centre = ((k + 0.5) * shape[0] / kinds + offset, *[n / 2 for n in shape[1:]])
        labels[disc(shape, centre, shape[0] / (divisor * kinds)) > 0] = k + 1
    return labels


@pytest.mark.parametrize("grid", PLACES)
@pytest.mark.parametrize("items", [1, 2])
def test_an_element_costs_the_mean_of_its_corners(grid, items):
    labels = labels_on(grid.shape, items)
    tissue = tissue_of(labels, {1: "rigid", 2: OWN, 3: "free"})
    found, prices = tissue.weights(BASE), {0: {}, 1: TISSUES["rigid"], 2: OWN, 3: {}}
    assert float(found.zero) == BASE.zero
    for item, *element in product(range(items), *[range(0, n - 1, 3) for n in grid.shape]):
        corners = [labels[(item, 0, *np.add(element, corner))] for corner in product((0, 1), repeat=grid.dim)]
        for name in ("div", "curl", "strain"):
            wanted = np.mean([prices[int(label)].get(name, getattr(BASE, name)) for label in corners])
            assert float(getattr(found, name)[(item, 0, *element)]) == pytest.approx(wanted, rel=1e-5, abs=1e-5)


def test_where_nothing_has_a_price_the_weights_are_numbers():
    tissue = tissue_of(labels_on((24, 24)), {1: "free"}, (2,))
    assert tissue.weights(BASE) is BASE
    assert bool((tissue.free == 1).all())
    assert tissue.hold(Grid((24, 24))) is None


def test_kinds_prices_and_borders_are_those_of_the_settings():
    tissue = tissue_of(labels_on((20, 20)), {3: OWN, 1: "incompressible"}, (2, 3))
    assert tissue.labels == (1, 2, 3)
    assert tissue.kinds == ("incompressible", "free", "own")
    assert tissue.prices == (TISSUES["incompressible"], {}, OWN)
    assert tissue.sliding == (False, True, True)
    assert torch.equal(tissue.gliding, tissue.shares[:, 1:])


@pytest.mark.parametrize("grid", PLACES)
def test_on_coarser_grids_shares_stay_shares(grid):
    labels = labels_on(grid.shape, 2)
    fine = tissue_of(labels, {1: "rigid", 2: "stiff", 3: "free"})
    assert fine.on(grid, grid) is fine
    assert torch.equal(fine.shares.sum(1, keepdim=True), (labels > 0).float())
    shape = tuple((n + 1) // 2 for n in grid.shape)
    coarse = fine.on(grid, Grid(shape, tuple(e / (n - 1) for e, n in zip(grid.extent, shape, strict=True))))
    assert coarse.shares.shape == (2, 3, *shape)
    assert -1e-6 < coarse.shares.min() < coarse.shares.max() < 1 + 1e-6
    assert coarse.shares.sum(1).max() < 1 + 1e-5
    assert -1e-6 < coarse.free.min() < coarse.free.max() <= 1
    assert abs(coarse.shares.mean() - fine.shares.mean()) < 0.05
    assert coarse.masks("rigid").sum(1).max() <= 1


def test_free_is_what_no_price_holds():
    labels = labels_on((24, 24))
    tissue = tissue_of(labels, {1: "rigid", 2: OWN, 3: "free"})
    assert torch.equal(tissue.free, ((labels == 0) | (labels == 3)).float())


def test_a_label_that_nobody_has_is_named():
    labels = torch.zeros(2, 1, 10, 10)
    labels[1, 0, 3:6, 3:6] = 4
    tissue_of(labels, {4: "rigid"})  # one item has it
    with pytest.raises(InputError, match=r"no voxel has the label 5 that the settings name"):
        tissue_of(labels, {4: "rigid", 5: "stiff"})
    with pytest.raises(InputError, match=r"no voxel has the label 6"):
        tissue_of(labels, {4: "rigid"}, (6,))


@pytest.mark.parametrize("spacing", [1.0, 0.4])
@pytest.mark.parametrize("shape", [(56, 48), (28, 24, 22)])
def test_what_is_rigid_and_what_keeps_its_volume_do_so_in_the_end(shape, spacing):
    grid = Grid(shape, (1.0, *[spacing] * (len(shape) - 1)))
    labels, u = balls(shape), bend(grid, 2.0)
    tissue = tissue_of(labels, {1: "rigid", 2: "incompressible"})
    v, (rigid, even) = tissue.corrected(u, grid, 0.03)
    along = torch.tensor(grid.spacing).view(-1, *[1] * grid.dim)
    stretched = kabsch_residual(v[0], (labels == 1)[0, 0], grid.spacing)
    assert stretched < 1e-3 < 0.05 < kabsch_residual(u[0], (labels == 1)[0, 0], grid.spacing)
    voxels = (v[0] / along).double().numpy()
    gradient = np.stack([np.stack(np.gradient(component)) for component in voxels])
    identity = np.eye(grid.dim).reshape(grid.dim, grid.dim, *[1] * grid.dim)
    off = np.abs(np.linalg.det(np.moveaxis(gradient + identity, (0, 1), (-2, -1))) - 1)[(labels == 2)[0, 0].numpy()]
    assert np.quantile(off, 0.999) < 0.01
    assert int(diagnose(v, grid).folds) == 0
    assert (rigid.label, rigid.kind, even.label, even.kind) == (1, "rigid", 2, "incompressible")
    assert int(rigid.nodes) == int((labels == 1).sum())
    assert float(rigid.after.residual) < 0.01 < 0.05 < float(rigid.before.residual)
    assert float(even.after.off) < 0.01 < 0.05 < float(even.before.off)
    assert abs(float(even.after.volume) - 1) < 2e-3


@pytest.mark.parametrize("many", [1, 2])
def test_items_may_have_labels_of_their_own_or_share_them(many):
    shape = (44, 40)
    grid, u = Grid(shape), torch.cat([bend(Grid(shape), 1.0), bend(Grid(shape), 2.0)])
    labels = torch.cat([balls(shape), balls(shape, offset=-2.0)])[:many]
    labels[-1, 0][labels[-1, 0] == 2] = 2 if many == 1 else 0  # the last of two lacks a label
    v, outcomes = tissue_of(labels, {1: "rigid", 2: "incompressible"}).corrected(u, grid, 0.03)
    assert outcomes[0].nodes.shape == outcomes[1].after.off.shape == (2,)
    assert bool(outcomes[1].after.off.isnan()[1]) == (many == 2)
    for item in range(2):
        own = labels[item % many, 0] == 1
        assert kabsch_residual(v[item], own) < 1e-3


def test_nothing_is_corrected_where_nothing_is_to_be_kept():
    grid = Grid((30, 32))
    u = bend(grid, 1.0)
    v, (outcome,) = tissue_of(balls(grid.shape, 1), {1: "stiff"}).corrected(u, grid, 0.03)
    assert torch.equal(u, v)
    assert torch.equal(outcome.before.residual, outcome.after.residual)


@pytest.mark.parametrize("divisor", [2.7, 3.2])
def test_a_shape_near_the_faces_of_a_strongly_bent_box_is_kept_without_folds(divisor):
    """Held at once it would fold what is between the label and the box."""
    grid = Grid((28, 24, 22))
    labels, u = balls(grid.shape, divisor=divisor), bend(grid, 3.0)
    v, (outcome,) = tissue_of(labels, {1: "rigid"}).corrected(u, grid, 0.03)
    assert int(diagnose(v, grid).folds) == 0
    assert float(outcome.after.residual) < 0.1 < float(outcome.before.residual)
