"""Matrices of one element: kept once where the form is constant."""

from torchdeform.core.grid import Grid
from torchdeform.fem.elements import components, element_matrices
from torchdeform.fem.form import div_curl_form, gradient_form
from torchdeform.fem.weights import Weights


def test_element_matrices_of_constant_forms_are_kept_once():
    grid = Grid((9, 9, 9))
    assert element_matrices(div_curl_form(3, Weights()), grid).shape == (1, 24, 24, 1, 1, 1)
    assert components(gradient_form(3)) == 1
