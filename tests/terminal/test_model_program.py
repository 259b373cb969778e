"""What the safety model lets the program's thread do next, step by step, and how many troubles each step takes."""

from __future__ import annotations

import pytest
from rigs.safety_model.drive import Drive
from rigs.safety_model.exploration import (
    GIVEN_UP,
    LEFT,
    RUNS_ON,
    TAKEN_FOR_OFF,
    UNWATCHED,
    Counterexample,
    described,
    explore,
)
from rigs.safety_model.frames import transfers
from rigs.safety_model.program import PLAYS, WORDS, program_steps
from rigs.safety_model.rules import DISABLED, ENABLE, NO_POWER, OURS, OWN_ID, SET_POINT, SHUTDOWN, TODAY, Assumptions
from rigs.safety_model.situation import At, Hand, Held, Situation, StopStage
from rigs.safety_model.steps import attended
from rigs.safety_model.supervisor import supervisor_steps

from drive_env import cia402
from drive_env.canopen.nmt import NmtState
from drive_env.cia402 import State

LIVE = Drive(fsa=State.OPERATION_ENABLED, turns=True, nmt=NmtState.OPERATIONAL)
READY = Drive(fsa=State.READY_TO_SWITCH_ON, nmt=NmtState.OPERATIONAL)


def steps(rules=OURS, keeps_order=True, **situation):
    made = Situation(**situation)
    return made, list(program_steps(made, rules, Assumptions(keeps_order=keeps_order)))


def of(kind, found):
    """Return what is after the one step of a kind."""
    (step,) = [step for step in found if step.kind == kind]
    return step.after


@pytest.mark.parametrize(
    ("kind", "taken", "situation"),
    [
        ("NMT start lost", 1, {"at": At.ARM, "rows": (ENABLE,)}),
        ("RPDO lost", 1, {"at": At.SEND, "rows": (ENABLE,), "by_pdo": True, "drive": READY}),
        ("RPDO held", 1, {"at": At.SEND, "rows": (ENABLE,), "by_pdo": True, "drive": READY}),
        ("SYNC lost", 1, {"at": At.SEND, "rows": (ENABLE,), "by_pdo": True, "drive": READY}),
        ("TPDO lost", 1, {"at": At.SEND, "rows": (ENABLE,), "by_pdo": True, "drive": READY}),
        ("heartbeat lost", OURS.beats, {"at": At.ARM, "drive": READY._replace(consumer=OWN_ID)}),
    ],
)
def test_each_trouble_is_counted_and_none_comes_where_none_is_left(kind, taken, situation):
    for troubles in (taken, taken + 1):
        _, found = steps(troubles=troubles, **situation)
        assert {step.after.troubles for step in found if step.kind == kind} == {troubles - taken}
    _, found = steps(troubles=taken - 1, **situation)
    assert kind not in {step.kind for step in found}


def test_what_happens_by_itself_takes_no_trouble():
    for at in (At.PROGRAM, At.ARM, At.SEND):
        made, found = steps(at=at, rows=(ENABLE,), drive=READY, troubles=2)
        for step in found:
            if step.kind in ("library", "stall", "leave", "play", "command") or step.kind.startswith("write"):
                assert step.after.troubles == made.troubles, step


def test_the_program_may_write_play_hang_and_end():
    _, found = steps()
    kinds = [step.kind for step in found]
    assert kinds == [*(f"write {word:02X}h" for word in WORDS), *["play"] * len(PLAYS), "stall", "leave"]
    assert of("stall", found).at is At.STALLED and of("leave", found).at is At.LEAVING
    _, found = steps(drive=LIVE)
    assert of("command", found).rows == (SET_POINT,)


def test_what_leads_to_motion_is_armed_for_and_counts_as_live():
    _, found = steps()
    for word in WORDS:
        after = of(f"write {word:02X}h", found)
        arms = word in OURS.arms_for
        assert after.rows == (word,) and not after.by_pdo
        assert after.at is (At.ARM if arms else At.SEND) and after.believed == arms
    plays = [step.after for step in found if step.kind == "play"]
    assert [after.rows for after in plays] == list(PLAYS) and all(after.by_pdo for after in plays)
    _, found = steps(TODAY, armed=True)
    assert of("write 0Fh", found).at is At.ARMED and not of("write 0Fh", found).believed
    _, found = steps(TODAY)
    assert of("write 0Fh", found).at is At.ARM and of("write 06h", found).at is At.SEND


@pytest.mark.parametrize("stage", StopStage)
def test_while_a_stop_is_under_way_or_failed_calls_are_refused(stage):
    _, found = steps(stop=stage, drive=LIVE)
    may = stage in (StopStage.NONE, StopStage.PROVEN)
    assert ("write 0Fh" in {step.kind for step in found}) == may
    if may:
        assert of("write 0Fh", found).stop is StopStage.NONE, "another start ends the stop"
        assert of("command", found).stop is stage, "a set-point does not"


def test_arming_starts_the_node_writes_who_is_watched_and_beats():
    _, found = steps(at=At.ARM, rows=(ENABLE,), drive=READY._replace(nmt=NmtState.PRE_OPERATIONAL))
    (step,) = found
    assert step.text == "the library sends NMT start; it writes 126 to 1016h; it sends 3 heartbeats"
    assert step.after.at is At.ARMED and step.after.armed and not step.after.interfered
    assert step.after.drive == READY._replace(consumer=OWN_ID, heard=True)
    _, (step,) = steps(at=At.ARM, drive=READY._replace(consumer=OWN_ID))
    assert step.text == "the library sends NMT start; it finds 126 in 1016h; it sends 3 heartbeats"
    assert step.after.drive.heard


def test_arming_is_refused_where_it_cannot_be_seen_to_have_worked():
    _, (step,) = steps(at=At.ARM, rows=(ENABLE,), silent=True)
    assert step.text.endswith("it refuses, since no TPDO comes") and step.after.at is At.PROGRAM
    _, (step,) = steps(at=At.ARM, rows=(ENABLE,), twin=OWN_ID)
    assert step.text.endswith("it hears its own node-ID from another, and refuses") and step.after.rows == ()
    _, (step,) = steps(at=At.ARM, rows=(ENABLE,), cancelled=True, drive=READY)
    assert step.text == "arming is broken off, since the drives are being stopped"
    assert step.after == Situation(drive=READY)
    _, (step,) = steps(TODAY, at=At.ARM, lockstep=True)
    assert step.text.endswith("it leaves 1016h, since the pace is lockstep") and step.after.drive.consumer == 0
    _, found = steps(at=At.ARM, rows=(ENABLE,), troubles=1)
    assert of("NMT start lost", found).at is At.PROGRAM
    for nmt in NmtState:
        _, found = steps(at=At.ARM, rows=(ENABLE,), troubles=1, drive=READY._replace(nmt=nmt))
        assert ("NMT start lost" in {step.kind for step in found}) == (nmt is not NmtState.OPERATIONAL)
    _, found = steps(TODAY, at=At.ARM, rows=(ENABLE,), troubles=1)
    assert of("NMT start lost", found).at is At.ARMED, "TODAY sends it and does not look"


def test_a_play_sends_row_by_row_and_returns_after_the_last():
    _, found = steps(at=At.SEND, rows=(SHUTDOWN, ENABLE), by_pdo=True, drive=READY)
    (step,) = found
    assert step.text == "6040h = 06h is sent in an RPDO, SYNC follows" and step.after.rows == (ENABLE,)
    _, (step,) = steps(at=At.SEND, rows=(), by_pdo=True, drive=READY, cancelled=True)
    assert step.after == Situation(drive=READY)
    _, (step,) = steps(TODAY, at=At.SEND, rows=(), by_pdo=True)
    assert step.after.believed


def test_what_becomes_of_a_row():
    on = READY._replace(fsa=State.SWITCHED_ON)
    situation = {"at": At.SEND, "rows": (ENABLE,), "by_pdo": True, "drive": on}
    _, found = steps(troubles=1, **situation)
    sent, lost, held = (of(kind, found) for kind in ("library", "RPDO lost", "RPDO held"))
    assert sent.drive.live and sent.hand is Hand.OURS and sent.rows == ()
    assert not lost.drive.live and lost.held == () and lost.rows == ()
    assert not held.drive.live and held.held == (Held("rpdo", ENABLE),) and held.rows == ()
    unsynced, unheard = of("SYNC lost", found), of("TPDO lost", found)
    assert unsynced.drive.latched == ENABLE and unsynced.at is At.PROGRAM
    assert unheard.drive.live and unheard.at is At.PROGRAM
    _, (step,) = steps(**situation | {"silent": True})
    assert step.text.endswith("no TPDO comes: the node is silent") and step.after.drive.live
    _, (step,) = steps(**situation | {"drive": on._replace(nmt=NmtState.PRE_OPERATIONAL), "troubles": 1})
    assert step.text.endswith("no TPDO comes: the node is not operational") and not step.after.drive.live


def test_a_set_point_for_a_live_axis_is_ours():
    _, (step,) = steps(at=At.SEND, rows=(SET_POINT,), drive=LIVE, hand=Hand.OTHER)
    assert step.after.hand is Hand.OURS and step.after.at is At.PROGRAM
    _, (step,) = steps(at=At.SEND, rows=(SET_POINT,), drive=READY)
    assert step.after.hand is Hand.NOBODY


def test_leaving_stops_what_was_armed_and_proves_it_off():
    _, (step,) = steps(at=At.LEAVING, armed=True, believed=True, drive=LIVE)
    assert step.after.stop is StopStage.QUICK
    _, (step,) = steps(at=At.LEAVING, armed=True)
    assert step.after.stop is StopStage.PROVE and step.after.acknowledged
    _, (step,) = steps(at=At.LEAVING)
    assert step.text == "the library closes" and step.after.at is At.CLOSED
    _, (step,) = steps(at=At.LEAVING, armed=True, stop=StopStage.PROVEN)
    assert step.after.at is At.RESTORE
    for stage in (StopStage.QUICK, StopStage.RAMP, StopStage.CUT, StopStage.PROVE):
        assert steps(at=At.LEAVING, armed=True, stop=stage)[1] == []


def test_a_node_that_could_not_be_proved_off_is_asked_once_more():
    _, found = steps(at=At.LEAVING, armed=True, stop=StopStage.UNPROVEN, drive=READY._replace(nmt=NmtState.STOPPED))
    closed, asked = (step.after for step in found)
    assert closed.at is At.CLOSED
    assert asked.stop is StopStage.PROVEN and asked.drive.nmt is NmtState.OPERATIONAL
    assert asked.drive.fsa is State.SWITCH_ON_DISABLED
    _, found = steps(at=At.LEAVING, armed=True, stop=StopStage.UNPROVEN, drive=LIVE._replace(consumer=OWN_ID))
    assert found[1].text.endswith("sees a live axis, and closes") and found[1].after.drive.heard
    _, found = steps(at=At.LEAVING, armed=True, stop=StopStage.UNPROVEN, silent=True)
    assert found[1].text.endswith("hears nothing, and closes") and found[1].after.at is At.CLOSED


def test_the_states_that_count_as_off():
    assert State.READY_TO_SWITCH_ON not in DISABLED and State.SWITCHED_ON not in DISABLED
    assert {State.READY_TO_SWITCH_ON, State.SWITCHED_ON} == NO_POWER - DISABLED


@pytest.mark.parametrize(("keeps_order", "waiting"), [(True, []), (False, [Held("request", ENABLE)])])
def test_a_request_that_was_held_back_comes_before_the_next_where_a_bus_keeps_order(keeps_order, waiting):
    """An enabling that is late, then a shutdown on the same identifier: the shutdown is the last on CAN."""
    drive = Drive(fsa=State.SWITCHED_ON, nmt=NmtState.OPERATIONAL)
    made = Situation(drive=drive, held=(Held("request", ENABLE),))
    first = next(transfers(made, cia402.CONTROLWORD, SHUTDOWN, Assumptions(keeps_order=keeps_order)))
    assert [frame for frame in first.after.held if frame.kind == "request"] == waiting
    assert first.after.drive.fsa is State.READY_TO_SWITCH_ON


# --- the supervisor ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("rules", "situation", "acts"),
    [
        (OURS, {}, False),
        (OURS, {"armed": True}, False),  # nothing is new
        (OURS, {"armed": True, "drive": LIVE}, True),  # a live axis that was taken for off
        (OURS, {"drive": LIVE}, False),  # without its thread
        (OURS, {"stop": StopStage.CUT}, True),
        (TODAY, {"stop": StopStage.CUT}, False),  # there is none
    ],
)
def test_who_attends_to_a_situation(rules, situation, acts):
    assert attended(Situation(**situation), rules) is acts


@pytest.mark.parametrize(
    ("situation", "told"),
    [
        ({"stop": StopStage.QUICK}, ["the stop sends 6040h = 02h"]),
        ({"stop": StopStage.RAMP}, ["the stop sees that the axis stands, or is off"]),
        ({"stop": StopStage.RAMP, "drive": LIVE}, ["the stop sees that the axis is not on its ramp"]),
        ({"stop": StopStage.CUT}, ["the stop sends 6040h = 00h"]),
        ({"stop": StopStage.PROVE, "acknowledged": True}, ["the stop reads 6041h: switch on disabled"]),
        ({"stop": StopStage.PROVE, "drive": LIVE}, ["the stop reads 6041h: operation enabled; so it stops"]),
        ({"stop": StopStage.PROVE, "drive": LIVE, "ramped": True},
         ["the stop reads 6041h: operation enabled; no proof, so the heartbeats end",
          "the stop reads 6041h: operation enabled; no proof, so once more"]),
        ({"stop": StopStage.PROVE, "drive": LIVE._replace(nmt=NmtState.STOPPED)},
         ["the stop reads 6041h; so it stops; the node answers no SDO in its NMT state"]),
        ({"armed": True, "believed": True, "drive": LIVE}, ["the supervisor sees what is, and stops the axis"]),
        ({"armed": True, "believed": True, "drive": READY._replace(consumer=OWN_ID, fsa=State.SWITCH_ON_DISABLED)},
         ["the supervisor looks"]),
    ],
)  # fmt: skip
def test_what_the_supervisor_does_is_told_step_by_step(situation, told):
    assert [step.text for step in supervisor_steps(Situation(**situation), OURS, Assumptions(0))] == told


# --- what was explored ------------------------------------------------------------------------------------------------
@pytest.mark.every(2)
@pytest.mark.parametrize(
    ("rules", "assumptions", "states", "transitions", "lengths"),
    [
        (TODAY, Assumptions(0), 2670, 13_734, {UNWATCHED: 2, RUNS_ON: 3, LEFT: 3, TAKEN_FOR_OFF: 7, GIVEN_UP: 7}),
        (TODAY, Assumptions(1), 59_458, 367_525, {UNWATCHED: 2, RUNS_ON: 3, LEFT: 3, TAKEN_FOR_OFF: 4, GIVEN_UP: 7}),
        (OURS, Assumptions(0), 2281, 8280, {}),
        (OURS, Assumptions(1, coincidences=True), 55_203, 259_211, {RUNS_ON: 5}),
    ],
    ids=["before", "before, one trouble", "ours", "ours, one trouble"],
)
def test_the_model_that_was_explored_is_this_one(rules, assumptions, states, transitions, lengths):
    """How large it is, and its shortest counterexamples. Whoever changes the model sees here how much of it changed."""
    result = explore(rules, assumptions)
    assert (result.states, result.transitions) == (states, transitions)
    assert {wrong: len(one.trace) for wrong, one in result.found.items()} == lengths


@pytest.mark.parametrize(
    ("drive", "told"),
    [
        (Drive(), "switch on disabled; pre-operational; no watchdog"),
        (LIVE._replace(consumer=OWN_ID), "operation enabled, turns; operational; watches 126, not begun"),
        (LIVE._replace(consumer=OWN_ID, heard=True), "operation enabled, turns; operational; watches 126"),
        (LIVE._replace(consumer=OWN_ID, heard=True, nmt=NmtState.PRE_OPERATIONAL),
         "operation enabled, turns; pre-operational; watches 126 without effect"),
    ],
)  # fmt: skip
def test_a_drive_in_one_line(drive, told):
    assert described(Situation(drive=drive)) == told


@pytest.mark.parametrize(("drive", "lockstep", "told"), [
    (Drive(), False, "off"), (LIVE, True, 'enabled by another master, turning, pace="lockstep"'),
])  # fmt: skip
def test_a_trace_begins_with_what_was_found(drive, lockstep, told):
    found = Counterexample(RUNS_ON, (("kill", "it dies", Situation()),), Situation(drive=drive, lockstep=lockstep))
    assert str(found).splitlines()[1:] == [
        f"   0. the axis is {told}", "   1. it dies  [switch on disabled; pre-operational; no watchdog]"
    ]  # fmt: skip
    assert found.kinds == {"kill"}


def test_names_of_beginnings_restrict_what_is_explored():
    everything = explore(TODAY, Assumptions(0))
    some = explore(TODAY, Assumptions(0), ("found enabled",))
    more = explore(TODAY, Assumptions(0), ("found enabled", "lockstep"))
    none = explore(TODAY, Assumptions(0), ())
    assert none.states < some.states < more.states < everything.states
    first = explore(TODAY, Assumptions(0), wanted=(UNWATCHED,))
    assert list(first.found) == [UNWATCHED] and first.states < everything.states
