"""Strips: one measure of all pairs as rows of dots, small enough for thousands of pairs, with its outliers by name."""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import quantiles

WIDTH, ROW = 320, 34  # of a strip and of a row of dots, in units of the drawing
_MARGIN, _DOT = 5.0, 4.0  # free space at either end, and the distance of neighbouring dots
_MOST = 7  # dots above one another; more of them look the same
_FEWEST, _FENCE = 5, 1.5  # pairs from which on there are outliers, and how far they are from the quartiles, in spreads
_ORDERS = 20.0  # from which on a scale is logarithmic
_NAMED, _MARKED = 3, 40  # outliers with their name, and with a mark of their own


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
        outliers: the worst come first.
        named: those of them whose names are written.
    """

    low: float
    high: float
    height: int
    log: bool
    lines: tuple[Line, ...]
    outliers: tuple[Outlier, ...]

    @property
    def named(self) -> tuple[Outlier, ...]:
        """The worst outliers, each pair once."""
        return tuple({outlier.name: outlier for outlier in reversed(self.outliers)}.values())[::-1][:_NAMED]


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
    lines, found = [], list[tuple[float, Outlier]]()
    for k, (column, sign) in enumerate(zip(columns, worse, strict=True)):
        places = {name: place(value) for name, value in column.items()}
        y, box = ROW * (k + 0.5), _quartiles(list(places.values()))
        far = _outliers(places, box, sign)
        found += [(how, Outlier(name, column[name], round(places[name], 1), y)) for name, how in far.items()]
        dots = "".join(_dots((x for name, x in places.items() if name not in far), y))
        lines.append(Line(dots, box, y))
    outliers = tuple(outlier for _, outlier in sorted(found, key=lambda pair: -pair[0]))
    return Strip(low, high, ROW * len(columns), log, tuple(lines), outliers)


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
    """Return by how much the worst outliers are beyond the quartile of their side, in spreads."""
    if len(column) < _FEWEST or sign == 0:
        return {}
    edge, spread = box[1 + sign], box[2] - box[0]
    beyond = {name: sign * (value - edge) for name, value in column.items()}
    far = {name: how / (spread or 1.0) for name, how in beyond.items() if how > _FENCE * spread}
    return dict(sorted(far.items(), key=lambda item: -item[1])[:_MARKED])


def _dots(places: Iterator[float], y: float) -> Iterator[str]:
    """Yield dots of a path, those of one place above and below each other."""
    count: Counter[float] = Counter()
    for place in places:
        x = round(place / _DOT) * _DOT
        height, count[x] = count[x], count[x] + 1
        if height < _MOST:
            shift = (height + 1) // 2 * _DOT * (-1) ** height
            yield f"M{x:g} {y + shift:g}h0"
