"""Maps of the world as plain numbers, as files hold them: linear maps, fields of vectors and B-splines, LPS mm."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError

Numbers = NDArray[np.float64]

# A spline becomes a field whose linear interpolation misses it by no more than this: in mm, and in cells of its mesh.
_CLOSE, _SHARE = 0.02, 0.01
_NODES = 1 << 24  # of the field; with more, the share of a cell alone counts


@dataclass(frozen=True)
class Linear:
    """x ↦ M x + t.

    Attributes:
        matrix: M ``(D, D)``.
        offset: t ``(D,)``, mm.
    """

    matrix: Numbers
    offset: Numbers

    @classmethod
    def about(cls, centre: Numbers, matrix: Numbers, shift: Numbers) -> "Linear":
        """Return x ↦ M (x − c) + c + t."""
        return cls(matrix, centre - matrix @ centre + shift)


@dataclass(frozen=True)
class Field:
    """x ↦ x + d(x), d between the nodes of a grid, 0 outside.

    Attributes:
        vectors: ``(*S, D)``, array order (z, y, x), vectors (x, y, z) in mm.
        origin: of node 0, mm.
        spacing: along x, y, z, mm.
        direction: columns are the directions of the grid's x, y, z.
    """

    vectors: Numbers
    origin: Numbers
    spacing: Numbers
    direction: Numbers


@dataclass(frozen=True)
class Spline:
    """x ↦ x + Σ c_j β(x/h − j), 0 where not all of the B-splines are there.

    Attributes:
        vectors: coefficients c ``(*S, D)``, as those of a `Field`.
        origin: of coefficient 0, mm.
        spacing: of the mesh h along x, y, z, mm.
        direction: as that of a `Field`.
        order: of the B-splines, 1 to 3.
    """

    vectors: Numbers
    origin: Numbers
    spacing: Numbers
    direction: Numbers
    order: int = 3

    def dense(self, name: str) -> Field:
        """Return the spline as a field on its own domain, fine enough that its linear interpolation is close.

        Args:
            name: the file, for the sentence.

        Raises:
            InputError: no domain, numbers that are not finite, or so many nodes that they do not fit.

        Notes:
            The error of linear interpolation is at most Σ_a (h_a²/8) |∂²d/∂x_a²|, and the second derivatives of a
            spline are no larger than the second differences of its coefficients.
        """
        shape = np.array(self.vectors.shape[:-1])
        if not np.isfinite(self.vectors).all() or min(shape) <= self.order:
            raise InputError(f"{name} holds a B-spline without a domain or with numbers that are not finite")
        cell = float(min(self.spacing))
        cuts = self._cuts(min(_CLOSE, _SHARE * cell))
        if math.prod((shape - self.order) * cuts + 1) > _NODES:
            cuts = self._cuts(_SHARE * cell)
        if math.prod(nodes := (shape - self.order) * cuts + 1) > _NODES:
            raise InputError(f"{name} holds a B-spline that is too rough for a field; {to_field(name)}")
        values = self.vectors
        for axis, (count, cut) in enumerate(zip(shape, cuts, strict=True)):
            weights = _weights(int(count), self.order, int(cut))
            values = np.moveaxis(np.tensordot(weights, values, axes=(1, axis)), 0, axis)
        start = np.full(len(nodes), (self.order - 1) / 2)
        origin = self.origin + self.direction @ (self.spacing * start)
        return Field(np.ascontiguousarray(values), origin, self.spacing / cuts[::-1], self.direction)

    def _cuts(self, error: float) -> NDArray[np.int64]:
        """Return into how many parts a cell must be cut along each array axis."""
        axes = range(self.vectors.ndim - 1)
        bends = [np.linalg.norm(np.diff(self.vectors, 2, axis), axis=-1).max(initial=0.0) for axis in axes]
        wanted = np.sqrt(len(bends) * np.array(bends) / (8 * error)) * (self.order > 1)
        return np.clip(np.ceil(wanted), 1, _NODES).astype(np.int64)


def _weights(count: int, order: int, cuts: int) -> Numbers:
    """Return the B-splines ``(nodes, coefficients)`` at the nodes of an axis."""
    from scipy.interpolate import BSpline

    knots = np.arange(count + order + 1) - (order + 1) / 2
    places = np.linspace(knots[order], knots[count], (count - order) * cuts + 1)
    return BSpline.design_matrix(places, knots, order).toarray()


def to_field(name: str) -> str:
    """Return the advice that turns any transform of ITK into a field."""
    return (
        f"sample it on the fixed image: f = SimpleITK.ReadImage('fixed.nii.gz'); SimpleITK.WriteImage(SimpleITK."
        f"TransformToDisplacementField(SimpleITK.ReadTransform('{name}'), SimpleITK.sitkVectorFloat64, f.GetSize(), "
        "f.GetOrigin(), f.GetSpacing(), f.GetDirection()), 'field.nii.gz')"
    )
