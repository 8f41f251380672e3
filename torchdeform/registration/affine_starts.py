"""Where an alignment may start: the files' geometry, centres, moments, and rotations about them."""

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdeform.registration.affine_group import angle, homogeneous, rotations
from torchdeform.registration.affine_level import Frame, Masked

# A ratio of sizes nearer to 1 than this is no reason to start with another scale.
_SAME_SIZE = 1.1


@dataclass(frozen=True)
class Start:
    """A map to start from.

    Attributes:
        name: where it comes from.
        map: matrix ``(D + 1, D + 1)`` in the coordinates of the `Frame`.
        turned: whether it is more than a shift and a scale.
    """

    name: str
    map: Tensor
    turned: bool


@dataclass(frozen=True)
class Body:
    """Where an image's content lies in the frame.

    Attributes:
        mass: centre of what is not background ``(D,)``.
        covariance: its second moments about that centre ``(D, D)``.
        box: centre of the image's box ``(D,)``.
    """

    mass: Tensor
    covariance: Tensor
    box: Tensor


def body(part: Masked, frame: Frame) -> Body:
    """Return the moments of |image − background|, or of the mask where there is one.

    Args:
        part: one or more channels; the background is the median over the faces of the box.
        frame: coordinates of the result.
    """
    grid = part.image.grid
    weight = _foreground(part.image.data) if part.weight is None else part.weight
    weight = weight.double().flatten().cpu()
    weight = weight / weight.sum()
    points = frame.from_world(part.image.to_world(grid.points(dtype=torch.float64)).flatten(2))[0]
    mass = points @ weight
    away = points - mass.unsqueeze(1)
    return Body(mass, (away * weight) @ away.T, (points[:, 0] + points[:, -1]) / 2)


def _foreground(data: Tensor) -> Tensor:
    axes = range(2, data.dim())
    faces = torch.cat([data.select(a, end).flatten(1) for a, end in itertools.product(axes, (0, -1))], dim=1)
    return (data - faces.median()).abs().mean(dim=1) + 1e-6


def make_starts(fixed: Body, moving: Body, *, turn: bool, scale: bool, mirror: bool = False) -> list[Start]:
    """Return the maps to try, those without a rotation first.

    Args:
        fixed: moments of the fixed image.
        moving: moments of the moving image, in the same frame.
        turn: try rotations about each centre, and the principal axes.
        scale: try the ratio of sizes.
        mirror: return mirror images of the same maps, which no alignment may end at.
    """
    ratio = float((moving.covariance.trace() / fixed.covariance.trace()).sqrt())
    sizes = [1.0, ratio] if scale and max(ratio, 1 / ratio) > _SAME_SIZE else [1.0]
    anchors = {
        "geometry": (fixed.box, fixed.box),
        "centres": (fixed.box, moving.box),
        "mass": (fixed.mass, moving.mass),
    }
    turns = rotations(len(fixed.box)) if turn else rotations(len(fixed.box))[:1]
    flip = torch.ones(len(fixed.box), dtype=torch.float64)
    flip[0] = -1.0 if mirror else 1.0
    found = []
    for (name, (start, end)), size, r in itertools.product(anchors.items(), sizes, turns):
        found.append(_about(name, size * r * flip, start, end))
    if turn:
        found += [_about("moments", r * flip, fixed.mass, moving.mass) for r in _axes(fixed, moving)]
    return sorted(found, key=lambda s: s.turned)


def _about(name: str, linear: Tensor, start: Tensor, end: Tensor) -> Start:
    degrees = float(angle(linear)) if torch.linalg.det(linear) > 0 else 180.0
    turned = degrees > 1.0
    full = f"{name}, turned by {degrees:.0f}°" if turned else name
    return Start(full, homogeneous(linear, end - linear @ start), turned)


def _axes(fixed: Body, moving: Body) -> list[Tensor]:
    """Return the rotations that take principal axes to principal axes: 2 in 2D, 4 in 3D."""
    frames = [torch.linalg.eigh(b.covariance).eigenvectors for b in (fixed, moving)]
    signs = itertools.product((1.0, -1.0), repeat=len(fixed.box))
    every = [frames[1] @ torch.diag(torch.tensor(s, dtype=torch.float64)) @ frames[0].T for s in signs]
    return [r for r in every if torch.linalg.det(r) > 0]
