"""Maps of the world as plain numbers, as files hold them: linear maps and B-splines; fields are volumes. LPS mm."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchdeform.errors import InputError
from torchdeform.io.volume import Volume

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
class Spline:
    """x ↦ x + Σ c_j β(x/h − j), 0 where not all of the B-splines are there.

    Attributes:
        coefficients: c as vectors (x, y, z) in mm, on a mesh of spacing h.
        order: of the B-splines, 1 to 3.
    """

    coefficients: Volume
    order: int = 3

    def dense(self, name: str) -> Volume:
        """Return the spline as vectors on its own domain, so fine that their linear interpolation is close.

        Args:
            name: the file, for the sentence.

        Raises:
            InputError: no domain, numbers that are not finite, or so many nodes that they do not fit.

        Notes:
            The error of linear interpolation is at most Σ_a (h_a²/8) |∂²d/∂x_a²|, and the second derivatives of a
            spline are no larger than the second differences of its coefficients.
        """
        mesh = self.coefficients
        values, spacing = mesh.values.astype(np.float64), np.array(mesh.spacing)
        if not np.isfinite(values).all() or min(mesh.size) <= self.order or self.order < 1:
            raise InputError(f"{name} holds a B-spline that is stepped, has no domain or numbers that are not finite")
        cell = float(min(spacing))
        cuts = self._cuts(values, min(_CLOSE, _SHARE * cell))
        if self._nodes(cuts) > _NODES:
            cuts = self._cuts(values, _SHARE * cell)
        if self._nodes(cuts) > _NODES:
            raise InputError(f"{name} holds a B-spline that is too rough for a field; {to_field(name)}")
        for axis, cut in enumerate(cuts):
            weights = _weights(values.shape[axis], self.order, cut)
            values = np.moveaxis(np.tensordot(weights, values, axes=(1, axis)), 0, axis)
        start = np.array(mesh.origin) + mesh.direction @ (spacing * (self.order - 1) / 2)
        return Volume(values, tuple(spacing / cuts[::-1]), tuple(start), mesh.direction)

    def _cuts(self, values: Numbers, error: float) -> list[int]:
        """Return into how many parts a cell must be cut along each array axis."""
        axes = range(values.ndim - 1)
        with np.errstate(over="ignore"):  # then there are too many nodes
            bends = [np.linalg.norm(np.diff(values, 2, axis), axis=-1).max(initial=0.0) for axis in axes]
        wanted = np.sqrt(len(bends) * np.array(bends) / (8 * error)) * (self.order > 1)
        return np.clip(np.ceil(wanted), 1, _NODES).astype(int).tolist()

    def _nodes(self, cuts: list[int]) -> int:
        counts = self.coefficients.size[::-1]
        return math.prod((count - self.order) * cut + 1 for count, cut in zip(counts, cuts, strict=True))


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
