"""Maps between physical spaces, in world points (x, y, z) in LPS mm: what `io` writes for ITK and reads from it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchdeform.core.derivatives import jacobian_determinant
from torchdeform.core.grid import over_slabs, require_float
from torchdeform.core.image import AUTO, Image, independence, outside_value, overlap
from torchdeform.core.interpolation import COPYING, LABEL_MODE, interpolator
from torchdeform.core.warp import inside_box, invert, sample
from torchdeform.errors import InputError

# A displacement that moves the faces of its grid further than this, in voxels, is no map of the grid onto itself.
_LARGEST_LEAK = 0.5

# Nodes along each axis of a face that an affine map is fitted to, about.
_LATTICE = 24


@dataclass(frozen=True)
class Affine:
    """The map x ↦ M x + t of world points (x, y, z) in LPS mm.

    Args:
        matrix: M ``(D, D)``.
        offset: t ``(D,)`` in mm.

    Raises:
        InputError: shapes, values that are not finite, or a singular matrix.
    """

    matrix: Tensor
    offset: Tensor

    def __post_init__(self) -> None:
        dim = self.offset.numel()
        if dim not in (2, 3) or tuple(self.matrix.shape) != (dim, dim) or tuple(self.offset.shape) != (dim,):
            shapes = f"{tuple(self.matrix.shape)} and {tuple(self.offset.shape)}"
            raise InputError(f"Affine: matrix must be (D, D) and offset (D,) with D = 2 or 3, got {shapes}")
        require_float(self.matrix, "Affine: matrix")
        require_float(self.offset, "Affine: offset")
        if not bool(self.matrix.isfinite().all() and self.offset.isfinite().all()):
            raise InputError("Affine: matrix and offset must be finite")
        if independence(self.matrix) == 0:
            raise InputError("Affine: the matrix is singular; it takes a volume to a plane")

    @property
    def dim(self) -> int:
        """Number of axes D, 2 or 3."""
        return self.offset.numel()

    @classmethod
    def identity(cls, dim: int) -> "Affine":
        """Return x ↦ x in ``dim`` dimensions, float64."""
        return cls(
            torch.eye(dim, dtype=torch.float64, device="cpu"), torch.zeros(dim, dtype=torch.float64, device="cpu")
        )

    def __call__(self, points: Tensor) -> Tensor:
        """Return M x + t for points ``(B, D, *T)``, in their type and on their device."""
        offset = self.offset.to(points).view(1, -1, *([1] * (points.dim() - 2)))
        return torch.einsum("ij,bj...->bi...", self.matrix.to(points), points) + offset

    def inverse(self) -> "Affine":
        """Return the inverse map."""
        matrix = torch.linalg.inv(self.matrix)
        return Affine(matrix, -matrix @ self.offset)

    def then(self, other: "Affine") -> "Affine":
        """Return the map that applies this one first and ``other`` second."""
        return Affine(other.matrix @ self.matrix, other.matrix @ self.offset + other.offset)

    def undo(self) -> "tuple[Affine, ...]":
        """Return the stages of the inverse map, one."""
        return (self.inverse(),)

    def local_volume(self) -> Callable[[Tensor], Tensor]:
        """Return the function x ↦ det M of world points."""
        return lambda points: torch.linalg.det(self.matrix).to(points) * torch.ones_like(points[:, :1])

    def to(self, device: torch.device | str) -> "Affine":
        """Return the same map; its few numbers may stay where they are."""
        del device
        return self


def place_of(image: Image) -> Image:
    """Return an image with the same grid and place, but zeros that take no memory as pixels."""
    nothing = torch.zeros((), dtype=torch.float32, device="cpu").expand(1, 1, *image.grid.shape)
    return replace(image, data=nothing)


@dataclass(frozen=True, eq=False)
class Displacement:
    """The map x ↦ x + d(x) of world points, d being given on a grid, interpolated linearly, and 0 outside it.

    Args:
        field: an image whose ``data`` is u ``(1, D, *S)``: array order, units of spacing; d is u in world axes.
        known_inverse: the field of the inverse map, on any grid, where it is known.
        margin: how far around its nodes, in voxels, the field goes on with its nearest values; half a voxel in ITK.

    Raises:
        InputError: not one displacement, not D components, or an inverse of another dimension.
    """

    field: Image
    known_inverse: Image | None = None
    margin: float = 0.5

    def __post_init__(self) -> None:
        for image in (self.field, self.known_inverse or self.field):
            image.grid.check_vector(image.data, "Displacement: u")
            if image.data.shape[0] != 1:
                raise InputError(f"Displacement: u must be one displacement, got a batch of {image.data.shape[0]}")
        if self.known_inverse is not None and self.known_inverse.grid.dim != self.dim:
            raise InputError(f"Displacement: the inverse must be {self.dim}D, got {self.known_inverse.grid.dim}D")

    @property
    def dim(self) -> int:
        """Number of axes D, 2 or 3."""
        return self.field.grid.dim

    def __call__(self, points: Tensor) -> Tensor:
        """Return x + d(x) for world points ``(B, D, *T)``, in their type and on their device."""
        where = self.field.to_grid(points.double())
        u = sample(self.field.data.to(points.device), where, self.field.grid)
        inside = inside_box(where, self.field.grid, self.margin)
        return self.field.to_world(where + torch.where(inside, u, 0.0)).to(points.dtype)

    def undo(self) -> "tuple[Stage, ...]":
        """Return the stages of the inverse map: the known one, or else one found by Newton's method at every node.

        Notes:
            A field that moves the faces of its grid by more than half a voxel is first split into the affine map that
            fits its faces best and a remainder, A ∘ (id + r); the inverse (id + r)⁻¹ ∘ A⁻¹ then has a grid to live on.
        """
        if self.known_inverse is not None:
            return (Displacement(self.known_inverse, self.field),)
        if _leak(self.field) <= _LARGEST_LEAK:
            return (self._inverted(),)
        back = _best_affine(self.field).inverse()
        return (back, Transform((self, back)).flatten(self.field)._inverted())

    def _inverted(self) -> "Displacement":
        return Displacement(replace(self.field, data=invert(self.field.data, self.field.grid)), self.field)

    def local_volume(self) -> Callable[[Tensor], Tensor]:
        """Return the function x ↦ det ∇(x + d(x)) of world points, central differences between which it is linear."""
        volume, field = jacobian_determinant(self.field.data, self.field.grid), self.field
        return lambda points: sample(
            volume.to(points.device), field.to_grid(points.double()), field.grid, outside=1.0
        ).to(points.dtype)

    def to(self, device: torch.device | str) -> "Displacement":
        """Return the same map with its fields on ``device``."""
        return Displacement(self.field.to(device), self.known_inverse and self.known_inverse.to(device), self.margin)


def _leak(field: Image) -> float:
    """Return how far, in voxels, u moves a face of the grid along the face's normal."""
    u, grid = field.data.detach(), field.grid
    faces = (
        u[:, k].select(axis - 1, end).abs().max() / grid.spacing[k]
        for k, axis in enumerate(grid.axes)
        for end in (0, -1)
    )
    return float(max(faces))


@torch.no_grad()
def _best_affine(field: Image) -> Affine:
    """Return the affine map of the world that is nearest to id + u on the faces of the grid, by least squares."""
    points = field.grid.points(dtype=torch.float64, device=field.data.device)
    start, end = (_on_faces(field.to_world(p)) for p in (points, points + field.data))
    middle = start.mean(0)
    known = torch.cat((start - middle, torch.ones_like(start[:, :1])), dim=1)
    fit = torch.linalg.lstsq(known, end).solution
    matrix = fit[:-1].T
    return Affine(matrix.contiguous(), fit[-1] - matrix @ middle)


def _on_faces(field: Tensor) -> Tensor:
    """Return the vectors at a lattice of nodes on each face of the grid, as rows."""
    faces = [field.select(axis, end) for axis in range(2, field.dim()) for end in (0, -1)]
    some = (face[(..., *(slice(None, None, max(n // _LATTICE, 1)) for n in face.shape[2:]))] for face in faces)
    return torch.cat([face.flatten(2)[0].T for face in some]).cpu()


Stage = Affine | Displacement


@dataclass(frozen=True, eq=False)
class Transform:
    """A chain of maps φ = s_n ∘ … ∘ s_1 of world points (x, y, z) in LPS mm, from the fixed to the moving space.

    Points of the fixed space go to the moving space; images come the other way: φ pulls the moving image back onto the
    fixed grid, warped(x) = moving(φ(x)), as in ITK and ANTs. `inverse` turns both around.

    Args:
        stages: `Affine` and `Displacement`, the one that is applied to points first comes first.
        fixed: the image whose points go in, where it is known; only its place is kept.
        moving: the image whose points come out, where it is known; only its place is kept.

    Raises:
        InputError: no stage, or parts of different dimensions.
    """

    stages: tuple[Stage, ...]
    fixed: Image | None = None
    moving: Image | None = None
    _undone: "Transform | None" = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        spaces = {name: place_of(image) for name in ("fixed", "moving") if (image := getattr(self, name)) is not None}
        dims = {stage.dim for stage in self.stages} | {image.grid.dim for image in spaces.values()}
        if not self.stages or len(dims) > 1:
            parts = f"{len(self.stages)} stages of {', '.join(f'{d}D' for d in sorted(dims)) or 'no dimension'}"
            raise InputError(f"Transform: it needs one stage at least and one dimension throughout, got {parts}")
        for name, value in {"stages": tuple(self.stages), **spaces}.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_displacement(
        cls,
        u: Tensor,
        fixed: Image,
        *,
        inverse: Tensor | None = None,
        affine: Affine | None = None,
        moving: Image | None = None,
    ) -> "Transform":
        """Return φ(x) = A(x + u(x)): points of the fixed image go through u, then through A, into the moving space.

        Args:
            u: displacement ``(1, D, *S)`` on the fixed grid, array order, units of spacing.
            fixed: the image whose grid it lives on.
            inverse: displacement of (id + u)⁻¹ on the same grid, where it is known.
            affine: A, fixed world to moving world; left out when None.
            moving: the moving image.

        Raises:
            InputError: shapes, dimensions.
        """
        known = None if inverse is None else replace(fixed, data=inverse)
        first = Displacement(replace(fixed, data=u), known)
        return cls((first,) if affine is None else (first, affine), fixed, moving)

    @property
    def dim(self) -> int:
        """Number of axes D, 2 or 3."""
        return self.stages[0].dim

    @property
    def reference(self) -> Image | None:
        """The place that images are pulled back onto when none is named: the fixed space, else the first field's."""
        first = self.stages[0]
        return self.fixed or (place_of(first.field) if isinstance(first, Displacement) else None)

    def points(self, points: Tensor) -> Tensor:
        """Return φ(p): points of the fixed space go to the moving space.

        Args:
            points: world points (x, y, z) in LPS mm, ``(N, D)`` or ``(B, D, *T)``.

        Returns:
            The same shape and type, in the moving space.

        Raises:
            InputError: shape, or points that are not floating point.

        Notes:
            Differentiable in the points, the fields and the matrices.
        """
        rows = points.dim() == 2
        columns = points.T.unsqueeze(0) if rows else points
        require_float(points, "points")
        if columns.dim() < 3 or columns.shape[1] != self.dim:
            shapes = f"(N, {self.dim}) or (B, {self.dim}, *T)"
            raise InputError(f"points must have shape {shapes}, got {tuple(points.shape)}")
        for stage in self.stages:
            columns = stage(columns)
        return columns[0].T if rows else columns

    def image(
        self, moving: Image, reference: Image | None = None, *, mode: str = "linear", outside: float | str | None = 0.0
    ) -> Image:
        """Return warped(x) = moving(φ(x)): the moving image comes to the fixed space.

        Args:
            moving: image in the moving space, any grid and any number of channels.
            reference: grid of the result; `reference` of this transform when None.
            mode: ``nearest``, ``linear``, ``cubic`` or ``label``; see `torchdeform.core.interpolation.interpolator`.
            outside: value where φ(x) is outside the moving image (ITK's resampler uses 0); None continues its edge.
                ``auto``: what `torchdeform.core.image.surroundings` finds, such as air or paper; 0 in the modes that
                copy labels.

        Returns:
            An image on the reference grid, with the moving image's type.

        Raises:
            InputError: mode, dimensions, no reference known, or images in another place than those of this transform.

        Notes:
            One interpolation only, whatever the number of stages; coordinates in float64. Differentiable in the moving
            pixels, the fields and the matrices (not with ``nearest`` and ``label``).
        """
        place = self._reference(reference)
        self._check(moving, self.moving, "moving")
        beyond = 0.0 if outside == AUTO and mode in COPYING else outside_value(moving, outside)
        at = interpolator(moving.data, moving.grid, mode=mode, outside=beyond)
        pixels = _over_nodes(place, lambda nodes: at(moving.to_grid(self.points(nodes))), moving.data.device)
        return replace(place, data=pixels, name=moving.name, pixel_type=moving.pixel_type)

    def labels(self, moving: Image, reference: Image | None = None, *, mode: str = LABEL_MODE) -> Image:
        """Return the labels of the moving image in the fixed space: by `image` in mode ``label``, 0 outside.

        Args:
            moving: whole numbers in the moving space.
            reference: as in `image`.
            mode: ``label``, with smooth borders, or ``nearest``, which keeps the thinnest parts.

        Raises:
            InputError: as `image`; labels that are not finite.

        Notes:
            Values are copied, never computed, so integers stay integers; labels above 2²⁴ need float64 ``data``.
        """
        return self.image(moving, reference, mode=mode)

    def flatten(self, reference: Image | None = None) -> Displacement:
        """Return the whole chain as one displacement on a grid, u = to_grid(φ(to_world(x))) − x.

        Args:
            reference: its grid is that of the result (fixed space); `reference` of this transform when None.

        Returns:
            A `Displacement`, float64: its points go from fixed to moving like those of this transform.

        Raises:
            InputError: dimensions, or no reference known.

        Notes:
            Exact at the nodes, second order between them, 0 outside the grid. Differentiable like `points`.
        """
        place = self._reference(reference)

        def displacement(nodes: Tensor) -> Tensor:
            return place.to_grid(self.points(nodes)) - place.to_grid(nodes)

        return Displacement(replace(place, data=_over_nodes(place, displacement, self._device)))

    def jacobian_determinant(self, reference: Image | None = None) -> Image:
        """Return det ∇φ at the nodes of a grid of the fixed space: moving volume over fixed volume.

        Args:
            reference: the grid; `reference` of this transform when None.

        Returns:
            An image ``(1, 1, *S)``, no unit, float64: below 1 where the fixed space is larger than the moving one
            (the map shrinks), 0 or less where it folds.

        Raises:
            InputError: dimensions, no reference known, or a field with fewer than 3 nodes along an axis.

        Notes:
            The product of the stages' determinants where each finds the point: exact for affine maps, central
            differences for fields, between whose nodes their determinant is linear. Differentiable.
        """
        place = self._reference(reference)
        volumes = [stage.local_volume() for stage in self.stages]

        def determinant(points: Tensor) -> Tensor:
            total = torch.ones_like(points[:, :1])
            for stage, volume in zip(self.stages, volumes, strict=True):
                total, points = total * volume(points), stage(points)
            return total

        data = _over_nodes(place, determinant, self._device)
        return replace(place, data=data, name="jacobian determinant", pixel_type="float32")

    def inverse(self) -> "Transform":
        """Return φ⁻¹: points of the moving space go to the fixed space, images of the fixed space to the moving one.

        Returns:
            The transform; its own inverse is this very object.

        Notes:
            Affine maps are inverted exactly. A displacement gives its known inverse, or one found on its own grid by
            `torchdeform.invert`; where it folds there is none, and what is returned does not undo it there.
            Differentiable once in a field by the implicit function theorem.
        """
        if self._undone is None:
            stages = tuple(back for stage in reversed(self.stages) for back in stage.undo())
            other = Transform(stages, self.moving, self.fixed)
            object.__setattr__(other, "_undone", self)
            object.__setattr__(self, "_undone", other)
            return other
        return self._undone

    def then(self, other: "Transform") -> "Transform":
        """Return other ∘ φ: points go through this one first, then through ``other``; images come through other first.

        Args:
            other: a transform whose fixed space is this one's moving space.

        Raises:
            InputError: dimensions, or spaces without overlap, as when the order is wrong.
        """
        if self.moving is not None and other.fixed is not None and self.dim == other.dim:
            _require_overlap(
                self.moving, other.fixed, "the second transform's fixed space", "give the transform applied first first"
            )
        return Transform(self.stages + other.stages, self.fixed, other.moving)

    def to(self, device: torch.device | str) -> "Transform":
        """Return the same map with its fields on ``device``."""
        return Transform(tuple(stage.to(device) for stage in self.stages), self.fixed, self.moving)

    @property
    def _device(self) -> torch.device:
        fields = [stage.field.data.device for stage in self.stages if isinstance(stage, Displacement)]
        return fields[0] if fields else torch.device("cpu")

    def _reference(self, reference: Image | None) -> Image:
        """Return the place of a result, which must be known and touch this transform's fixed space."""
        place = reference or self.reference
        if place is None:
            raise InputError("this transform does not know its fixed grid; give the fixed image as reference")
        self._check(place, self.reference, "fixed")
        return place_of(place)

    def _check(self, image: Image, own: Image | None, side: str) -> None:
        """Raise `InputError` unless an image has this transform's dimension and touches one of its spaces."""
        if image.grid.dim != self.dim:
            kinds = f"{image.name} is {image.grid.dim}D but the transform is {self.dim}D"
            raise InputError(f"{kinds}; give two of the same dimension")
        if own is not None:
            hint = "give the image that it was made for, or take the inverse transform"
            _require_overlap(image, own, f"the transform's {side} space", hint)


def _require_overlap(image: Image, space: Image, name: str, hint: str) -> None:
    if overlap(image, space) == 0 and overlap(space, image) == 0:
        raise InputError(f"{image.name} and {name} lie apart in the world; {hint}")


def _over_nodes(place: Image, function: Callable[[Tensor], Tensor], device: torch.device) -> Tensor:
    """Return a function ``(1, D, *T) -> (1, C, *T)`` of world points at all nodes, a few rows at a time."""

    def values(rows: slice) -> Tensor:
        return function(place.to_world(place.grid.points(dtype=torch.float64, device=device, rows=rows)))

    return over_slabs(values, place.grid.shape, device)
