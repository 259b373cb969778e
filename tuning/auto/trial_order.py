"""The order in which gains are tried on an axis: lower ones until some pass, then alternatives, then neighbours."""

from __future__ import annotations

from typing import NamedTuple

# Factors of the gains that were found on a twin: how far down to go when they fail, and what is tried beside a pass.
SLOWER, DOWN, UP = 0.6, 0.8, 1.15
# Beside the gains that serve on all twins: the best if everything is as it was identified, and if friction is less.
BOLD, SLIPPERY = range(2)
OTHERS = ("the best gains for the axis exactly as identified", "the best gains for less friction")
MOST_TRIALS = 3  # of an axis on which gains pass


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
        return f"the gains found, times {self.factor:.2f}" if self.other is None else OTHERS[self.other]


class Ladder:
    """The trials of one axis.

    Args:
        fallbacks: How many sets of gains there are to fall back on, the fastest first.
        coupled: Other axes pull at this one, which no twin knows: the first of the fallbacks is tried in any case.

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
        self._trials = 0
        self._best = 1.0  # factor
        self._tried: list[float] = []
        self._ceiling = float("inf")  # a factor that failed

    def step(self, passed: bool, better: bool, loud: bool) -> None:
        """Record the result of a trial, and choose the next.

        Args:
            passed: Whether it passed.
            better: Whether it is the best so far.
            loud: Whether its current was noisy at rest: a limit cycle, since there is little friction.
        """
        rung = self.rung
        assert rung is not None, "nothing was to be tried"
        self._trials += 1
        if rung.other is None:
            self._tried.append(rung.factor)
            if not passed:
                self._ceiling = min(self._ceiling, rung.factor)
        self._owed &= rung.fallback is None
        if self.passed:
            self.rung = self._beside(rung, better) if rung.fallback is None else None
        elif not passed:
            self.failures.append(rung)
            self.rung = self._below(rung)
        else:
            self.passed = True
            self._best = rung.factor
            if rung.fallback is not None:
                self.rung = None
            else:
                # Below gains that failed: half way up again.
                self.rung = self._open(DOWN) if self.failures else Rung(other=SLIPPERY if loud else BOLD)
        if self.rung is None and self.passed and self._owed:
            self.rung = Rung(fallback=0)

    def _below(self, rung: Rung) -> Rung | None:
        """Return lower gains than those that failed."""
        if rung.fallback is None:
            return Rung(SLOWER) if rung.factor > SLOWER else Rung(fallback=0)
        return Rung(fallback=rung.fallback + 1) if rung.fallback + 1 < self._fallbacks else None

    def _beside(self, rung: Rung, better: bool) -> Rung | None:
        """Return a neighbour of the best: farther in the same direction if that was better, else in the other."""
        if self._trials >= MOST_TRIALS:
            return None
        if rung.other is not None:
            # Beyond the bold ones lies what not even the twin that is as identified takes for better.
            return None if better else self._open(UP)
        before, self._best = self._best, rung.factor if better else self._best
        if better:
            return self._open(rung.factor * rung.factor / before)
        return self._open(self._best * (DOWN if rung.factor > before else UP))

    def _open(self, factor: float) -> Rung | None:
        """Return a factor as a rung, None if it was tried or is no lower than one that failed."""
        known = any(abs(factor - tried) < 0.02 for tried in self._tried)
        return None if known or factor >= self._ceiling else Rung(factor)
