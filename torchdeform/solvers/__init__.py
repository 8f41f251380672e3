"""Linear solvers: conjugate gradients, fast transforms, and what a solver returns."""
