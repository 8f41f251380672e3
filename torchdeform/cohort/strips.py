"""Strips: one measure of all pairs as rows of dots, small enough for thousands of pairs, with its outliers by name."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import quantiles

WIDTH, ROW = 320, 34  # of a strip and of a row of dots, in units of the drawing
_MARGIN, _DOT = 5.0, 4.0  # free space at either end, and the distance of neighbouring dots
_MOST = 7  # dots above one another
_FEWEST, _FENCE = 5, 1.5  # pairs from which on there are outliers, and how far they are from the quartiles, in spreads
_ORDERS = 20.0  # from which on a scale is logarithmic
_NAMED, _MARKED = 3, 40  # outliers whose names are written, and with a mark of their own


@dataclass(frozen=True)
class Outlier:
    """A pair far from the others: its name and value, and where its dot is."""

    name: str
    value: float
    x: float
    y: float


@dataclass(frozen=True)
class Line:
    """A row of dots: their path, the places of their quartiles, and their height."""

    dots: str
    quartiles: tuple[float, float, float]
    y: float


@dataclass(frozen=True)
class Strip:
    """What is drawn of a measure.

    Attributes:
        low: its smallest value, at the left end.
        high: its largest value, at the right end.
        height: of the drawing.
        log: whether the scale is logarithmic.
        lines: a row of dots for each column.
        outliers: those with a mark of their own, the worst first.
        far: number of pairs that are outliers.
    """

    low: float
    high: float
    height: int
    log: bool
    lines: tuple[Line, ...]
    outliers: tuple[Outlier, ...]
    far: int

    @property
    def named(self) -> tuple[Outlier, ...]:
        """The worst outliers, whose names are written, each pair once."""
        worst: dict[str, Outlier] = {}
        for outlier in self.outliers:
            worst.setdefault(outlier.name, outlier)
        return tuple(worst.values())[:_NAMED]


def strip_of(columns: Sequence[Mapping[str, float]], worse: Sequence[int], *, ratios: bool = False) -> Strip:
    """Return the strip of a measure.

    Args:
        columns: its values by pair, before and after, say; none of them empty.
        worse: of each column, which values are the worse ones: 1 the large, −1 the small, 0 no matter.
        ratios: draw positive values of several orders of magnitude, and take their quartiles, as logarithms.

    Notes:
        Outliers are farther than 1.5 times the distance of the quartiles from the nearer quartile, as in a box plot.
    """
    every = [value for column in columns for value in column.values()]
    low, high = min(every), max(every)
    log = ratios and 0 < low * _ORDERS < high
    place = _placement(low, high, log)
    lines, found, names = [], list[tuple[float, Outlier]](), set[str]()
    for k, (column, sign) in enumerate(zip(columns, worse, strict=True)):
        y, places = ROW * (k + 0.5), {name: place(value) for name, value in column.items()}
        box = _quartiles(list(places.values()))
        far = _outliers(places, box, sign)
        marked = sorted(far, key=lambda name: -far[name])[:_MARKED]
        found += [(far[name], Outlier(name, column[name], round(places[name], 1), y)) for name in marked]
        others = (places[name] for name in places.keys() - set(marked))
        lines.append(Line("".join(_dots(others, y)), box, y))
        names |= far.keys()
    outliers = tuple(outlier for _, outlier in sorted(found, key=lambda pair: -pair[0]))
    return Strip(low, high, ROW * len(columns), log, tuple(lines), outliers, len(names))


def _placement(low: float, high: float, log: bool) -> Callable[[float], float]:
    """Return the function that takes a value to its place along the strip."""
    scaled = math.log if log else float
    start, end = scaled(low), scaled(high)
    return lambda value: _MARGIN + (WIDTH - 2 * _MARGIN) * (scaled(value) - start) / ((end - start) or 1.0)


def _quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    if len(values) < 2:
        return values[0], values[0], values[0]
    first, second, third = quantiles(values, n=4, method="inclusive")
    return first, second, third


def _outliers(column: Mapping[str, float], box: tuple[float, float, float], sign: int) -> dict[str, float]:
    """Return by how much outliers are beyond the quartile of their side, in spreads."""
    if len(column) < _FEWEST or sign == 0:
        return {}
    edge, spread = box[1 + sign], box[2] - box[0]
    beyond = {name: sign * (value - edge) for name, value in column.items()}
    return {name: how / (spread or 1.0) for name, how in beyond.items() if how > _FENCE * spread}


def _dots(places: Iterable[float], y: float) -> Iterator[str]:
    """Yield dots of a path, those of one place above and below each other; of many pairs a dot stands for several."""
    counts = Counter(round(place / _DOT) * _DOT for place in places)
    share = max(1.0, max(counts.values(), default=0) / _MOST)
    for x, count in sorted(counts.items()):
        for height in range(math.ceil(count / share)):
            shift = (height + 1) // 2 * _DOT * (-1) ** height
            yield f"M{x:g} {y + shift:g}h0"
