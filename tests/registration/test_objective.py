"""What is maximised, and which maps move together."""

import torch
from nested_settings import settings_of
from pictures import bend, blobs

from torchdeform.core.grid import Grid
from torchdeform.registration.channels import with_channels
from torchdeform.registration.objective import Addition, Coupling, forward_objective
from torchdeform.registration.problem import RegistrationProblem


def test_maps_of_a_batch_are_by_themselves_without_a_coupling():
    coupling, v = Coupling(), torch.randn(2, 2, 5, 6)
    for same in (coupling.velocity, coupling.extended, coupling.counted, coupling.all, coupling.together):
        assert same(v) is v


def test_an_addition_counts_in_the_choice_of_the_best_map():
    shape = (40, 40)
    grid, image, labels = Grid(shape), blobs(shape), (blobs(shape) > 0.5).float()
    settings = settings_of(labels_weight=1.0).decided()
    problem = with_channels(RegistrationProblem(grid, image, image, labels=(labels, labels)), settings)
    objective = forward_objective(problem, grid, settings)
    maps = [torch.zeros(1, 2, *shape), bend(grid, 3.0)]
    alone = objective.similarity.on_common_voxels(maps)
    whole = objective.on_common_voxels(maps, None)
    assert whole[0] == alone[0]
    assert whole[1] < alone[1]
    assert isinstance(objective.more[0], Addition)
