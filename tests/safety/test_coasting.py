"""An axis that turns though it is off, faster than it may: no enabling, since a quick stop would not hold it."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.fault_injection import LIMITS, ON, RADIANS, TURN, problems, run_lockstep

from drive_env import EmulatedDrives, SafetyError, motion

COASTING = 5 * TURN  # pps
SLOW_RAMP = 6  # pps^2, the quick stop's: no axis may be faster than it stops within a second
PUSH = 0.1  # N*m


@pytest.fixture(scope="module")
def emulated():
    with EmulatedDrives(load="fan", num_threads=1, ideal=True) as drives:
        yield drives


@pytest.fixture(autouse=True)
def as_commissioned(emulated):
    ramp = emulated.read(0x6085)
    yield
    emulated.machine.load_torque = 0.0
    emulated.write(0x6085, ramp)


def coast(drives, emulated):
    """Have the load turn the rotor, and let go."""
    drives.read(0x6041)
    emulated.machine.load_torque = PUSH
    while abs(emulated.machine.rotor_speed[0]) < COASTING * RADIANS:
        drives.advance(0.005)
    emulated.machine.load_torque = 0.0


def enable(drives):
    motion.enable(drives, mode="hm")


def enable_in_rows(drives):
    motion.select_mode(drives, "hm")
    drives.record([0x6064], 0.1, play={0x6040: np.repeat([0x06, 0x07, 0x0F], [5, 5, 90])})


@pytest.mark.parametrize("begin", [enable, enable_in_rows])
def test_an_axis_that_is_faster_than_its_quick_stop_can_hold_is_not_enabled(emulated, begin):
    def session(drives):
        drives.write(0x6085, SLOW_RAMP)
        for name in ((0x6099, 1), (0x6099, 2)):
            drives.write(name, 1)
        coast(drives, emulated)
        begin(drives)

    truth, _, ended = run_lockstep(emulated, session)
    assert isinstance(ended, SafetyError) and "it turns though it is off" in str(ended)
    assert f"beyond the limit {SLOW_RAMP}; it was not enabled" in str(ended)
    assert np.abs(truth.omega()).max() >= COASTING * RADIANS
    assert not np.isin(truth.fsa(), ON).any()


def test_an_axis_that_coasts_within_its_limits_is_caught(emulated):
    def session(drives):
        coast(drives, emulated)
        motion.enable(drives, mode="pv")
        drives.advance(0.2)
        speeds.append(float(emulated.machine.rotor_speed[0]))

    speeds = []
    truth, *_ = run_lockstep(emulated, session)
    assert np.isin(truth.fsa(), ON).any() and abs(speeds[0]) < 0.1 * COASTING * RADIANS
    assert not problems(truth)


def test_the_limits_of_these_tests_allow_that_speed():
    assert LIMITS.velocity is None or LIMITS.velocity > COASTING
