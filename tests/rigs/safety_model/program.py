"""The possible steps of the program between two calls, and of the library in the program's thread."""

from __future__ import annotations

from drive_env import cia402
from drive_env.canopen.nmt import SERVICES, Command, NmtState
from drive_env.firmware.common.fsa import ENABLE_OPERATION
from rigs.safety_model.drive import NOBODY, hear, latch, sync, take_nmt, write_controlword
from rigs.safety_model.frames import deliver, transfers
from rigs.safety_model.rules import (
    DISABLE_VOLTAGE,
    ENABLE,
    ENABLE_AND_RESET,
    QUICK_STOP,
    SET_POINT,
    SHUTDOWN,
    SWITCH_ON,
    Assumptions,
    Rules,
)
from rigs.safety_model.situation import (
    IN_A_STOP,
    LIBRARY,
    At,
    Hand,
    Held,
    Situation,
    Step,
    Steps,
    StopStage,
    begun,
    ended,
    has_sdo,
    joined,
    left,
    master_id,
    moved,
    refused,
)

# One controlword of each kind that CiA 402's commands tell apart, as test_safety_model.py shows; with bit 7 no command
# is made, whatever the others are.
WORDS = (DISABLE_VOLTAGE, QUICK_STOP, SHUTDOWN, SWITCH_ON, ENABLE, ENABLE_AND_RESET)
PLAYS = ((ENABLE,), (SHUTDOWN, ENABLE))  # whose last word enables


def program_steps(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    """Yield the next steps of the program's thread."""
    if s.at is At.PROGRAM:
        yield from _calls(s, rules, assumptions)
    elif s.at is At.ARM:
        yield from _arm(s, rules, assumptions)
    elif s.at in (At.ARMED, At.SEND):
        yield from _send(s, rules, assumptions)
    elif s.at is At.LEAVING:
        yield from _leave(s, rules)
    elif s.at in (At.RESTORE, At.RESTORE_AGAIN):
        yield from _restore(s, assumptions)


def _enables(rows: tuple[int, ...]) -> bool:
    mask, value = ENABLE_OPERATION
    return any(word >= 0 and word & mask == value for word in rows)


def _calls(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    for word in WORDS:
        yield from _check(s, rules, f"write {word:02X}h", f"the program writes 6040h = {word:02X}h", (word,))
    for rows in PLAYS:
        words = ", ".join(f"{word:02X}h" for word in rows)
        yield from _check(s, rules, "play", f"the program plays 6040h = {words}", rows)
    if s.troubles and not s.held:
        for kind, text, after, _ in transfers(s, cia402.STATUSWORD, None, assumptions):
            if after.held:
                yield Step(kind, joined("the program reads 6041h", text), after)
    if s.drive.live:
        yield from _check(s, rules, "command", "the program writes a set-point of the live axis", (SET_POINT,))
    yield Step("stall", "the program hangs", s._replace(at=At.STALLED))
    yield Step("leave", "the program ends and closes its drives", left(s, rules))


def _check(s: Situation, rules: Rules, kind: str, text: str, rows: tuple[int, ...]) -> Steps:
    """Return the step in which the envelope lets a call pass, after which the call goes on; or none: it is refused."""
    if rules.watches and (s.stop in IN_A_STOP or s.stop is StopStage.UNPROVEN):
        return
    checked = s._replace(at=At.SEND, rows=rows, by_pdo=kind == "play")
    if rules.arms_for & frozenset(rows):
        if rules.live_from == "statusword":
            checked = checked._replace(believed=True)
        checked = checked._replace(at=At.ARM if rules.arms == "each time" or not s.armed else At.ARMED)
    if rules.watches and rows != (SET_POINT,) and s.stop is StopStage.PROVEN:
        checked = checked._replace(stop=StopStage.NONE)
    yield Step(kind, text, checked)


def _arm(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    """Send NMT start, write 1016h, begin the heartbeats: in this order, before the frame that was checked."""
    if s.cancelled and rules.checks == "frames":
        yield Step(LIBRARY, "arming is broken off, since the drives are being stopped", refused(s))
        return
    started = moved(s, take_nmt(s.drive, Command.START), Hand.NOBODY)
    if s.silent and rules.operational == "seen":
        yield Step(LIBRARY, "the library sends NMT start; it refuses, since no TPDO comes", refused(started))
        return
    yield from _configure(started, rules, assumptions, LIBRARY, "the library sends NMT start")
    if s.troubles and s.drive.nmt is not NmtState.OPERATIONAL:
        lost = s._replace(troubles=s.troubles - 1)
        what = "the library sends NMT start, which is lost"
        if rules.operational == "seen":
            yield Step("NMT start lost", f"{what}; it refuses, since no TPDO comes", refused(lost))
        else:
            yield from _configure(lost, rules, assumptions, "NMT start lost", what)


def _configure(s: Situation, rules: Rules, assumptions: Assumptions, kind: str, text: str) -> Steps:
    ours = master_id(rules)
    if s.lockstep and not rules.arms_in_lockstep:
        yield Step(kind, f"{text}; it leaves 1016h, since the pace is lockstep", s._replace(at=At.ARMED, armed=True))
    elif rules.own_id and s.twin == ours:
        yield Step(kind, f"{text}; it hears its own node-ID from another, and refuses", refused(s))
    elif s.drive.consumer == ours and has_sdo(s) and not s.silent:
        yield from _beat(s, rules, kind, f"{text}; it finds {ours} in 1016h")
    else:
        for outcome, more, after, answer in transfers(s, 0x1016, ours, assumptions):
            both = kind if outcome == LIBRARY else outcome
            done = f"{text}; it writes {ours} to 1016h"
            if answer:
                yield from _beat(after, rules, both, done)
            else:
                # A new 1016h watches no node until the next heartbeat: no state for an axis that may be live.
                failed = begun(refused(after), rules) if rules.watches and s.armed else refused(after)
                yield Step(both, joined(done, more), failed)


def _beat(s: Situation, rules: Rules, kind: str, text: str) -> Steps:
    after = s._replace(at=At.ARMED, armed=True, interfered=False)
    beats = f"{rules.beats} heartbeat" + "s" * (rules.beats > 1)
    yield Step(kind, f"{text}; it sends {beats}", after._replace(drive=hear(s.drive, master_id(rules))))
    if s.troubles >= rules.beats:
        lost = after._replace(troubles=s.troubles - rules.beats)
        yield Step("heartbeat lost", f"{text}; it sends {beats}, lost", lost)


def _send(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    if not s.rows:
        # What is played mostly goes on after it has enabled; only then does the library look at what was.
        done = refused(s)
        done = done._replace(believed=True) if rules.live_from == "writes" else done
        yield Step(LIBRARY, "the play ends, and returns", done)
        return
    word = s.rows[0]
    if s.cancelled and rules.checks == "frames":
        yield Step(LIBRARY, "the call is broken off", refused(s))
    elif word == SET_POINT:
        hand = Hand.OURS if s.drive.live else s.hand
        yield Step(LIBRARY, "the set-point is sent", refused(s)._replace(hand=hand))
    elif s.by_pdo:
        yield from _play_row(s, rules, assumptions)
    else:
        for kind, text, after, answer in transfers(s, cia402.CONTROLWORD, word, assumptions):
            done = refused(after)
            if answer and rules.live_from == "writes":
                done = done._replace(believed=_enables((word,)))
            yield Step(kind, joined(f"6040h = {word:02X}h is sent by SDO", text), done)


def _play_row(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    """Send a row: an RPDO, then SYNC, at which the drive takes it and sends a TPDO."""
    word, rest = s.rows[0], s.rows[1:]
    what = f"6040h = {word:02X}h is sent in an RPDO"

    if assumptions.keeps_order:
        for frame in [frame for frame in s.held if frame.kind == "rpdo"]:
            s = deliver(s, frame)
    taken = s._replace(drive=latch(s.drive, word))
    synced = moved(taken, sync(taken.drive), Hand.OURS)
    if not SERVICES[s.drive.nmt].pdo:
        yield Step(LIBRARY, f"{what}, and no TPDO comes: the node is not operational", refused(s))
        return
    if s.silent:
        yield Step(LIBRARY, f"{what}, SYNC follows, and no TPDO comes: the node is silent", refused(synced))
        return
    yield Step(LIBRARY, f"{what}, SYNC follows", synced._replace(rows=rest))
    if s.troubles:
        spent = s.troubles - 1
        unanswered = moved(s, sync(s.drive), Hand.OURS)._replace(troubles=spent)
        yield Step("RPDO lost", f"{what} and lost, SYNC follows", unanswered._replace(rows=rest))
        late = unanswered._replace(held=(*unanswered.held, Held("rpdo", word)))
        yield Step("RPDO held", f"{what} and held back, SYNC follows", late._replace(rows=rest))
        yield Step("SYNC lost", f"{what}, the SYNC after it is lost", refused(taken._replace(troubles=spent)))
        answer = refused(synced._replace(troubles=spent))
        yield Step("TPDO lost", f"{what}, SYNC follows, the TPDO is lost", answer)


def _leave(s: Situation, rules: Rules) -> Steps:
    """Begin the stop, wait for it, or go on after it."""
    if s.stop in IN_A_STOP:
        return
    if s.stop is StopStage.NONE and s.armed and (rules.watches or s.believed):
        stop = begun(s, rules)
        if not s.believed:  # no controlword is sent to an axis that is off already
            stop = stop._replace(stop=StopStage.PROVE, acknowledged=True)
        yield Step(LIBRARY, "the library begins to stop the axis", stop)
    elif s.stop is StopStage.UNPROVEN and rules.gives_up == "one proven off":
        text = "another axis of the node is proven off; the library goes on to put 1016h back"
        yield Step(LIBRARY, text, s._replace(at=At.RESTORE))
    elif s.stop is StopStage.UNPROVEN:
        yield Step(LIBRARY, "the library leaves 1016h as it is and closes", ended(s, At.CLOSED))
        yield from _ask_once_more(s, rules)
    elif s.armed:
        yield Step(LIBRARY, "the library goes on to put 1016h back", s._replace(at=At.RESTORE))
    else:
        yield Step(LIBRARY, "the library closes", ended(s, At.CLOSED))


def _ask_once_more(s: Situation, rules: Rules) -> Steps:
    """Start a node that may have been stopped by its watchdog, and answers nothing therefore, to prove its axis off."""
    drive = take_nmt(s.drive, Command.START)
    what = "the library sends NMT start, as to a node that its watchdog has stopped"
    if s.silent or drive.live:
        drive = hear(drive, master_id(rules)) if rules.beats_last else drive
        seen = "hears nothing" if s.silent else "sees a live axis"
        yield Step(LIBRARY, f"{what}, {seen}, and closes", ended(moved(s, drive, Hand.NOBODY), At.CLOSED))
    else:
        off = moved(s, write_controlword(drive, DISABLE_VOLTAGE), Hand.NOBODY)
        yield Step(LIBRARY, f"{what}, and proves the axis off after 6040h = 00h", off._replace(stop=StopStage.PROVEN))


def _restore(s: Situation, assumptions: Assumptions) -> Steps:
    again = s.at is At.RESTORE_AGAIN
    what = "the library writes 0 to 1016h"
    if again:
        s = moved(s, take_nmt(s.drive, Command.ENTER_PRE_OPERATIONAL), Hand.NOBODY)
        what = "the library sends NMT 80h and writes 0 to 1016h once more"
    if s.drive.consumer == NOBODY:
        yield Step(LIBRARY, "the library closes: 1016h is as it was", ended(s, At.CLOSED))
        return
    for kind, text, after, answer in transfers(s, 0x1016, NOBODY, assumptions):
        done = ended(after, At.CLOSED) if answer or again else after._replace(at=At.RESTORE_AGAIN)
        yield Step(kind, joined(what, text), done)
