"""Monitor functions: how large the cells of a grid shall be where. Small f asks for small cells, J = f.

Builders return f with its range as asked for; `normalise_monitor` gives it the mean that a map needs, which the three
versions of the deformation method do by themselves.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from torchdeform.core.derivatives import divergence, jacobian
from torchdeform.core.grid import Grid, magnitude
from torchdeform.errors import InputError, require_choice, require_ranges
from torchdeform.solvers.sine_cosine import inverse_transform, transform

Mean = Literal["mean", "reciprocal_mean"]

# A number or tensor (B,) or (); a point: D numbers, or a tensor (B, D) or (D,). All in units of spacing.
Number = float | Tensor
Point = Sequence[float] | Tensor


@dataclass(frozen=True, kw_only=True)
class MonitorSettings:
    """What all builders have in common.

    Args:
        f_min: value where the cells shall be smallest, positive.
        f_max: value where they shall be largest, at least f_min; only their ratio matters after normalising.
        smoothing: standard deviation of the Gaussian that smooths images before they are differentiated, and the
            monitors of shapes, densities and labels at the end; units of spacing.
        dtype: floating type of the monitors of shapes; images keep theirs.
        device: device of the monitors of shapes, unless centre or size is a tensor on another one.

    Raises:
        InputError: a number out of range.
    """

    f_min: float = 0.2
    f_max: float = 1.0
    smoothing: float = 0.0
    dtype: torch.dtype = torch.float32
    device: torch.device | str = "cpu"

    def __post_init__(self) -> None:
        if not 0 < self.f_min <= self.f_max < math.inf:
            raise InputError(
                f"MonitorSettings: need 0 < f_min <= f_max, both finite, got f_min={self.f_min}, f_max={self.f_max}"
            )
        require_ranges(self, "MonitorSettings: ", smoothing="finite, not negative")

    def blend(self, closeness: Tensor) -> Tensor:
        """Return f_max − (f_max − f_min) · closeness, closeness being 1 where cells shall be smallest and 0 far off."""
        return self.f_max - (self.f_max - self.f_min) * closeness


_DEFAULT = MonitorSettings()


def ring_monitor(
    grid: Grid, centre: Point, radius: Number, width: Number, settings: MonitorSettings = _DEFAULT
) -> Tensor:
    """Return f = f_max − (f_max − f_min) exp(−((|x − centre| − radius)/width)²), small on a circle or a sphere.

    Args:
        grid: the grid.
        centre: centre of the ring (2D) or spherical shell (3D), D numbers or a tensor ``(B, D)``, units of spacing.
        radius: its radius, a number or a tensor ``(B,)``.
        width: distance at which f has gone 63 % of the way from f_min to f_max, likewise.
        settings: range, smoothing, type.

    Returns:
        ``(B, 1, *S)``, B = 1 unless an argument is batched.

    Raises:
        InputError: shapes, or a width that is not positive.

    Notes:
        Differentiable in centre (but not where a node lies on it), radius and width, as are the other shapes.
    """
    distance = _distance(_offset(grid, centre, settings))
    away = (distance - _column(grid, radius, settings, "radius")) / _width(grid, width, settings)
    return _finish(torch.exp(-(away**2)), grid, settings)


def ball_monitor(
    grid: Grid, centre: Point, radius: Number, width: Number, settings: MonitorSettings = _DEFAULT
) -> Tensor:
    """Return f = f_max − (f_max − f_min) (1 + tanh((radius − |x − centre|)/width))/2, small in a disc or a ball.

    Args:
        grid: the grid.
        centre: its centre, D numbers or a tensor ``(B, D)``, units of spacing.
        radius: its radius, a number or a tensor ``(B,)``.
        width: half the thickness of the transition at its rim, likewise.
        settings: range, smoothing, type.

    Returns:
        ``(B, 1, *S)``.

    Raises:
        InputError: shapes, or a width that is not positive.
    """
    inside = _column(grid, radius, settings, "radius") - _distance(_offset(grid, centre, settings))
    return _finish(_step(inside / _width(grid, width, settings)), grid, settings)


def box_monitor(grid: Grid, low: Point, high: Point, width: Number, settings: MonitorSettings = _DEFAULT) -> Tensor:
    """Return f that is f_min in the box from ``low`` to ``high`` and f_max far from it, with tanh steps between.

    Args:
        grid: the grid.
        low: corner with the smallest coordinates, D numbers or a tensor ``(B, D)``, units of spacing.
        high: the opposite corner, likewise.
        width: half the thickness of the transition at its faces, a number or a tensor ``(B,)``.
        settings: range, smoothing, type.

    Returns:
        ``(B, 1, *S)``.

    Raises:
        InputError: shapes, or a width that is not positive.
    """
    scale = _width(grid, width, settings)
    steps = _step(_offset(grid, low, settings) / scale) * _step(-_offset(grid, high, settings) / scale)
    return _finish(steps.prod(dim=1, keepdim=True), grid, settings)


def line_monitor(grid: Grid, start: Point, end: Point, width: Number, settings: MonitorSettings = _DEFAULT) -> Tensor:
    """Return f = f_max − (f_max − f_min) exp(−(d/width)²), d being the distance to the line from ``start`` to ``end``.

    Args:
        grid: the grid.
        start: one end of the line, D numbers or a tensor ``(B, D)``, units of spacing.
        end: its other end, likewise.
        width: distance at which f has gone 63 % of the way from f_min to f_max, a number or a tensor ``(B,)``.
        settings: range, smoothing, type.

    Returns:
        ``(B, 1, *S)``.

    Raises:
        InputError: shapes, or a width that is not positive.
    """
    offset, along = _offset(grid, start, settings), -_offset(grid, end, settings)
    along = along + offset  # end − start, at every node
    length = (along**2).sum(1, keepdim=True).clamp(min=torch.finfo(along.dtype).tiny)
    share = ((offset * along).sum(1, keepdim=True) / length).clamp(0, 1)
    square = ((offset - share * along) ** 2).sum(1, keepdim=True)
    return _finish(torch.exp(-square / _width(grid, width, settings) ** 2), grid, settings)


def gradient_monitor(image: Tensor, grid: Grid, settings: MonitorSettings = _DEFAULT) -> Tensor:
    """Return f = f_min + (f_max − f_min)/(1 + |∇I|²/s²), s² being the mean of |∇I|²: small at the edges of an image.

    Args:
        image: I ``(B, C, *S)`` in any unit; the squares of the gradients of its channels are added up.
        grid: its grid.
        settings: range, and the smoothing of the image.

    Returns:
        ``(B, 1, *S)``; f_max where the image is constant.

    Raises:
        InputError: shape, fewer than 3 nodes along an axis, or an image that is not finite.

    Notes:
        Does not depend on the unit of I. Differentiable in it.
    """
    _require_image(image, grid, "gradient_monitor: image")
    slopes = jacobian(smooth(image / magnitude(image), grid, settings.smoothing), grid)
    return settings.blend(_share((slopes**2).sum(dim=(1, 2)).unsqueeze(1), grid))


def curvature_monitor(image: Tensor, grid: Grid, settings: MonitorSettings = _DEFAULT) -> Tensor:
    """Return f = f_min + (f_max − f_min)/(1 + κ²/s²), s² the mean of κ²: small where an image bends.

    κ = div(∇I/√(|∇I|² + c²)) with c² the mean of |∇I|²: the mean curvature of the graph of I/c, near that of the level
    sets where the image is steep, and small where it is flat whatever its noise.

    Args:
        image: I ``(B, C, *S)`` in any unit; the squares of the curvatures of its channels are added up.
        grid: its grid.
        settings: range, and the smoothing of the image.

    Returns:
        ``(B, 1, *S)``; f_max where the image is constant.

    Raises:
        InputError: shape, fewer than 3 nodes along an axis, or an image that is not finite.

    Notes:
        As `gradient_monitor`.
    """
    _require_image(image, grid, "curvature_monitor: image")
    slopes = jacobian(smooth(image / magnitude(image), grid, settings.smoothing), grid)
    total = torch.zeros_like(image[:, :1])
    for slope in slopes.unbind(1):
        square = (slope**2).sum(1, keepdim=True)
        steepness = square + mean_value(square, grid)
        normal = slope / steepness.clamp(min=torch.finfo(image.dtype).tiny).sqrt()
        total = total + divergence(normal, grid) ** 2
    return settings.blend(_share(total, grid))


def density_monitor(density: Tensor, grid: Grid, settings: MonitorSettings = _DEFAULT) -> Tensor:
    """Return f = mean(density)/density, kept between f_min and f_max: cells small where the density is large.

    Args:
        density: how many nodes are wanted per volume, ``(B, 1, *S)``, not negative, any unit.
        grid: its grid.
        settings: range, and the smoothing of f.

    Returns:
        ``(B, 1, *S)``.

    Raises:
        InputError: shape, or a density that is negative, zero everywhere or not finite.

    Notes:
        Under Version 2 the nodes then have this density. Differentiable where f is not cut off.
    """
    grid.check_scalar(density, "density_monitor: density")
    mean = mean_value(density, grid)
    if not bool(density.isfinite().all()) or bool((density < 0).any()) or not bool((mean > 0).all()):
        raise InputError("density_monitor: density must be finite, nowhere negative and not zero everywhere")
    f = (mean / density.clamp(min=torch.finfo(density.dtype).tiny)).clamp(settings.f_min, settings.f_max)
    return smooth(f, grid, settings.smoothing)


def label_monitor(labels: Tensor, factors: Mapping[int, float], grid: Grid, smoothing: float = 0.0) -> Tensor:
    """Return f that is the factor of its label at each node, and what makes the mean of f equal 1 at all others.

    With Version 1, which gives J(φ)(ξ) = f(ξ), each region's volume is multiplied by its factor.

    Args:
        labels: label of each node, ``(B, 1, *S)``, whole numbers of any type.
        factors: new volume over old volume by label, positive. Labels that are not named share what is left; where
            there are none the factors must keep the volume of Ω.
        grid: its grid.
        smoothing: standard deviation of the Gaussian that smooths the borders of regions, units of spacing.

    Returns:
        ``(B, 1, *S)``, float64 if the labels are, else float32.

    Raises:
        InputError: shape, a factor that is not positive and finite, a label that does not occur, or factors that leave
            the rest of Ω no volume or, where labels fill it, do not keep its volume.

    Notes:
        Volumes are those of the trapezoidal rule. A smooth border lies half inside the region, half outside.
    """
    values = labels if labels.dtype == torch.float64 else labels.to(torch.float32)
    grid.check_scalar(values, "label_monitor: labels")
    require_factors(factors, "label_monitor")
    taken = f = torch.zeros_like(values)
    for label, factor in factors.items():
        region = smooth((labels == label).to(values.dtype), grid, smoothing)
        if not bool(region.any()):
            raise InputError(f"label_monitor: label {label} does not occur; name labels that the image has")
        taken, f = taken + region, f + factor * region
    named = torch.cat([labels == label for label in factors], dim=1)
    if bool(named.any(dim=1).all()):
        require_same_volume(named.to(values.dtype), list(factors.values()), grid, "label_monitor")
        return normalise_monitor(f, grid)
    free, left = mean_value(1 - taken, grid), 1 - mean_value(f, grid)
    require_rest(named.logical_not().all(dim=1).flatten(1).any(1), left.flatten(), "label_monitor")
    return f + left / free * (1 - taken)


def require_factors(factors: Mapping[int, float], where: str) -> None:
    """Raise `InputError`, which names ``where``, unless there are factors, all positive and finite."""
    if not factors or not all(0 < factor < math.inf for factor in factors.values()):
        raise InputError(f"{where}: factors must be positive and finite, one or more, got {dict(factors)}")


def require_rest(before: Tensor, after: Tensor, where: str) -> None:
    """Raise `InputError`, which names ``where``, unless what no label names has volume before and after, ``(B,)``."""
    if not bool((before > 0).all()):
        item = int((before > 0).logical_not().nonzero()[0, 0])
        raise InputError(
            f"{where}: the labels fill item {item} of the batch, so nothing takes up the slack; name fewer"
        )
    if not bool((after > 0).all()):
        raise InputError(
            f"{where}: the factors leave the rest of the domain no volume; name fewer labels or lower them"
        )


def require_same_volume(inside: Tensor, factors: Sequence[float], grid: Grid, where: str) -> None:
    """Raise `InputError`, which names ``where``, unless regions that fill Ω keep its volume.

    To 0.1 % of the smallest of them, which could be what the others leave.

    Args:
        inside: 1 in each region, else 0, ``(B, R, *S)``.
        factors: new volume over old volume of each.
        grid: the grid.
        where: what to name.
    """
    shares = mean_value(inside, grid).flatten(1)
    total = (shares * shares.new_tensor(factors)).sum(1) / shares.sum(1)
    wrong = (total - 1).abs() > 1e-3 * shares.amin(1)
    if bool(wrong.any()):
        raise InputError(
            f"{where}: the labels fill the domain, and the factors would make its volume {float(total[wrong][0]):.6g} "
            "times as large; leave out a label, which then takes up the slack, or choose factors that keep the volume"
        )


def smooth(field: Tensor, grid: Grid, sigma: float) -> Tensor:
    """Return the field convolved with a Gaussian, or rather with the diffusion of the grid of the same variance.

    Args:
        field: ``(B, C, *S)``, any unit.
        grid: its grid.
        sigma: standard deviation in units of spacing; 0 returns the field.

    Returns:
        ``(B, C, *S)``.

    Raises:
        InputError: shape, or sigma out of range.

    Notes:
        Solves ∂f/∂t = Δ_h f/2 with no flux through the boundary up to t = σ², exactly, by cosine transforms. Thus it
        keeps the mean (of the trapezoidal rule) and leaves no value outside the range of the field, however small σ is.
        Linear and differentiable.
    """
    grid.check(field, "smooth: field")
    if not 0 <= sigma < math.inf:
        raise InputError(f"smooth: sigma must be finite and not negative, got {sigma}")
    if sigma == 0:
        return field
    for axis, h in zip(grid.axes, grid.spacing, strict=True):
        size = field.shape[axis]
        theta = torch.arange(size, dtype=torch.float64, device=field.device) * (math.pi / (size - 1))
        damping = torch.exp(-2 * ((sigma / h) * torch.sin(theta / 2)) ** 2).to(field.dtype)
        modes = inverse_transform(field, axis, "cosine") * damping.view(-1, *[1] * (field.dim() - 1 - axis))
        field = transform(modes, axis, "cosine")
    return field


def normalise_monitor(f: Tensor, grid: Grid, kind: Mean = "mean") -> Tensor:
    """Return f · c with the mean over Ω that a map onto Ω needs: ∫ f = |Ω| or ∫ 1/f = |Ω|.

    Args:
        f: ``(B, 1, *S)``, positive.
        grid: its grid.
        kind: ``mean`` for Version 1, where f is given at the old places of the nodes; ``reciprocal_mean`` for Versions
            2 and 3, where it is given at the new ones.

    Returns:
        ``(B, 1, *S)``.

    Raises:
        InputError: shape, an unknown kind, or a monitor that is not positive or not finite.

    Notes:
        By the trapezoidal rule, `Grid.quadrature`, the one that removes the mean of a divergence. Differentiable.
    """
    require_choice(kind, get_args(Mean), "normalise_monitor: kind")
    require_positive(f, grid, "normalise_monitor: f")
    return f / mean_value(f, grid) if kind == "mean" else f * mean_value(1 / f, grid)


def require_positive(f: Tensor, grid: Grid, name: str) -> None:
    """Raise `InputError` unless ``f``, which ``name`` is to name, is ``(B, 1, *S)``, positive and finite."""
    grid.check_scalar(f, name)
    if not bool(f.isfinite().all()):
        raise InputError(f"{name} must be finite, got NaN or infinity; a monitor is a positive cell size everywhere")
    least = float(f.detach().amin())
    if least <= 0:
        raise InputError(f"{name} must be positive, got {least:g}; a map with J = {least:g} folds, raise f_min")


def mean_value(field: Tensor, grid: Grid) -> Tensor:
    """Return (∫ field)/|Ω| of each item and channel by the trapezoidal rule, ``(B, C, 1, ..)`` from ``(B, C, *S)``."""
    weights = grid.quadrature(dtype=field.dtype, device=field.device)[0] / grid.volume
    # One by one: a batch may be summed in another order than an item alone.
    means = torch.stack([(item * weights).flatten(1).sum(1) for item in field])
    return means.view(*means.shape, *[1] * grid.dim)


def _share(square: Tensor, grid: Grid) -> Tensor:
    """Return q/(q + mean q) for q = ``square``: 0 where q is 0, towards 1 where it stands out."""
    return square / (square + mean_value(square, grid)).clamp(min=torch.finfo(square.dtype).tiny)


def _require_image(image: Tensor, grid: Grid, name: str) -> None:
    grid.check(image, name)
    if not bool(image.isfinite().all()):
        raise InputError(f"{name} must be finite, got NaN or infinity")


def _column(grid: Grid, value: Number, settings: MonitorSettings, name: str) -> Tensor:
    """Return a number or ``(B,)`` as ``(B or 1, 1, 1, ..)``."""
    tensor = _tensor(value, settings)
    if tensor.dim() > 1:
        raise InputError(f"monitor: {name} must be a number or a tensor (B,), got shape {tuple(tensor.shape)}")
    return tensor.view(-1, *[1] * (grid.dim + 1))


def _width(grid: Grid, width: Number, settings: MonitorSettings) -> Tensor:
    column = _column(grid, width, settings, "width")
    if not bool((column > 0).all()):
        raise InputError(f"monitor: width must be positive, got {float(column.detach().amin()):g}")
    return column


def _offset(grid: Grid, point: Point, settings: MonitorSettings) -> Tensor:
    """Return x − point at every node, ``(B, D, *S)``."""
    tensor = _tensor(point, settings)
    if tensor.dim() not in (1, 2) or tensor.shape[-1] != grid.dim:
        shape = tuple(tensor.shape)
        raise InputError(f"monitor: a point must be {grid.dim} numbers or a tensor (B, {grid.dim}), got shape {shape}")
    return grid.points(dtype=tensor.dtype, device=tensor.device) - tensor.view(-1, grid.dim, *[1] * grid.dim)


def _tensor(value: Number | Point, settings: MonitorSettings) -> Tensor:
    device = value.device if isinstance(value, Tensor) else settings.device
    return torch.as_tensor(value, dtype=settings.dtype, device=device)


def _distance(offset: Tensor) -> Tensor:
    return torch.linalg.vector_norm(offset, dim=1, keepdim=True)


def _step(x: Tensor) -> Tensor:
    """Return (1 + tanh x)/2 without the loss of digits for large −x."""
    return torch.sigmoid(2 * x)


def _finish(closeness: Tensor, grid: Grid, settings: MonitorSettings) -> Tensor:
    return smooth(settings.blend(closeness), grid, settings.smoothing)
