"""A trace at the velocity loop's rate: the same run, to the bit, seen five times as often."""

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.emulator.loop_trace import SIGNALS, trace_loops
from drive_env.firmware.servo.stages import FIRMWARE

FIELDS = [name for name in FIRMWARE.layout.dtype.names if name != "padding"]


def set_points(cycles):
    return (np.random.default_rng(0).normal(size=cycles) * 200_000).astype(int)


@pytest.mark.parametrize(
    ("load", "mode"), [("inertia", "csv"), ("vertical_screw", "csp"), ("gantry", "pv"), ("inertia", "pp")]
)
def test_a_traced_run_is_the_run_itself_to_the_bit(load, mode):
    states, seen = [], []
    for traced in (False, True):
        with EmulatedDrives(load=load, num_machines=2, seed=3, randomise=True) as drives:
            motion.enable(drives, mode=mode)
            drives.machine.schedule("motor.R_s", 0.05, [0.5])
            play = {0x607A: set_points(120) // 100} if mode == "csp" else {0x60FF: set_points(120)}
            if mode == "pp":
                motion.start_move(drives, 20_000)
            if traced:
                seen.append(trace_loops(drives, ["omega_meas"], 0.12, play).signals["omega_meas"])
            else:
                seen.append(drives.record([0x606C], 0.12, play)[0x606C])
            drives.record([0x606C], 0.01)
            states.append(drives.inside.records.copy())
    # Lanes without an axis are computed, too, and may hold no numbers.
    differ = [name for name in FIELDS if not np.array_equal(states[0][name], states[1][name], equal_nan=True)]
    assert differ == []
    assert np.array_equal(np.rint(seen[1][::5] * 65536.0 / (2.0 * np.pi)), seen[0])


def test_between_two_cycles_the_loops_work(running):
    trace = trace_loops(running, list(SIGNALS), 0.02)
    assert trace.t == pytest.approx(np.arange(100) * 2e-4)
    turned = trace.signals["theta_m"][:, 0]
    # The rotor's own angle and speed, window by window.
    assert np.diff(turned) == pytest.approx(trace.signals["omega_m"][1:, 0] * 2e-4, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((["torque"], 0.01), "no signal is named 'torque'; there are position_demand"),
        ((["omega_m"], 0.0105), "not a whole number of communication cycles"),
    ],
)
def test_what_cannot_be_traced_is_refused(axis, arguments, message):
    with pytest.raises(ValueError, match=message):
        trace_loops(axis, *arguments)


def test_a_bus_has_no_such_trace():
    class OnABus:
        machine = None

    with pytest.raises(ValueError, match="once per communication cycle only"):
        trace_loops(OnABus(), ["omega_m"], 0.01)
