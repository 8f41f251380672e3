"""The deformation method: maps with a given Jacobian determinant, as grids that follow a monitor function."""
