"""The div-curl least squares on Q1 elements: weak form, assembly, system, solvers."""

from torchdeform.fem.boundary import Face
from torchdeform.fem.div_curl import DivCurlSolution, solve_div_curl
from torchdeform.fem.solver import SolverSettings
from torchdeform.fem.system import DivCurlSystem
from torchdeform.fem.weights import Weights, weights_of_labels

__all__ = [
    "DivCurlSolution",
    "DivCurlSystem",
    "Face",
    "SolverSettings",
    "Weights",
    "solve_div_curl",
    "weights_of_labels",
]
