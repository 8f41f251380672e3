"""Good and bad pairs for the verdict: every open pair as it is, and pairs that no registration can get right."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from pairs import SETS, WHOLE_BRAINS, Pair
from skimage import data as pictures
from torch import Tensor

import torchdeform as td
from torchdeform.core.image import background, luminance
from torchdeform.io.images import read_labels, read_optional
from torchdeform.io.points import matched, read_points
from torchdeform.registration.annotations import Annotations

GOOD_PAIR = "good pair"
_Part = TypeVar("_Part")


@dataclass(frozen=True)
class Scene:
    """Two images, what is known of them, and settings that differ from the defaults."""

    fixed: td.Image
    moving: td.Image
    annotations: Annotations = field(default_factory=Annotations)
    overrides: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """A scene that is made when it is wanted; every other case of a kind belongs to the first half."""

    kind: str
    name: str
    make: Callable[[], Scene]
    first: bool = True


def scene(pair: Pair, *, labels: bool = False, points: bool = False, masks: bool = True, **overrides: Any) -> Scene:
    """Return the images of a pair, with what else its files say."""
    fixed, moving = td.read_image(pair.fixed), td.read_image(pair.moving)
    known: dict[str, Any] = {}
    if masks:
        known |= {"fixed_mask": read_optional(pair.fixed_mask), "moving_mask": read_optional(pair.moving_mask)}
    if labels and pair.fixed_labels and pair.moving_labels:
        known |= {"fixed_labels": read_labels(pair.fixed_labels), "moving_labels": read_labels(pair.moving_labels)}
    if points and pair.fixed_points and pair.moving_points:
        some, others = read_points(pair.fixed_points, fixed), read_points(pair.moving_points, moving)
        first, second, _ = matched(some, others)
        known |= {"fixed_points": first.T.unsqueeze(0), "moving_points": second.T.unsqueeze(0)}
    return Scene(fixed, moving, Annotations(**known), overrides)


def changed(pair: Pair, change: Callable[[td.Image], td.Image], *, labels: bool = False, **overrides: Any) -> Scene:
    """Return a pair with another moving image, and labels and mask changed with it."""
    given = scene(pair, labels=labels, **overrides)
    known = given.annotations
    rest = {name: getattr(known, name) for name in ("moving_mask", "moving_labels")}
    moved = {name: image if image is None else change(image) for name, image in rest.items()}
    return replace(given, moving=change(given.moving), annotations=replace(known, **moved))


def flipped(*axes: int) -> Callable[[td.Image], td.Image]:
    """Turn the array over along axes counted from the last one (x = 1), and leave the header as it is."""
    return lambda image: replace(image, data=image.data.flip([-axis for axis in axes]))


def half(axis: int, *, last: bool = False) -> Callable[[td.Image], td.Image]:
    """Keep one half along an axis, counted from the last one."""

    def cut(image: td.Image) -> td.Image:
        place = image.data.dim() - axis
        count = image.data.shape[place]
        first = count // 2 if last else 0
        part = image.data.narrow(place, first, count - first if last else count // 2)
        corner = torch.zeros(1, image.grid.dim, 1, dtype=torch.float64)
        corner[0, place - 2] = first * image.grid.spacing[place - 2]
        origin = tuple(image.to_world(corner).flatten().tolist())
        return replace(image, data=part, grid=td.Grid(tuple(part.shape[2:]), image.grid.spacing), origin=origin)

    return cut


def quarter(image: td.Image, *, last: bool = False) -> td.Image:
    """Set a quarter of an image to its background."""
    data, (high, wide) = image.data.clone(), (n // 2 for n in image.data.shape[-2:])
    rows, columns = (slice(high, None), slice(wide, None)) if last else (slice(high), slice(wide))
    data[..., rows, columns] = background(data)
    return replace(image, data=data)


def rescaled(factor: float) -> Callable[[td.Image], td.Image]:
    """Change spacing and origin, as a wrong unit does."""

    def change(image: td.Image) -> td.Image:
        grid = td.Grid(image.grid.shape, tuple(factor * h for h in image.grid.spacing))
        return replace(image, grid=grid, origin=tuple(factor * x for x in image.origin))

    return change


def shifted(*millimetres: float) -> Callable[[td.Image], td.Image]:
    """Move an image in the world, (x, y, z)."""
    return lambda image: replace(image, origin=tuple(map(sum, zip(image.origin, millimetres, strict=True))))


def inverted(image: td.Image) -> td.Image:
    return replace(image, data=image.data.amax() - image.data + image.data.amin())


def _noise(image: td.Image, seed: int) -> Tensor:
    return torch.randn(image.data.shape, generator=torch.Generator().manual_seed(seed))


def noisy(deviations: float, seed: int = 0) -> Callable[[td.Image], td.Image]:
    """Add noise of so many standard deviations of the image."""
    return lambda image: replace(image, data=image.data + deviations * image.data.std() * _noise(image, seed))


def noise_like(image: td.Image, seed: int = 1) -> td.Image:
    """An image of noise with the mean and the deviation of another."""
    return replace(image, data=image.data.mean() + image.data.std() * _noise(image, seed))


def picture(name: str) -> td.Image:
    """A picture that comes with scikit-image, in grey."""
    values = np.asarray(getattr(pictures, name)(), dtype=np.float32)
    values = values if values.ndim == 2 else values[..., :3].mean(2)
    grid = td.Grid((values.shape[0], values.shape[1]))
    return td.Image(torch.from_numpy(values)[None, None], grid, name=name, pixel_type="uint8")


def relabelled(image: td.Image, shift: int = 1) -> td.Image:
    """Give every label the number of another one."""
    names = image.data.unique()
    names = names[names != 0]
    data = image.data.clone()
    for old, new in zip(names, names.roll(shift), strict=True):
        data[image.data == old] = new
    return replace(image, data=data)


def with_labels_of(given: Scene, other: Path | td.Image | None) -> Scene:
    labels = other if isinstance(other, td.Image) else read_labels(_known(other))
    return replace(given, annotations=replace(given.annotations, moving_labels=labels))


def _with_changed_labels(pair: Pair, change: Callable[[td.Image], td.Image]) -> Scene:
    return with_labels_of(scene(pair, labels=True), change(read_labels(_known(pair.moving_labels))))


def with_points_rolled(given: Scene, steps: int) -> Scene:
    points = _known(given.annotations.moving_points)
    return replace(given, annotations=replace(given.annotations, moving_points=points.roll(steps, 2)))


def _known(part: _Part | None) -> _Part:
    """Return what a case cannot be made without."""
    if part is None:
        raise ValueError("the set of images is not complete")
    return part


class Cases:
    """All cases on the images of a folder."""

    def __init__(self, folder: Path) -> None:
        self.sets = {name: SETS[name](folder) for name in SETS if name not in (*WHOLE_BRAINS, "lung_ct_3d_bare")}
        self.folder = folder

    def _pair(self, name: str, index: int = 0) -> Pair:
        return self.sets[name][index]

    def _mixed(self, first: tuple[str, int], second: tuple[str, int], **overrides: Any) -> Scene:
        one, other = (self._pair(*place) for place in (first, second))
        return scene(Pair("", one.fixed, other.fixed), **overrides)

    def good(self) -> Iterator[Case]:
        """Every pair of the open sets, with what is known of it."""
        for name, pairs in self.sets.items():
            for index, pair in enumerate(pairs):
                yield Case(
                    GOOD_PAIR, f"{name} {pair.name}", lambda p=pair: scene(p, labels=True, points=True), index % 2 == 0
                )

    def bad(self) -> Iterator[Case]:
        """Pairs that are wrong in a way that has a name."""
        for kind, make in _KINDS.items():
            for index, (name, build) in enumerate(make(self)):
                yield Case(kind, name, build, index % 2 == 0)

    def all(self) -> list[Case]:
        return [*self.good(), *self.bad()]


_Made = Iterator[tuple[str, Callable[[], Scene]]]
_SPOTS = {
    "slice": ("mindboggle_2d", 0),
    "heart": ("heart_2d", 0),
    "section": ("histology_2d", 0),
    "hippocampus": ("hippocampus_3d", 0),
    "spine": ("spine_t1t2_3d", 0),
    "mouse": ("mouse_brain_3d", 0),
    "lung": ("lung_ct_3d", 0),
}


def _unrelated(cases: Cases) -> _Made:
    for spot, name in (("slice", "camera"), ("heart", "coins"), ("section", "astronaut"), ("slice", "moon")):
        fixed = cases._pair(*_SPOTS[spot]).fixed
        yield f"{spot} <- {name}", lambda f=fixed, n=name: Scene(td.read_image(f), picture(n))
    for first, second in (("camera", "coffee"), ("chelsea", "brick"), ("text", "astronaut"), ("moon", "clock")):
        yield f"{first} <- {second}", lambda a=first, b=second: Scene(picture(a), picture(b))
    for spot, index in (("heart", 4), ("slice", 3)):
        pair = cases._pair(_SPOTS[spot][0], index)
        yield f"camera <- {spot}", lambda f=pair.fixed: Scene(picture("camera"), td.read_image(f))


def _organ(cases: Cases) -> _Made:
    pairs = (("slice", "heart"), ("heart", "slice"), ("section", "heart"), ("mouse", "hippocampus"))
    pairs += (("hippocampus", "lung"), ("spine", "hippocampus"), ("slice", "section"), ("hippocampus", "spine"))
    for first, second in pairs:
        yield f"{first} <- {second}", lambda a=first, b=second: cases._mixed(_SPOTS[a], _SPOTS[b])


def _level(cases: Cases) -> _Made:
    for first, second in ((0, 3), (6, 1), (9, 5), (2, 8), (11, 3), (4, 9), (3, 7), (8, 0)):
        names = (cases._pair("heart_2d", k).name.split(" ")[0] for k in (first, second))
        yield " <- ".join(names), lambda a=first, b=second: cases._mixed(("heart_2d", a), ("heart_2d", b))


# Left and right of these look alike, so only labels can tell a mirror image of another animal or person.
_SYMMETRIC = ("mindboggle_2d", "mouse_brain_3d")


def _mirrored(cases: Cases) -> _Made:
    spots = [_SPOTS[name] for name in ("heart", "slice", "hippocampus", "section", "spine", "lung", "mouse")]
    spots += [("heart_2d", 4), ("heart_2d", 10), ("mindboggle_2d", 3), ("hippocampus_3d", 4), ("histology_2d", 2)]
    for name, index in spots:
        pair, labels = cases._pair(name, index), name in _SYMMETRIC
        told = ", with labels" if labels else ""
        yield f"{name} {pair.name}{told}", lambda p=pair, k=labels: changed(p, flipped(1), labels=k)


def _mirrored_unlabelled(cases: Cases) -> _Made:
    for name, index in (("mindboggle_2d", 2), ("mouse_brain_3d", 1)):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}", lambda p=pair: changed(p, flipped(1))


def _upside_down(cases: Cases) -> _Made:
    for name, index in (("heart_2d", 1), ("mindboggle_2d", 1), ("hippocampus_3d", 1), ("histology_2d", 1)):
        pair, labels = cases._pair(name, index), name in _SYMMETRIC
        yield f"{name} {pair.name}, rows", lambda p=pair, k=labels: changed(p, flipped(2), labels=k)
    for name, index in (("heart_2d", 7), ("mindboggle_2d", 5)):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}, turned, not aligned", lambda p=pair: changed(p, flipped(1, 2), align="none")


def _half(cases: Cases) -> _Made:
    places = (("mindboggle_2d", 2), ("heart_2d", 3), ("hippocampus_3d", 2), ("histology_2d", 0), ("mindboggle_2d", 4))
    for number, (name, index) in enumerate((*places, ("hippocampus_3d", 6))):
        pair, cut = cases._pair(name, index), half(1 + number % 2, last=number > 2)
        yield f"{name} {pair.name}", lambda p=pair, c=cut: changed(p, c)


def _labels(cases: Cases) -> _Made:
    for name, index in (("mindboggle_2d", 0), ("hippocampus_3d", 0), ("mindboggle_2d", 3), ("hippocampus_3d", 5)):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}, other numbers", partial(_with_changed_labels, pair, relabelled)
    for index, other in ((0, 5), (2, 9), (7, 3)):
        pair, path = cases._pair("heart_2d", index), cases._pair("heart_2d", other).moving_labels
        yield f"heart_2d {pair.name}, another's", lambda p=pair, q=path: with_labels_of(scene(p, labels=True), q)
    for name, index, other in (
        ("mindboggle_2d", 2, 5),
        ("mindboggle_2d", 4, 0),
        ("hippocampus_3d", 2, 5),
        ("hippocampus_3d", 6, 2),
    ):
        pair, path = cases._pair(name, index), cases._pair(name, other).moving_labels
        yield f"{name} {pair.name}, another's", lambda p=pair, q=path: with_labels_of(scene(p, labels=True), q)
    pair = cases._pair("mindboggle_2d", 5)
    yield f"mindboggle_2d {pair.name}, mirrored", partial(_with_changed_labels, pair, flipped(1))


def _landmarks(cases: Cases) -> _Made:
    for name, index, steps in (
        ("histology_2d", 0, 1),
        ("histology_2d", 1, 5),
        ("lung_ct_3d", 0, 7),
        ("histology_2d", 3, 20),
    ):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}", lambda p=pair, s=steps: with_points_rolled(scene(p, points=True), s)


def _far(cases: Cases) -> _Made:
    places = (("heart_2d", 5, (45, 20)), ("mindboggle_2d", 6, (50, 10)), ("hippocampus_3d", 3, (12, 12, 8)))
    places += (("lung_ct_3d", 0, (70, 40, 0)), ("histology_2d", 1, (70, 90)), ("spine_t1t2_3d", 0, (15, 10, 0)))
    for name, index, move in places:
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}", lambda p=pair, m=move: changed(p, shifted(*m), align="none")


def _spacing(cases: Cases) -> _Made:
    places = (
        ("mindboggle_2d", 1, 10.0),
        ("hippocampus_3d", 1, 0.001),
        ("heart_2d", 2, 1000.0),
        ("spine_t1t2_3d", 0, 0.1),
    )
    for name, index, factor in (*places, ("mindboggle_2d", 4, 0.001), ("heart_2d", 8, 10.0)):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}, × {factor:g}", lambda p=pair, f=factor: changed(p, rescaled(f))


def _contrast(cases: Cases) -> _Made:
    for name, index in (
        ("heart_2d", 1),
        ("mindboggle_2d", 0),
        ("hippocampus_3d", 4),
        ("mindboggle_2d", 5),
        ("heart_2d", 9),
    ):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}", lambda p=pair: changed_image(p, inverted, similarity="ssd")


def changed_image(pair: Pair, change: Callable[[td.Image], td.Image], **overrides: Any) -> Scene:
    """Return a pair with another moving image; labels and mask stay."""
    given = scene(pair, **overrides)
    return replace(given, moving=change(given.moving))


def _heavy_noise(cases: Cases) -> _Made:
    for name, index, strength in (
        ("heart_2d", 3, 8.0),
        ("mindboggle_2d", 2, 8.0),
        ("hippocampus_3d", 3, 5.0),
        ("spine_t1t2_3d", 0, 3.0),
    ):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}", lambda p=pair, s=strength: changed_image(p, noisy(s), masks=False)


def _only_noise(cases: Cases) -> _Made:
    for name, index in (("heart_2d", 6), ("mindboggle_2d", 4), ("hippocampus_3d", 2), ("histology_2d", 0)):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}", lambda p=pair: changed_image(p, lambda i: noise_like(luminance(i)), masks=False)


def _resection(cases: Cases) -> _Made:
    for name, index in (
        ("mindboggle_2d", 1),
        ("hippocampus_3d", 1),
        ("heart_2d", 0),
        ("mindboggle_2d", 6),
        ("hippocampus_3d", 6),
    ):
        pair = cases._pair(name, index)
        yield (
            f"{name} {pair.name}",
            lambda p=pair, i=index: changed_image(p, lambda m: quarter(m, last=i > 1), masks=False),
        )


def _measure(cases: Cases) -> _Made:
    spine = cases._pair("spine_t1t2_3d")
    swapped = Pair("t2 <- t1w", spine.moving, spine.fixed, spine.moving_labels, spine.fixed_labels)
    for pair in (spine, swapped):
        for measure in ("lncc", "ssd"):
            yield f"{pair.name} {measure}", lambda p=pair, m=measure: scene(p, similarity=m)


def _destroyed(cases: Cases) -> _Made:
    spine = cases._pair("spine_t1t2_3d")
    swapped = Pair("t2 <- t1w", spine.moving, spine.fixed, spine.moving_labels, spine.fixed_labels)
    yield spine.name, lambda: scene(spine, labels=True, similarity="lncc")
    yield swapped.name, lambda: scene(swapped, labels=True, similarity="lncc")
    for name, index in (("mindboggle_2d", 2), ("heart_2d", 11), ("hippocampus_3d", 2)):
        pair = cases._pair(name, index)
        yield f"{name} {pair.name}", lambda p=pair: changed_image(p, inverted, labels=True, similarity="ssd")


_KINDS: dict[str, Callable[[Cases], _Made]] = {
    "unrelated": _unrelated,
    "another organ": _organ,
    "wrong level": _level,
    "mirrored": _mirrored,
    "mirrored, symmetric": _mirrored_unlabelled,
    "upside down": _upside_down,
    "half": _half,
    "labels swapped": _labels,
    "landmarks swapped": _landmarks,
    "far, not aligned": _far,
    "wrong spacing": _spacing,
    "contrast inverted, ssd": _contrast,
    "heavy noise": _heavy_noise,
    "only noise": _only_noise,
    "resection": _resection,
    "wrong similarity": _measure,
    "overlap destroyed": _destroyed,
}
KINDS = (GOOD_PAIR, *_KINDS)
