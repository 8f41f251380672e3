"""The weights of the div-curl least squares."""

import math

import pytest
import torch

from torchdeform.core.grid import Grid
from torchdeform.errors import InputError
from torchdeform.fem.weights import Weights, weights_of_labels

GRID = Grid((4, 5))


def test_what_is_constant_and_what_is_isotropic():
    per_item, per_element = torch.rand(3, 1, 1, 1) + 1, torch.rand(1, 1, 3, 4) + 1
    assert Weights().constant
    assert Weights(2.0, 2.0, 0.1).isotropic
    assert not Weights(2.0, 1.0).isotropic
    assert Weights(per_item, 1.0).constant
    assert not Weights(1.0, per_element).constant
    assert Weights(per_item, per_item.clone()).isotropic
    assert not Weights(per_item, 1.0).isotropic
    wanted = torch.tensor(1.0, requires_grad=True)
    assert not Weights(wanted, 1.0).isotropic
    assert Weights(wanted, wanted).isotropic
    assert Weights(1.0, 1.0, torch.tensor(0.1)).zero_positive
    assert not Weights().zero_positive


def test_what_is_typical_is_a_quarter_up_the_elements_of_each_item():
    weight = torch.rand(3, 1, 3, 4) + 1
    typical = Weights(weight, 2.0, torch.tensor(0.5), strain=10 * weight).typical()
    torch.testing.assert_close(typical.div, weight.flatten(1).sort().values[:, 3].view(3, 1, 1, 1))
    torch.testing.assert_close(typical.strain, 10 * typical.div)
    assert typical.curl == 2.0
    assert typical.constant


def test_tensors_can_be_exchanged_and_moved():
    weights = Weights(torch.ones(1, 1, 3, 4), 2.0, torch.tensor(0.5))
    assert len(weights.tensors) == 2
    other = weights.with_tensors((torch.zeros(1), torch.ones(1)))
    assert float(other.div) == 0
    assert other.curl == 2.0
    assert float(other.zero) == 1
    assert all(w.dtype == torch.float64 for w in weights.to(torch.zeros(1, dtype=torch.float64)).tensors)


@pytest.mark.parametrize("bad", [{"div": 0.0}, {"curl": -1.0}, {"zero": -1e-3}, {"div": math.nan}, {"zero": math.inf}])
def test_numbers_out_of_range_are_refused(bad):
    with pytest.raises(InputError, match=f"Weights: {next(iter(bad))} must be finite"):
        Weights(**bad)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (torch.ones(3, 4), r"must be a number or have shape \(B, 1, 3, 4\)"),
        (torch.ones(1, 1, 4, 5), r"must be a number or have shape \(B, 1, 3, 4\)"),
        (torch.ones(1, 2, 3, 4), r"must be a number or have shape \(B, 1, 3, 4\)"),
        (torch.zeros(1, 1, 3, 4), "must be finite and positive, got 0"),
        (torch.full((1, 1, 3, 4), math.nan), "must be finite and positive"),
    ],
)
def test_tensors_that_do_not_fit_are_refused(bad, message):
    with pytest.raises(InputError, match=message):
        Weights(div=bad).check(GRID)


def test_tensors_that_fit_are_taken():
    Weights(torch.ones(2, 1, 3, 4), torch.ones(1, 1, 1, 4), torch.tensor(0.0)).check(GRID)


def test_labels_cost_what_they_are_said_to_and_their_border_is_soft():
    labels = torch.zeros(2, 1, 4, 5, dtype=torch.int64)
    labels[0, 0, :2] = 3
    labels[1, 0, :, 4] = 7
    prices = {3: Weights(100.0, 1.0, 0.2, 10.0), 7: Weights(0.5, 1.0, 0.2, 4.0), 9: Weights(1e4, 1.0, 0.2)}
    weights = weights_of_labels(labels, prices, Weights(0.5, 1.0, 0.2), GRID)
    weights.check(GRID)
    assert (weights.curl, weights.zero) == (1.0, 0.2)
    torch.testing.assert_close(weights.div[0, 0], torch.tensor([100.0, 50.25, 0.5]).view(3, 1).expand(3, 4))
    torch.testing.assert_close(weights.strain[1, 0], torch.tensor([0.0, 0.0, 0.0, 2.0]).expand(3, 4))
    torch.testing.assert_close(weights.div[1], torch.full((1, 3, 4), 0.5))


def test_labels_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match=r"labels must have shape \(B, 1, 4, 5\), got \(1, 4, 5\)"):
        weights_of_labels(torch.zeros(1, 4, 5), {}, Weights(), GRID)


def test_the_base_is_what_the_cheapest_sixteenth_costs_with_strain_as_divergence_and_curl():
    strain = torch.zeros(1, 1, 4, 8)
    strain[..., 1:] = 10.0
    base = Weights(0.5, 1.0, 0.1, strain).base(2)
    assert (float(base.div), float(base.curl), base.zero, base.strain) == (0.5, 1.0, 0.1, 0.0)
    even = Weights(0.5, 0.0, 0.1, torch.full((1, 1, 4, 8), 10.0)).base(2)
    assert (float(even.div), float(even.curl)) == (5.5, 5.0)
