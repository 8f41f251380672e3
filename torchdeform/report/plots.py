"""Single pictures of a registration on matplotlib axes, for notebooks and papers."""

import math
from typing import TYPE_CHECKING, TypedDict, Unpack

import torch
from torch import Tensor

from torchdeform.core.derivatives import curl, divergence, jacobian_determinant
from torchdeform.core.grid import Grid
from torchdeform.core.image import Image
from torchdeform.core.warp import compose, voxels
from torchdeform.errors import InputError
from torchdeform.registration.result import RegistrationResult
from torchdeform.report import drawing
from torchdeform.report.planes import WORDS, Plane, chosen_plane
from torchdeform.report.report_data import (
    end_of_scale,
    log_volume,
    signed_or_length,
    volume_counts,
)
from torchdeform.report.sampling import grey, sample_at_fixed, to_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class View(TypedDict, total=False):
    """Where to draw, and which slice of a volume: the last three arguments of `plot_image`."""

    axes: "Axes | None"
    plane: str | None
    index: int | None


def plot_image(
    image: Image, *, axes: "Axes | None" = None, plane: str | None = None, index: int | None = None
) -> "Axes":
    """Show an image, or one slice of a volume, from its 0.5th to its 99.5th percentile.

    Args:
        image: grey or in colours, 2D or 3D.
        axes: where to draw; matplotlib's current axes when None.
        plane: ``axial``, ``coronal`` or ``sagittal`` in 3D; axial when None. Shown as radiologists see it.
        index: number of the slice, from 0; the middle one when None.

    Returns:
        The axes.

    Raises:
        InputError: a plane or a slice that does not exist.
    """
    axes, cut, number = _view(image, axes, plane, index)
    pixels = image.data.detach().cpu()
    drawing.draw_image(axes, cut, cut.cut(to_unit(pixels, pixels), [number])[0])
    return axes


def plot_overlay(fixed: Image, moving: Image, **view: Unpack[View]) -> "Axes":
    """Show two images over each other: fixed in blue, moving (or warped) in orange, white where both are bright.

    Args:
        fixed: image whose grid is shown.
        moving: image of the same dimension; it is sampled at its position in the world.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of the fixed image.

    Returns:
        The axes.

    Raises:
        InputError: a plane or a slice that does not exist, or dimensions that differ.
    """
    axes, cut, first, second = _grey_slices(fixed, moving, **view)
    picture = drawing.tinted(first[0].numpy(), second[0].numpy())
    drawing.show(axes, cut, torch.as_tensor(picture).movedim(-1, 0))
    return axes


def plot_checkerboard(fixed: Image, moving: Image, *, tiles: int = 8, **view: Unpack[View]) -> "Axes":
    """Show alternating tiles of two images: where they fit, edges continue from tile to tile.

    Args:
        fixed: image whose grid is shown; it has the first tile.
        moving: as in `plot_overlay`.
        tiles: along the longer side of the slice, at least 2.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of the fixed image.

    Returns:
        The axes.

    Raises:
        InputError: as `plot_overlay`, or fewer than 2 tiles.
    """
    if tiles < 2:
        raise InputError(f"tiles: a checkerboard has at least 2 tiles along a side, got {tiles}")
    axes, cut, first, second = _grey_slices(fixed, moving, **view)
    spacing = [cut.grid.spacing[axis] for axis in cut.axes]
    side = max(n * h for n, h in zip(cut.shape, spacing, strict=True)) / tiles
    down, across = ((torch.arange(n) * h / side).floor().long() for n, h in zip(cut.shape, spacing, strict=True))
    odd = (down[:, None] + across[None, :]) % 2 == 1
    drawing.draw_image(axes, cut, torch.where(odd, second, first))
    return axes


def plot_difference(fixed: Image, moving: Image, *, limit: float | None = None, **view: Unpack[View]) -> "Axes":
    """Show |fixed − moving|, both scaled from 0 to 1 by their own percentiles: dark where they agree.

    Args:
        fixed: image whose grid is shown.
        moving: as in `plot_overlay`.
        limit: value of the brightest colour; use one value to compare the differences before and after. When None,
            the 99.8th percentile of the slice.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of the fixed image.

    Returns:
        The axes.

    Raises:
        InputError: as `plot_overlay`.
    """
    axes, cut, first, second = _grey_slices(fixed, moving, **view)
    values = (first - second).abs()
    _map_with_bar(axes, cut, values, drawing.difference_scale(_limit(values, limit)))
    return axes


def plot_grid(
    u: Tensor, space: Image | Grid, *, background: Image | None = None, lines: int = 36, **view: Unpack[View]
) -> "Axes":
    """Draw where φ = id + u moves the lines of a regular grid in a slice: from the fixed to the moving space.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        space: the image on whose grid u is given, or that grid.
        background: image to show below, pale, such as the moving one.
        lines: about how many lines along the longer side.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of ``space``.

    Returns:
        The axes.

    Raises:
        InputError: shape of u, a plane or a slice that does not exist.

    Notes:
        In 3D the lines are seen along the axis that the plane cuts.
    """
    place = _place(space)
    place.grid.check_vector(u, "plot_grid: u")
    axes, cut, number = _view(place, **view)
    if background is not None:
        drawing.draw_faint(axes, cut, _grey_slice(background, place, cut, number))
    drawing.draw_lines(axes, cut, cut.cut(u.detach().cpu(), [number])[0], lines)
    axes.set_aspect(cut.aspect)
    return axes


def plot_determinant(u: Tensor, space: Image | Grid, *, limit: float | None = None, **view: Unpack[View]) -> "Axes":
    """Show log J of φ = id + u, written as J: moving volume over fixed volume, orange where moving is larger.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        space: the image on whose grid u is given, or that grid.
        limit: largest J of the scale, above 1 (the smallest is 1 / limit). When None 2, or more if the map needs it.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of ``space``.

    Returns:
        The axes.

    Raises:
        InputError: shape of u, a limit not above 1, a plane or a slice that does not exist.
    """
    if limit is not None and not limit > 1:
        raise InputError(f"limit: the largest determinant of the scale must be above 1, got {limit}")
    place = _place(space)
    values, reach = _log_determinant(u, place.grid)
    return _plot_map(values, place, drawing.volume_scale(reach if limit is None else math.log(limit)), **view)


def plot_divergence(u: Tensor, space: Image | Grid, *, limit: float | None = None, **view: Unpack[View]) -> "Axes":
    """Show div u = Σ_k ∂_k u_k.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        space: the image on whose grid u is given, or that grid.
        limit: end of the scale; the 99.8th percentile when None.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of ``space``.

    Returns:
        The axes.

    Raises:
        InputError: shape of u, a plane or a slice that does not exist.
    """
    place = _place(space)
    values = divergence(u.detach().cpu(), place.grid)
    return _plot_map(values, place, drawing.signed_scale(_limit(values, limit)), **view)


def plot_curl(u: Tensor, space: Image | Grid, *, limit: float | None = None, **view: Unpack[View]) -> "Axes":
    """Show curl u = ∂0 u1 − ∂1 u0 in 2D, its length |curl u| in 3D.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        space: the image on whose grid u is given, or that grid.
        limit: end of the scale; the 99.8th percentile when None.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of ``space``.

    Returns:
        The axes.

    Raises:
        InputError: shape of u, a plane or a slice that does not exist.
    """
    place = _place(space)
    values = signed_or_length(curl(u.detach().cpu(), place.grid))
    return _plot_map(values, place, drawing.rotation_scale(_limit(values, limit), place.grid.dim), **view)


def plot_inverse_error(
    u: Tensor, inverse: Tensor, space: Image | Grid, *, limit: float | None = None, **view: Unpack[View]
) -> "Axes":
    """Show the inverse consistency |φ(ψ(x)) − x| in voxels for φ = id + u and its inverse ψ = id + w.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        inverse: displacement w of the inverse, the same shape.
        space: the image on whose grid u and w are given, or that grid.
        limit: end of the scale in voxels; the 99.8th percentile when None.
        view: ``axes``, ``plane`` and ``index`` as in `plot_image`, of ``space``.

    Returns:
        The axes.

    Raises:
        InputError: shapes, a plane or a slice that does not exist.
    """
    place = _place(space)
    for name, field in (("u", u), ("inverse", inverse)):
        place.grid.check_vector(field, f"plot_inverse_error: {name}")
    values = voxels(compose(u.detach().cpu(), inverse.detach().cpu(), place.grid), place.grid)
    return _plot_map(values, place, drawing.length_scale(_limit(values, limit)), **view)


def plot_volume_histogram(u: Tensor, space: Image | Grid, *, axes: "Axes | None" = None) -> "Axes":
    """Draw how often each J = det ∇(id + u) occurs, in % of all voxels, over log J.

    Args:
        u: displacement ``(1, D, *S)`` in units of spacing.
        space: the image on whose grid u is given, or that grid.
        axes: as in `plot_image`.

    Returns:
        The axes.

    Raises:
        InputError: shape of u.
    """
    grid, axes = _place(space).grid, _axes(axes)
    values, limit = _log_determinant(u, grid)
    drawing.draw_volumes(axes, volume_counts(values, limit), limit, WORDS[grid.dim])
    return axes


def plot_convergence(result: RegistrationResult, *, axes: "Axes | None" = None, item: int = 0) -> "Axes":
    """Draw the similarity over the steps, one line per pyramid level, coarse to fine.

    Args:
        result: what `torchdeform.register` returned.
        axes: as in `plot_image`.
        item: which item of the batch.

    Returns:
        The axes.

    Raises:
        InputError: an item that does not exist.
    """
    if not 0 <= item < len(result.similarity_after):
        raise InputError(f"item: the batch has {len(result.similarity_after)} items, from 0; there is no item {item}")
    axes = _axes(axes)
    drawing.draw_convergence(axes, result, item=item)
    return axes


def _axes(axes: "Axes | None") -> "Axes":
    if axes is not None:
        return axes
    from matplotlib import pyplot

    return pyplot.gca()


def _place(space: Image | Grid) -> Image:
    """Return an image with the planes of ``space``; a bare grid gets the axes of the world."""
    if isinstance(space, Image):
        return space
    return Image(torch.zeros(()).expand(1, 1, *space.shape), space, name="the grid")


def _view(
    image: Image, axes: "Axes | None" = None, plane: str | None = None, index: int | None = None
) -> "tuple[Axes, Plane, int]":
    """Return the axes to draw on, the plane and the number of its slice."""
    cut, number = chosen_plane(image, plane, index)
    return _axes(axes), cut, number


def _grey_slices(fixed: Image, moving: Image, **view: Unpack[View]) -> "tuple[Axes, Plane, Tensor, Tensor]":
    """Return the axes, a plane, and both images in its slice in grey from 0 to 1, each ``(1, down, across)``."""
    axes, cut, number = _view(fixed, **view)
    return axes, cut, _grey_slice(fixed, fixed, cut, number), _grey_slice(moving, fixed, cut, number)


def _grey_slice(image: Image, fixed: Image, cut: Plane, number: int) -> Tensor:
    """Return an image in a slice of the fixed one, in grey from 0 to 1, ``(1, down, across)``."""
    if image.grid.dim != fixed.grid.dim:
        raise InputError(f"{image.name} is {image.grid.dim}D and {fixed.name} {fixed.grid.dim}D; give two of a kind")
    values = grey(image.to("cpu")).detach()
    return cut.arrange(to_unit(sample_at_fixed(values, image, fixed, cut.points([number])), values))[0]


def _limit(values: Tensor, limit: float | None) -> float:
    """Return the end of a scale: the given limit, or the value below which nearly all values are."""
    if limit is None:
        return end_of_scale(values, 1e-6)
    if not limit > 0:
        raise InputError(f"limit: the end of a scale must be positive, got {limit}")
    return limit


def _log_determinant(u: Tensor, grid: Grid) -> tuple[Tensor, float]:
    """Return log J and where its scale ends."""
    values = log_volume(jacobian_determinant(u.detach().cpu(), grid))
    return values, end_of_scale(values, math.log(2))


def _plot_map(values: Tensor, place: Image, scale: drawing.Scale, **view: Unpack[View]) -> "Axes":
    """Draw a field ``(1, 1, *S)`` in a slice."""
    axes, cut, number = _view(place, **view)
    _map_with_bar(axes, cut, cut.cut(values, [number])[0], scale)
    return axes


def _map_with_bar(axes: "Axes", cut: Plane, values: Tensor, scale: drawing.Scale) -> None:
    """Draw a map, and the bar of its colours below."""
    shown = drawing.draw_map(axes, cut, values, scale)
    drawing.draw_bar(axes.inset_axes((0.15, -0.08, 0.7, 0.035)), shown, scale)
