"""Labels that keep their volume: the determinant is brought to 1 there, by the smallest smooth change of a map.

Each step of Gauss-Newton makes the smallest change v, in the sense of ∫ |∇v|², with Σ C_ka ∂_a v_k = 1 − det ∇φ =: d on
the label and v = 0 at the rim of a box around it. With A for the left side at the nodes of the label, C being the
cofactors of ∇φ, and R for the Laplacian, v = R⁻¹ Aᵀ p and A R⁻¹ Aᵀ p = d. Where φ = id, v is the gradient of a
potential: the curl stays what it was. As A is a divergence and R⁻¹ two integrations, A R⁻¹ Aᵀ is nearly the identity
but for waves from node to node, which central differences do not see: conjugate gradients take some ten steps, and with
ε p added, a price ‖A v − d‖² / ε for what is left, they do not follow what no v can do.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchdeform.core.derivatives import add_adjoint_derivative, cofactors, determinant, jacobian, map_jacobian
from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.fold_free import largest_share
from torchdeform.core.grid import Grid, per_item
from torchdeform.core.regions import Crop, all_but_few, grown, nearest, require_labels
from torchdeform.solvers.cg import conjugate_gradient, dots

# Done when |det ∇φ − 1| is smaller than this at all nodes but one in a thousand.
_TOLERANCE = 2e-3

# ε of the module's docstring: less fits waves from node to node sooner, more is steadier where volumes do not fit.
_PRICE = 0.03

# A step leaves no one-sided determinant below the first, or half of the smallest there was; it is halved so often; at
# most so many are made, as long as each takes a tenth off the error.
_FLOOR, _HALVINGS, _STEPS, _GAIN = 0.05, 5, 20, 0.9

# Conjugate gradients within a step: relative tolerance, and steps.
_RTOL, _LINEAR_STEPS = 0.03, 20

# Nodes around the label that take part: half of its width, and no fewer than this.
_LEAST_MARGIN = 6

# Voxels over which the change fades out towards what must not move.
_FADE = 3


@torch.no_grad()
def hold_volume(u: Tensor, inside: Tensor, grid: Grid, *, still: Tensor | None = None) -> Tensor:
    """Return u, changed as little and as smoothly as can be so that det ∇φ = 1 on a label.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing, of a map without folds.
        inside: ``(B or 1, L, *S)`` of bool, one or more labels.
        grid: the grid.
        still: ``(B or 1, L, *S)`` of bool, labels that must not move; none by default.

    Returns:
        ``(B, D, *S)``: `jacobian_determinant` within 0.002 of 1 at 99.9 % of the label's nodes and no new fold. Where
        volumes do not fit, as where a label fills a box that φ does not, the nearest that was found: measure it with
        `label_fit`.

    Raises:
        InputError: shapes or types.

    Notes:
        The determinant becomes 1 at the nodes next to the label too: so the simplices around the label's nodes, and
        with them its volume, see `nodal_volumes`, are right as well. What moves lies in a box half of the label's width
        around it, in which the rest gives way evenly; on the faces of Ω nodes only glide. 2 to 5 steps. Not
        differentiable.
    """
    grid.check_vector(u, "hold_volume: u")
    require_labels(inside, grid, "hold_volume: inside")
    if still is not None:
        require_labels(still, grid, "hold_volume: still")
    anywhere = inside.flatten(0, 1).any(0)
    if not bool(anywhere.any()):
        return u
    across = float(anywhere.sum()) ** (1 / grid.dim)
    crop = Crop.around(anywhere, grid, max(_LEAST_MARGIN, math.ceil(across / 2)))
    return crop.replaced(u, _Label(crop, inside, still, u).held(crop.of(u)))


class _Label:
    """A label with the box around it.

    Args:
        crop: the box.
        inside: as `hold_volume`, on the whole grid.
        still: as `hold_volume`.
        u: a map on the whole grid.
    """

    def __init__(self, crop: Crop, inside: Tensor, still: Tensor | None, u: Tensor) -> None:
        self.grid = crop.grid
        self.free = None
        label = crop.of(inside).any(1, keepdim=True)
        around = grown(label)
        if still is not None:
            fixed = crop.of(still).any(1, keepdim=True)
            label, around = label & ~fixed, around & ~fixed
            self.free = (nearest(fixed, _FADE)[0].clamp(max=_FADE**2).sqrt() / _FADE).to(u)
        self.label, self.around = (mask.expand(len(u), -1, *self.grid.shape) for mask in (label, around))
        self.smooth = _inverse_laplacian(crop, u)

    def held(self, u: Tensor) -> Tensor:
        """Return u on the box with det ∇φ = 1 on the label."""
        floor = (self._lowest(u) / 2).clamp(max=_FLOOR)
        open_ = torch.ones_like(floor, dtype=torch.bool)
        for _ in range(_STEPS):
            gradient = map_jacobian(u, self.grid)
            left = self._left(gradient)
            open_ = open_ & (self._worst(left) > _TOLERANCE)
            if not bool(open_.any()):
                break
            move = self._direction(cofactors(gradient), left * per_item(open_, left))
            share, gain = self._search(u, move, dots(left, left), floor)
            u = u + per_item(share * open_, u) * move
            open_ = open_ & (share > 0) & (gain < _GAIN**2)
        return u

    def _search(self, u: Tensor, move: Tensor, before: Tensor, floor: Tensor) -> tuple[Tensor, Tensor]:
        """Return the share of a move to make, and by what it multiplies the squared error."""
        after = before

        def accept(share: Tensor) -> Tensor:
            nonlocal after
            trial = u + per_item(share, u) * move
            left = self._left(map_jacobian(trial, self.grid))
            after = dots(left, left)
            return (after <= before) & (self._lowest(trial) >= floor)

        share = largest_share(accept, before, halvings=_HALVINGS)
        return share, after / before.clamp(min=torch.finfo(before.dtype).tiny)

    def _left(self, gradient: Tensor) -> Tensor:
        """Return 1 − det ∇φ on the label and around it, 0 elsewhere."""
        return (1 - determinant(gradient)).masked_fill(~self.around, 0)

    def _worst(self, left: Tensor) -> Tensor:
        """Return what all nodes of the label but one in a thousand keep to, ``(B,)``."""
        found = left.new_zeros(len(left))
        for item, (values, where) in enumerate(zip(left.abs(), self.label, strict=True)):
            if bool(where.any()):
                found[item] = all_but_few(values[where])
        return found

    def _lowest(self, u: Tensor) -> Tensor:
        return one_sided_determinant(u, self.grid).flatten(1).amin(1)

    def _direction(self, factors: Tensor, left: Tensor) -> Tensor:
        """Return R⁻¹ Aᵀ p with (A R⁻¹ Aᵀ + ε) p = left."""

        def rows(v: Tensor) -> Tensor:
            return (factors * jacobian(v, self.grid)).sum((1, 2)).unsqueeze(1).masked_fill(~self.around, 0)

        def change(p: Tensor) -> Tensor:
            total = torch.zeros_like(factors[:, 0])
            for a in range(self.grid.dim):
                add_adjoint_derivative(total, factors[:, :, a] * p, self.grid, a)
            return self._freely(self.smooth(self._freely(total)))

        found = conjugate_gradient(lambda p: rows(change(p)) + _PRICE * p, left, rtol=_RTOL, max_steps=_LINEAR_STEPS)
        return change(found.value)

    def _freely(self, field: Tensor) -> Tensor:
        return field if self.free is None else field * self.free


def _inverse_laplacian(crop: Crop, like: Tensor) -> Callable[[Tensor], Tensor]:
    """Return load ↦ v with −Δ v = load, v being 0 at the rim of the crop; where that is a face of Ω only n·v is."""
    grid = crop.grid
    solvers = []
    for k in range(grid.dim):
        ends = [[crop.cut(axis, side) or axis == k for side in (0, 1)] for axis in range(grid.dim)]
        modes = [_modes(*along) for along in zip(grid.shape, grid.spacing, ends, strict=True)]
        shapes = [[-1 if b == a else 1 for b in range(grid.dim)] for a in range(grid.dim)]
        values = [v.view(shape) for (v, _), shape in zip(modes, shapes, strict=True)]
        solvers.append(([q.to(like) for _, q in modes], (1 / sum(values[1:], start=values[0])).to(like)))

    def solve(load: Tensor) -> Tensor:
        parts = []
        for component, (bases, scale) in zip(load.unbind(1), solvers, strict=True):
            modes = component
            for axis, basis in enumerate(bases, start=1):
                modes = _times(modes, basis, axis)
            modes = modes * scale
            for axis, basis in enumerate(bases, start=1):
                modes = _times(modes, basis.mT, axis)
            parts.append(modes)
        return torch.stack(parts, dim=1)

    return solve


def _times(x: Tensor, matrix: Tensor, axis: int) -> Tensor:
    """Return x with its axis multiplied by a matrix from the right."""
    return (x.movedim(axis, -1) @ matrix).movedim(-1, axis)


def _modes(count: int, spacing: float, ends: list[bool]) -> tuple[Tensor, Tensor]:
    """Return λ ``(m,)`` and Q ``(n, m)`` with K Q = E Q λ and Qᵀ E Q = 1 on the nodes of one axis.

    K is the matrix of second differences and E that of the trapezoidal rule, the ends being 0 where ``ends`` says so.
    """
    slopes = torch.eye(count, dtype=torch.float64, device="cpu").diff(dim=0) / spacing
    root = torch.ones(count, dtype=torch.float64, device="cpu")
    root[[0, -1]] = math.sqrt(2)
    root[[end for end, fixed in zip((0, -1), ends, strict=True) if fixed]] = 0.0
    values, vectors = torch.linalg.eigh(root[:, None] * (slopes.mT @ slopes) * root)
    return values[sum(ends) :], (root[:, None] * vectors)[:, sum(ends) :]
