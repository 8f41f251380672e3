"""Finite elements: the div-curl least squares and the direct solver for it."""

from torchdeform.fem.boundary import Face
from torchdeform.fem.div_curl import DivCurlSolution, SolverSettings, solve_div_curl
from torchdeform.fem.fast_transform import TransformSolver
from torchdeform.fem.weights import Weights

__all__ = ["DivCurlSolution", "Face", "SolverSettings", "TransformSolver", "Weights", "solve_div_curl"]
