"""Faults by their real causes, and the way back: emergencies (table 303), limits of travel, inputs, brake chopper.

Machine 0 of two has the cause; machine 1 is its healthy neighbour.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.firmware.record import get_lanes, set_lanes

FIRST = np.array([True, False])
REV = 65536  # increments per revolution
FAST = 500_000  # pps: 458 rpm
QUICK = 65_536_000  # 6085h of the preset, pps^2; twice 6083h and 6084h

STATE, FAULT, REACTION_ACTIVE, ENABLED = 0x4F, 0x08, 0x0F, 0x07
WARNING, INTERNAL_LIMIT = 1 << 7, 1 << 11
# Table 85: bits of 2101h that tell a fault.
FAULT_FLAGS = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 3 | 1 << 5 | 1 << 6 | 1 << 7 | 1 << 12 | 1 << 17
# Table 9: bits of 1001h.
GENERIC, CURRENT, VOLTAGE, TEMPERATURE, PROFILE, MANUFACTURER = 0x01, 0x02, 0x04, 0x08, 0x20, 0x80

CUT, RAMP = "stage cut at once", "fault reaction active on the ramp of 6085h"

Drives = EmulatedDrives
Step = Callable[[Drives], None]


def state(drives: Drives, machine: int = 0) -> int:
    return int(drives.read(0x6041)[machine]) & STATE


def bits(drives: Drives, mask: int, machine: int = 0) -> int:
    return int(drives.read(0x6041)[machine]) & mask


def messages(drives: Drives) -> list[tuple[int, int, tuple[int, ...]]]:
    return [(message.axis, message.code, message.extra) for message in drives.emergencies()]


def reset_edge(drives: Drives) -> None:
    drives.write(0x6040, 0x00, where=FIRST)
    drives.write(0x6040, 0x80, where=FIRST)
    drives.advance(0.002)
    drives.write(0x6040, 0x00, where=FIRST)


def turn(drives: Drives) -> None:
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, FAST)
    drives.advance(0.3)


def set_first(name: str, value: float) -> Step:
    return lambda drives: drives.machine.set(name, value, FIRST)


def nothing(drives: Drives) -> None:
    pass


# --- causes ---------------------------------------------------------------------------------------------------------
def load_motor(drives: Drives) -> None:
    """A phase without current is only seen where current is asked for."""
    turn(drives)
    drives.machine.set("load.breakaway", 0.04)
    drives.machine.set("load.coulomb", 0.04)
    drives.advance(0.2)


def short_winding(drives: Drives) -> None:
    """A short circuit in the motor leaves a hundredth of the winding; the current loop was tuned for all of it."""
    for name in ("motor.R_s", "motor.L_d", "motor.L_q"):
        drives.machine.set(name, 0.01 * drives.machine.parameters[name], FIRST)


def mend_winding(drives: Drives) -> None:
    for name in ("motor.R_s", "motor.L_d", "motor.L_q"):
        drives.machine.set(name, float(drives.machine.parameters[name][1]), FIRST)


def short_with_cable_off(cable: str) -> Step:
    """With its cable off one phase is out of the short: what flows, flows through the other that is measured."""

    def apply(drives: Drives) -> None:
        drives.machine.set(cable, 1.0, FIRST)
        short_winding(drives)

    return apply


def mend_all(drives: Drives) -> None:
    drives.machine.set("motor.open_a", 0.0, FIRST)
    drives.machine.set("motor.open_b", 0.0, FIRST)
    mend_winding(drives)


def supply(volts: float) -> Step:
    def apply(drives: Drives) -> None:
        drives.machine.supply = np.array([volts, 24.0])

    return apply


def enable_input(closed: bool) -> Step:
    def apply(drives: Drives) -> None:
        drives.machine.enable_input = np.array([closed, True])

    return apply


def turn_by_halls(drives: Drives) -> None:
    drives.write("Commutation Mode", 2)
    turn(drives)


def heat_stage(drives: Drives) -> None:
    """Twenty times the stage's resistance and hardly any mass: the motor's own current brings it above 100 degC."""
    drives.machine.set("stage.thermal_time", 0.05, FIRST)
    drives.machine.set("stage.thermal_resistance", 300.0, FIRST)
    drives.machine.set("stage.on_resistance", 0.08, FIRST)


def hold_stage_hot(drives: Drives) -> None:
    """Surroundings of 120 degC keep it hot without current."""
    heat_stage(drives)
    drives.machine.set("motor.ambient", 120.0, FIRST)


def cool_stage(drives: Drives) -> None:
    drives.machine.set("motor.ambient", 25.0, FIRST)
    drives.machine.set("stage.on_resistance", 0.004, FIRST)
    drives.advance(0.3)


def spin_inertia(drives: Drives) -> None:
    drives.machine.set("load.inertia", 2e-3, FIRST)
    motion.enable(drives, mode="pv")
    drives.write(0x6083, 2_000_000)  # hardly any overshoot on the way up
    drives.write(0x60FF, 2_000_000)
    drives.advance(1.8)


def brake_hard(drives: Drives) -> None:
    """The kinetic energy of 2 g m^2 at 1830 rpm has no way through the diode of the supply."""
    drives.write(0x6083, 200_000_000)
    drives.write(0x60FF, [0, 2_000_000])


def brake_by_chopper(drives: Drives) -> None:
    drives.write("Brake Chopper.Voltage", 550)
    drives.write("Brake Chopper.Enable", 1)


def block(drives: Drives) -> None:
    drives.machine.set("load.breakaway", 50.0, FIRST)
    drives.machine.set("load.coulomb", 50.0, FIRST)


def unblock(drives: Drives) -> None:
    drives.machine.set("load.coulomb", 2e-3, FIRST)
    drives.machine.set("load.breakaway", 3e-3, FIRST)


def turn_with_window(drives: Drives) -> None:
    drives.write("Following error window", 30_000)
    turn(drives)


def stand_ready(drives: Drives) -> None:
    drives.write("ABN Encoder Settings.Encoder Init Mode", 0)  # estimate offset: turns the motor


def block_and_enable(drives: Drives) -> None:
    block(drives)
    motion.enable(drives, mode="pv")


def turn_without_window(drives: Drives) -> None:
    drives.write("Following error window", 0)
    turn(drives)


def block_for_a_minute(drives: Drives) -> None:
    """45 A of 42 A nominal last for 10 s / ((45 / 42)^2 - 1) = 67.6 s."""
    block(drives)
    drives.advance(67.0)


class Row(NamedTuple):
    """A fault: code and first two additional bytes (table 303, or CiA's code), 1001h, 2101h, and how it comes about."""

    code: int
    extra: tuple[int, int]
    register: int
    flag: int
    reaction: str
    start: Step
    cause: Step
    remove: Step
    within: float  # s from the cause to the end of the reaction
    stays: bool  # the drive sees the cause while its stage is off: then a reset has no effect
    options: dict[str, Any] = {}  # noqa: RUF012


ROWS = {
    "open load A": Row(
        0x1000, (1, 0), GENERIC | MANUFACTURER, 1 << 6, RAMP,
        load_motor, set_first("motor.open_a", 1.0), set_first("motor.open_a", 0.0), 1.0, False,
    ),
    "open load B": Row(
        0x1000, (2, 0), GENERIC | MANUFACTURER, 1 << 6, RAMP,
        load_motor, set_first("motor.open_b", 1.0), set_first("motor.open_b", 0.0), 1.0, False,
    ),
    "short in the stage": Row(
        0x2310, (0, 0), GENERIC | CURRENT, 1 << 0, CUT,
        turn, set_first("stage.short_conductance", 10.0), set_first("stage.short_conductance", 0.0), 0.01, True,
    ),
    "hard short in the stage": Row(
        0x2310, (0, 0), GENERIC | CURRENT, 1 << 0, CUT,
        turn, set_first("stage.short_conductance", 1000.0), set_first("stage.short_conductance", 0.0), 0.01, True,
    ),
    "short in the motor, phase B": Row(
        0x2311, (0, 0), GENERIC | CURRENT, 1 << 0, CUT,
        turn, short_with_cable_off("motor.open_a"), mend_all, 0.02, False,
    ),
    "short in the motor, phase A": Row(
        0x2312, (0, 0), GENERIC | CURRENT, 1 << 0, CUT,
        turn, short_with_cable_off("motor.open_b"), mend_all, 0.02, False,
    ),
    "supply too high": Row(
        0x3210, (0, 0), GENERIC | VOLTAGE, 1 << 2, CUT,
        turn, supply(65.0), supply(24.0), 0.1, True,
    ),
    "braking a big inertia": Row(
        0x3210, (0, 0), GENERIC | VOLTAGE, 1 << 2, CUT,
        spin_inertia, brake_hard, brake_by_chopper, 0.5, False, {"motor": "class_1kw"},
    ),
    "hot stage": Row(
        0x4310, (2, 0), GENERIC | TEMPERATURE, 1 << 3, CUT,
        load_motor, hold_stage_hot, cool_stage, 1.0, True,
    ),
    "enable input open": Row(
        0x5441, (0, 255), GENERIC | MANUFACTURER, 1 << 12, CUT,
        turn, enable_input(False), enable_input(True), 0.002, True,
    ),
    "halls disconnected": Row(
        0x7300, (0, 0), GENERIC | PROFILE, 1 << 5, CUT,
        turn_by_halls, set_first("motor.hall_broken", 1.0), set_first("motor.hall_broken", 0.0), 0.002, True,
    ),
    "blocked while the encoder is initialised": Row(
        0x7305, (0, 0), GENERIC | PROFILE, 1 << 7, CUT,
        stand_ready, block_and_enable, unblock, 2.0, False,
    ),
    "blocked rotor": Row(
        0x8611, (0, 0), GENERIC | PROFILE, 0, RAMP,
        turn_with_window, block, unblock, 0.3, False,
    ),
    "supply too low": Row(
        0xFF00, (0, 0), GENERIC | VOLTAGE, 1 << 1, CUT,
        turn, supply(5.0), supply(24.0), 0.5, True,
    ),
    "blocked at more than nominal current": Row(
        0x2350, (0, 0), GENERIC | CURRENT, 1 << 17, RAMP,
        turn_without_window, block_for_a_minute, unblock, 3.0, False, {"motor": "class_1kw", "ideal": True},
    ),
}  # fmt: skip


def until_fault(drives: Drives, row: Row) -> list[int]:
    """Let time pass until machine 0 is in fault; return its statusword of every millisecond."""
    words: list[int] = []
    while not words or words[-1] & STATE != FAULT:
        assert len(words) * 0.001 <= row.within + 1e-9, "no fault"
        drives.advance(0.001)
        words.append(int(drives.read(0x6041)[0]))
    return words


@pytest.mark.every(2)
@pytest.mark.parametrize("name", ROWS)
def test_fault_comes_by_its_cause_and_goes_after_it(name):
    row = ROWS[name]
    with EmulatedDrives(load="inertia", num_machines=2, **row.options) as drives:
        row.start(drives)
        assert messages(drives) == []
        assert drives.read(0x1001).tolist() == [0, 0]
        assert drives.read(0x2101)[0] & FAULT_FLAGS == 0
        row.cause(drives)
        words = until_fault(drives, row)

        # What it did: statusword, 1001h, 2101h, one emergency; the stage is off.
        assert (REACTION_ACTIVE in [word & STATE for word in words]) == (row.reaction == RAMP)
        assert drives.machine.motor_torque[0] == 0.0
        assert get_lanes(drives.inside.records, "i_q", 1)[0] == 0.0
        assert drives.read(0x1001).tolist() == [row.register, 0]
        assert drives.read(0x2101)[0] & FAULT_FLAGS == row.flag
        assert drives.read(0x2101)[1] & FAULT_FLAGS == 0
        drives.advance(0.05)
        found = [m for m in drives.emergencies() if m.name != "overtemperature_warning"]
        assert [(m.axis, m.code, m.error_register, m.extra) for m in found] == [
            (0, row.code, row.register, (*row.extra, 0, 0, 0))
        ]
        assert state(drives, 1) == ENABLED

        # While the cause is there a reset has no effect; one that needs current to be seen comes back with it.
        if row.stays:
            reset_edge(drives)
            assert state(drives) == FAULT
            assert drives.read(0x1001)[0] == row.register
            assert messages(drives) == []
        elif row.cause is not brake_hard:
            reset_edge(drives)
            assert messages(drives) == [(0, 0x0000, (0, 0, 0, 0, 0))]
            motion.enable(drives, where=FIRST)
            drives.write(0x60FF, FAST)
            until_fault(drives, row)
            assert messages(drives) == [(0, row.code, (*row.extra, 0, 0, 0))]

        # The cause gone, the drive stays in fault until the edge.
        row.remove(drives)
        drives.advance(0.3)
        assert state(drives) == FAULT
        assert messages(drives) == []
        motion.reset_fault(drives, where=FIRST)
        assert [(m.code, m.error_register, m.extra) for m in drives.emergencies()] == [(0, 0, (0, 0, 0, 0, 0))]
        drives.advance(0.001)
        assert drives.read(0x1001)[0] == 0
        assert drives.read(0x2101)[0] & FAULT_FLAGS == 0

        # And turns again.
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, FAST)
        drives.advance(2.0)
        assert np.all(abs(drives.read(0x606C) - FAST) < 60_000)
        assert messages(drives) == []


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.reaction == CUT and row.start is turn])
def test_stage_is_cut_within_a_millisecond_and_the_rotor_coasts(name):
    row = ROWS[name]
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        row.start(drives)
        row.cause(drives)
        until_fault(drives, row)
        speed = drives.machine.rotor_speed[0]
        torques = []
        for _ in range(20):
            drives.advance(0.001)
            torques.append(drives.machine.motor_torque[0])
        assert not np.any(torques)
        # Friction alone: less than 1 % of 6085h's deceleration.
        assert abs(drives.machine.rotor_speed[0]) > 0.5 * abs(speed)


@pytest.mark.parametrize("name", ["short in the stage", "enable input open", "blocked rotor"])
def test_neighbour_does_not_notice(name):
    row = ROWS[name]
    traces = []
    for cause in (row.cause, nothing):
        with EmulatedDrives(load="inertia", num_machines=2) as drives:
            row.start(drives)
            cause(drives)
            trace = drives.record([0x6041, 0x6064, 0x606C, 0x6077, 0x2101], 0.3)
            traces.append([trace[key][:, 1] for key in (0x6041, 0x6064, 0x606C, 0x6077, 0x2101)])
    assert np.array_equal(traces[0], traces[1])


def test_no_fault_before_somebody_switches_on():
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        drives.machine.enable_input = np.array([False, True])
        drives.machine.supply = np.array([5.0, 24.0])
        drives.advance(0.5)
        assert state(drives) == 0x40
        assert messages(drives) == []
        drives.write(0x6040, 0x06)
        drives.advance(0.002)
        drives.write(0x6040, 0x07)
        drives.advance(0.002)
        assert state(drives) == FAULT
        assert len(messages(drives)) == 1


# --- warning --------------------------------------------------------------------------------------------------------
def test_pre_warning_sets_bit_7_only():
    """Table 303, 4310h 1: the stage is warmed by its own current to between 85 and 100 degC; nothing stops."""
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        load_motor(drives)
        heat_stage(drives)
        current = abs(float(np.mean(drives.record([0x6077], 0.1)[0x6077][:, 0]))) * 1e-3
        drives.machine.set("stage.thermal_resistance", (92.0 - 25.0) / (1.5 * 0.08 * current**2), FIRST)
        drives.advance(0.6)
        assert 85.0 < drives.machine.temperatures[1][0] < 100.0
        assert [(m.axis, m.code, m.error_register, m.extra) for m in drives.emergencies()] == [
            (0, 0x4310, 0, (1, 0, 0, 0, 0))
        ]
        assert (bits(drives, WARNING), bits(drives, WARNING, 1)) == (WARNING, 0)
        assert state(drives) == ENABLED
        assert drives.read(0x1001)[0] == 0
        assert drives.read(0x2101)[0] & FAULT_FLAGS == 0
        assert abs(drives.read(0x606C)[0] - FAST) < 60_000
        # Gone with the heat, without a reset.
        cool_stage(drives)
        assert bits(drives, WARNING) == 0
        assert messages(drives) == []


def test_a_warning_that_lasts_is_sent_once():
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        drives.machine.set_temperatures(25.0, [92.0, 25.0])
        for _ in range(3):
            motion.enable(drives)
            drives.advance(0.02)
            motion.disable(drives)
            drives.advance(0.02)
        assert drives.machine.temperatures[1][0] > 85.0
        assert messages(drives) == [(0, 0x4310, (1, 0, 0, 0, 0))]


def test_2101h_tells_what_is_wrong_now_not_what_came_first():
    """Table 85 is a status: a second cause shows, and the first does no longer once it is gone."""
    undervoltage, emergency_stop = 1 << 1, 1 << 12
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        turn(drives)
        enable_input(False)(drives)
        drives.advance(0.01)
        assert drives.read(0x2101)[0] & FAULT_FLAGS == emergency_stop
        drives.machine.supply = [5.0, 24.0]
        drives.advance(0.5)
        assert drives.read(0x2101)[0] & FAULT_FLAGS == emergency_stop | undervoltage
        enable_input(True)(drives)
        drives.advance(0.01)
        assert drives.read(0x2101)[0] & FAULT_FLAGS == undervoltage
        assert state(drives) == FAULT
        drives.machine.supply = 24.0
        drives.advance(0.5)
        assert drives.read(0x2101)[0] & FAULT_FLAGS == 0
        assert state(drives) == FAULT
        assert [code for _, code, _ in messages(drives)] == [0x5441]


# --- limits of travel -----------------------------------------------------------------------------------------------
class Limit(NamedTuple):
    """A limit of travel: first additional byte of FF01h (table 303), load, side, and where it stands [inc]."""

    extra: int
    load: str
    side: int
    edge: int


TURNS_TO_SWITCH = 0.23 / (2.0 * np.pi * 0.006366)  # pulley of the belt axis
NO_ERROR = (0, 0x0000, (0, 0, 0, 0, 0))  # CiA 301: 1001h has fallen to 0
LIMITS = {
    "positive software limit": Limit(1, "inertia", +1, 250_000),
    "negative software limit": Limit(2, "inertia", -1, -350_000),
    "positive limit switch": Limit(3, "belt", +1, round(TURNS_TO_SWITCH * REV)),
    "negative limit switch": Limit(4, "belt", -1, -round(TURNS_TO_SWITCH * REV)),
}


def at_limit(limit: Limit) -> Drives:
    """Drive machine 0 into its limit in pv; its neighbour stands enabled in the middle."""
    drives = EmulatedDrives(load=limit.load, num_machines=2)
    if limit.load == "inertia":
        # Manual, section 6.1.11: corrected limit = limit - home offset.
        drives.write("Home offset", 50_000)
        drives.write("Software position limit.Minimum Position Limit", -300_000)
        drives.write("Software position limit.Maximum Position Limit", 300_000)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, [limit.side * 300_000, 0])
    drives.advance(round(abs(limit.edge) / 300_000 + 0.3, 3))
    return drives


@pytest.mark.parametrize("name", LIMITS)
def test_limit_of_travel_stops_the_axis_and_leaves_it_enabled(name):
    limit = LIMITS[name]
    with at_limit(limit) as drives:
        assert [(m.axis, m.code, m.error_register, m.extra) for m in drives.emergencies()] == [
            (0, 0xFF01, 0x21, (limit.extra, 0, 0, 0, 0))
        ]
        assert [state(drives, machine) for machine in (0, 1)] == [ENABLED, ENABLED]
        assert bits(drives, INTERNAL_LIMIT) == INTERNAL_LIMIT
        assert bits(drives, INTERNAL_LIMIT, 1) == 0
        assert drives.read(0x1001).tolist() == [0x21, 0]  # generic and profile specific, while it lasts
        assert drives.read(0x2101)[0] & FAULT_FLAGS == 0
        assert drives.read(0x2101)[0] & 0x100  # stop mode
        assert abs(drives.machine.rotor_speed[0]) < 0.5
        # Behind the edge by the ramp of 6085h, the loops' lag and the belt's stretch.
        behind = limit.side * (int(drives.read(0x6064)[0]) - limit.edge)
        assert 0 <= behind < 300_000**2 / (2 * QUICK) + 25_000
        drives.advance(0.5)
        assert messages(drives) == []
        drives.write(0x60FF, [-limit.side * 300_000, 0])
        drives.advance(0.5)
        assert drives.read(0x1001).tolist() == [0, 0]
        assert messages(drives) == [NO_ERROR]


def command(drives: Drives, mode: str, way: int) -> None:
    """Ask machine 0 for motion to one side in the present mode."""
    if mode == "pp":
        drives.write(0x607A, int(drives.read(0x6064)[0]) + way * 60_000, where=FIRST)
        drives.write(0x6040, 0x1F, where=FIRST)
        drives.advance(0.002)
        drives.write(0x6040, 0x0F, where=FIRST)
    elif mode == "cst":
        drives.write(0x6071, way * 1500, where=FIRST)
    elif mode == "csp":
        start = int(drives.read(0x6062)[0])
        rows = start + np.rint(way * 100_000 * np.arange(1, 301) * 1e-3).astype(np.int64)
        play = np.repeat(rows[:, None], 2, 1)
        play[:, 1] = drives.read(0x6062)[1]
        drives.record([0x6041], 0.3, play={0x607A: play})
    else:
        drives.write(0x60FF, way * 100_000, where=FIRST)


@pytest.mark.every(7)
@pytest.mark.parametrize("mode", ["pv", "pp", "csp", "csv", "cst"])
@pytest.mark.parametrize("name", LIMITS)
def test_axis_leaves_a_limit_but_goes_no_further(name, mode):
    limit = LIMITS[name]
    with at_limit(limit) as drives:
        drives.write(0x60FF, 0)
        drives.advance(0.05)
        motion.select_mode(drives, mode)
        drives.advance(0.05)
        drives.emergencies()
        start = int(drives.read(0x6064)[0])
        command(drives, mode, limit.side)
        drives.advance(0.2)
        further = limit.side * (int(drives.read(0x6064)[0]) - start)
        assert further < 300  # 2 degrees: what the loops hold with
        assert state(drives) == ENABLED
        assert bits(drives, INTERNAL_LIMIT) == INTERNAL_LIMIT

        command(drives, mode, -limit.side)
        drives.advance(0.1 if mode == "cst" else 0.6)
        back = limit.side * (start - int(drives.read(0x6064)[0]))
        assert back > 20_000
        assert bits(drives, INTERNAL_LIMIT) == 0
        assert state(drives) == ENABLED
        assert messages(drives) == [NO_ERROR]


@pytest.mark.parametrize("side", [+1, -1])
@pytest.mark.parametrize("mode", ["pp", "csp", "csv", "pv"])
def test_axis_that_its_load_pushes_past_a_software_limit_tells_and_can_be_led_back(mode, side):
    """Section 6.1.11: the limits are the actual position's, too; table 303: "the actual position is outside"."""
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        drives.write("Software position limit.Minimum Position Limit", -30_000)
        drives.write("Software position limit.Maximum Position Limit", 30_000)
        drives.write(0x2003, [200, 2000])
        drives.write(0x6065, 0)
        motion.enable(drives, mode=mode)
        drives.advance(0.02)
        drives.machine.load_torque = [side * 0.02, 0.0]
        while side * int(drives.read(0x6064)[0]) < 60_000:
            drives.advance(0.01)
        drives.machine.load_torque = 0.0
        assert [(m.axis, m.code, m.error_register, m.extra) for m in drives.emergencies()] == [
            (0, 0xFF01, 0x21, (1 if side > 0 else 2, 0, 0, 0, 0))
        ]
        assert drives.read(0x1001).tolist() == [0x21, 0]
        assert [bits(drives, INTERNAL_LIMIT, machine) for machine in (0, 1)] == [INTERNAL_LIMIT, 0]
        assert state(drives) == ENABLED
        drives.write(0x2003, 2000)
        drives.advance(0.5)
        # A position mode goes back by itself; a velocity mode is led.
        if mode in ("csv", "pv"):
            assert drives.read(0x1001).tolist() == [0x21, 0]
            drives.write(0x60FF, [-side * 300_000, 0])
            while side * int(drives.read(0x6064)[0]) > 0:
                drives.advance(0.001)
            drives.write(0x60FF, 0)
            drives.advance(0.1)
        assert abs(drives.read(0x6064)[0]) < 29_000
        assert [(m.axis, m.code, m.error_register, m.extra) for m in drives.emergencies()] == [(0, 0, 0, (0,) * 5)]
        assert drives.read(0x1001).tolist() == [0, 0]
        assert bits(drives, INTERNAL_LIMIT) == 0


# --- supply ---------------------------------------------------------------------------------------------------------
def test_brake_chopper_takes_what_braking_gives():
    """2006h: on above the voltage, off below voltage minus hysteresis; without it the same braking ends in 3210h."""
    with EmulatedDrives(load="inertia", num_machines=2, motor="class_1kw") as drives:
        drives.write("Brake Chopper.Enable", [1, 0])
        drives.write("Brake Chopper.Voltage", 550)
        drives.write("Brake Chopper.Hysteresis", 20)
        drives.machine.set("load.inertia", 2e-3)
        motion.enable(drives, mode="pv")
        drives.write(0x6083, 2_000_000)
        drives.write(0x60FF, 2_000_000)
        drives.advance(1.8)
        assert messages(drives) == []
        drives.write(0x6083, 200_000_000)
        drives.write(0x60FF, 0)
        volts, brake = [], []
        for _ in range(600):
            drives.advance(0.001)
            volts.append(get_lanes(drives.inside.records, "u_dc", 2))
            brake.append(int(drives.read(0x2101)[0]) >> 18 & 1)
        volts = np.array(volts)
        assert messages(drives) == [(1, 0x3210, (0, 0, 0, 0, 0))]
        assert volts[:, 1].max() > 60.0
        assert volts[:, 0].max() < 60.0
        # Table 85, bit 18: brake output active.
        assert 0 < sum(brake) < 300
        assert brake[-1] == 0
        assert abs(drives.machine.rotor_speed[0]) < 1.0


def test_brake_chopper_hysteresis():
    """A link above the limit falls through the resistor, which lets go one hysteresis below: an RC discharge."""
    with EmulatedDrives(load="inertia", num_machines=2, ideal=True, supply=24.0) as drives:
        drives.machine.set("stage.supply_sinks", 0.0)
        drives.machine.set("stage.supply_resistance", 0.05)
        drives.write("Brake Chopper.Enable", [1, 0])
        drives.write("Brake Chopper.Voltage", 400)
        drives.write("Brake Chopper.Hysteresis", 100)
        drives.advance(0.002)
        set_lanes(drives.inside.records, "u_dc", np.array([45.0, 45.0]))
        volts = []
        for _ in range(30):
            drives.advance(0.001)
            volts.append(get_lanes(drives.inside.records, "u_dc", 2))
        volts = np.array(volts)
    R, C, I = 4.7, 2e-3, 0.1
    t = np.arange(1, 31) * 1e-3
    expected = (45.0 + I * R) * np.exp(-t / (R * C)) - I * R
    falling = expected > 30.0
    # The drive integrates with its current tick; the exact curve differs by less than half a tick of slope.
    assert np.all(abs(volts[falling, 0] - expected[falling]) < 0.5 * 40e-6 * 45.0 / (R * C))
    # Below 30 V the idle current alone drains it, as it does the neighbour's.
    rest = np.flatnonzero(~falling)
    assert 29.5 < volts[rest[0], 0] <= 30.05
    assert np.allclose(np.diff(volts[rest, 0]), -I / C * 1e-3, atol=1e-6)
    assert np.allclose(volts[:, 1], 45.0 - I / C * t, atol=1e-6)


# --- inputs ---------------------------------------------------------------------------------------------------------
def test_inputs_show_what_the_load_presses():
    """60FDh and 2702h: bit 0 left, bit 1 right, bit 2 home; bit 3 is the enable input."""
    with EmulatedDrives(load="belt", num_machines=2) as drives:
        drives.advance(0.001)
        assert drives.read(0x60FD).tolist() == [0b1000, 0b1000]
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, [-300_000, 300_000])
        trace = drives.record([0x60FD, 0x2702], 1.6)
        assert np.array_equal(trace[0x60FD], trace[0x2702])
        levels = trace[0x60FD][1:]
        seen = [[level for level, _ in groupby(levels[:, machine].tolist())] for machine in (0, 1)]
        assert seen == [[0b1000, 0b1100, 0b1000, 0b1001], [0b1000, 0b1010]]
        drives.machine.enable_input = [False, True]
        drives.advance(0.002)
        assert drives.read(0x60FD).tolist() == [0b0001, 0b1010]


def test_unconnected_inputs_read_active_and_must_be_deactivated():
    """Manual, 2005h: "has to be set to the value 3 if limit switches are not connected"."""
    with EmulatedDrives(load="inertia", num_machines=2) as drives:
        assert drives.read(0x2005).tolist() == [3, 3]  # the preset of a load without switches
        drives.write(0x2005, [0, 3])
        motion.enable(drives, mode="pv")
        assert drives.read(0x60FD).tolist() == [15, 15]
        for velocity in (FAST, -FAST):
            drives.write(0x60FF, velocity)
            drives.advance(0.3)
            assert abs(drives.read(0x6064)[0]) < 300
            assert abs(drives.read(0x606C)[1] - velocity) < 60_000
        assert messages(drives) == [(0, 0xFF01, (3, 0, 0, 0, 0)), (0, 0xFF01, (4, 0, 0, 0, 0))]


@pytest.mark.parametrize(
    ("settings", "side", "codes"),
    [
        (0x00, -1, [4]),
        (0x00, +1, [3]),
        (0x01, -1, []),  # left switch deactivated
        (0x02, +1, []),  # right switch deactivated
        (0x01, +1, [3]),
        (0x02, -1, [4]),
        (0x30, -1, [4]),  # the home switch's bits change nothing here
    ],
)
def test_limit_switches_of_table_58(settings, side, codes):
    with EmulatedDrives(load="belt", num_machines=2) as drives:
        drives.write(0x2005, settings)
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, [side * 300_000, 0])
        drives.advance(1.35)
        assert [(m.axis, m.code, m.extra[0]) for m in drives.emergencies()] == [(0, 0xFF01, code) for code in codes]


@pytest.mark.parametrize(("settings", "forbidden", "extra"), [(0x04, -1, 4), (0x08, +1, 3)])
def test_inverted_switch_is_active_while_not_pressed(settings, forbidden, extra):
    with EmulatedDrives(load="belt", num_machines=2) as drives:
        drives.write(0x2005, settings)
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, forbidden * 300_000)
        drives.advance(0.2)
        assert np.all(abs(drives.read(0x6064)) < 300)
        assert messages(drives) == [(axis, 0xFF01, (extra, 0, 0, 0, 0)) for axis in (0, 1)]
        drives.write(0x60FF, -forbidden * 300_000)
        drives.advance(0.2)
        assert np.all(-forbidden * drives.read(0x6064) > 30_000)
        assert np.all(drives.read(0x60FD) & 0b11 == 0)  # levels, not what 2005h makes of them


def test_load_stronger_than_the_motor_is_a_following_error():
    """7 A give 0.25 N*m; 0.5 N*m push the axis out of the window of a tenth of a turn while it holds its place."""
    with EmulatedDrives(load="inertia", num_machines=2, parameters={"load.inertia": 1e-3}) as drives:
        drives.write("Following error window", REV // 10)
        motion.enable(drives, mode="csp")
        drives.advance(0.1)
        assert messages(drives) == []
        drives.machine.load_torque = np.array([0.5, 0.0])
        drives.advance(0.2)
        drives.machine.load_torque = 0.0
        drives.advance(1.5)
        assert messages(drives) == [(0, 0x8611, (0, 0, 0, 0, 0))]
        assert (state(drives), state(drives, 1)) == (FAULT, ENABLED)
        assert drives.read(0x1001).tolist() == [GENERIC | PROFILE, 0]


@pytest.mark.parametrize("leg", ["motor.open_a", "motor.open_b"])
def test_a_dc_motor_with_either_leg_open_carries_no_current(leg):
    """Two legs in series: the current that one cannot carry does not flow in the other."""
    with EmulatedDrives(load="inertia", motor="re_40", ideal=True) as drives:
        motion.enable(drives, mode="cst")
        drives.write("Target torque", 2000)
        drives.advance(0.01)
        assert drives.machine.motor_torque[0] > 0.05
        drives.machine.set(leg, 1.0)
        drives.advance(0.002)
        assert abs(drives.machine.motor_torque[0]) < 1e-9
