"""The choice of a setting: nobody is judged by a setting that was chosen on themselves."""

import math

import pytest
from held_out import DEFAULT, Score, choose, chosen_without, gain, standard_error


def score(which: str, pair: str, subjects: str, group: str = "", **errors: float) -> Score:
    return Score(group or which, which, pair, frozenset(subjects), errors)


def held_out_gain(scores: list[Score]) -> float:
    chosen = chosen_without(scores, [DEFAULT, "other"])
    return gain(scores, lambda s: chosen[s.set, s.pair])


ALONE = [
    score("brains", "a", "A", default=0.5, other=0.1),
    *(score("brains", name, name.upper(), default=0.5, other=0.51) for name in "bcd"),
]


def test_what_helps_one_subject_alone_is_not_taken_for_it():
    assert choose(ALONE, [DEFAULT, "other"]) == "other"  # in hindsight it wins
    chosen = chosen_without(ALONE, [DEFAULT, "other"])
    assert chosen["brains", "a"] == DEFAULT
    assert {chosen["brains", name] for name in "bcd"} == {"other"}
    assert held_out_gain(ALONE) == pytest.approx(-0.02 * 3 / 4)  # and held out it loses


def test_a_pair_is_chosen_for_without_every_pair_that_shows_one_of_its_subjects():
    scores = [
        score("chain", "a <- b", "AB", default=0.5, other=0.6),
        score("chain", "b <- c", "BC", default=0.5, other=0.1),
        score("chain", "c <- d", "CD", default=0.5, other=0.6),
        score("chain", "d <- e", "DE", default=0.5, other=0.4),
    ]
    chosen = chosen_without(scores, [DEFAULT, "other"])
    # Left for a <- b: c <- d and d <- e, which cancel; for b <- c: d <- e alone; for d <- e: the first two.
    assert chosen == {
        ("chain", "a <- b"): DEFAULT,
        ("chain", "b <- c"): "other",
        ("chain", "c <- d"): DEFAULT,
        ("chain", "d <- e"): "other",
    }


def test_a_subject_in_two_sets_is_left_out_of_both():
    scores = [
        score("t1", "a", "A", "people", default=0.5, other=0.1),
        score("t2", "a", "A", "people", default=0.5, other=0.1),
        score("t1", "b", "B", "people", default=0.5, other=0.6),
    ]
    assert chosen_without(scores, [DEFAULT, "other"])["t1", "a"] == DEFAULT


def test_a_subject_alone_in_its_set_gets_what_other_sets_choose():
    scores = [
        score("lung", "lung", "L", default=1.5, other=9.0),
        score("mice", "a", "A", default=0.2, other=0.1),
        score("mice", "b", "B", default=0.2, other=0.1),
    ]
    assert chosen_without(scores, [DEFAULT, "other"])["lung", "lung"] == "other"
    assert chosen_without(scores[:1], [DEFAULT, "other"])["lung", "lung"] == DEFAULT  # nothing is left to choose on


def test_ties_keep_the_default():
    scores = [score("brains", name, name, default=0.5, other=0.5) for name in "ab"]
    assert choose(scores, ["other", DEFAULT]) == DEFAULT
    assert choose([], ["other", DEFAULT]) == DEFAULT


def test_gains_are_shares_of_the_error_and_groups_weigh_alike():
    scores = [
        score("lung", "a", "A", default=2.0, other=1.5),  # mm: a quarter less
        score("t1", "b", "B", "people", default=0.2, other=0.18),  # 10 % less
        score("t2", "b", "B", "people", default=0.4, other=0.48),  # 20 % more
    ]
    assert gain(scores, lambda _: "other") == pytest.approx((0.25 + (0.1 - 0.2) / 2) / 2)
    assert gain(scores, lambda _: DEFAULT) == 0


def test_the_standard_error_is_that_of_a_mean_where_each_pair_has_its_own_subject():
    values = [0.1, 0.4, -0.2, 0.3, 0.25]
    scores = [score("s", str(k), str(k), default=value) for k, value in enumerate(values)]
    middle = sum(values) / 5
    expected = math.sqrt(sum((v - middle) ** 2 for v in values) / 4 / 5)

    def mean_of(some):
        return sum(s.errors[DEFAULT] for s in some) / len(some)

    assert standard_error(scores, mean_of) == pytest.approx(expected)
    doubled = [score("s", f"{k}{half}", str(k), default=v) for half in "xy" for k, v in enumerate(values)]
    assert standard_error(doubled, mean_of) == pytest.approx(expected)  # more pairs of the same subjects say no more
    assert standard_error(scores[:1], mean_of) is None
