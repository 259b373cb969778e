"""The steps of the thread that watches and stops; in the code before, the program stops in its own."""

from __future__ import annotations

from drive_env import cia402
from drive_env.canopen.nmt import NmtState
from drive_env.cia402 import State as Fsa
from rigs.safety_model.frames import named, transfers
from rigs.safety_model.rules import DISABLE_VOLTAGE, QUICK_STOP, Assumptions, Rules
from rigs.safety_model.situation import (
    GONE,
    IN_A_STOP,
    LIBRARY,
    At,
    Situation,
    Step,
    Steps,
    StopStage,
    begun,
    has_sdo,
    joined,
    master_id,
)


def supervisor_steps(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    """Yield the steps of the thread that stops drives; with the rules TODAY it is the program's, but for a stall."""
    if s.at in GONE:
        return
    if s.stop in IN_A_STOP:
        yield from _stop(s, rules, assumptions)
    elif s.armed and s.at not in (At.RESTORE, At.RESTORE_AGAIN):
        if rules.watches:
            yield from _look(s, rules)
        elif s.at is At.STALLED and s.believed and not s.lockstep and s.stop is StopStage.NONE:
            what = "the lifeline sends a quick stop, and waits for no answer"
            for kind, text, after, _ in transfers(s, cia402.CONTROLWORD, QUICK_STOP, assumptions):
                yield Step(kind, joined(what, text), after._replace(stop=StopStage.PROVEN))


def _watchdog_is_there(s: Situation, rules: Rules) -> bool:
    return s.drive.nmt is NmtState.OPERATIONAL and s.drive.consumer == master_id(rules)


def _look(s: Situation, rules: Rules) -> Steps:
    """Look at 6041h, at whether TPDOs come on SYNC, at boot-up messages and foreign heartbeats, and act upon it."""
    ours = master_id(rules)
    shared = s.twin == ours
    # A node that sends nothing is as good as one without a watchdog. What it does not tell stays as it was believed.
    gone = rules.misses == "each" if s.silent else not _watchdog_is_there(s, rules)
    live = s.believed if s.silent else s.drive.live
    # What may be live is stopped like what is: a frame that waits in the drive for its SYNC is in no statusword. While
    # the library arms, the watchdog may be gone: it is being made, and stopped if that fails.
    # An axis that a single frame can enable is not off; nor is one that the call under way may enable.
    believed = s.drive.fsa not in rules.off or (s.believed and s.at not in (At.PROGRAM, At.STALLED))
    believed = s.believed if s.silent else believed
    lost = live and (shared or gone)
    may_be_lost = believed and (shared or (gone and s.at is not At.ARM))
    if lost or may_be_lost or (live and (s.at is At.STALLED or s.stop is StopStage.PROVEN)):
        after = begun(s, rules)
    else:
        # What was checked before the watchdog went is checked anew.
        cancelled = s.cancelled or ((shared or gone) and s.at in (At.ARMED, At.SEND))
        pending = s.interfered and gone and s.at is At.ARM  # until it is armed, or stopped
        after = s._replace(believed=believed, cancelled=cancelled, interfered=pending)
    if after != s:
        text = "the supervisor sees what is, and stops the axis" if after.stop is not s.stop else "the supervisor looks"
        yield Step(LIBRARY, text, after)


def _stop(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    if s.stop is StopStage.QUICK:
        for kind, text, after, answer in transfers(s, cia402.CONTROLWORD, QUICK_STOP, assumptions):
            # Once in quick stop active it needs no help any more: a controlword that comes late changes nothing.
            stops = answer is not None and after.drive.fsa is not Fsa.OPERATION_ENABLED
            sent = after._replace(stop=StopStage.RAMP, ramped=True, acknowledged=answer is not None)
            sent = sent._replace(interfered=s.interfered and not stops)
            yield Step(kind, joined("the stop sends 6040h = 02h", text), sent)
    elif s.stop is StopStage.RAMP:
        # A quick stop that comes while operation is being disabled waits for that ramp, if it came; we wait as
        # long as a second watchdog is in force, too.
        guarded = _watchdog_is_there(s, rules) and s.twin != master_id(rules)
        waits = s.drive.fsa is not Fsa.OPERATION_ENABLED or (s.drive.ramps and s.acknowledged and guarded)
        if not (s.drive.live and s.drive.turns and waits and has_sdo(s)) or s.silent:
            how = "is not on its ramp" if s.drive.live and s.drive.turns else "stands, or is off"
            yield Step(LIBRARY, f"the stop sees that the axis {how}", s._replace(stop=StopStage.CUT))
    elif s.stop is StopStage.CUT:
        for kind, text, after, answer in transfers(s, cia402.CONTROLWORD, DISABLE_VOLTAGE, assumptions):
            then = StopStage.PROVEN if rules.gives_up == "always" else StopStage.PROVE
            unanswered = answer is None
            done = after._replace(stop=then, acknowledged=not unanswered, interfered=s.interfered and unanswered)
            yield Step(kind, joined("the stop sends 6040h = 00h", text), done)
    elif s.stop is StopStage.PROVE:
        for kind, text, after, answer in transfers(s, cia402.STATUSWORD, None, assumptions):
            what = "the stop reads 6041h" if answer is None else f"the stop reads 6041h: {named(answer)}"
            enough = rules.proof == "read" or s.acknowledged
            if answer in rules.off and enough:
                proven = after._replace(stop=StopStage.PROVEN, believed=False, ramped=False, acknowledged=False)
                yield Step(kind, joined(what, text), proven)
            else:
                if not s.ramped:
                    yield Step(kind, joined(f"{what}; so it stops", text), begun(after, rules))
                    continue
                gives_up = after._replace(stop=StopStage.UNPROVEN, armed=False, ramped=False, acknowledged=False)
                yield Step(kind, joined(f"{what}; no proof, so the heartbeats end", text), gives_up)
                yield Step(kind, joined(f"{what}; no proof, so once more", text), after._replace(stop=StopStage.CUT))
