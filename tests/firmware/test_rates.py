"""Periods of a device: current loop, velocity loop, supervision and communication cycle, each apart from the others."""

import numpy as np
import pytest

from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.emulator.loop_trace import trace_loops

FAST = {"current": 32000, "velocity": 8000, "supervision": 4000, "communication": 4000}
SEEN = (0x6041, 0x6064, 0x606C, 0x6077)


@pytest.fixture
def variant(tmp_path):
    """Return a function that writes a variant with rates [Hz] of its own, and gives its path."""

    def write(**rates):
        path = tmp_path / ("_".join(str(rate) for rate in rates.values()) + ".toml")
        lines = "\n".join(f"{name} = {rate}" for name, rate in rates.items())
        path.write_text(f'variant_of = "tmcm1636"\n[rates]\n{lines}\n')
        return str(path)

    return write


def test_a_cycle_of_four_supervision_periods_is_four_cycles_of_one(variant):
    """What is played every 4 ms moves the axis to the bit as the same rows do that are repeated every millisecond."""
    targets = np.repeat(np.random.default_rng(3).integers(-400_000, 400_000, 60), 4)
    traces = {}
    for device, every in (("tmcm1636", 1), (variant(communication=250), 4)):
        with EmulatedDrives(device, "belt", num_threads=1) as drives:
            motion.enable(drives, mode="csv")
            traces[every] = drives.record(SEEN, 0.24, play={0x60FF: targets[::every]}, period=0.004)
    for index in SEEN:
        assert np.array_equal(traces[1][index], traces[4][index]), hex(index)
    assert np.ptp(traces[1][0x606C]) > 100_000


def test_in_a_long_cycle_the_drive_supervises_itself_in_between(variant):
    """A profile is planned every millisecond, whatever the cycle: its speed is a straight line, not a staircase."""
    with EmulatedDrives(variant(communication=250), "inertia", ideal=True, num_threads=1) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x6083, "200 rad/s^2")
        drives.write(0x60FF, "100 rad/s")
        trace = trace_loops(drives, ["velocity_demand"], 0.2)
    assert len(trace.t) == 1000
    demand = trace.signals["velocity_demand"][5:, 0]
    assert np.allclose(np.diff(demand[::5]), 200.0 * 0.001)  # a step of a millisecond each millisecond


def test_a_cycle_of_250_us(variant):
    """The profile grows by a dt in each cycle, and the axis follows it: 606Ch against the closed form a t."""
    device = variant(**FAST)
    with EmulatedDrives(device, "inertia", num_threads=1) as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x6083, "200 rad/s^2")
        drives.write(0x60FF, "100 rad/s")
        trace = drives.record([0x606C], 0.3, period=0.00025)
    assert np.allclose(np.diff(trace.t), 0.00025)
    assert find_device(device).communication_rate == 4000
    speed = trace[0x606C, "rad/s"][:, 0]
    late = trace.t > 0.05
    assert np.max(np.abs(speed[late] - 200.0 * trace.t[late])) < 3.0  # rad/s


def test_the_same_physics_at_any_rate(variant):
    """A free run-up by constant torque is the closed form i k_t / J t, at 1 ms as at 250 us."""
    reached = []
    for device in ("tmcm1636", variant(**FAST)):
        with EmulatedDrives(device, "inertia", ideal=True, num_threads=1) as drives:
            motion.enable(drives, mode="cst")
            drives.write(0x6071, 500)
            drives.advance(0.05)
            reached.append(float(drives.machine.rotor_speed[0]))
    assert reached[1] == pytest.approx(reached[0], rel=0.02) and reached[0] > 1.0


@pytest.mark.parametrize("rates", [{"communication": 300}, {"supervision": 3000}, {"velocity": 7000}])
def test_rates_that_are_no_whole_multiples_are_refused(variant, rates):
    with pytest.raises(ValueError, match="each must be a whole multiple of the next"):
        find_device(variant(**rates))
