"""The assembled matrix: with values on the boundary it has the solution that it should."""

import torch
from forms import close, random_field

from torchdeform.core.grid import Grid
from torchdeform.fem.assembly import assemble, constrain_matrix
from torchdeform.fem.boundary import fixed_unknowns, lift
from torchdeform.fem.form import div_curl_form
from torchdeform.fem.operator import apply_form
from torchdeform.fem.weights import Weights


def test_a_constrained_matrix_solves_with_the_values_lifted():
    grid = Grid((4, 5), (1.0, 0.7))
    form, fixed = div_curl_form(2, Weights(2.0, 1.0)), fixed_unknowns("dirichlet", grid)
    exact = random_field(grid, batch=1)
    load = apply_form(form, exact, grid)
    matrix = constrain_matrix(assemble(form, grid), fixed)
    close(matrix.to_dense(), matrix.to_dense().T)
    right = lift(lambda v: apply_form(form, v, grid), load, exact, fixed)
    solved = torch.linalg.solve(matrix.to_dense(), right.flatten()).view_as(exact) + exact.masked_fill(~fixed, 0)
    close(solved, exact, atol=1e-12)
