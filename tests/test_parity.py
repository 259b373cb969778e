"""One script, two kinds of drives: on the emulator and over CAN in lockstep the same integers come out.

On the bus the emulator is reached by python-can's virtual bus, through the hub, and by calls; each with the safety
envelope, and without it.
"""

from __future__ import annotations

import uuid
from collections import deque
from contextlib import contextmanager

import can
import numpy as np
import pytest
from socketcan import CHANNEL, SOCKETCAN

from drive_env import CanDrives, EmulatedDrives, ObjectAccessError, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame

WATCHED = [0x6041, 0x6061, 0x6062, 0x6064, 0x606C, 0x6077]
TURN = 65536  # increments


class WorldBus(can.BusABC):
    """A python-can bus with a world at its other end, all in the caller's thread."""

    def __init__(self, world):
        super().__init__(channel="world")
        self._world = world
        self._waiting = deque()
        world.power_on()
        world.listeners.append(self._hear)

    def send(self, msg, timeout=None):
        self._world.receive(Frame(msg.arbitration_id, bytes(msg.data), msg.is_remote_frame))

    def _hear(self, ended):
        if ended.sender != "master":
            frame = ended.frame
            self._waiting.append(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False))

    def _recv_internal(self, timeout):
        return (self._waiting.popleft() if self._waiting else None), True

    def fileno(self):
        raise NotImplementedError


@contextmanager
def served(how, nodes=(1,), safety=True, **machine):
    """Emulated drives behind a bus, as CanDrives."""
    world = World(lockstep=True)
    world.add(EmulatedDrives(num_threads=1, **machine), list(nodes))
    options = {"nodes": nodes, "pace": "lockstep", "safety": safety}
    try:
        if how == "calls":
            bus = WorldBus(world)
            with CanDrives(bus=bus, **options) as drives:
                yield drives
            bus.shutdown()
            return
        if how == "hub":
            port = Hub()
            where = {"channel": port.channel}
        else:
            where = {"interface": how, "channel": CHANNEL if how == "socketcan" else str(uuid.uuid4())}
            port = CanPort(can.Bus(**where))
        with Server(world, port), CanDrives(**where, **options) as drives:
            yield drives
    finally:
        world.close()


def watch(drives, seconds, play=None):
    trace = drives.record(WATCHED, seconds, play=play)
    return np.stack([trace[name] for name in WATCHED])


def pp(drives):
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 1_500_000)
    motion.start_move(drives, 3 * TURN)
    yield watch(drives, 0.15)
    motion.start_move(drives, -TURN, relative=True)  # replans under way
    yield watch(drives, 0.35)
    motion.move_to(drives, 0)
    yield watch(drives, 0.1)  # an axis that is still turning would be braked by the envelope before its voltage goes
    motion.disable(drives)
    yield watch(drives, 0.02)


def pv(drives):
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 1_000_000)
    yield watch(drives, 0.1)
    drives.write("Velocity mode settings.P_Parameter", 600)
    drives.write("Target velocity", -500_000)
    yield watch(drives, 0.2)
    motion.quick_stop(drives)
    yield watch(drives, 0.2)


def csp(drives):
    motion.enable(drives, mode="csp")
    drives.write((0x60C2, 1), 2)
    targets = np.rint(TURN * (1 - np.cos(np.linspace(0, 2 * np.pi, 300)))).astype(int)
    yield watch(drives, 0.3, {0x607A: targets, 0x60B1: np.arange(300)})
    yield watch(drives, 0.03)


def csv(drives):
    motion.enable(drives, mode="csv")
    targets = np.rint(500_000 * np.sin(np.linspace(0, 6, 250))).astype(int)
    yield watch(drives, 0.25, {0x60FF: targets})
    for target in range(0, 100_000, 10_000):  # a policy, cycle by cycle, SDO and PDO
        drives.write(0x60FF, target)
        yield watch(drives, 0.002)
        yield watch(drives, 0.001, {0x60FF: [target + 5000]})


def cst(drives):
    motion.enable(drives, mode="cst")
    targets = np.where(np.arange(120) // 20 % 2, -700, 900)
    yield watch(drives, 0.12, {0x6071: targets, 0x60B2: np.full(120, 30)})
    drives.write(0x6071, 0)
    drives.advance(0.05)
    yield watch(drives, 0.01)


def handshake_in_pdos(drives):
    """The set-point handshake of pp cycle by cycle: controlword and target in one row."""
    motion.enable(drives, mode="pp")
    words = np.full(200, 0x0F)
    words[10:20] = words[100:110] = 0x1F
    targets = np.where(np.arange(200) < 90, TURN, -TURN)
    yield watch(drives, 0.2, {0x607A: targets, 0x6040: words})


def homing(drives):
    increments_per_metre = TURN / (0.006366 * 2 * np.pi)
    drives.write(0x6098, 21)
    drives.write((0x6099, 1), round(0.2 * increments_per_metre))
    drives.write((0x6099, 2), round(0.02 * increments_per_metre))
    drives.write(0x609A, round(4.0 * increments_per_metre))
    drives.write(0x607C, 1000)
    motion.enable(drives, mode="hm")
    drives.write(0x6040, 0x1F)
    yield watch(drives, 1.2)
    motion.wait_for(drives, (0x1400, 0x1400), 5.0, "homing attained")
    yield drives.read(0x6064)
    drives.write(0x607C, -2000)
    motion.home(drives)
    yield drives.read(0x6064)
    yield watch(drives, 0.01)


def run(script, drives):
    return [np.asarray(part) for part in script(drives)]


def assert_equal(expected, found):
    assert len(expected) == len(found)
    for k, (a, b) in enumerate(zip(expected, found, strict=True)):
        assert a.shape == b.shape
        wrong = np.argwhere(a != b)
        assert not wrong.size, f"part {k}: first difference at object, cycle, axis {wrong[0]}: {a[tuple(wrong[0])]}, " \
            f"on the bus {b[tuple(wrong[0])]}"  # fmt: skip


SCRIPTS = {script.__name__: script for script in (pp, pv, csp, csv, cst, handshake_in_pdos, homing)}
_emulated = {}


def emulated(name):
    """What the script gives on emulated drives; computed once."""
    if name not in _emulated:
        with EmulatedDrives(load="belt" if name == "homing" else "two_mass", num_threads=1) as drives:
            _emulated[name] = run(SCRIPTS[name], drives)
    return _emulated[name]


@pytest.mark.every(3)
@pytest.mark.parametrize("safety", [True, False], ids=["enveloped", "bare"])
@pytest.mark.parametrize("name", SCRIPTS)
def test_the_same_script_gives_the_same_integers(name, safety):
    load = "belt" if name == "homing" else "two_mass"
    with served("calls", load=load, safety=safety) as drives:
        assert_equal(emulated(name), run(SCRIPTS[name], drives))


@pytest.mark.every(3)
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


def test_the_same_mode_twice_is_refused_alike():
    def twice(drives):
        drives.write(0x6060, 3)
        with pytest.raises(ObjectAccessError) as error:
            drives.write(0x6060, 3)
        return error.value.abort_code

    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        expected = twice(drives)
    with served("calls", load="inertia") as drives:
        assert twice(drives) == expected == 0x08000022


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
