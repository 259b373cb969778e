"""CoolStep: the current by the load reading, against a second implementation, and the energy that it saves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.stepper_rig import FREE, MICROSTEPS, build, lane

from drive_env import motion
from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
REAL = FREE | {"load.inertia": 5.0 * MOTOR.inertia}
RPM = MICROSTEPS / 60.0  # microsteps a second


def turn(drives, speed, **objects):
    """Bring motors to a speed [microsteps/s] in pv, with their whole rated current, then set objects ("x2098": 1)."""
    drives.write(0x2003, 255)
    motion.enable(drives, mode="pv")
    drives.write(0x6083, 400_000)
    drives.write(0x60FF, round(speed))
    drives.advance(1.0)
    for name, value in objects.items():
        drives.write(int(name[1:], 16), value)


def second_implementation(readings, run, *, minimum, down, width, up, start):
    """Return the current's step after each reading (manual, 2098h to 209Ch; TMC5160 data sheet, COOLCONF)."""
    lowest = run // (4 if minimum else 2)
    lower, upper = 32 * start, 32 * (start + width + 1)
    current, above, found = run, 0, []
    for reading in readings:
        if reading < lower:
            current, above = min(current + (1, 2, 4, 8)[up], run), 0
        elif reading >= upper:
            above += 1
            if above == (32, 8, 2, 1)[down]:
                current, above = max(current - 1, lowest), 0
        found.append(current)
    return found


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("minimum", "down", "width", "up", "start"),
    [(0, 1, 0, 0, 5), (1, 2, 2, 1, 4), (1, 3, 0, 3, 6), (0, 3, 1, 2, 5), (0, 0, 0, 0, 3)],
)
def test_the_current_is_that_of_a_second_implementation_fed_with_the_readings(minimum, down, width, up, start):
    settings = {"x2098": minimum, "x2099": down, "x209A": width, "x209B": up, "x209E": 12, "x20A5": round(50 * RPM)}
    with build(parameters=REAL) as drives:
        turn(drives, 120 * RPM, **settings)
        drives.write(0x209C, start)
        readings, currents, begun = [], [], lane(drives, "load_start")[0]
        for k in range(2500):
            drives.machine.load_torque = -0.2 * MOTOR.rated_torque * (1.0 - math.cos(k * 0.012)) ** 2
            drives.advance(0.001)
            if lane(drives, "load_start")[0] != begun:
                begun = lane(drives, "load_start")[0]
                readings.append(int(drives.read(0x2101)[0]))
                drives.advance(0.001)  # the current follows with the next period
                currents.append(int(lane(drives, "current_scale")[0]))
                assert lane(drives, "load_start")[0] == begun
        assert drives.emergencies() == []
        expected = second_implementation(readings, 31, minimum=minimum, down=down, width=width, up=up, start=start)
        assert len(readings) > 500
        assert currents == expected
        assert min(expected) < 31 and len(set(expected)) > 3


@pytest.mark.parametrize(
    ("run", "minimum", "lowest"), [(255, 0, 15), (255, 1, 7), (128, 0, 8), (128, 1, 4), (40, 1, 1)]
)
def test_it_goes_down_to_a_half_or_a_quarter_of_the_run_current(run, minimum, lowest):
    with build(parameters=REAL) as drives:
        turn(drives, 120 * RPM, x2098=minimum, x2099=3, x209E=40, x209C=1, x2003=run)
        drives.advance(0.3)
        assert lane(drives, "current_scale")[0] == lowest
        full = lane(drives, "full_scale_current")[0]
        assert lane(drives, "amplitude")[0] == pytest.approx(full * (lowest + 1) / 32.0)
        drives.write(0x209C, 0)  # no CoolStep
        drives.advance(0.003)
        assert lane(drives, "current_scale")[0] == run // 8


def test_it_works_above_its_speed_and_in_spread_cycle_alone():
    with build(num_machines=3, parameters=REAL) as drives:
        turn(drives, 120 * RPM, x2098=1, x2099=3, x209E=40, x209C=1)
        drives.write(0x20A5, np.rint(np.array([119, 121, 119]) * RPM).astype(int))
        drives.write(0x2093, [0, 0, 1])
        drives.advance(0.3)
        np.testing.assert_array_equal(lane(drives, "current_scale"), [7, 31, 31])
        drives.write(0x60FF, round(100 * RPM))
        drives.advance(0.3)
        np.testing.assert_array_equal(lane(drives, "current_scale"), 31)


def drawn(drives):
    """Return the mean power [W] of the bridges over half a second."""
    power = np.zeros(drives.num_axes)
    for _ in range(500):
        drives.advance(0.001)
        power += lane(drives, "bridge_power") / 500.0
    return power


def test_energy_is_saved_where_there_is_little_load():
    """Machines without and with CoolStep, unloaded and loaded by 60 % of the rated torque; friction is there."""
    with build(num_machines=4, parameters=REAL) as drives:
        turn(drives, 150 * RPM, x2098=1, x2099=2, x209A=1, x209B=2, x209D=1, x209E=6)
        drives.write(0x209C, [0, 3, 0, 3])
        load = np.array([0.0, 0.0, 0.6, 0.6]) * MOTOR.rated_torque
        for k in range(100):
            drives.machine.load_torque = -load * (k + 1) / 100.0
            drives.advance(0.01)
        drives.advance(1.0)
        power, current = drawn(drives), lane(drives, "amplitude")
        behind = 50.0 * (lane(drives, "step_position") - lane(drives, "theta_m"))
        assert np.all(np.abs(behind) < 0.5 * math.pi)
        assert power[1] < 0.35 * power[0]
        assert power[3] > power[1] and current[3] > 1.5 * current[1]
        # What is left is the shaft's power and the loss of the current there is: copper alone shrinks.
        speed = 150 * math.pi / 30.0
        shaft = (load + MOTOR.coulomb + MOTOR.viscous * speed) * speed
        assert np.all(power > shaft)
        np.testing.assert_allclose(
            (power[1] - shaft[1]) / (power[0] - shaft[0]), (current[1] / current[0]) ** 2, rtol=0.1
        )


@pytest.mark.parametrize("adapts", [True, False])
def test_a_sudden_load_raises_the_current_again_without_a_lost_step(adapts):
    """Half of the rated torque at once, more than the lowered current carries: left low, the steps are lost."""
    with build(parameters=FREE | {"load.inertia": 20.0 * MOTOR.inertia}) as drives:
        turn(drives, 150 * RPM, x2098=1, x2099=3, x209A=0, x209B=3, x209E=6, x209C=6)
        drives.advance(1.0)
        lowered = lane(drives, "current_scale")[0]
        assert lowered == 7
        if not adapts:
            drives.write(0x209C, 0)
            drives.write(0x2003, 8 * 7)
        drives.machine.load_torque = -0.5 * MOTOR.rated_torque
        drives.advance(0.3)
        behind = 50.0 * (lane(drives, "step_position") - lane(drives, "theta_m"))
        assert (abs(behind[0]) < math.pi) == adapts
        if adapts:
            assert lane(drives, "current_scale")[0] > 2 * lowered
            assert drives.read(0x606C)[0] == round(150 * RPM) and drives.emergencies() == []
