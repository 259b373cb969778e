"""Signals, death, other masters and programs on the bus, frames that come late."""

from __future__ import annotations

from drive_env.canopen.nmt import Command
from rigs.safety_model.drive import NOBODY, sync, take_nmt, tick, trip, write_controlword
from rigs.safety_model.frames import deliver
from rigs.safety_model.rules import ENABLE, SHUTDOWN, Assumptions, Rules
from rigs.safety_model.situation import (
    GONE,
    IN_A_STOP,
    At,
    Hand,
    Situation,
    Step,
    Steps,
    StopStage,
    begun,
    ended,
    has_sdo,
    left,
    master_id,
    moved,
)


def signal_steps(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    """Yield the steps of the process as a whole: signals, a pause, a kill."""
    if s.at in GONE:
        return
    if assumptions.coincidences or not s.interfered:
        yield Step("kill", "the process is killed", ended(s, At.DEAD))
    if s.troubles:
        drive = tick(s.drive, frozenset((s.twin,)) if s.twin else frozenset())
        paused = moved(s, drive, Hand.NOBODY)._replace(troubles=s.troubles - 1)
        yield Step("pause", "the process is paused for longer than the drive waits for it", paused)
    for name in ("INT", "TERM"):
        if name not in rules.handles:
            yield Step(name, f"SIG{name} ends the process", ended(s, At.DEAD))
        elif rules.stops_in == "supervisor":
            if s.armed and s.stop in (StopStage.NONE, StopStage.PROVEN) and s.at not in (At.RESTORE, At.RESTORE_AGAIN):
                yield Step(name, f"SIG{name}: the supervisor begins to stop the axis", begun(s, rules))
        elif s.at in (At.RESTORE, At.RESTORE_AGAIN):
            yield Step(name, f"SIG{name} breaks off the putting back, and the process ends", ended(s, At.CLOSED))
        elif s.at is not At.LEAVING:
            yield Step(name, f"SIG{name} raises in the program, which leaves", left(s, rules))
        elif s.stop in IN_A_STOP:
            text = f"SIG{name} breaks off the stop; at the interpreter's end the drives are closed"
            yield Step(name, text, s._replace(at=At.RESTORE, stop=StopStage.PROVEN, ramped=False, acknowledged=False))


_FOREIGN = {
    "80h": ("sends NMT 80h (enter pre-operational)", (Command.ENTER_PRE_OPERATIONAL,)),
    "02h": ("sends NMT 02h (stop)", (Command.STOP,)),
    "81h": ("sends NMT 81h (reset node)", (Command.RESET_NODE,)),
    "82h": ("sends NMT 82h (reset communication)", (Command.RESET_COMMUNICATION,)),
    "82h, 01h": ("sends NMT 82h and 01h, as after its own start", (Command.RESET_COMMUNICATION, Command.START)),
}


def other_steps(s: Situation, rules: Rules, assumptions: Assumptions) -> Steps:
    """Yield the steps of other masters, other programs and the drive itself."""
    if s.drive.latched is not None:
        yield Step("foreign SYNC", "another master sends SYNC", moved(s, sync(s.drive), Hand.OURS))
    if s.twin:
        yield Step("twin ends", f"the other program with node-ID {s.twin} ends", s._replace(twin=NOBODY))
    if not s.troubles or s.at in GONE:
        return
    seen = s._replace(troubles=s.troubles - 1, interfered=s.armed)
    for kind, (text, commands) in _FOREIGN.items():
        drive = s.drive
        for command in commands:
            drive = take_nmt(drive, command)
        if drive != s.drive:
            yield Step(kind, f"another master {text}", moved(seen, drive, Hand.NOBODY))
    if has_sdo(s):
        drive = write_controlword(write_controlword(s.drive, SHUTDOWN), ENABLE)
        if drive.live and not s.drive.live:
            yield Step("foreign enable", "another master enables the axis", moved(seen, drive, Hand.OTHER))
    if not s.twin:
        ours = master_id(rules)
        yield Step("same id", f"another program begins to beat as node {ours}, too", seen._replace(twin=ours))
    if not s.silent:
        text = "the node falls silent: it hears and sends nothing any more, while the session's other axes are heard"
        yield Step("silence", text, s._replace(troubles=s.troubles - 1, silent=True))
    if (tripped := trip(s.drive)) != s.drive:
        faulty = moved(s._replace(troubles=s.troubles - 1), tripped, Hand.NOBODY)
        yield Step("drive fault", "the drive has a fault", faulty)


def late_frame_steps(s: Situation, assumptions: Assumptions) -> Steps:
    """Return the arrivals of frames to the drive that were held back, of each identifier the first."""
    kinds: set[str] = set()
    for frame in s.held:
        if frame.kind == "answer" or (assumptions.keeps_order and frame.kind in kinds):
            continue
        kinds.add(frame.kind)
        what = f"6040h = {frame.content:02X}h"
        how = "by SDO" if frame.kind == "request" else "in an RPDO"
        yield Step("late frame", f"{what} {how}, held back until now, arrives", deliver(s, frame))
