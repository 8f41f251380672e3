"""Phantoms of tissue that turns, fills with contrast, and slides: pairs drawn in code whose true map is known.

A scene is a picture given by formulas and a motion that is followed exactly, forwards for the truth and backwards for
what the moving image shows. Both images have noise of their own. A seed makes another phantom of the same kind.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

import torchdeform as td

# A signed distance from a shape, and what a scene looks like: both of points (1, D, *S) in voxels, as (1, 1, *S).
Distance = Callable[[Tensor], Tensor]
_NOISE = 0.012  # standard deviation; tissue is about 0.5, bone 1
_STEPS = 12  # of Runge-Kutta


@dataclass(frozen=True)
class Phantom:
    """A pair and what is known of it.

    Attributes:
        name: of the kind and the dimension.
        fixed: ``(1, 1, *S)``.
        moving: likewise.
        tissue: labels of the fixed image, float, 0 for the rest.
        truth: displacement from fixed to moving in voxels ``(1, D, *S)``.
        settings: what is said of the labels, as `td.load_settings` takes it.
    """

    name: str
    fixed: Tensor
    moving: Tensor
    tissue: Tensor
    truth: Tensor
    settings: Mapping[str, Any] = field(default_factory=dict)

    @property
    def grid(self) -> td.Grid:
        """The grid of both images, spacing 1."""
        return td.Grid(tuple(self.fixed.shape[2:]))


@dataclass(frozen=True)
class Body:
    """A shape that moves rigidly.

    Attributes:
        distance: from it, negative inside, at the beginning.
        turn: skew matrix ``(D, D)``, the logarithm of its rotation.
        centre: what it turns about ``(D,)``.
        shift: how far it moves ``(D,)``.
    """

    distance: Distance
    turn: Tensor
    centre: Tensor
    shift: Tensor

    def back(self, x: Tensor, time: float) -> Tensor:
        """Return where points of the body were at the beginning."""
        centre, shift = (_along(c, x) for c in (self.centre, self.shift))
        return centre + _times(torch.linalg.matrix_exp(-time * self.turn), x - centre - time * shift)

    def velocity(self, x: Tensor, time: float) -> Tensor:
        """Return the velocity of the body's points."""
        centre, shift = (_along(c, x) for c in (self.centre, self.shift))
        return _times(self.turn, x - centre - time * shift) + shift


def follow(bodies: Sequence[Body], width: float, rest: Callable[[Tensor], Tensor] | None = None) -> "Motion":
    """Return the flow that is each body's own motion up to a voxel around it and fades out over ``width`` voxels.

    Between bodies the velocities are blended. The flow of a smooth velocity does not fold.
    """

    def velocity(x: Tensor, time: float) -> Tensor:
        far = [(body.distance(body.back(x, time)) - 1.0).clamp(min=0) for body in bodies]
        near = torch.stack(far).amin(0)
        nearness = 1 / (torch.stack(far) + 1e-9)
        shares = _smooth(nearness / nearness.sum(0))
        fade = _smooth(1 - near / width)
        parts = [share * body.velocity(x, time) for share, body in zip(shares, bodies, strict=True)]
        around = 0.0 if rest is None else (1 - fade) * rest(x)
        return fade * torch.stack(parts).sum(0) + around

    return Motion(velocity)


@dataclass(frozen=True)
class Motion:
    """The flow of a velocity (points, time) → (1, D, *S) over one unit of time."""

    velocity: Callable[[Tensor, float], Tensor]

    def forth(self, x: Tensor) -> Tensor:
        """Return where points go."""
        return self._followed(x, 0.0, 1.0)

    def back(self, x: Tensor) -> Tensor:
        """Return where points come from."""
        return self._followed(x, 1.0, 0.0)

    def _followed(self, x: Tensor, start: float, stop: float) -> Tensor:
        h = (stop - start) / _STEPS
        for k in range(_STEPS):
            t = start + k * h
            a = self.velocity(x, t)
            b = self.velocity(x + h / 2 * a, t + h / 2)
            c = self.velocity(x + h / 2 * b, t + h / 2)
            d = self.velocity(x + h * c, t + h)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        return x


def bones(dim: int = 2, seed: int = 1) -> Phantom:
    """Femur and tibia that turn by 20 and 10 degrees against each other in soft tissue."""
    n, scale = ((160, 1.0), (64, 0.4))[dim - 2]
    grid, rng = td.Grid((n,) * dim), np.random.default_rng(seed)
    middle = torch.full((dim,), (n - 1) / 2, dtype=torch.float64)

    def at(down: float, across: float) -> Tensor:
        return middle + scale * torch.tensor([down, across, *[0.0] * (dim - 2)], dtype=torch.float64)

    ends = (at(-50, 9), at(-10, 2)), (at(20, -1), at(50, -5))
    femur, tibia = (_long_bone(*two, scale * 8.5, scale * 3) for two in ends)
    still = torch.zeros(dim, dtype=torch.float64)
    turns = [_skew(dim, math.radians(angle), rng) for angle in (20, -10)]
    pivots = at(-20, 4), at(28, -2)  # both nearer to the knee
    bodies = [Body(d, turn, c, still) for d, turn, c in zip((femur, tibia), turns, pivots, strict=True)]
    leg = _union(*(_long_bone(a, b, scale * 32, 0.0) for a, b in ((at(-90, 16), at(5, 0)), (at(5, 0), at(90, -10)))))
    textures = [_texture(grid, sigma, rng) for sigma in (2.2, 1.6, 5.0)]

    def scene(x: Tensor) -> Tensor:
        soft, marrow, slow = (texture(x) for texture in textures)
        value = 0.05 + _inside(leg(x)) * (0.37 + 0.1 * soft + 0.05 * slow)
        for bone in (femur, tibia):
            d = bone(x)
            value = torch.lerp(value, torch.ones_like(value), _inside(d))
            value = torch.lerp(value, 0.62 + 0.12 * marrow, _inside(d + 2.5))
        return value

    x = grid.points(dtype=torch.float64)
    labels = _labels(x, femur, tibia)
    settings = {"tissues": {1: "rigid", 2: "rigid"}}
    return _pair(f"bones {dim}D", grid, scene, scene, follow(bodies, 28 * scale), labels, settings, rng)


def lesion(dim: int = 2, seed: int = 1) -> Phantom:
    """A lesion of a breast that brightens by 60 % and moves by 3 voxels without any change of its volume."""
    n = (144, 64)[dim - 2]
    grid, rng = td.Grid((n,) * dim), np.random.default_rng(seed)
    scale = n / 144 if dim == 2 else 0.62
    middle = torch.full((dim,), (n - 1) / 2, dtype=torch.float64)
    rough = _texture(grid, 7 * scale, rng)

    def blob(x: Tensor) -> Tensor:
        return (x - _along(middle, x)).square().sum(1, keepdim=True).sqrt() - scale * (17 + 3.0 * rough(x))

    direction = rng.normal(size=dim)
    shift = torch.tensor(3 * direction / np.linalg.norm(direction))
    body = Body(blob, torch.zeros(dim, dim, dtype=torch.float64), middle, shift)
    drift = [_texture(grid, 14 * scale, rng) for _ in range(dim)]
    fine = 1.8 if dim == 2 else 1.3
    textures = [_texture(grid, sigma, rng) for sigma in (fine, 2.2 * fine, fine, 2.2 * fine)]

    def window(x: Tensor) -> Tensor:
        return torch.sin(math.pi * (x / (n - 1)).clamp(0, 1)).prod(1, keepdim=True)

    def rest(x: Tensor) -> Tensor:
        return 1.2 * scale * window(x) * torch.cat([part(x) for part in drift], dim=1)

    def scene(x: Tensor, enhanced: float = 0.0) -> Tensor:
        small, coarse, own, large = (texture(x) for texture in textures)
        d = blob(x)
        value = torch.lerp(0.4 + 0.06 * small + 0.09 * coarse, 0.7 + 0.05 * own + 0.05 * large, _inside(d, 2.0))
        return value * (1 + enhanced * _inside(d - 0.5, 3.0))

    labels = _labels(grid.points(dtype=torch.float64), blob)
    settings = {"tissues": {1: "incompressible"}}
    motion = follow([body], 30 * scale, rest)
    return _pair(f"lesion {dim}D", grid, scene, lambda x: scene(x, 0.6), motion, labels, settings, rng)


def blocks(dim: int = 2, seed: int = 1, shape: str = "flat") -> Phantom:
    """Two blocks that slide by 6 voxels along each other: on a plane, a slanted one, or a disc within a ring."""
    n = (128, 64)[dim - 2]
    grid, rng = td.Grid((n,) * dim), np.random.default_rng(seed)
    parts = (_disc_in_ring if shape == "curved" else _two_blocks)(n, dim, math.radians(25 if shape == "slanted" else 0))
    textures = [[_texture(grid, sigma, rng) for sigma in (1.8, 4.0)] for _ in range(2)]

    def scene(x: Tensor, time: float) -> Tensor:
        value = torch.full_like(x[:, :1], 0.05)
        for part, (fine, slow) in zip(parts, textures, strict=True):
            at = part.back(x, time)
            value = torch.lerp(value, 0.5 + 0.12 * fine(at) + 0.12 * slow(at), _inside(part.distance(at)))
        return value

    x = grid.points(dtype=torch.float64)
    labels = _labels(x, *(part.distance for part in parts))
    moved = [(labels == k) * (part.back(x, -1.0) - x) for k, part in enumerate(parts, start=1)]
    truth = torch.stack(moved).sum(0)
    images = _noisy(scene(x, 0.0), rng), _noisy(scene(x, 1.0), rng)
    return Phantom(f"blocks {dim}D, {shape}", *images, labels, truth.float(), {"sliding": [1, 2]})


def breathing(dim: int = 2, seed: int = 1) -> Phantom:
    """Lungs and belly that glide along the ribs by up to 8 voxels, as in a frontal slice of a chest."""
    n = 128
    grid, rng = td.Grid((n,) * dim), np.random.default_rng(seed)
    x = grid.points(dtype=torch.float64)
    textures = [_texture(grid, sigma, rng) for sigma in (1.3, 1.8, 2.2)]

    def cavity(x: Tensor) -> Tensor:
        y, across = x[:, :1], (x[:, 1:] - (n - 1) / 2).abs()
        dome = 34 - (28.0**2 - (across - 12).clamp(0, 28).square()).sqrt() + 12  # the top of the cavity
        return torch.maximum(across - 40, dome - y)

    def diaphragm(x: Tensor) -> Tensor:
        across = (x[:, 1:] - (n - 1) / 2).abs()
        return 82 - 9 * torch.exp(-(((across - 20) / 13) ** 2)) - x[:, :1]

    def ribs(x: Tensor) -> Tensor:
        y, across = x[:, :1], (x[:, 1:] - (n - 1) / 2).abs()
        return ((across - 46) ** 2 + ((y - 8) % 13 - 6.5) ** 2).sqrt() - 3.2

    def inner(x: Tensor) -> Tensor:
        vessels, _, belly = (texture(x) for texture in textures)
        heart = ((x[:, :1] - 62).square() / 1.4 + (x[:, 1:] - (n - 1) / 2 - 4).square()).sqrt() - 13
        lung = 0.12 + 0.33 * (vessels - 0.5).clamp(min=0)
        value = torch.lerp(0.55 + 0.1 * belly, lung, _inside(-diaphragm(x)))
        return torch.lerp(value, 0.65 + 0.04 * belly, _inside(heart))

    def wall(x: Tensor) -> Tensor:
        body = torch.maximum((x[:, 1:] - (n - 1) / 2).abs() - 54, 8 - x[:, :1])
        muscle = torch.lerp(0.45 + 0.1 * textures[1](x), torch.tensor(1.0, dtype=x.dtype), _inside(ribs(x)))
        return 0.03 + _inside(body) * muscle

    def velocity(x: Tensor, time: float) -> Tensor:
        y = (x[:, :1] - 24).clamp(min=0) / (n - 1 - 24)
        down = 8.0 * _smooth((y / 0.45).clamp(max=1)) * _smooth(((1 - y) / 0.5).clamp(max=1))
        return torch.cat([down, torch.zeros_like(x[:, 1:])], dim=1)

    motion = Motion(velocity)
    inside = cavity(x) < 0
    here, there = (torch.lerp(wall(x), inner(at), _inside(cavity(x))) for at in (x, motion.back(x)))
    truth = inside * (motion.forth(x) - x)
    images = _noisy(here, rng), _noisy(there, rng)
    return Phantom(f"breathing {dim}D", *images, inside.float(), truth.float(), {"sliding": [1]})


def _two_blocks(n: int, dim: int, angle: float) -> list[Body]:
    """Return an upper and a lower block, the plane between them slanted, that move apart along it."""
    middle = torch.full((dim,), (n - 1) / 2 + 0.25, dtype=torch.float64)
    along, across = torch.zeros(2, dim, dtype=torch.float64)
    along[:2] = torch.tensor([math.sin(angle), math.cos(angle)])
    across[:2] = torch.tensor([math.cos(angle), -math.sin(angle)])
    long, deep = (0.33 * n, 0.28 * n) if dim == 2 else (0.34 * n, 0.30 * n)

    def block(side: int) -> Distance:
        def distance(x: Tensor) -> Tensor:
            way = x - _along(middle, x)
            s, h = ((way * _along(one, x)).sum(1, keepdim=True) for one in (along, across))
            sides = [s.abs() - long, -side * h, side * h - deep]
            sides += [way[:, k : k + 1].abs() - long for k in range(2, dim)]
            return torch.stack(sides).amax(0)

        return distance

    still = torch.zeros(dim, dim, dtype=torch.float64)
    return [Body(block(side), still, middle, -side * 3.0 * along) for side in (-1, 1)]


def _disc_in_ring(n: int, dim: int, _: float) -> list[Body]:
    """Return a disc and a ring around it that turn against each other."""
    middle, inner, outer = torch.full((dim,), (n - 1) / 2, dtype=torch.float64), 0.24 * n + 0.1, 0.43 * n

    def radius(x: Tensor) -> Tensor:
        return (x - _along(middle, x)).square().sum(1, keepdim=True).sqrt()

    turn = torch.zeros(dim, dim, dtype=torch.float64)
    turn[0, 1], turn[1, 0] = -3.0 / inner, 3.0 / inner
    still = torch.zeros(dim, dtype=torch.float64)
    shapes = [lambda x: radius(x) - inner, lambda x: torch.maximum(inner - radius(x), radius(x) - outer)]
    return [Body(shape, sign * turn, middle, still) for shape, sign in zip(shapes, (1, -1), strict=True)]


def _pair(
    name: str,
    grid: td.Grid,
    fixed: Distance,
    moving: Distance,
    motion: Motion,
    labels: Tensor,
    settings: Mapping[str, Any],
    rng: np.random.Generator,
) -> Phantom:
    """Return the phantom of a scene before and after a motion."""
    x = grid.points(dtype=torch.float64)
    images = _noisy(fixed(x), rng), _noisy(moving(motion.back(x)), rng)
    return Phantom(name, *images, labels, (motion.forth(x) - x).float(), settings)


def _long_bone(start: Tensor, end: Tensor, radius: float, bulge: float) -> Distance:
    """Return the distance from a rod with thicker ends."""
    axis = end - start
    length = float(axis.norm())

    def distance(x: Tensor) -> Tensor:
        way, unit = x - _along(start, x), _along(axis / length, x)
        s = (way * unit).sum(1, keepdim=True).clamp(0, length)
        ends = torch.minimum(s, length - s)
        thick = radius + bulge * torch.exp(-((ends / (0.9 * radius)) ** 2)) if bulge else radius
        return (way - s * unit).square().sum(1, keepdim=True).sqrt() - thick

    return distance


def _union(*shapes: Distance) -> Distance:
    return lambda x: torch.stack([shape(x) for shape in shapes]).amin(0)


def _labels(x: Tensor, *shapes: Distance) -> Tensor:
    """Return the number of the shape that a node is in, from 1; 0 for none."""
    return torch.stack([k * (shape(x) < 0).float() for k, shape in enumerate(shapes, start=1)]).sum(0)


def _skew(dim: int, angle: float, rng: np.random.Generator) -> Tensor:
    """Return the logarithm of a rotation, in 3D about an axis near the last one."""
    turn = torch.zeros(dim, dim, dtype=torch.float64)
    if dim == 2:
        turn[0, 1], turn[1, 0] = -angle, angle
        return turn
    axis = np.array([0.0, 0.0, 1.0]) + 0.3 * rng.normal(size=3)
    a, b, c = (angle * axis / np.linalg.norm(axis)).tolist()
    return torch.tensor([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]], dtype=torch.float64)


def _texture(grid: td.Grid, sigma: float, rng: np.random.Generator) -> Callable[[Tensor], Tensor]:
    """Return smooth noise with standard deviation 1 that can be looked at anywhere."""
    values = gaussian_filter(rng.standard_normal(grid.shape), sigma, mode="wrap")
    values /= values.std()

    def look(x: Tensor) -> Tensor:
        found = map_coordinates(values, x[0].numpy(), order=3, mode="grid-wrap")
        return torch.from_numpy(found)[None, None]

    return look


def _noisy(values: Tensor, rng: np.random.Generator) -> Tensor:
    return (values + _NOISE * torch.from_numpy(rng.standard_normal(values.shape))).float()


def _inside(distance: Tensor, width: float = 1.0) -> Tensor:
    """Return 1 inside, 0 outside, with a border of so many voxels."""
    return (0.5 - distance / width).clamp(0, 1)


def _smooth(t: Tensor) -> Tensor:
    """Return a step from 0 to 1 with two derivatives."""
    t = t.clamp(0, 1)
    return t**3 * (10 - 15 * t + 6 * t**2)


def _along(values: Tensor, x: Tensor) -> Tensor:
    return values.to(x).view(1, -1, *[1] * (x.dim() - 2))


def _times(matrix: Tensor, x: Tensor) -> Tensor:
    return torch.einsum("ij,bj...->bi...", matrix.to(x), x)
