"""The brake output: delays and currents (TMCM-3313 manual, 2002h, 200Ah, 200Ch), and a hanging load on its brake."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.stepper_rig import SMOOTH, build, hold, lane
from rigs.truth import brake_is_closed

from drive_env import motion
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
DAMPED = SMOOTH | {"motor.viscous": MOTOR.viscous}
FULL_STEP = 2.0 * np.pi / 200
SWITCHED, ENABLED, FAULT, READY, OFF = 0x23, 0x27, 0x28, 0x21, 0x40
OPENS, CLOSES = 0.04, 0.02  # s, of the brake itself
HANGS = 0.15  # N*m: what hangs on the axis


def commission(drives, *, enable=0, apply=0, release=0, current=(0, 255)):
    drives.write(0x200A, enable)
    drives.write((0x2002, 1), apply)
    drives.write((0x2002, 2), release)
    drives.write((0x200C, 1), current[0])
    drives.write((0x200C, 2), current[1])
    drives.machine.brake = "output"


def switch_on(drives):
    drives.write(0x6060, 1)
    for word in (6, 7):
        drives.write(0x6040, word)
        drives.advance(0.002)


def watch(drives, milliseconds):
    """Return each millisecond: state, stage, output, brake closed; before the first one passes, and after each."""
    rows = []
    for _ in range(milliseconds):
        drives.advance(0.001)
        rows.append(
            (
                int(drives.read(0x6041)[0]) & 0x6F,
                lane(drives, "stage_on")[0],
                drives.machine.brake_output[0],
                bool(brake_is_closed(drives)[0]),
            )
        )
    return rows


def first(rows, column, value):
    """Return the first millisecond in which a column has a value."""
    return next(k for k, row in enumerate(rows) if row[column] == value)


def test_on_enabling_current_flows_then_the_brake_is_released_then_the_state_changes():
    """Figure of 2002h: current, 200Ah, brake, 2002h:02, operation enabled."""
    with build(parameters=DAMPED) as drives:
        commission(drives, enable=30, release=50)
        switch_on(drives)
        drives.write(0x6040, 15)
        assert drives.read(0x6041)[0] & 0x6F == SWITCHED
        rows = watch(drives, 120)
        assert first(rows, 1, 1.0) == 0
        assert first(rows, 2, 1.0) == 30
        assert first(rows, 3, False) == 30 + round(OPENS * 1000)
        assert first(rows, 0, ENABLED) == 80
        assert rows[-1] == (ENABLED, 1.0, 1.0, False)


def test_on_disabling_the_brake_is_applied_and_current_waits_for_it():
    with build(parameters=DAMPED) as drives:
        commission(drives, apply=35)
        hold(drives)
        drives.advance(0.1)
        drives.write(0x6040, 7)
        rows = watch(drives, 100)
        applied = first(rows, 2, 0.0)
        assert first(rows, 0, SWITCHED) == applied
        assert first(rows, 3, True) == applied + round(CLOSES * 1000)
        assert first(rows, 1, 0.0) == applied + 35


def drop(*, apply, word, state):
    """Return how far a hanging load sinks as an axis is switched off [rad], and for how long current flowed on [ms]."""
    with build(parameters=DAMPED, ideal=True) as drives:
        commission(drives, enable=10, apply=apply, release=60)
        switch_on(drives)
        drives.write(0x6040, 15)
        drives.advance(0.2)
        drives.machine.load_torque = -HANGS
        drives.advance(0.5)
        before = drives.machine.rotor_angle[0]
        drives.write(0x6040, word)
        rows = watch(drives, 300)
        assert rows[-1][0] & 0x6F == state
        assert rows[-1][1:] == (0.0, 0.0, True)
        return before - drives.machine.rotor_angle[0], sum(row[1] for row in rows)


@pytest.mark.parametrize(("word", "state"), [(7, SWITCHED), (6, READY), (2, OFF)])  # disable, shutdown, quick stop
def test_a_hanging_load_does_not_move_when_the_delay_is_as_long_as_the_brake_takes(word, state):
    sunk, flowed = drop(apply=25, word=word, state=state)
    assert abs(sunk) < 1e-4
    assert flowed >= 25
    # Too short a delay: it falls until the brake has closed, J' = psi'' with the rotor's inertia alone.
    sunk, _ = drop(apply=10, word=word, state=state)
    assert sunk > 10 * FULL_STEP


def test_disable_voltage_takes_the_energy_away_at_once():
    """No delay keeps current in a motor that must have none: the load falls until the brake has closed."""
    sunk, flowed = drop(apply=25, word=0, state=OFF)
    assert flowed == 0
    assert sunk > FULL_STEP


def test_what_cuts_the_stage_also_cuts_a_current_that_waits_for_the_brake():
    with build(num_machines=2, parameters=DAMPED) as drives:
        commission(drives, apply=5_000)
        hold(drives)
        drives.write(0x6040, 6)
        drives.advance(0.1)
        np.testing.assert_array_equal(lane(drives, "stage_on"), 1.0)
        drives.machine.enable_input = [False, True]
        drives.advance(0.002)
        np.testing.assert_array_equal(lane(drives, "stage_on"), [0.0, 1.0])
        drives.write(0x6040, 0)
        drives.advance(0.001)
        np.testing.assert_array_equal(lane(drives, "stage_on"), 0.0)


@pytest.mark.parametrize(("words", "flows"), [((7, 6), True), ((7, 0), False), ((7, 2), False), ((6, 7), True)])
def test_a_current_that_waits_for_the_brake_survives_orders_and_ends_when_the_energy_is_taken(words, flows):
    """Shutdown and switch on (6, 3) leave it; disable voltage and quick stop of an axis that is off (10) end it."""
    with build(parameters=DAMPED) as drives:
        commission(drives, apply=500)
        hold(drives)
        for word in words:
            drives.write(0x6040, word)
            drives.advance(0.05)
        assert lane(drives, "stage_on")[0] == flows
        drives.advance(0.5)
        assert lane(drives, "stage_on")[0] == 0.0


def test_an_axis_that_turns_is_not_held_when_it_is_shut_down():
    with build(parameters=DAMPED) as drives:
        commission(drives, apply=500)
        drives.machine.brake = "open"
        motion.enable(drives, mode="pv")
        drives.write(0x6083, 10**6)
        drives.write(0x60FF, 50_000)
        drives.advance(0.5)
        drives.write(0x6040, 6)
        drives.advance(0.001)
        assert lane(drives, "stage_on")[0] == 0.0
        assert drives.machine.brake_output[0] == 0.0


@pytest.mark.parametrize(("word", "state"), [(7, SWITCHED), (6, READY), (0, OFF)])
def test_enabling_that_is_called_off_never_enables(word, state):
    with build(parameters=DAMPED) as drives:
        commission(drives, enable=100, apply=20, release=100)
        switch_on(drives)
        drives.write(0x6040, 15)
        rows = watch(drives, 150)
        drives.write(0x6040, word)
        rows += watch(drives, 300)
        assert ENABLED not in {row[0] for row in rows}
        assert rows[-1] == (state, 0.0, 0.0, True)
        drives.write(0x6040, 6)
        drives.write(0x6040, 7)
        drives.write(0x6040, 15)
        assert first(watch(drives, 250), 0, ENABLED) == 200


def test_an_axis_that_is_not_enabled_in_time_is_not_enabled_later():
    with build(num_machines=2, parameters=DAMPED) as drives:
        commission(drives, enable=[300, 0])
        with pytest.raises(TimeoutError, match=r"axis 0 did not reach operation enabled in 0\.1 s"):
            motion.enable(drives, mode="pp", timeout=0.1)
        drives.advance(0.5)
        assert (drives.read(0x6041) & 0x6F).tolist() == [READY, ENABLED]
        motion.enable(drives, timeout=0.5)


def test_a_fault_on_the_way_to_operation_enabled_ends_it():
    with build(parameters=DAMPED) as drives:
        commission(drives, enable=100)
        switch_on(drives)
        drives.write(0x6040, 15)
        drives.advance(0.05)
        drives.machine.enable_input = False
        rows = watch(drives, 200)
        assert rows[-1] == (FAULT, 0.0, 0.0, True)
        assert {row[1] for row in rows[1:]} == {0.0}


def test_a_network_that_is_lost_on_the_way_to_operation_enabled_ends_it():
    with build(parameters=DAMPED) as drives:
        commission(drives, enable=100)
        switch_on(drives)
        drives.write(0x6040, 15)
        drives.advance(0.05)
        firmware = drives.device.firmware
        assert firmware.trip(drives.inside.records, 0, 1, firmware.communication_lost) == 1
        rows = watch(drives, 200)
        assert {row[:2] for row in rows} == {(FAULT, 0.0)}


def test_without_currents_the_output_is_dead_and_its_delays_do_nothing_but_that_of_enabling():
    """Both currents 0 switch the automatic control off (200Ch); a brake on the output stays closed then."""
    with build(parameters=DAMPED) as drives:
        commission(drives, enable=20, apply=500, release=500, current=(0, 0))
        switch_on(drives)
        drives.write(0x6040, 15)
        rows = watch(drives, 50)
        assert first(rows, 0, ENABLED) == 20
        assert {row[2:] for row in rows} == {(0.0, True)}
        drives.write(0x6040, 7)
        assert first(watch(drives, 50), 1, 0.0) <= 2


@pytest.mark.parametrize(
    ("release", "opens"),
    [(255, True), (160, True), (140, False), (40, False)],  # pull-in at 60 % of the largest current
)
def test_a_brake_opens_by_its_pull_in_current_alone(release, opens):
    with build(parameters=DAMPED) as drives:
        commission(drives, current=(0, release))
        hold(drives)
        drives.advance(0.1)
        assert drives.machine.brake_output[0] == pytest.approx(release / 255)
        assert brake_is_closed(drives)[0] != opens
        drives.write((0x200C, 2), 80)  # above its drop-out current it stays what it is
        drives.advance(0.1)
        assert brake_is_closed(drives)[0] != opens


def test_the_brake_falls_when_the_supply_does():
    with build(parameters=DAMPED) as drives:
        commission(drives)
        hold(drives)
        drives.advance(0.1)
        assert not brake_is_closed(drives)[0]
        drives.machine.supply = 0.0
        drives.advance(0.5)
        assert brake_is_closed(drives)[0]
