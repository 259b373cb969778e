"""`auto` on a TMCM-3313 of a bus, inside the envelope that its commands set: load detection and the closed loop."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.fault_injection import eds_read_once
from rigs.world_bus import on_bus

from drive_env import EmulatedDrives, Limits, cia402
from drive_env.devices import find_device
from drive_env.motors import find_motor
from tuning.stepper.commissioning import commission
from tuning.target import Target, hold_to_travel

DEVICE, MOTOR, AXES = find_device("tmcm3313"), find_motor("qsh4218_51"), 3
WAY = np.full(AXES, 120.0)  # rad


@pytest.mark.slow
def test_three_axes_are_commissioned_with_their_loops_inside_the_envelope_of_the_command(tmp_path):
    with eds_read_once(), EmulatedDrives("tmcm3313", "inertia", num_machines=AXES, num_threads=1) as inside:
        with on_bus(inside, stay=True, timeout=5.0, safety=Limits(silence=5.0)) as drives:
            volts = np.full(AXES, float(MOTOR.voltage))
            where = {"channel": "here", "nodes": [1]}
            target = Target(drives, DEVICE, MOTOR, volts, -WAY, WAY, MOTOR.rated_speed, MOTOR.rated_current, bus=where)
            hold_to_travel(target)
            result = commission(target, tmp_path / "before.toml")
        assert result.accepted.all(), [axis.reason for axis in result.axes]
        assert not result.kept, "it has no 1010h"
        assert not cia402.is_live(inside.read(cia402.STATUSWORD)).any()
