"""A session on a bus: program, envelope, frames, other masters, one drive, and everything that may happen next.

A frame that meets no trouble arrives before its sender does anything else; frames in flight are therefore those alone
that a trouble has held back (`Situation.held`).
"""

from __future__ import annotations

from rigs.safety_model.drive import tick
from rigs.safety_model.others import late_frame_steps, other_steps, signal_steps
from rigs.safety_model.program import program_steps
from rigs.safety_model.rules import Assumptions, Rules
from rigs.safety_model.situation import DRIVE, At, Hand, Situation, Step, Steps, beating, moved
from rigs.safety_model.supervisor import supervisor_steps


def steps(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    """Return everything that may happen next."""
    if s.at is At.SEND and rules.checks == "frames":  # one with its check, under a lock
        yield from program_steps(s, rules, assumptions)
        return
    supervised = False
    for step in supervisor_steps(s, rules, assumptions):
        supervised = rules.watches
        yield step
    yield from program_steps(s, rules, assumptions)
    yield from signal_steps(s, rules, assumptions)
    yield from other_steps(s, rules, assumptions)
    yield from late_frame_steps(s, assumptions)
    # A tick is long: what the supervisor has to do, and arming, is done before.
    if not supervised and not (rules.watches and s.at is At.ARM):
        yield Step(DRIVE, "time passes", _time_passes(s, rules))


def attended(s: Situation, rules: Rules) -> bool:
    """Return whether the supervisor has something to do in this situation, and will within 20 ms."""
    return rules.watches and any(True for _ in supervisor_steps(s, rules, Assumptions(troubles=0)))


def left_alone(s: Situation, rules: Rules) -> Situation:
    """Return the situation that follows when the program does nothing and no trouble comes."""
    acts = next(supervisor_steps(s, rules, Assumptions(troubles=0)), None)
    return _time_passes(s, rules) if acts is None else acts.after


def _time_passes(s: Situation, rules: Rules) -> Situation:
    return moved(s, tick(s.drive, beating(s, rules)), Hand.NOBODY)._replace(interfered=False)
