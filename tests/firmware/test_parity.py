"""One script, two kinds of drives: on the emulator and over CAN in lockstep the same integers come out.

On the bus the emulator is reached by python-can's virtual bus, through the hub, and by calls; each with the safety
envelope, and without it.
"""

from __future__ import annotations

import numpy as np
import pytest
from rigs.parity_scripts import SCRIPTS, WATCHED, emulated, run, watch
from rigs.socketcan import SOCKETCAN
from rigs.world_bus import assert_equal, served

from drive_env import EmulatedDrives, ObjectAccessError, motion


@pytest.mark.every(18)
@pytest.mark.parametrize("safety", [True, False], ids=["enveloped", "bare"])
@pytest.mark.parametrize("name", SCRIPTS)
def test_the_same_script_gives_the_same_integers(name, safety):
    load = "belt" if name == "homing" else "two_mass"
    with served("calls", load=load, safety=safety) as drives:
        assert_equal(emulated(name), run(SCRIPTS[name], drives))


@pytest.mark.every(84)
@pytest.mark.parametrize("how", ["virtual", "hub", SOCKETCAN])
@pytest.mark.parametrize("name", SCRIPTS)
def test_it_does_so_on_the_virtual_bus_and_through_the_hub(name, how):
    with served(how, load="belt" if name == "homing" else "two_mass") as drives:
        assert_equal(emulated(name), run(SCRIPTS[name], drives))


def test_something_happens_in_every_script():
    for name in SCRIPTS:
        parts = [part for part in emulated(name) if part.ndim == 3]
        moved = np.concatenate(parts, axis=1)[WATCHED.index(0x6064)]
        assert np.ptp(moved) > 1000, name


def test_several_nodes_are_the_axes_in_their_order():
    with EmulatedDrives(load="inertia", num_machines=3, seed=4, randomise=True, num_threads=1) as drives:
        expected = run(different_targets, drives)
    machine = {"load": "inertia", "num_machines": 3, "seed": 4, "randomise": True}
    with served("calls", nodes=(9, 2, 127), **machine) as drives:
        assert drives.num_axes == 3
        assert_equal(expected, run(different_targets, drives))


def different_targets(drives):
    motion.enable(drives, mode="csv")
    targets = np.linspace(0, 1, 100)[:, None] * np.array([300_000, -200_000, 50_000])
    yield watch(drives, 0.1, {0x60FF: targets.astype(int)})
    drives.write(0x60FF, [1000, 2000, 3000], where=np.array([True, False, True]))
    yield drives.read(0x60FF)
    yield watch(drives, 0.05)


def fault_and_reset(drives):
    """A following error: its emergency, its statuswords, its reset."""
    motion.enable(drives, mode="csp")
    drives.write(0x6065, 2000)
    targets = np.arange(80) * 4000
    yield watch(drives, 0.08, {0x607A: targets})
    # A drive writes the code and the bytes of its own table; names are this table's on either side.
    yield [tuple(message) for message in drives.emergencies()]
    motion.reset_fault(drives)
    drives.advance(0.002)
    yield [tuple(message) for message in drives.emergencies()]
    yield drives.read(0x6041)


def test_a_fault_has_the_same_integers_and_the_same_emergencies():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        expected = list(fault_and_reset(drives))
    assert expected[1] == [(0, 0x8611, expected[1][0][2], (0, 0, 0, 0, 0), "following_error")]
    with served("calls", load="inertia", safety=False) as drives:
        found = list(fault_and_reset(drives))
    assert found[1:3] == expected[1:3]
    assert_equal([expected[0], expected[3]], [found[0], found[3]])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        (0x6041, 0),  # can only be read
        (0x1234, 0),  # does not exist
        ((0x607D, 5), 0),  # has no such sub-index
        (0x2003, 99_000),  # beyond its range
        (0x6060, 7),  # no mode has this number
        (0x605A, 3),  # a value that the object does not know
        (0x6071, 1.5),  # no integer
    ],
)
def test_what_is_refused_is_refused_with_the_same_code(name, value):
    with EmulatedDrives(load="inertia", num_threads=1) as drives, pytest.raises(ObjectAccessError) as expected:
        drives.write(name, value)
    with served("calls", load="inertia") as drives, pytest.raises(ObjectAccessError) as found:
        drives.write(name, value)
    assert found.value.abort_code == expected.value.abort_code


def test_a_reset_restores_the_stored_values_and_goes_on():
    def reset(drives):
        drives.write(0x6081, 12345)
        motion.enable(drives, mode="pv")
        drives.advance(0.01)
        drives.reset_node()
        return [int(drives.read(name)[0]) for name in (0x6081, 0x6041, 0x6060)]

    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        expected = reset(drives)
    with served("calls", load="inertia") as drives:
        assert reset(drives) == expected
        motion.enable(drives, mode="csv")  # PDOs are mapped anew
        assert drives.record([0x6041], 0.005)[0x6041].shape == (5, 1)


def test_homing_that_cannot_be_is_told():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        drives.write(0x6098, 21)
        for name, value in (((0x6099, 1), 100_000), ((0x6099, 2), 10_000), (0x609A, 1_000_000)):
            drives.write(name, value)
        with pytest.raises(TimeoutError, match=r"axis 0 did not attain home in 0\.1 s: statusword"):
            motion.home(drives, timeout=0.1)  # there is no switch on this machine
