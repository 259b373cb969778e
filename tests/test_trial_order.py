"""The order in which gains are tried: down until some pass, then beside them."""

from __future__ import annotations

import pytest

from tuning.auto.trial_order import BOLD, SLIPPERY, Ladder, Rung


def climb(outcomes, fallbacks=3):
    """Return what is tried while trials have these outcomes: (passed, better, loud)."""
    ladder, rungs = Ladder(fallbacks), []
    for passed, better, loud in outcomes:
        rungs.append(ladder.rung)
        ladder.step(passed, better, loud)
    return [*rungs, ladder.rung], ladder


FAIL, BEST, BEST_LOUD, WORSE = (False, False, False), (True, True, False), (True, True, True), (True, False, False)
F = Rung  # a factor
B, S = Rung(other=BOLD), Rung(other=SLIPPERY)
NONE, RULE, SOFT, LAST = None, Rung(fallback=0), Rung(fallback=1), Rung(fallback=2)


@pytest.mark.parametrize(
    ("outcomes", "rungs"),
    [
        ((BEST,), [F(1.0), B]),  # what passes at once is followed by the bold ones
        ((BEST_LOUD,), [F(1.0), S]),  # by those for less friction if it hunts
        ((BEST_LOUD, WORSE), [F(1.0), S, F(1.15)]),
        ((BEST, BEST), [F(1.0), B, NONE]),  # if they are better, nothing lies beyond them
        ((BEST, WORSE), [F(1.0), B, F(1.15)]),  # if they are not, the first ones are tried faster
        ((BEST, FAIL), [F(1.0), B, F(1.15)]),  # also if they fail, which says nothing of the others
        ((BEST, WORSE, BEST), [F(1.0), B, F(1.15), NONE]),  # and no more than three trials
        ((FAIL,), [F(1.0), F(0.6)]),
        ((FAIL, BEST), [F(1.0), F(0.6), F(0.8)]),  # below what failed: half way up again
        ((FAIL, BEST, BEST), [F(1.0), F(0.6), F(0.8), RULE]),  # and the rule's: the twins did not know the axis
        ((FAIL, BEST, WORSE, FAIL), [F(1.0), F(0.6), F(0.8), RULE, NONE]),
        ((FAIL, FAIL), [F(1.0), F(0.6), RULE]),
        ((FAIL, FAIL, BEST), [F(1.0), F(0.6), RULE, NONE]),  # of a fallback that passes no neighbour is tried
        ((FAIL, FAIL, FAIL, FAIL, FAIL), [F(1.0), F(0.6), RULE, SOFT, LAST, NONE]),
    ],
)
def test_what_is_tried_next(outcomes, rungs):
    found, _ = climb(outcomes)
    for one, other in zip(found, rungs, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            assert (one.fallback, one.other) == (other.fallback, other.other)
            assert one.fallback is not None or one.factor == pytest.approx(other.factor)


@pytest.mark.parametrize(
    ("outcomes", "rungs"),
    [
        ((BEST, BEST), [F(1.0), B, RULE]),  # before it is over, the rule's gains have their trial
        ((BEST, BEST, WORSE), [F(1.0), B, RULE, NONE]),
        ((BEST, BEST, FAIL), [F(1.0), B, RULE, NONE]),
        ((FAIL, BEST, BEST), [F(1.0), F(0.6), F(0.8), RULE]),
        ((FAIL, FAIL, BEST), [F(1.0), F(0.6), RULE, NONE]),  # they had it
        ((FAIL, FAIL, FAIL, BEST), [F(1.0), F(0.6), RULE, SOFT, NONE]),
    ],
)
def test_where_axes_are_coupled_the_rule_is_tried_in_any_case(outcomes, rungs):
    ladder, found = Ladder(3, coupled=True), []
    for passed, better, loud in outcomes:
        found.append(ladder.rung)
        ladder.step(passed, better, loud)
    for one, other in zip([*found, ladder.rung], rungs, strict=True):
        assert (one and (one.fallback, one.other)) == (other and (other.fallback, other.other))


def test_nothing_at_or_above_what_failed_is_tried_again():
    ladder = Ladder(1)
    tried = []
    while ladder.rung is not None:
        tried.append(ladder.rung)
        fails = ladder.rung.fallback is None and ladder.rung.factor > 0.7
        ladder.step(not fails, not fails, loud=False)
    factors = [rung.factor for rung in tried]
    assert factors == pytest.approx([1.0, 0.6, 0.8, 1.0])
    assert tried[-1].fallback == 0
    assert ladder.passed


def test_what_failed_before_is_known():
    _, ladder = climb((FAIL, FAIL, BEST))
    assert [rung.words for rung in ladder.failures] == ["the gains found", "these lowered to 60 %"]
    assert ladder.passed
    assert not climb((FAIL,) * 5)[1].passed
