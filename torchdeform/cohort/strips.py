"""Strips: one measure of all pairs as rows of dots, small enough for thousands of pairs, with its outliers by name."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import quantiles

WIDTH, ROW = 320, 34  # of a strip and of a row of dots, in units of the drawing
_MARGIN, _DOT = 5.0, 4.0  # free space at either end, and the distance of neighbouring dots
_MOST = 7  # dots above one another; more of them look the same
_FEWEST, _FENCE = 5, 1.5  # pairs from which on there are outliers, and how far they are from the quartiles, in spreads
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
    """A row of dots: their path, their median, the box from the first quartile to the third, and their height."""

    dots: str
    middle: float
    box: tuple[float, float]
    y: float


@dataclass(frozen=True)
class Strip:
    """What is drawn of a measure.

    Attributes:
        low: its smallest value, at the left end.
        high: its largest value, at the right end.
        height: of the drawing.
        lines: a row of dots for each column.
        outliers: the worst come first.
        named: those of them whose names are written.
    """

    low: float
    high: float
    height: int
    lines: tuple[Line, ...]
    outliers: tuple[Outlier, ...]

    @property
    def named(self) -> tuple[Outlier, ...]:
        """The worst outliers, each pair once."""
        return tuple({outlier.name: outlier for outlier in reversed(self.outliers)}.values())[::-1][:_NAMED]


def strip_of(columns: Sequence[Mapping[str, float]], worse: Sequence[int]) -> Strip:
    """Return the strip of a measure.

    Args:
        columns: its values by pair, before and after, say; none of them empty.
        worse: of each column, which values are the worse ones: 1 the large, −1 the small, 0 no matter.

    Notes:
        Outliers are farther than 1.5 times the distance of the quartiles from the nearer quartile, as in a box plot.
    """
    every = [value for column in columns for value in column.values()]
    low, high = min(every), max(every)
    scale = (WIDTH - 2 * _MARGIN) / (high - low) if high > low else 0.0

    def place(value: float) -> float:
        return round(_MARGIN + scale * (value - low), 1)

    lines, found = [], list[tuple[float, Outlier]]()
    for k, (column, sign) in enumerate(zip(columns, worse, strict=True)):
        y, box = ROW * (k + 0.5), _quartiles(list(column.values()))
        far = _outliers(column, box, sign)
        found += [(how, Outlier(name, column[name], place(column[name]), y)) for name, how in far.items()]
        dots = "".join(_dots((place(value) for name, value in column.items() if name not in far), y))
        lines.append(Line(dots, place(box[1]), (place(box[0]), place(box[2])), y))
    outliers = tuple(outlier for _, outlier in sorted(found, key=lambda pair: -pair[0]))
    return Strip(low, high, ROW * len(columns), tuple(lines), outliers)


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
