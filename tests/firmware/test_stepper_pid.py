"""The position PID of a stepper (2020h = 2, 3) against its linear model, computed by an implementation of its own.

The field is an integrator, and the rotor follows it with the lag of the load angle: with a deviation e, K_P = P / 256,
K_I = I / 65536 f / 128 and K_D = D 128 div / f

    de/dt = -d(disturbance)/dt - (K_P e + K_I int e + K_D de/dt)        (mode 2, the ramp's velocity drops out)
    de/dt = v_ramp - (K_P e + K_I int e + K_D de/dt)                     (mode 3)
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.closed_loop_rig import PID_RECIPE, build, close_loop
from rigs.stepper_rig import MICROSTEPS, SMOOTH, holding_torque, lane

from drive_env.motors import MOTORS

MOTOR = MOTORS["qsh4218_51"]
PPS = MICROSTEPS / (2.0 * math.pi)
CLOCK = 16e6
# The rotor's swing is no part of the model: it is damped.
STIFF = SMOOTH | {"motor.viscous": 10.0 * MOTOR.viscous}
SETTINGS = {  # 2022h, 202Bh, 202Ch, 202Dh, 202Eh, 2021h, 202Fh
    "P": (0, 3000, 0, 0, 2, 0, 400_000),
    "PI": (0, 3000, 300, 400, 2, 0, 400_000),
    "PID": (0, 3000, 300, 400, 100, 800, 400_000),
    "clipped": (0, 3000, 0, 0, 2, 0, 2_000),
    "sum clipped": (0, 0, 500, 2, 2, 0, 400_000),
}
OBJECTS = (0x2022, 0x202B, 0x202C, 0x202D, 0x202E, 0x2021, 0x202F)


def model(setting, start, ramp, seconds, alone):
    """Return the deviation [microsteps] every millisecond, by Euler steps of 20 us, the ramp's velocity given."""
    _, p, i, i_clip, divider, d, most = setting
    k_p, k_i, k_d = p / 256, i / 65536 * CLOCK / 128, d * 128 * divider / CLOCK
    e, total, found, dt = start, 0.0, [], 2e-5
    largest = i_clip * 65536 * 128 / CLOCK  # of the sum, as an integral over time
    for k in range(round(seconds / dt)):
        if k % 50 == 0:
            found.append(e)
        total = min(max(total + e * dt, -largest), largest)
        outer = k_p * e + k_i * total
        drift = ramp if alone else 0.0
        v = (outer + k_d * drift) / (1.0 + k_d)  # with de/dt = drift - v
        v = min(max(v, -most), most)
        e += (drift - v) * dt
    return np.array(found)


@pytest.mark.parametrize("name", list(SETTINGS))
def test_the_answer_to_a_step_of_the_load_is_the_linear_models(name):
    """A load moves the rotor by its angle; the PID turns the field until the encoder is where the steps are."""
    share = 0.5
    with build(recipe=PID_RECIPE, parameters=STIFF) as drives:
        for index, value in zip(OBJECTS, SETTINGS[name], strict=True):
            drives.write(index, value)
        drives.write(0x2022, 255)  # corrects nothing until the rotor has moved
        close_loop(drives, 2)
        drives.machine.load_torque = -share * MOTOR.rated_torque
        drives.advance(0.4)
        held = holding_torque(MOTOR, np.hypot(lane(drives, "i_a"), lane(drives, "i_b"))[0])
        step = math.asin(share * MOTOR.rated_torque / held) / 50.0 * PPS
        start = lane(drives, "loop_deviation")[0] * PPS
        assert start == pytest.approx(step, rel=0.03)
        drives.write(0x2022, SETTINGS[name][0])
        found = []
        for _ in range(300):
            found.append(lane(drives, "loop_deviation")[0] * PPS)
            drives.advance(0.001)
    expected = model(SETTINGS[name], start, 0.0, 0.3, alone=False)
    np.testing.assert_allclose(found, expected, atol=0.04 * step + 1.5)
    assert min(np.abs(found)) < 0.5 * step


def test_on_the_ramps_velocity_the_axis_follows_without_lag_and_alone_with_that_of_its_gain():
    """Mode 2 adds to the ramp; mode 3 needs a deviation for every velocity: v 256 / P, none with an integral part."""
    velocity, p = 10_000, 8_000
    with build(recipe=PID_RECIPE | {0x2022: 0, 0x2021: 0, 0x202B: p}, parameters=STIFF, num_machines=3) as drives:
        drives.write(0x202C, [0, 0, 500])
        close_loop(drives, [2, 3, 3], operation="pv")
        drives.write(0x6083, 10_000_000)
        drives.write(0x60FF, velocity)
        drives.advance(1.5)
        speed = lane(drives, "omega_m") * PPS
        np.testing.assert_allclose(speed, velocity, rtol=0.04)
        deviation = lane(drives, "loop_deviation") * PPS
        np.testing.assert_allclose(deviation, [0.0, velocity * 256 / p, 0.0], atol=3.0)


def test_the_answer_of_mode_3_to_a_ramp_is_the_linear_models():
    setting = SETTINGS["PI"]
    with build(recipe=PID_RECIPE, parameters=STIFF) as drives:
        for index, value in zip(OBJECTS, setting, strict=True):
            drives.write(index, value)
        close_loop(drives, 3, operation="pv")
        drives.write(0x6083, 2**31 - 1)
        drives.write(0x60FF, 5_000)
        found = []
        for _ in range(400):
            found.append(lane(drives, "loop_deviation")[0] * PPS)
            drives.advance(0.001)
    expected = model(setting, 0.0, 5_000.0, 0.4, alone=True)
    np.testing.assert_allclose(found[2:], expected[1:-1], atol=0.03 * expected.max() + 2.0)


def test_within_the_tolerance_nothing_is_corrected():
    with build(recipe=PID_RECIPE, parameters=STIFF, num_machines=2) as drives:
        drives.write(0x2022, [200, 40])
        close_loop(drives, 2)
        drives.machine.load_torque = -0.5 * MOTOR.rated_torque  # some 85 microsteps
        drives.advance(1.0)
        behind = lane(drives, "loop_deviation") * PPS
        assert 70 < behind[0] < 100
        assert behind[1] <= 41
        assert lane(drives, "field_position")[0] == pytest.approx(lane(drives, "step_position")[0], abs=1e-9)


def test_lost_steps_are_made_up_for():
    """The rotor slips by four full steps; the PID moves the field on until the encoder says that all is well."""
    with build(recipe=PID_RECIPE, parameters=STIFF, num_machines=2) as drives:
        drives.write(0x2022, 5)
        drives.write(0x2020, [2, 0])
        hold = 0.97 * MOTOR.rated_torque
        close_loop(drives, [2, 0])
        drives.write(0x202F, 0)
        drives.machine.load_torque = -hold
        drives.advance(0.05)
        drives.machine.load_torque = -1.3 * MOTOR.rated_torque
        for _ in range(200):
            drives.advance(0.001)
            if np.all(lane(drives, "theta_m") * 50.0 < -1.6 * math.pi):
                break
        drives.machine.load_torque = 0.0
        drives.advance(0.5)
        turns = np.rint(lane(drives, "theta_m") * PPS / 1024)
        assert np.all(turns <= -1)
        drives.write(0x202F, 400_000)
        drives.advance(2.0)
        np.testing.assert_allclose(drives.read(0x6064), [0, turns[1] * 1024], atol=6)
