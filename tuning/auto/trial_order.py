"""The order in which gains are tried on an axis: lower ones until some pass, then alternatives, then neighbours."""

from __future__ import annotations

from typing import NamedTuple

# Factors of the gains that were found on a twin: how far down to go when they fail, and what is tried beside a pass.
SLOWER, DOWN, UP = 0.6, 0.8, 1.15
# Beside the gains that serve on all twins: the best if everything is as it was identified, and if friction is less.
BOLD, SLIPPERY = range(2)
OTHERS = ("the best gains for the axis exactly as identified", "the best gains for less friction")


class Rung(NamedTuple):
    """One trial.

    factor: Of the gains found. other: Others that were found, by their number, instead. fallback: One, by its number.
    """

    factor: float = 1.0
    fallback: int | None = None
    other: int | None = None

    @property
    def words(self) -> str:
        """Return these gains in words."""
        if self.fallback is not None:
            return "the gains of a rule"
        if self.other is not None:
            return OTHERS[self.other]
        return "the gains found" if self.factor == 1.0 else f"these lowered to {100.0 * self.factor:.0f} %"


class Ladder:
    """The trials of one axis.

    Args:
        fallbacks: How many sets of gains there are to fall back on, the fastest first.
        coupled: Other axes pull at this one, which no twin knows: the first of the fallbacks is tried in any case, as
            it is where gains have failed.

    Attributes:
        rung: What is to be tried next; None when it is over.
        passed: Whether any gains have passed.
        failures: What failed before that.
    """

    def __init__(self, fallbacks: int, coupled: bool = False) -> None:
        self.rung: Rung | None = Rung()
        self.passed = False
        self.failures: list[Rung] = []
        self._fallbacks = fallbacks
        self._owed = coupled  # a trial of the first fallback

    def step(self, passed: bool, better: bool, loud: bool) -> None:
        """Record the result of a trial, and choose the next.

        Args:
            passed: Whether it passed.
            better: Whether it is the best so far.
            loud: Whether its current was noisy at rest: a limit cycle, since there is little friction.
        """
        rung = self.rung
        assert rung is not None, "nothing was to be tried"
        self._owed &= rung.fallback is None
        if self.passed:
            # Beyond the bold ones lies what not even the twin that is as identified takes for better.
            self.rung = None if better or rung.other is None else Rung(UP)
        elif not passed:
            self.failures.append(rung)
            self._owed |= rung.fallback is None  # the twins have not known this axis well enough
            self.rung = self._below(rung)
        else:
            self.passed = True
            if rung.fallback is not None:
                self.rung = None
            else:
                # Below gains that failed: half way up again.
                self.rung = Rung(DOWN) if self.failures else Rung(other=SLIPPERY if loud else BOLD)
        if self.rung is None and self.passed and self._owed:
            self.rung = Rung(fallback=0)

    def _below(self, rung: Rung) -> Rung | None:
        """Return lower gains than those that failed."""
        if rung.fallback is None:
            return Rung(SLOWER) if rung.factor > SLOWER else Rung(fallback=0)
        return Rung(fallback=rung.fallback + 1) if rung.fallback + 1 < self._fallbacks else None
