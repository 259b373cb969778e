"""The forbidden situations of a session, and the search for them: breadth first, so that traces are shortest ones."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from drive_env.canopen.nmt import NmtState
from drive_env.cia402 import State as Fsa
from rigs.safety_model.drive import NOBODY, tick
from rigs.safety_model.rules import Assumptions, Rules
from rigs.safety_model.situation import DRIVE, GONE, LIBRARY, At, Hand, Situation, Step, StopStage, beating, beginnings
from rigs.safety_model.steps import attended, left_alone, steps

RUNS_ON = "runs on: nothing monitors it, and no watchdog ends it"
GIVEN_UP = "the watchdog is given up while the axis is live"
UNWATCHED = "the axis is live under our hand, and neither a watchdog nor the envelope was made ready"
TAKEN_FOR_OFF = "the envelope takes a live axis for off"
UNRAMPED = "the voltage is switched off while the axis turns, and no ramp was tried"
LEFT = "a signal that can be handled left the stop to the watchdog"
_SETTLED = 12  # ticks, or steps of the library, after which what does not end never ends


def verdicts(before: Situation, step: Step, rules: Rules) -> Iterable[str]:
    """Return the invariants that a step breaks."""
    after, ours = step.after, step.after.hand is Hand.OURS
    live = after.drive.live
    if live and ours and before.drive.consumer != NOBODY == after.drive.consumer and before.at in _RESTORING:
        yield GIVEN_UP
    if live and ours and (after.at in GONE or after.stop is StopStage.UNPROVEN) and _runs_on_alone(after, rules):
        yield RUNS_ON
    if live and ours and after.at is At.STALLED and _runs_on_beside_a_stalled_program(after, rules):
        yield RUNS_ON
    if live and ours and after.silent and after.at is At.PROGRAM and _runs_on_beside_a_stalled_program(after, rules):
        yield RUNS_ON
    if after.at in GONE:
        if step.kind in ("INT", "TERM") and live and ours and after.at is At.DEAD:
            yield LEFT
        return
    if live and ours and not after.armed and after.stop is not StopStage.UNPROVEN:
        yield UNWATCHED
    if live and ours and after.armed and not after.believed and after.at is At.PROGRAM and not attended(after, rules):
        yield TAKEN_FOR_OFF
    cuts = before.stop is StopStage.CUT and before.drive.fsa is Fsa.OPERATION_ENABLED and before.drive.turns
    if cuts and not live and not before.ramped:
        yield UNRAMPED


_RESTORING = (At.RESTORE, At.RESTORE_AGAIN)


def _runs_on_alone(s: Situation, rules: Rules) -> bool:
    """Return whether the axis stays live however long the drive is left alone, others' heartbeats going on."""
    drive, others = s.drive, beating(s, rules)
    for _ in range(_SETTLED):
        drive = tick(drive, others)
    return drive.live or drive.turns


def _runs_on_beside_a_stalled_program(s: Situation, rules: Rules) -> bool:
    """Return whether the axis stays live beside a supervisor whose program makes no call any more."""
    s = s._replace(troubles=0)
    for _ in range(4 * _SETTLED):
        s = left_alone(s, rules)
    return s.drive.live or s.drive.turns


@dataclass(frozen=True)
class Counterexample:
    """A shortest way to a broken invariant."""

    wrong: str
    trace: tuple[tuple[str, str, Situation], ...]  # kind, text, what is then
    beginning: Situation

    @property
    def kinds(self) -> frozenset[str]:
        """The kinds of the steps."""
        return frozenset(kind for kind, _, _ in self.trace)

    def __str__(self) -> str:
        """Return the trace as an engineer reads it."""
        found = "enabled by another master, turning" if self.beginning.drive.live else "off"
        lines = [f"{self.wrong}", f"   0. the axis is {found}" + (', pace="lockstep"' * self.beginning.lockstep)]
        for k, (_, text, after) in enumerate(self.trace, 1):
            lines.append(f"  {k:2d}. {text}  [{described(after)}]")
        return "\n".join(lines)


def described(s: Situation) -> str:
    """Return the drive in one line: state, NMT state, watchdog."""
    drive = s.drive
    turning = ", turns" if drive.turns else ""
    watchdog = "no watchdog" if drive.consumer == NOBODY else f"watches {drive.consumer}"
    begun = "" if drive.consumer == NOBODY or drive.heard else ", not begun"
    idle = " without effect" if drive.heard and drive.nmt is not NmtState.OPERATIONAL else ""
    fsa, nmt = drive.fsa.name.lower().replace("_", " "), drive.nmt.name.lower().replace("_", "-")
    return f"{fsa}{turning}; {nmt}; {watchdog}{begun}{idle}"


@dataclass
class Exploration:
    """The result of an exploration.

    Attributes:
        states: How many situations are reachable.
        transitions: How many steps there are between them.
        seconds: How long it took.
        found: The first, shortest counterexample of each invariant.
    """

    states: int
    transitions: int
    seconds: float
    found: dict[str, Counterexample]


def explore(
    rules: Rules,
    assumptions: Assumptions | None = None,
    only: Collection[str] | None = None,
    wanted: Collection[str] = (),
) -> Exploration:
    """Explore every situation breadth first.

    Args:
        rules: How the library acts.
        assumptions: What the world does.
        only: Kinds of steps that are allowed beside those of the library and the drive; all by default. "found
            enabled" and "lockstep" name beginnings.
        wanted: Stop at the first counterexample of one of these invariants.
    """
    assumptions = assumptions or Assumptions()
    began = time.perf_counter()
    parents: dict[Situation, tuple[Situation, str, str] | None] = {}
    frontier: list[Situation] = []
    for first in beginnings(rules, assumptions):
        needed = [name for name, is_so in (("found enabled", first.drive.live), ("lockstep", first.lockstep)) if is_so]
        if only is None or all(name in only for name in needed):
            parents[first] = None
            frontier.append(first)
    found: dict[str, Counterexample] = {}
    transitions = 0
    while frontier:
        following: list[Situation] = []
        for s in frontier:
            for step in steps(s, rules, assumptions):
                if only is not None and step.kind not in only and step.kind not in (LIBRARY, DRIVE):
                    continue
                transitions += 1
                is_new = step.after not in parents
                if is_new:
                    parents[step.after] = (s, step.kind, step.text)
                for wrong in verdicts(s, step, rules):
                    if wrong not in found:
                        found[wrong] = _trace(parents, wrong, s, step)
                        if wrong in wanted:
                            return Exploration(len(parents), transitions, time.perf_counter() - began, found)
                if is_new:
                    following.append(step.after)
        frontier = following
    return Exploration(len(parents), transitions, time.perf_counter() - began, found)


def _trace(
    parents: dict[Situation, tuple[Situation, str, str] | None], wrong: str, before: Situation, step: Step
) -> Counterexample:
    trace = [(step.kind, step.text, step.after)]
    while (link := parents[before]) is not None:
        trace.append((link[1], link[2], before))
        before = link[0]
    return Counterexample(wrong, tuple(reversed(trace)), before)
