"""Labels that stay rigid: a map is moved there to the motion that fits it best, and around them less and less."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdeform.core.diagnostics import one_sided_determinant
from torchdeform.core.fold_free import where_items
from torchdeform.core.grid import Grid
from torchdeform.core.regions import Crop, grown, nearest, require_labels

# Voxels over which a correction fades out: the first that leave the determinants that are asked for.
_WIDTHS = (4, 8, 16)

# No correction takes a node nearer to a face of the box than to this share of its distance before.
_SQUEEZE = 0.2

# Squared voxels that stand for no distance at all.
_TOUCHING = 1e-12


def hold_rigid(u: Tensor, inside: Tensor, grid: Grid, floor: float = 0.3) -> Tensor:
    """Return u with the rigid motion that fits it best on each label; see `RigidHold`.

    Args:
        u: displacement ``(B, D, *S)`` in units of spacing.
        inside: labels ``(B or 1, L, *S)`` of bool.
        grid: the grid.
        floor: smallest one-sided determinant wanted around the labels.

    Returns:
        ``(B, D, *S)``; where nothing folds less, folded: look at `diagnose`.

    Raises:
        InputError: shapes or types.
    """
    return RigidHold(inside, grid)(u, floor)


@dataclass(frozen=True)
class RigidMotion:
    """Motions y = R (x − start) + end, one per item, in units of spacing and float64.

    Attributes:
        turn: R − I, ``(B, D, D)``.
        start: the centre of the label ``(B, D)``.
        end: where it goes ``(B, D)``.
    """

    turn: Tensor
    start: Tensor
    end: Tensor

    @property
    def shift(self) -> Tensor:
        """The displacement of the origin, ``(B, D)``."""
        return self.end - self.start - (self.turn @ self.start.unsqueeze(2)).squeeze(2)

    def at(self, points: Tensor) -> Tensor:
        """Return the displacement of points ``(D, M)``, ``(B, D, M)``."""
        return self.turn @ points.to(self.turn) + self.shift.unsqueeze(2)

    def on(self, axes: Sequence[Tensor], like: Tensor) -> Tensor:
        """Return the displacement at the nodes of a box with these coordinates ``(1, 1, .., n, .., 1)`` by axis."""
        ones = [1] * len(axes)
        total = self.shift.view(*self.shift.shape, *ones)
        for a, x in enumerate(axes):  # added up as planes and lines, in float64, before they fill the box
            part = self.turn[:, :, a].reshape(*self.shift.shape, *ones) * x
            total = (part + total) if a == 0 else total.to(like) + part.to(like)
        return total.to(like)


@torch.no_grad()
def fit_rigid(points: Tensor, moved: Tensor, weights: Tensor) -> RigidMotion:
    """Return the rigid motions that take points to their places with the least weighted squares.

    Args:
        points: x ``(D, M)``.
        moved: φ(x) ``(B, D, M)``.
        weights: ``(B or 1, M)``, not negative; where all are 0 the motion is none.

    Returns:
        `RigidMotion`.

    Notes:
        Kabsch's method, without reflections. What the points leave open, such as the turn about a line of them, is as
        near to no turn as it can be. A constant for gradients.
    """
    points, moved, weights = points.double(), moved.double(), weights.double()
    share = (weights / weights.sum(1, keepdim=True).clamp(min=torch.finfo(torch.float64).tiny)).unsqueeze(1)
    start, end = (share * points).sum(2), (share * moved).sum(2)
    before, after = points - start.unsqueeze(2), moved - end.unsqueeze(2)
    eye = torch.eye(len(points), dtype=torch.float64, device=points.device)
    # A tiny turn towards none, which decides where nothing else does.
    size = (share * before.square()).sum((1, 2)) + torch.finfo(torch.float64).tiny
    left, _, right = torch.linalg.svd((share * after) @ before.mT + 1e-12 * size.view(-1, 1, 1) * eye)
    sign = torch.ones_like(end)
    sign[:, -1] = (left @ right).det().sign()
    return RigidMotion(left * sign.unsqueeze(1) @ right - eye, start.expand_as(end), end)


class RigidHold:
    """Labels of a grid that are made rigid again after every change of a map.

    Args:
        inside: ``(B or 1, L, *S)`` of bool, one channel for each label; none may share nodes.
        grid: the grid of the maps.

    Raises:
        InputError: shape or type of the labels.

    Notes:
        On a label and on the nodes next to it, over corners too, u becomes the rigid motion that fits φ best on the
        label. The correction at the nearest of these nodes, less and less of it, is made around them: over 4 voxels, or
        8 or 16 where fewer would fold. What is rigid already is left as it is, and so is all around it. Between
        labels both corrections are made, more of the nearer one's; no label reaches the nodes of another.
        On a face of the box that a label does not touch the components that lead out stay as they are, and near it less
        of the correction is made to them. Where a label touches a face it takes the nodes of the face along, into the
        box: there φ(Ω) ends short of the face. No correction leads out of the box or takes a node nearer to a face than
        to a fifth of its distance, so that layers keep their order; nodes that would have to are not rigid.
        Weights are made once for each width that is needed.
    """

    def __init__(self, inside: Tensor, grid: Grid) -> None:
        require_labels(inside, grid, "RigidHold: inside")
        self.grid = grid
        self._labels = [label for label in inside.split(1, dim=1) if bool(label.any())]
        points = grid.points(dtype=torch.float64, device=inside.device)[0].flatten(1)
        self._nodes = [label.flatten(2).any(0).any(0).nonzero().flatten() for label in self._labels]
        self._points = [points[:, nodes] for nodes in self._nodes]
        self._near = Crop.around(inside.flatten(0, 1).any(0), grid, max(_WIDTHS) + 2) if self._labels else None
        self._blends: dict[int, list[_Blend]] = {}

    def __call__(self, u: Tensor, floor: float | Tensor = 0.3) -> Tensor:
        """Return u, rigid on the labels.

        Args:
            u: displacement ``(B, D, *S)`` in units of spacing.
            floor: the fading is widened until no one-sided determinant near the labels is below this or below the
                smallest there was; a number or one per item ``(B,)``.

        Returns:
            ``(B, D, *S)``. Where no width will do, with the one that leaves the largest smallest determinant: look
            whether it is positive. The motions count as constant for gradients.

        Raises:
            InputError: shape.
        """
        self.grid.check_vector(u, "RigidHold: u")
        if (near := self._near) is None:
            return u
        motions = self.fit(u)
        best, least = u, u.new_full((len(u),), -torch.inf)
        wanted = torch.as_tensor(floor, dtype=u.dtype, device=u.device).expand(len(u))
        for width in _WIDTHS:
            trial = self._corrected(u, motions, near, width)
            lowest = _lowest(trial, near)
            better = (least < wanted) & (lowest > least)
            best, least = where_items(better, trial, best), torch.where(better, lowest, least)
            if width == _WIDTHS[0] and bool((least < wanted).any()):
                wanted = torch.minimum(wanted, _lowest(u, near))
            if bool((least >= wanted).all()):
                break
        return best

    def fit(self, u: Tensor) -> list[RigidMotion]:
        """Return the motion of each label that occurs which fits φ best."""
        flat, motions = u.detach().flatten(2), []
        for label, nodes, x in zip(self._labels, self._nodes, self._points, strict=True):
            motions.append(fit_rigid(x, x + flat[:, :, nodes], label.flatten(1)[:, nodes]))
        return motions

    def _corrected(self, u: Tensor, motions: Sequence[RigidMotion], near: Crop, width: int) -> Tensor:
        """Return u with corrections that fade out over so many voxels."""
        if width not in self._blends:
            self._blends[width] = _blends(self._labels, self.grid, width)
        moved = u.clone()
        for motion, blend in zip(motions, self._blends[width], strict=True):
            blend.crop.of(moved).add_(blend.correction(blend.crop.of(u), motion))
        return _keep_off_faces(moved, u, near)


def _lowest(u: Tensor, near: Crop) -> Tensor:
    """Return the smallest one-sided determinant of each item in a crop, ``(B,)``."""
    return near.without_rim(one_sided_determinant(near.of(u), near.grid)).flatten(1).amin(1)


def _keep_off_faces(moved: Tensor, u: Tensor, near: Crop) -> Tensor:
    """Take back, in place, where a correction of u leaves the box or comes nearer to a face than `_SQUEEZE` allows."""
    grid, before, after = near.whole, near.of(u), near.of(moved)
    for k, (first, n, side) in enumerate(zip(near.low, near.grid.shape, grid.extent, strict=True)):
        x = torch.arange(first, first + n, dtype=u.dtype, device=u.device) * grid.spacing[k]
        x = x.view(-1, *[1] * (grid.dim - 1 - k))
        low = torch.minimum(before[:, k], (_SQUEEZE - 1) * x)
        high = torch.maximum(before[:, k], (1 - _SQUEEZE) * (side - x))
        after[:, k] = after[:, k].clone().clamp(low, high)  # a gradient needs what was there
    return moved


@dataclass(frozen=True)
class _Blend:
    """How a label's correction goes on around it.

    Attributes:
        crop: the label and what is around it.
        axes: coordinates of its nodes.
        weights: how much of the correction is made, ``(B or 1, D, *crop)``, by component.
        source: the number of the node whose correction it is, ``(B or 1, 1, *crop)``.
    """

    crop: Crop
    axes: tuple[Tensor, ...]
    weights: Tensor
    source: Tensor

    def correction(self, u: Tensor, motion: RigidMotion) -> Tensor:
        """Return what is added to u ``(B, D, *crop)``."""
        away = motion.on(self.axes, u) - u
        source = self.source.flatten(2).expand(*away.shape[:2], -1)
        return self.weights.to(u) * away.flatten(2).gather(2, source).view_as(away)


def _blends(labels: Sequence[Tensor], grid: Grid, width: int) -> list[_Blend]:
    """Return how far the corrections of labels reach: wholly to the nodes next to them, not to each other."""
    anywhere = torch.stack(torch.broadcast_tensors(*labels)).any(0)
    total = torch.zeros(anywhere.shape, dtype=torch.float64, device=anywhere.device)
    most, claims = torch.zeros_like(total), []
    for label in labels:
        crop = Crop.around(label[:, 0].any(0), grid, width + 2)
        others = crop.of(anywhere & ~label)
        squares, source = nearest(grown(crop.of(label)) & ~others, width)
        share, claim = _claim(squares.double(), width)
        claims.append((crop, label, claim.masked_fill_(others, 0), source))
        crop.of(total).add_(claim)
        crop.of(most).copy_(torch.maximum(crop.of(most), share))
    return [
        _Blend(crop, *_weights(crop, label, claim, crop.of(total), crop.of(most), width), source)
        for crop, label, claim, source in claims
    ]


def _claim(squares: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Return how much is blended in at squared distances, 1 at 0 and 0 from the width on, and the same per square."""
    near = (1 - squares.sqrt() / width).clamp(min=0)
    share = near.square() * (3 - 2 * near)
    return share, share / (squares + _TOUCHING)


def _weights(
    crop: Crop, label: Tensor, claim: Tensor, total: Tensor, most: Tensor, width: int
) -> tuple[tuple[Tensor, ...], Tensor]:
    """Return the coordinates, and the part that a label has in all claims; faces claim what leads out of them."""
    whole, axes = crop.whole, []
    weights = torch.empty(len(total), whole.dim, *crop.grid.shape, dtype=torch.float64, device=label.device)
    for k, (first, count) in enumerate(zip(crop.low, crop.grid.shape, strict=True)):
        node = torch.arange(first, first + count, dtype=torch.float64, device=label.device)
        node = node.view([-1 if a == k else 1 for a in range(-2, whole.dim)])
        rival, kept = torch.zeros_like(total), torch.ones_like(total, dtype=torch.bool)
        for side, depth in ((0, node), (-1, whole.shape[k] - 1 - node)):
            free = ~label.select(k + 2, side).flatten(1).any(1)
            free = free.view(-1, *[1] * (whole.dim + 1))
            rival = rival + _claim(depth.square(), width)[1] * free
            kept = kept & ~(free & (depth == 0))
        weights[:, k : k + 1] = kept * most * claim / (total + rival).clamp(min=torch.finfo(torch.float64).tiny)
        axes.append(node * whole.spacing[k])
    return tuple(axes), weights
