"""Emergencies of every CAN device of ours (CiA 301, 7.2.7, 1003h; the manuals); can_devices.py has the facts."""

from __future__ import annotations

import pytest
from rigs.can_devices import (
    CONTROLWORD,
    DEVICES,
    EACH_AXIS,
    EACH_DEVICE,
    ENABLED,
    FAULT,
    MODE,
    NODE,
    PROFILE,
    SWITCH_ON_DISABLED,
    configure,
    enable,
    frame_of,
    fresh,
    give,
    heat,
    others,
    read,
    silence,
    states,
    write,
)

from drive_env.canopen.frames import Frame
from drive_env.canopen.nmt import NmtState
from drive_env.node.error_history import CONDITIONS as ALL_CONDITIONS

REGISTER, HISTORY, EMCY_ID, INHIBIT, BEHAVIOUR = 0x1001, 0x1003, 0x1014, 0x1015, 0x1029
RANGE, WRONG_STATE, NO_OBJECT = 0x0609_0030, 0x0800_0022, 0x0602_0000
RPDO_ID = 0x2F5
RESET = "00 00 00"


@pytest.fixture
def wire(emulated, facts):
    """Node 5, pre-operational, without PDOs of its own accord, its first RPDO at 2F5h with controlword and mode."""
    made = fresh(emulated(facts.name))
    silence(made, facts)
    give(made, facts.rpdos[0], RPDO_ID, None, [facts.entries[index, 0].mapping for index in (CONTROLWORD, MODE)])
    yield made
    heat(made, facts, None)


def with_history(reason):
    return pytest.mark.parametrize(
        "facts",
        [pytest.param(facts, id=repr(facts), marks=[] if facts.has(HISTORY) else pytest.mark.skip(
            reason=f"{facts} {reason}: its EDS has no 1003h")) for facts in DEVICES],
    )  # fmt: skip


def expected(facts, axis):
    """Return the emergencies of an axis that is too hot, by its manual."""
    further = facts.manual.further_axis if axis else 0
    return [frame_of(code, f"{register | further:02X}", extra, axis) for code, register, extra in facts.manual.hot_told]


def sent(wire):
    return [str(frame) for frame in wire.take() if frame.can_id == 0x080 + NODE]


# --- an axis ----------------------------------------------------------------------------------------------------------
@EACH_AXIS
def test_a_fault_names_its_motor_and_its_reset_tells_the_end(wire, facts, axis):
    enable(wire, facts)
    heat(wire, facts, axis)
    wire.wait(1)
    assert sent(wire) == expected(facts, axis)
    wire.wait(50)
    assert sent(wire) == [], "once"
    assert states(wire, facts) == others(facts, axis, FAULT, ENABLED)
    assert read(wire, facts, REGISTER) == int(expected(facts, axis)[0].split()[3], 16)
    heat(wire, facts, None)
    wire.wait(1)
    assert write(wire, facts, CONTROLWORD + PROFILE * axis, 0x80) == 0
    wire.wait(1)
    (ended,) = sent(wire)
    assert ended[:13] == f"085  {RESET}"
    if "axis" in facts.manual.hot_told[0][2]:
        place = facts.manual.hot_told[0][2].index("axis")
        assert ended.split()[4 + place] == f"{axis:02X}", "the reset names its motor, too"
    assert states(wire, facts) == others(facts, axis, SWITCH_ON_DISABLED, ENABLED)
    assert read(wire, facts, REGISTER) == 0


@EACH_AXIS
def test_an_application_error_does_what_1029h_says(wire, facts, axis):
    for raw, name in facts.manual.error_behaviour.items():
        configure(wire, BEHAVIOUR, 2, raw, 1)
        enable(wire, facts, [axis])
        wire.start()
        heat(wire, facts, axis)
        wire.wait(2)
        told = sent(wire)
        assert told[0] == expected(facts, axis)[0], "told before the state changes"
        assert wire.node.state is NmtState[name]
        heat(wire, facts, None)
        wire.node.receive(Frame(0, bytes((0x80, NODE))), wire.now)
        assert told + sent(wire) == expected(facts, axis), "what else there is, as soon as it may be told"
        wire.wait(1)
        wire.take()
        assert write(wire, facts, CONTROLWORD + PROFILE * axis, 0x80) == 0
        wire.wait(2)
        wire.take()


# --- the node ---------------------------------------------------------------------------------------------------------
def lose_the_bus(wire, facts):
    wire.node.bus_off(wire.now)
    wire.node.bus_on(wire.now)


def frame(text):
    return lambda wire, facts: wire.node.receive(Frame(RPDO_ID, bytes.fromhex(text)), wire.now)


def nothing(wire, facts):
    pass


GOOD = frame("00 00 00")
# Code, additional bytes, bits of 1001h (CiA 301; manual of the TMCM-1636, table 303), how it begins, how it ends.
CONDITIONS = {
    "pdo_not_accepted": (0x6320, 0, 0x21, frame("00 00 02"), GOOD),  # vl
    "pdo_too_short": (0x8210, 0, 0x11, frame("00 00"), GOOD),
    "pdo_too_long": (0x8220, 0, 0x11, frame("00 00 00 00"), GOOD),
    "error_passive": (0x8120, 0, 0x11, lambda wire, _: wire.node.error_passive(wire.now), nothing),
    "controller_overflow": (0x8110, 1, 0x11, lambda wire, _: wire.node.overrun(wire.now, "controller"), nothing),
    "transmit_overflow": (0x8110, 2, 0x11, lambda wire, _: wire.node.overrun(wire.now, "transmit"), nothing),
    "receive_overflow": (0x8110, 3, 0x11, lambda wire, _: wire.node.overrun(wire.now, "receive"), nothing),
    "bus_off_recovered": (0x8140, 0, 0x11, lose_the_bus, nothing),
}


def test_every_condition_of_the_bus_has_its_end():
    """A lost heartbeat and a stopped node are in test_conformance_nmt.py."""
    assert CONDITIONS.keys() == ALL_CONDITIONS.keys() - {"communication_error", "heartbeat_lost"}


@EACH_DEVICE
def test_what_the_bus_has_begins_and_ends(wire, facts):
    configure(wire, BEHAVIOUR, 1, 1, 1)  # stay operational
    wire.start()
    for name, (code, first, register, begin, end) in CONDITIONS.items():
        register = facts.manual.refused if name == "pdo_not_accepted" else register
        begin(wire, facts)
        assert sent(wire) == [frame_of(code, f"{register:02X}", (first, 255, 0, 0, 0), 0)], name
        if end is not nothing:
            begin(wire, facts)
            wire.wait(5)
            assert sent(wire) == [], "once, until it is over"
            assert read(wire, facts, REGISTER) == register
        end(wire, facts)
        wire.wait(1)
        (ended,) = sent(wire)
        assert ended[:13] == f"085  {RESET}", name
        wire.wait(20)
        assert sent(wire) == [], "once"
        assert read(wire, facts, REGISTER) == 0


@EACH_DEVICE
def test_the_register_has_the_bits_of_all_errors_and_reset_communication_forgets(wire, facts):
    wire.start()
    wire.play(f"""
        rx {RPDO_ID:03X}  00 00 02
        tx 085  20 63 {facts.manual.refused:02X} 00 FF 00 00 00
        rx {RPDO_ID:03X}  00
        tx 085  10 82 11 00 FF 00 00 00   # the PDO's error is another one now
        rx 000  82 05
        tx 705  00
        rx 605  40 01 10 00 00 00 00 00
        tx 585  4F 01 10 00 00 00 00 00
    """)


@EACH_AXIS
def test_bus_off_takes_the_enabled_axis_to_fault_and_is_told_after_recovery(wire, facts, axis):
    configure(wire, BEHAVIOUR, 1, 1, 1)
    enable(wire, facts, [axis])
    wire.start()
    wire.node.bus_off(wire.now)
    wire.play("""
        rx 605  40 41 60 00 00 00 00 00   # nothing comes, nothing goes
        rx 000  81 05
        wait 20 ms
    """)
    assert states(wire, facts) == others(facts, axis, FAULT, SWITCH_ON_DISABLED)
    wire.node.bus_on(wire.now)
    (told,) = sent(wire)
    assert told[:10] == "085  40 81"


# --- identifier and inhibit time --------------------------------------------------------------------------------------
@EACH_DEVICE
def test_its_identifier(wire, facts):
    wire.start()
    for bad in (0x001, 0x180, 0x605, 0x701, 0x85 | 1 << 29, 0x85 | 1 << 30):
        assert wire.download(EMCY_ID, 0, bad, 4) == RANGE
    assert wire.download(EMCY_ID, 0, 0x86, 4) == WRONG_STATE, "in use"
    wire.play(f"""
        rx 605  23 14 10 00 85 00 00 80   # off
        tx 585  60 14 10 00 00 00 00 00
        rx {RPDO_ID:03X}  00
        rx 605  40 01 10 00 00 00 00 00
        tx 585  4F 01 10 00 11 00 00 00   # the error is there all the same
        rx 605  23 14 10 00 99 00 00 00   # on
        tx 585  60 14 10 00 00 00 00 00
        rx {RPDO_ID:03X}  00 00 00
        rx {RPDO_ID:03X}  00
        tx 099  10 82 11 00 FF 00 00 00
    """)


@pytest.mark.parametrize(
    "facts",
    [pytest.param(facts, id=repr(facts), marks=[] if facts.has(INHIBIT) else pytest.mark.skip(
        reason=f"{facts} has no inhibit time of emergencies: its EDS has no 1015h")) for facts in DEVICES],
)  # fmt: skip
def test_inhibit_time_in_tenths_of_a_millisecond(wire, facts):
    wire.start()
    wire.play(f"""
        rx 605  2B 15 10 00 C8 00 00 00   # 200: 20 ms
        tx 585  60 15 10 00 00 00 00 00
        rx {RPDO_ID:03X}  00
        tx 085  10 82 11 00 FF 00 00 00   # the first at once
        rx {RPDO_ID:03X}  00 00 00 00
        rx {RPDO_ID:03X}  00
        wait 19 ms
        wait 1 ms
        tx 085  20 82 11 00 FF 00 00 00
        wait 19 ms
        wait 1 ms
        tx 085  10 82 11 00 FF 00 00 00
        wait 100 ms
        rx {RPDO_ID:03X}  00 00 00 00
        tx 085  20 82 11 00 FF 00 00 00
    """)


# --- the history ------------------------------------------------------------------------------------------------------
@with_history("keeps no errors")
def test_the_history_has_what_was_told_the_newest_first_and_is_cleared_by_0(wire, facts):
    """Manual 003, 1003h: code below, axis in bit 16, number of the error bit in bits 24 to 29."""
    enable(wire, facts)
    for axis in facts.axes:
        heat(wire, facts, axis)
        wire.wait(1)
        heat(wire, facts, None)
        wire.wait(1)
    wire.take()
    rows = [code | axis << 16 | extra[0] << 24 for axis in facts.axes for code, _, extra in facts.manual.hot_told]
    count = read(wire, facts, HISTORY)
    assert [read(wire, facts, HISTORY, sub) for sub in range(count, 0, -1)] == rows
    assert wire.download(HISTORY, 0, 1, 1) == RANGE
    assert wire.download(HISTORY, 0, 0, 1) == 0
    assert read(wire, facts, HISTORY) == 0
    for axis in facts.axes:
        assert write(wire, facts, CONTROLWORD + PROFILE * axis, 0x80) == 0
    wire.wait(2)
    wire.take()
    assert read(wire, facts, HISTORY) == 0, "the end of an error is none"


@with_history("keeps no errors")
def test_the_history_holds_as_many_as_it_has_sub_indices(wire, facts):
    wire.start()
    depth = max(facts.subs(HISTORY))
    for k in range(depth + 3):
        wire.receive(RPDO_ID, "00" if k % 2 else "00 00 00 00")
    assert read(wire, facts, HISTORY) == depth
    newest = 0x8210 if (depth + 2) % 2 else 0x8220
    assert read(wire, facts, HISTORY, 1) & 0xFFFF == newest
    assert read(wire, facts, HISTORY, depth) & 0xFFFF == (0x8210 if newest == 0x8220 and depth % 2 == 0 else 0x8220)
    wire.receive(0, "82 05")
    assert read(wire, facts, HISTORY) == depth, "a reset is no reason to forget"


@pytest.mark.parametrize("facts", [facts for facts in DEVICES if not facts.has(HISTORY)], ids=repr)
def test_a_device_without_a_history_says_so(wire, facts):
    assert wire.download(HISTORY, 0, 0, 1) == NO_OBJECT
