"""The finite state automaton: figure 4 and tables 141 to 149 of the TMCM-1636 firmware manual, and the option codes."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives, cia402, motion
from drive_env.cia402 import State
from drive_env.firmware.record import get_lanes, set_lanes

PP, PV, CST = 1, 3, 10
NRTSO, SOD, RTSO, SO, OE, QSA, FRA, FAULT = State

# --- the manual's tables, as text -------------------------------------------------------------------------------------
# Table 149 (188, 284: the same): bits 7 to 0 of the statusword; the second group's "_h" is a slip of the manual.
STATE_CODING = {
    NRTSO: "x0xx 0000",
    SOD: "x1xx 0000",
    RTSO: "x01x 0001",
    SO: "x01x 0011",
    OE: "x01x 0111",
    QSA: "x00x 0111",
    FRA: "x0xx 1111",
    FAULT: "x0xx 1000",
}
# Table 143 (182, 278: the same): command, bits 7, 3, 2, 1, 0 of the controlword, transitions.
COMMANDS = (
    ("shutdown", "0x110", (2, 6, 8)),
    ("switch on", "00111", (3,)),
    ("switch on & enable operation", "01111", (3, 4)),
    ("disable voltage", "0xx0x", (7, 9, 10, 12)),
    ("quick stop", "0x01x", (7, 10, 11)),
    ("disable operation", "00111", (5,)),
    ("enable operation", "01111", (4, 16)),
)
# Figure 4: the two ends of each arrow that a command makes. 15 is the fault reset's.
ARROWS = {
    2: (SOD, RTSO), 3: (RTSO, SO), 4: (SO, OE), 5: (OE, SO), 6: (SO, RTSO), 7: (RTSO, SOD), 8: (OE, RTSO),
    9: (OE, SOD), 10: (SO, SOD), 11: (OE, QSA), 12: (QSA, SOD), 15: (FAULT, SOD), 16: (QSA, OE),
}  # fmt: skip
STAY_IN_QUICK_STOP = (5, 6)  # table 115


def matches(pattern, bits):
    """Return whether bits, a string of 0 and 1, fit a pattern in which x is any."""
    return all(p in ("x", b) for p, b in zip(pattern.replace(" ", ""), bits, strict=True))


def state_of(statusword):
    """Return the one state whose coding a statusword has."""
    found = [state for state, pattern in STATE_CODING.items() if matches(pattern, f"{int(statusword) & 0xFF:08b}")]
    assert len(found) == 1, f"{statusword:04X}h is coded as {found}"
    return found[0]


def after_controlword(state, word, before, quick_stop_option):
    """Return the state that the manual's tables give at once; a ramp's end (5) is not at once."""
    if state is FAULT:
        return ARROWS[15][1] if word & ~before & 0x80 else FAULT
    bits = "".join(str(word >> bit & 1) for bit in (7, 3, 2, 1, 0))
    for _, pattern, transitions in COMMANDS:
        if not matches(pattern, bits):
            continue
        for number in transitions:
            start, end = ARROWS[number]
            allowed = number != 16 or quick_stop_option in STAY_IN_QUICK_STOP
            if start is state and allowed and number != 5:
                state = end
    return state


def after_a_moment(state, word, quick_stop_option):
    """Return the state after the automatic transitions of an axis at standstill."""
    if state is NRTSO:
        return SOD
    if state is FRA:
        return FAULT
    if state is QSA and quick_stop_option not in STAY_IN_QUICK_STOP:
        return SOD
    if state is OE and word & 0x8F == 0x07:
        return SO
    return state


# --- drives -----------------------------------------------------------------------------------------------------------
# A small DC link with a hungry bleeder follows the supply within a millisecond.
QUICK_LINK = {"stage.dc_capacitance": 5e-5, "stage.idle_current": 1.0}
WAY = {SOD: (), RTSO: (6,), SO: (6, 7), OE: (6, 7, 15), QSA: (6, 7, 15, 2), FAULT: (6, 7)}


@pytest.fixture(scope="module")
def shared():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1, parameters=QUICK_LINK) as made:
        yield made


@pytest.fixture
def drives(shared):
    """Two drives in switch on disabled, no mode selected, the supply as it should be."""
    shared.machine.supply = 24.0
    shared.machine.load_torque = 0.0
    shared.machine.set("stage.dc_capacitance", QUICK_LINK["stage.dc_capacitance"])
    shared.machine.reset()
    return shared


@pytest.fixture(scope="module")
def many():
    """One drive per pattern of the low controlword byte."""
    with EmulatedDrives(load="inertia", num_machines=256, num_threads=1, parameters=QUICK_LINK) as made:
        yield made


def go_to(drives, state, quick_stop_option=6):
    """Take axes at standstill to a state: by the bus where there is a way, else by the record."""
    drives.write(0x605A, quick_stop_option)
    for word in WAY.get(state, ()):
        drives.write(0x6040, word)
    if state is FAULT:
        set_supply(drives, 5.0)
        drives.write(0x6040, 0)
        set_supply(drives, 24.0)
        drives.emergencies()
    elif state in (NRTSO, FRA):
        # A drive leaves these two by itself, within a millisecond.
        set_lanes(drives.inside.records, "fsa", np.full(drives.num_axes, int(state)))
        set_lanes(drives.inside.records, "drive_function", np.full(drives.num_axes, 1.0 if state is FRA else 0.0))
        set_lanes(drives.inside.records, "stopping", np.full(drives.num_axes, 1 if state is FRA else 0))
        return
    assert {state_of(word) for word in drives.read(0x6041)} == {state}


def set_supply(drives, volts, patience=1.0):
    """Change the supply and let the voltage at the bridge get there: it is a capacitor's."""
    drives.machine.supply = volts
    goal = np.broadcast_to(np.asarray(volts, float), (drives.num_axes,))
    waited = 0.0
    while waited < patience:
        drives.advance(0.002)
        waited += 0.002
        if (np.abs(get_lanes(drives.inside.records, "u_dc", drives.num_axes) - goal) < 1.0).all():
            break
    drives.advance(0.002)


def states(drives):
    return [state_of(word) for word in drives.read(0x6041)]


def statusword(drives):
    return int(drives.read(0x6041)[0])


# --- row by row -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [0, PP, PV, CST])
def test_transition_5_of_an_axis_at_standstill(drives, mode):
    if mode:
        drives.write(0x6060, mode)
    go_to(drives, OE)
    drives.advance(0.005)
    drives.write(0x6040, 0x07)
    drives.advance(0.020)
    assert states(drives) == [SO, SO]


def test_transitions_0_and_1_come_with_power(drives):
    go_to(drives, OE)
    drives.machine.power_cycle()
    assert states(drives) == [SOD, SOD]
    go_to(drives, NRTSO)
    drives.advance(0.001)
    assert states(drives) == [SOD, SOD]


# --- all states x all patterns ----------------------------------------------------------------------------------------
@pytest.mark.every(7)
@pytest.mark.parametrize("high", [0x0000, 0xFF00])
@pytest.mark.parametrize("before", [0x0000, 0x0080])
@pytest.mark.parametrize(("start", "option"), [*((s, 2) for s in State), *((s, 5) for s in (OE, QSA))])
@pytest.mark.parametrize("mode", [0, PP, PV, CST])  # tables 143, 182 and 278 are the same
def test_every_pattern_in_every_state(many, start, option, before, high, mode):
    many.machine.reset()
    if mode:
        many.write(0x6060, mode)
    go_to(many, start, option)
    set_lanes(many.inside.records, "controlword", np.full(256, before))
    low = np.arange(256)
    many.write(0x6040, low | high)
    expected = [after_controlword(start, int(word), before, option) for word in low]
    assert states(many) == expected
    many.advance(0.003)
    settled = [after_a_moment(state, int(word), option) for state, word in zip(expected, low, strict=True)]
    assert states(many) == settled


def test_the_oracle_itself_moves():
    # A table misread as "nothing matches" would make the comparison empty.
    ends = [after_controlword(s, w, 0, 6) for s in State for w in range(256)]
    moves = sum(end is not s for end, s in zip(ends, (s for s in State for _ in range(256)), strict=True))
    # 2: 16 words of bits 6, 5, 4, 3; 3, 4, 5: 8; 6, 8: 16; disable voltage 64; quick stop 32; 16: 8; 15: 128.
    assert moves == 16 + (8 + 8 + 64 + 32) + (8 + 16 + 64 + 32) + (16 + 64 + 32) + (64 + 8) + 128


# --- statusword -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("state", [SOD, RTSO, SO, OE, QSA, FAULT])
def test_statusword_of_a_state(drives, state):
    go_to(drives, state)
    word = statusword(drives)
    assert state_of(word) is state
    assert word & 0x0010, "voltage enabled: the supply is there"
    assert word & 0x0200, "remote: this drive is commanded by the bus"
    assert not word & 0x2080, "no warning, no following error bit"
    assert not word & 0xC000, "the motor stands still"


def test_bit_4_falls_with_the_supply(drives):
    set_supply(drives, [24.0, 3.0])
    assert [bool(word & 0x0010) for word in drives.read(0x6041)] == [True, False]
    assert states(drives) == [SOD, SOD], "voltage is watched once the drive is switched on"


def test_bits_14_and_15_tell_motion_and_direction(drives):
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, [500_000, -500_000])
    drives.advance(0.3)
    assert [int(word) >> 14 for word in drives.read(0x6041)] == [0b01, 0b11]
    drives.write(0x60FF, 0)
    drives.advance(0.5)
    assert [int(word) >> 14 for word in drives.read(0x6041)] == [0, 0]


# --- ramps ------------------------------------------------------------------------------------------------------------
SPEED = 600_000  # pps
SLOW_DOWN, QUICK = 3_000_000, 12_000_000  # pps^2: 200 and 50 ms
CST_TORQUE = 300  # mA
LONGEST_STOP = 1.0  # s after the end of the ramp: longer than that no stop holds the power
STANDS = 65_536  # pps: 60 rpm, one encoder count per window is 73


def run(drives, mode):
    """Bring both axes to SPEED, or in cst to some speed, with the two ramps of the option codes set apart."""
    motion.enable(drives, mode=mode)
    drives.write(0x6081, SPEED)
    drives.write(0x6085, QUICK)
    if mode == "pp":
        drives.write(0x6084, SLOW_DOWN)
        motion.start_move(drives, 10_000_000)
        drives.advance(0.4)
    elif mode == "pv":
        drives.write(0x6083, SLOW_DOWN)
        drives.write(0x60FF, SPEED)
        drives.advance(0.4)
    else:
        drives.write(0x6084, SLOW_DOWN)
        drives.write(0x6071, CST_TORQUE)
        drives.advance(0.300)
    assert (drives.read(0x606C) > SPEED / 3).all()
    assert states(drives) == [OE, OE]


def braking(trace, mode):
    """Return the deceleration [pps^2] of axis 0 from 6062h, in cst, which has no position demand, from 606Ch."""
    if mode == "cst":
        speed = trace[0x606C][:, 0].astype(float)
    else:
        speed = np.gradient(trace[0x6062][:, 0].astype(float), trace.t)
    # Below 60 % the velocity loop, which the stop has just closed in cst, follows its ramp.
    rows = slice(np.argmax(speed < 0.6 * speed[0]), np.argmax(speed < 0.15 * speed[0]))
    assert rows.stop - rows.start > 10
    return -np.polyfit(trace.t[rows], speed[rows], 1)[0]


RECORDED = (0x6041, 0x6062, 0x606C)
RAMPS = {1: SLOW_DOWN, 2: QUICK, 5: SLOW_DOWN, 6: QUICK}


@pytest.mark.every(5)
@pytest.mark.parametrize("mode", ["pp", "pv", "cst"])
@pytest.mark.parametrize("option", [1, 2, 5, 6])
def test_605ah_chooses_ramp_and_end_of_the_quick_stop(drives, option, mode):
    drives.write(0x605A, option)
    run(drives, mode)
    drives.write(0x6040, 0x02)
    assert states(drives) == [QSA, QSA]
    trace = drives.record(RECORDED, duration=0.7)
    assert braking(trace, mode) == pytest.approx(RAMPS[option], rel=0.1 if mode == "cst" else 0.02)
    seen = [state_of(word) for word in trace[0x6041][:, 0]]
    if option in STAY_IN_QUICK_STOP:
        assert set(seen) == {QSA}
        assert abs(int(drives.read(0x606C)[0])) < 0.03 * SPEED
        drives.write(0x6040, 0x0F)
        assert states(drives) == [OE, OE], "transition 16"
    else:
        # 12 comes once the ramp has ended and the motor stands.
        end = seen.index(SOD)
        assert seen == [QSA] * end + [SOD] * (len(seen) - end)
        ramp = float(trace[0x606C][0, 0]) / RAMPS[option]
        assert 0.9 * ramp - 0.005 < end * 1e-3 < ramp + 0.300
        assert abs(int(trace[0x606C][end, 0])) < STANDS


@pytest.mark.parametrize("mode", ["pp", "pv"])
def test_a_quick_stop_ends_with_the_motor_stopped(drives, mode):
    # With the commissioned values of ramps and gains: power taken from a motor that still runs is no stop.
    motion.enable(drives, mode=mode)
    if mode == "pp":
        motion.start_move(drives, 20_000_000)
    else:
        drives.write(0x60FF, 2_000_000)
    drives.advance(0.4)
    speed = drives.machine.rotor_speed[0]
    drives.write(0x6040, 0x02)
    for _ in range(500):
        if state_of(statusword(drives)) is SOD:
            break
        drives.advance(0.001)
    assert state_of(statusword(drives)) is SOD
    assert abs(drives.machine.rotor_speed[0]) < 0.05 * speed


def test_605bh_shutdown_cuts_the_stage(drives):
    assert drives.read(0x605B).tolist() == [0, 0]
    run(drives, "pv")
    drives.write(0x6040, 0x06)
    assert states(drives) == [RTSO, RTSO]
    drives.advance(0.001)
    assert drives.machine.motor_torque.tolist() == [0.0, 0.0]
    assert (drives.read(0x606C) > 0.9 * SPEED).all(), "the axis coasts"


@pytest.mark.parametrize("mode", ["pp", "pv", "cst"])
def test_605ch_disable_operation_takes_the_slow_down_ramp(drives, mode):
    assert drives.read(0x605C).tolist() == [1, 1]
    run(drives, mode)
    drives.write(0x6040, 0x07)
    trace = drives.record(RECORDED, duration=0.7)
    assert braking(trace, mode) == pytest.approx(SLOW_DOWN, rel=0.1 if mode == "cst" else 0.02)
    seen = [state_of(word) for word in trace[0x6041][:, 0]]
    end = seen.index(SO)
    assert seen == [OE] * end + [SO] * (len(seen) - end)


@pytest.mark.parametrize(
    ("word", "end"),
    [(0x06, RTSO), (0x02, SOD), (0x0F, OE), (0x07, SO)],  # 6, 10 and 4 follow 5
)
def test_other_commands_wait_for_the_end_of_transition_5(drives, word, end):
    run(drives, "pv")
    drives.write(0x6040, 0x07)
    drives.advance(0.050)
    drives.write(0x6040, word)
    assert states(drives) == [OE, OE]
    drives.advance(0.100)
    assert states(drives) == [OE, OE], "the ramp of 200 ms runs on"
    drives.advance(0.100)
    assert states(drives) == [end, end]


def test_disable_voltage_does_not_wait(drives):
    run(drives, "pv")
    drives.write(0x6040, 0x07)
    drives.advance(0.050)
    drives.write(0x6040, 0x00)
    assert states(drives) == [SOD, SOD]
    drives.advance(0.001)
    assert drives.machine.motor_torque.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("mode", ["pp", "pv", "cst"])
def test_605dh_halt_stops_and_resumes(drives, mode):
    assert drives.read(0x605D).tolist() == [1, 1]
    run(drives, mode)
    drives.write(0x6040, 0x010F)
    trace = drives.record(RECORDED, duration=0.7)
    assert braking(trace, mode) == pytest.approx(SLOW_DOWN, rel=0.1 if mode == "cst" else 0.02)
    assert {state_of(word) for word in trace[0x6041][:, 0]} == {OE}
    assert np.abs(drives.read(0x606C)).max() < 0.03 * SPEED
    if mode != "cst":
        assert (drives.read(0x6041) & 0x0400).all(), "CiA 402: with halt, bit 10 tells that the axis has stopped"
    drives.write(0x6040, 0x000F)
    drives.advance(0.4 if mode != "cst" else 0.150)
    if mode == "cst":
        assert (drives.read(0x606C) > SPEED / 3).all()
    else:
        np.testing.assert_allclose(drives.read(0x606C), SPEED, rtol=0.05)
    if mode == "pp":
        motion.wait_for(drives, cia402.TARGET_REACHED, 30.0, "target reached")
        assert drives.read(0x6062).tolist() == [10_000_000, 10_000_000], "the move of before the halt"


# --- faults -----------------------------------------------------------------------------------------------------------
def test_605eh_a_following_error_takes_the_quick_stop_ramp_then_faults(drives):
    assert drives.read(0x605E).tolist() == [2, 2]
    run(drives, "pp")
    drives.write(0x6065, 200, where=np.array([True, False]))  # the axis lags v/k_v, some 19,000 increments
    trace = drives.record(RECORDED, duration=0.5)
    seen = [state_of(word) for word in trace[0x6041][:, 0]]
    first, end = seen.index(FRA), seen.index(FAULT)
    assert first <= 2
    assert seen == [OE] * first + [FRA] * (end - first) + [FAULT] * (len(seen) - end)
    assert braking(trace, "pp") == pytest.approx(QUICK, rel=0.02)
    assert SPEED / QUICK - 0.002 < (end - first) * 1e-3 < SPEED / QUICK + 0.300
    assert abs(int(trace[0x606C][end, 0])) < STANDS
    assert {state_of(word) for word in trace[0x6041][:, 1]} == {OE}, "the other axis goes on"
    assert [(e.axis, e.code, e.error_register, e.extra) for e in drives.emergencies()] == [
        (0, 0x8611, 0x21, (0, 0, 0, 0, 0))
    ]
    assert drives.read(0x1001).tolist() == [0x21, 0]
    drives.write(0x6040, 0x00)
    drives.write(0x6040, 0x80)
    assert states(drives)[0] is SOD
    assert drives.read(0x1001).tolist() == [0, 0]


@pytest.mark.parametrize(
    ("supply", "code", "register", "flag"),
    [(5.0, 0xFF00, 0x05, 1 << 1), (65.0, 0x3210, 0x05, 1 << 2)],  # table 303; table 85; 3210h is CiA's
)
def test_a_wrong_supply_cuts_the_stage_at_once(drives, supply, code, register, flag):
    run(drives, "pv")
    drives.machine.supply = [24.0, supply]
    trace = drives.record([0x6041, 0x1001, 0x2101], duration=0.6)
    seen = [state_of(word) for word in trace[0x6041][:, 1]]
    first = seen.index(FAULT)
    assert seen == [OE] * first + [FAULT] * (len(seen) - first), "no ramp: the stage is cut"
    assert {state_of(word) for word in trace[0x6041][:, 0]} == {OE}
    assert drives.machine.motor_torque[1] == 0.0
    assert drives.machine.motor_torque[0] != 0.0
    assert trace[0x1001][:, 1].tolist() == [0] * first + [register] * (len(seen) - first)
    assert trace[0x1001][:, 0].tolist() == [0] * len(seen)
    assert (trace[0x2101][-1] & 0b111).tolist() == [0, flag]
    # Bit 4, voltage enabled, falls with the fault of a missing voltage, in the same millisecond.
    present = (trace[0x6041][:, 1] & 0x0010) != 0
    assert present.tolist() == [supply > 24.0 or k < first for k in range(len(seen))]
    messages = drives.emergencies()
    assert [(e.axis, e.code, e.error_register, e.extra) for e in messages] == [(1, code, register, (0, 0, 0, 0, 0))]
    assert drives.emergencies() == [], "each is told once"


def test_15_needs_the_cause_gone_and_the_edge(drives):
    go_to(drives, OE)
    set_supply(drives, 5.0)
    drives.write(0x6040, 0x80)
    assert states(drives) == [FAULT, FAULT], "the cause is there"
    set_supply(drives, 24.0)
    assert states(drives) == [FAULT, FAULT], "bit 7 is set, but it is no edge"
    drives.write(0x6040, 0x80)
    assert states(drives) == [FAULT, FAULT], "written again it is none either"
    drives.write(0x6040, 0x00)
    assert states(drives) == [FAULT, FAULT], "a falling edge is none"
    drives.write(0x6040, 0x80)
    assert states(drives) == [SOD, SOD]
    assert drives.read(0x1001).tolist() == [0, 0]
    drives.write(0x6040, 0x06)
    assert states(drives) == [RTSO, RTSO], "and the automaton goes on from there"


def test_an_emergency_keeps_the_error_register_of_its_moment(drives):
    go_to(drives, OE)
    set_supply(drives, [5.0, 24.0])
    set_supply(drives, 24.0)
    motion.reset_fault(drives)
    # Fetched late: the fault is reset by now, but the first message left the drive while it was there.
    assert [(e.axis, e.code, e.error_register) for e in drives.emergencies()] == [(0, 0xFF00, 0x05), (0, 0x0000, 0x00)]


def test_a_fault_during_the_disable_ramp_wins(drives):
    run(drives, "pv")
    drives.write(0x6040, 0x07)
    drives.advance(0.020)
    set_supply(drives, 65.0)
    assert states(drives) == [FAULT, FAULT]
    drives.advance(0.300)
    assert states(drives) == [FAULT, FAULT]


def test_a_wrong_supply_during_a_fault_reaction_cuts_it(drives):
    run(drives, "pp")
    drives.write(0x6065, 200)
    drives.advance(0.010)
    assert states(drives) == [FRA, FRA]
    set_supply(drives, 65.0)
    assert states(drives) == [FAULT, FAULT]
    assert [e.code for e in drives.emergencies()] == [0x8611, 0x3210] * 2
    assert drives.read(0x1001).tolist() == [0x25, 0x25]


# --- a stop that never comes to rest --------------------------------------------------------------------------------
@pytest.mark.parametrize("option", [1, 2, 5, 6])
def test_a_quick_stop_that_does_not_come_to_rest_is_cut_a_second_after_its_ramp(drives, option):
    """Without gains nothing brakes: 605Ah = 1 and 2 end without power; 5 and 6 stay, as they are told to."""
    drives.write(0x605A, option)
    drives.write(0x6065, 2**31 - 1)
    run(drives, "pv")
    for sub in (1, 2):
        drives.write((0x2042, sub), 0)
    drives.write(0x6040, 0x02)
    trace = drives.record(RECORDED, duration=SPEED / RAMPS[option] + LONGEST_STOP + 0.1)
    seen = [state_of(word) for word in trace[0x6041][:, 0]]
    if option in STAY_IN_QUICK_STOP:
        assert set(seen) == {QSA}
        return
    end = seen.index(SOD)
    assert seen == [QSA] * end + [SOD] * (len(seen) - end)
    assert end * 1e-3 == pytest.approx(SPEED / RAMPS[option] + LONGEST_STOP, abs=0.05)
    assert abs(int(trace[0x606C][end, 0])) > STANDS


def test_a_fault_reaction_that_does_not_come_to_rest_is_cut_a_second_after_its_ramp(drives):
    drives.machine.set("stage.dc_capacitance", 0.1)
    run(drives, "pp")
    drives.write(0x6065, 200)
    drives.machine.load_torque = -0.30
    trace = drives.record(RECORDED, duration=SPEED / QUICK + LONGEST_STOP + 0.1)
    drives.machine.load_torque = 0.0
    seen = [state_of(word) for word in trace[0x6041][:, 0]]
    first, end = seen.index(FRA), seen.index(FAULT)
    assert (end - first) * 1e-3 == pytest.approx(SPEED / QUICK + LONGEST_STOP, abs=0.05)
    assert abs(int(trace[0x606C][end, 0])) > STANDS
