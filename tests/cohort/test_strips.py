"""Strips: dots where values say, outliers as a box plot has them, and a size that does not grow with the pairs."""

import math
import random
import re

import pytest

from torchdeform.cohort.strips import ROW, WIDTH, strip_of


def places(dots: str) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(r"M(\S+) (\S+?)h0", dots)]


def test_dots_are_where_the_values_are():
    strip = strip_of([{"a": 1.0, "b": 2.0, "c": 3.0}], [1])
    found = sorted(x for x, _ in places(strip.lines[0].dots))
    assert found == pytest.approx([5, WIDTH / 2, WIDTH - 5], abs=2)
    assert (strip.low, strip.high, strip.log, strip.height) == (1, 3, False, ROW)
    assert strip.lines[0].quartiles == pytest.approx((82.5, 160, 237.5))  # of 1, 2, 3: 1.5, 2, 2.5


def test_equal_values_are_dots_above_each_other():
    strip = strip_of([dict.fromkeys("abcde", 7.0)], [1])
    assert len({x for x, _ in places(strip.lines[0].dots)}) == 1
    assert len({y for _, y in places(strip.lines[0].dots)}) == 5
    assert strip.outliers == ()


def test_values_of_many_magnitudes_have_a_logarithmic_scale():
    strip = strip_of([{"a": 1e-4, "b": 1e-2, "c": 1.0}], [1], ratios=True)
    assert strip.log
    assert sorted(x for x, _ in places(strip.lines[0].dots)) == pytest.approx([5, WIDTH / 2, WIDTH - 5], abs=2)
    assert not strip_of([{"a": 0.0, "b": 1e-2, "c": 1.0}], [1], ratios=True).log
    assert not strip_of([{"a": 1e-4, "b": 1e-2, "c": 1.0}], [1]).log


@pytest.mark.parametrize("worse", [-1, 0, 1])
def test_outliers_are_those_of_a_box_plot_on_the_worse_side(worse):
    """Against matplotlib's own box plot."""
    cbook = pytest.importorskip("matplotlib.cbook")
    generator = random.Random(3)
    values = {f"p{k}": generator.gauss(0, 1) for k in range(300)} | {"low": -6.0, "high": 9.0}
    fliers = cbook.boxplot_stats(list(values.values()))[0]["fliers"].tolist()
    wanted = {name for name, value in values.items() if value in fliers and value * worse > 0}
    strip = strip_of([values], [worse])
    assert {outlier.name for outlier in strip.outliers} == wanted
    if worse:
        assert strip.named[0].name == {-1: "low", 1: "high"}[worse]
    assert len(strip.named) <= 3


def test_one_pair_that_folds_is_an_outlier_among_many_that_do_not():
    strip = strip_of([dict.fromkeys("abcdefgh", 0.0) | {"bad": 3.0}], [1])
    assert [(o.name, o.value, o.x) for o in strip.outliers] == [("bad", 3.0, WIDTH - 5)]


def test_few_pairs_have_no_outliers():
    assert strip_of([{"a": 0.0, "b": 0.1, "c": 99.0}], [1]).outliers == ()


def test_a_pair_is_named_once():
    column = dict.fromkeys("abcdefgh", 0.0) | {"bad": 3.0}
    strip = strip_of([column, column], [1, 1])
    assert len(strip.outliers) == 2
    assert [outlier.name for outlier in strip.named] == ["bad"]


def test_ten_thousand_pairs_are_not_much_larger_than_a_hundred():
    def size(count: int) -> int:
        generator = random.Random(0)
        strip = strip_of([{f"{k}": math.exp(generator.gauss(0, 0.3)) for k in range(count)}], [1])
        return len(strip.lines[0].dots) + 100 * len(strip.outliers)

    assert size(10_000) < 12_000


def test_of_many_pairs_the_heights_are_shares():
    values = {f"{k}": float(k % 4 == 0) for k in range(1000)}
    found = places(strip_of([values], [0]).lines[0].dots)
    assert [sum(x == at for x, _ in found) for at in (4, WIDTH - 4)] == [7, 3]


def test_all_outliers_are_counted():
    values = {f"{k}": float(k >= 900) for k in range(1000)}
    strip = strip_of([values], [1])
    assert (strip.far, len(strip.outliers), len(strip.named)) == (100, 40, 3)
