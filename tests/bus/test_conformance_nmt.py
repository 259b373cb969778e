"""NMT and error control of every CAN device of ours (CiA 301, 7.2.8 and 7.3.2); can_devices.py has the facts."""

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
    PROFILE_VELOCITY,
    READY,
    STATUSWORD,
    SWITCH_ON_DISABLED,
    TARGET_VELOCITY,
    VELOCITY,
    configure,
    enable,
    frame_of,
    fresh,
    others,
    read,
    request,
    silence,
    state,
    states,
    write,
)

from drive_env.canopen.nmt import NmtState

P, O, S = NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED
TO = {P: "80", O: "01", S: "02"}
END = {"80": P, "01": O, "02": S, "81": P, "82": P}
HEARTBEAT, CONSUMER, BEHAVIOUR, GUARD_TIME, LIFE_FACTOR = 0x1017, 0x1016, 0x1029, 0x100C, 0x100D
WATCH_7 = "rx 605  23 16 10 01 32 00 07 00   # node 7, 50 ms\ntx 585  60 16 10 01 00 00 00 00"
EACH_BEHAVIOUR = pytest.mark.parametrize(
    ("facts", "raw"),
    [pytest.param(facts, raw, id=f"{facts}-{raw}") for facts in DEVICES for raw in facts.manual.error_behaviour],
)
GUARDED = pytest.mark.parametrize(
    "facts",
    [pytest.param(facts, id=repr(facts), marks=[] if facts.has(GUARD_TIME) else pytest.mark.skip(
        reason=f"{facts} has no life guarding: its EDS has no 100Ch")) for facts in DEVICES],
)  # fmt: skip


@pytest.fixture
def wire(emulated, facts):
    """Node 5, pre-operational, without PDOs of its own accord."""
    made = fresh(emulated(facts.name))
    silence(made, facts)
    return made


def without_register(frame):
    """Return an emergency as a transcript has it whose error register is open."""
    text = str(frame)
    return text[:11] + ".." + text[13:]


# --- states -----------------------------------------------------------------------------------------------------------
@pytest.mark.every(5)
@EACH_DEVICE
@pytest.mark.parametrize("start", TO)
def test_commands_move_the_state(wire, facts, start):
    for address in (NODE, 0):
        for command, end in END.items():
            wire.receive(0, f"{TO[start]} {NODE:02X}")
            assert wire.node.state is start
            frames = wire.receive(0, f"{command} {address:02X}")
            assert wire.node.state is end
            assert [str(frame) for frame in frames] == (["705  00"] if command in ("81", "82") else [])
    wire.receive(0, f"{TO[start]} {NODE:02X}")
    for data in ("01 06", "01 7F", "01", "01 05 00", "", "00 05", "03 05", "83 05", "FF 00"):
        wire.play(f"rx 000  {data}")
    wire.play("rx 000  RTR")
    assert wire.node.state is start


@EACH_DEVICE
def test_what_lives_in_which_state(wire, facts):
    status = request(STATUSWORD, 0)
    wire.play(f"""
        rx 605  2B 17 10 00 64 00 00 00   # heartbeat every 100 ms
        tx 585  60 17 10 00 00 00 00 00
        wait 1 ms
        tx 705  7F                        # pre-operational: it begins at once
        rx 605  40 {status} 00 00 00 00
        tx 585  4B {status} .. .. 00 00
        rx 000  01 05                     # operational
        rx 605  40 {status} 00 00 00 00
        tx 585  4B {status} .. .. 00 00
        rx 000  02 05                     # stopped
        rx 605  40 {status} 00 00 00 00
        wait 99 ms
        wait 1 ms
        tx 705  04                        # error control lives
        rx 000  80 05
        rx 605  40 {status} 00 00 00 00
        tx 585  4B {status} .. .. 00 00
        wait 99 ms
        wait 1 ms
        tx 705  7F
    """)


# --- the drive and the state of its node ------------------------------------------------------------------------------
@EACH_AXIS
def test_stopped_takes_the_enabled_axis_to_fault_and_no_other(wire, facts, axis):
    """Manual of the TMCM-6212, section 2.2: the one link between the two automata."""
    enable(wire, facts, [axis])
    wire.start()
    wire.play("rx 000  02 05\nwait 2 ms")
    assert states(wire, facts) == others(facts, axis, FAULT, SWITCH_ON_DISABLED)
    frames = wire.receive(0, "80 05")
    assert [without_register(frame) for frame in frames] == facts.told_of("stopped", [axis]), "once it may be told"
    assert read(wire, facts, 0x1001) & 0x11 == 0x11, "generic error, and communication"
    assert write(wire, facts, CONTROLWORD + PROFILE * axis, 0x80) == 0, "the cause is gone: it can be reset"
    wire.wait(1)
    assert any(frame.data[:3] == bytes(3) for frame in wire.take()), "no error any more"
    assert states(wire, facts) == [SWITCH_ON_DISABLED] * len(facts.axes)
    assert read(wire, facts, 0x1001) == 0


@pytest.mark.every(5)
@EACH_AXIS
def test_a_turning_axis_brakes_when_its_node_is_stopped(wire, facts, axis):
    enable(wire, facts, [axis])
    assert write(wire, facts, TARGET_VELOCITY + PROFILE * axis, facts.manual.speed) == 0
    wire.wait(300)
    speed = read(wire, facts, VELOCITY + PROFILE * axis)
    assert speed > 0.5 * facts.manual.speed
    wire.receive(0, "02 05")
    wire.wait(1500)
    wire.receive(0, "80 05")
    wire.take()
    assert state(wire, axis) == FAULT
    assert abs(read(wire, facts, VELOCITY + PROFILE * axis)) < 0.1 * speed


@pytest.mark.every(7)
@EACH_AXIS
@pytest.mark.parametrize("words", [[], [6], [6, 7]])
def test_other_states_of_an_axis_do_not_care_about_stopped(wire, facts, axis, words):
    for word in words:
        assert write(wire, facts, CONTROLWORD + PROFILE * axis, word) == 0
    before = states(wire, facts)
    wire.play("""
        rx 000  02 05
        wait 2 ms
        rx 000  80 05
    """)
    assert states(wire, facts) == before


@EACH_DEVICE
def test_pre_operational_and_reset_communication_leave_the_axes_alone(wire, facts):
    enable(wire, facts)
    configure(wire, HEARTBEAT, 0, 1000, 2)
    assert write(wire, facts, PROFILE_VELOCITY, 12345) == 0
    wire.start()
    wire.receive(0, "80 05")
    wire.wait(3)
    assert states(wire, facts) == [ENABLED] * len(facts.axes)
    wire.receive(0, "82 05")
    wire.wait(3)
    wire.take()
    assert states(wire, facts) == [ENABLED] * len(facts.axes)
    assert read(wire, facts, HEARTBEAT) == facts.default(HEARTBEAT), "1000h to 1FFFh are the stored ones"
    assert read(wire, facts, PROFILE_VELOCITY) == 12345, "the others stay"


@EACH_DEVICE
def test_reset_node_restarts_all_axes_and_brings_everything_back(wire, facts):
    places = [PROFILE_VELOCITY + PROFILE * axis for axis in facts.axes]
    before = [read(wire, facts, index) for index in (*places, HEARTBEAT)]
    enable(wire, facts)
    for index in places:
        assert write(wire, facts, index, 12345) == 0
    configure(wire, HEARTBEAT, 0, 1000, 2)
    wire.play("rx 000  81 05\ntx 705  00")
    assert states(wire, facts) == [SWITCH_ON_DISABLED] * len(facts.axes)
    assert [read(wire, facts, index) for index in (*places, HEARTBEAT)] == before
    assert [read(wire, facts, MODE + PROFILE * axis) for axis in facts.axes] == [0] * len(facts.axes)


# --- heartbeat --------------------------------------------------------------------------------------------------------
@EACH_DEVICE
def test_heartbeats_keep_their_period_and_begin_with_the_boot_up_message(wire, facts):
    configure(wire, HEARTBEAT, 0, 7, 2)
    times = []
    for k in range(50):
        wire.wait(1)
        times += [k for frame in wire.take() if frame.can_id == 0x705]
    assert times == list(range(0, 50, 7))
    configure(wire, HEARTBEAT, 0, 0, 2)
    wire.play("wait 50 ms")


@EACH_BEHAVIOUR
def test_a_lost_heartbeat_does_what_1029h_says_and_is_told_once(wire, facts, raw):
    configure(wire, BEHAVIOUR, 1, raw, 1)
    last = facts.axes[-1]
    enable(wire, facts, [last])
    wire.start()
    silence(wire, facts)
    wire.play(f"""
        {WATCH_7}
        wait 200 ms                       # watching begins with the first
        rx 707  05
        wait 49 ms
        rx 707  05
        wait 50 ms
    """)
    wire.wait(1)
    told = wire.take()
    assert [without_register(frame) for frame in told] == facts.told_of("lost", [last])
    assert {frame.data[2] & 0x7F for frame in told} == {0x11}, "generic error, and communication"
    assert wire.node.state.name == facts.manual.error_behaviour[raw]
    wire.wait(20)
    assert wire.take() == [], "once"
    wire.receive(0, "80 05")
    wire.take()
    stopped = facts.manual.error_behaviour[raw] == "STOPPED"
    assert states(wire, facts) == others(facts, last, FAULT if stopped else ENABLED, SWITCH_ON_DISABLED)
    assert read(wire, facts, 0x1001) & 0x11 == 0x11
    if facts.has(0x1003):
        history = [read(wire, facts, 0x1003, sub) for sub in range(1, 1 + read(wire, facts, 0x1003))]
        codes = [int.from_bytes(frame.data[:2], "little") for frame in told]
        assert [one & 0xFFFF for one in history[::-1]] == codes, "1003h has what the emergencies told (CiA 301)"
    wire.play("rx 707  05")
    wire.wait(1)
    if stopped:
        assert read(wire, facts, 0x1001) & 0x11 == 0x11, "the axis is in fault still"
        assert write(wire, facts, CONTROLWORD + PROFILE * last, 0x80) == 0
        wire.wait(1)
    assert any(frame.data[:3] == bytes(3) for frame in wire.take()), "no error any more"
    assert read(wire, facts, 0x1001) == 0


@EACH_DEVICE
def test_an_entry_that_watches_nobody(wire, facts):
    for entry in ("00 00 07 00", "32 00 00 00", "32 00 80 00", "32 00 FF 00"):
        wire.play(f"""
            rx 605  23 16 10 01 {entry}
            tx 585  60 16 10 01 00 00 00 00
            rx 707  05
            rx 700  05
            rx 780  05
            wait 60 ms
        """)


# --- guarding ---------------------------------------------------------------------------------------------------------
@EACH_DEVICE
def test_node_guarding_alternates_and_shows_the_state(wire, facts):
    wire.play("""
        rx 705  RTR
        tx 705  7F
        rx 705  RTR
        tx 705  FF
        rx 000  01 05
        rx 705  RTR
        tx 705  05
        rx 000  02 05
        rx 705  RTR
        tx 705  84
        rx 000  80 05
        rx 705  RTR
        tx 705  7F
        rx 000  82 05                     # reset communication: toggle 0 again
        tx 705  00
        rx 705  RTR
        tx 705  7F
        rx 706  RTR
        rx 700  RTR
        rx 685  RTR
        rx 705  7F                        # no remote frame
        rx 605  2B 17 10 00 E8 03 00 00   # the heartbeat excludes guarding
        tx 585  60 17 10 00 00 00 00 00
        rx 705  RTR
        wait 1 ms
        tx 705  7F
        rx 605  2B 17 10 00 00 00 00 00
        tx 585  60 17 10 00 00 00 00 00
        rx 705  RTR
        tx 705  FF
    """)


@GUARDED
def test_life_guarding(wire, facts):
    last = facts.axes[-1]
    enable(wire, facts, [last])
    wire.start()
    wire.play("""
        rx 605  2B 0C 10 00 0A 00 00 00   # 10 ms
        tx 585  60 0C 10 00 00 00 00 00
        rx 605  2F 0D 10 00 03 00 00 00   # three times
        tx 585  60 0D 10 00 00 00 00 00
        wait 100 ms                       # it begins with the first request
        rx 705  RTR
        tx 705  05
        wait 29 ms
        rx 705  RTR
        tx 705  85
        wait 30 ms
    """)
    wire.wait(1)
    assert [str(frame) for frame in wire.take()] == [frame_of(0x8130, "11", (0, 255, 0, 0, 0), 0)]
    wire.play("""
        rx 705  RTR                       # stopped, it lives again
        tx 705  04
        rx 000  80 05
    """)
    assert state(wire, last) == FAULT
    assert write(wire, facts, CONTROLWORD + PROFILE * last, 0x80) == 0
    wire.wait(1)
    (ended,) = wire.take()
    assert ended.data[:3] == bytes(3), "no error any more"
    assert read(wire, facts, 0x1001) == 0


@pytest.mark.parametrize("facts", [facts for facts in DEVICES if not facts.has(GUARD_TIME)], ids=repr)
def test_a_device_without_life_guarding_answers_all_the_same_and_watches_nobody(wire, facts):
    assert wire.download(GUARD_TIME, 0, 10, 2) == wire.download(LIFE_FACTOR, 0, 3, 1) == 0x0602_0000
    wire.play("""
        rx 705  RTR
        tx 705  7F
        wait 500 ms
    """)
    assert read(wire, facts, 0x1001) == 0
    assert write(wire, facts, CONTROLWORD, 6) == 0
    assert state(wire, 0) == READY
