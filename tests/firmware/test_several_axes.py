"""A module of six axes on one node, the TMCM-6212, and its masters: axes of objects, emergencies, lent identifiers."""

from __future__ import annotations

import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.world_bus import WorldBus

from drive_env import CanDrives, EmulatedDrives, ObjectAccessError, motion
from drive_env.bus.world import World
from drive_env.devices import FOLDER, find_device
from drive_env.fieldbus.description import describe
from drive_env.master.can.port import Port
from drive_env.master.can.sdo import SdoClient

MODULE = find_device("tmcm6212")
AXES = 6


@pytest.fixture
def drives():
    with EmulatedDrives(MODULE.name, load="inertia", num_machines=AXES, num_threads=1) as made:
        yield made


@pytest.fixture
def wire(drives):
    return Wire(drives)


@pytest.mark.parametrize(
    ("index", "axis", "base"),
    [(0x2005, 0, 0x2005), (0x2A05, 5, 0x2005), (0x21FF, 0, 0x21FF), (0x2200, 1, 0x2000), (0x2BFF, 5, 0x21FF),
     (0x3002, 0, 0x3002), (0x8841, 5, 0x6041), (0x1541, 5, 0x1401), (0x1B42, 5, 0x1A02), (0x1017, 0, 0x1017)],
)  # fmt: skip
def test_the_axis_of_an_index(index, axis, base):
    assert MODULE.locate(index) == (axis, base)
    assert MODULE.is_shared(index) == (index in (0x3002, 0x1017))


def test_a_drive_of_one_axis_shares_nothing():
    assert not find_device("tmcm1636").is_shared(0x2704)


# --- emergencies ------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_master_finds_the_axis_of_an_emergency():
    machine = {"load": "inertia", "num_machines": 2 * AXES, "num_threads": 1}
    hot = np.where(np.arange(2 * AXES) == AXES + 4, 151.0, 25.0)
    found = []
    with EmulatedDrives(MODULE.name, **machine) as inside:
        motion.enable(inside, mode="pv")
        inside.machine.set_temperatures(25.0, hot)
        inside.advance(0.002)
        found.append(inside.emergencies())
    with served((1, 20)) as (world, bus), CanDrives(MODULE.name, bus=bus, nodes=(1, 20), pace="lockstep") as drives:
        motion.enable(drives, mode="pv")
        world.nodes[1].drives.machine.set_temperatures(25.0, hot)
        drives.advance(0.002)
        found.append(drives.emergencies())
    assert found[0] == found[1]
    assert tuple(found[0][0]) == (AXES + 4, 0x4310, 0x09, (2, 4, 0, 0, 0), "overtemperature")


@pytest.mark.parametrize(
    ("extra", "name", "axis"),
    [
        ((2, 5, 0, 0, 0), "overtemperature", 5),
        ((1, 0, 0, 0, 0), "overtemperature_warning", 0),
        ((2, 6, 0, 0, 0), "emergency_4310h", 0),  # the node has no seventh
        ((3, 1, 0, 0, 0), "emergency_4310h", 0),
    ],
)
def test_bytes_that_were_received(extra, name, axis):
    assert describe(MODULE.name, None).emergency(0x4310, extra) == (name, axis)


def test_bytes_that_are_none_are_told(tmp_path):
    folder = shutil.copytree(FOLDER / "tmcm1636", tmp_path / "own")
    path = folder / "device.toml"
    path.write_text(
        path.read_text(encoding="utf-8").replace("bytes = [2, 0, 0", 'bytes = [2, "axes", 0', 1), encoding="utf-8"
    )
    with pytest.raises(ValueError, match=r"device.toml: bytes = \[2, 'axes', 0, 0, 0\] .* \"axis\" in place of one"):
        find_device(str(folder))


# --- process data -----------------------------------------------------------------------------------------------------
SAMPLED = (0x6041, 0x6064, 0x606C)


@contextmanager
def served(nodes=(1,)):
    """Nodes of the module on a bus in lockstep."""
    world = World(lockstep=True)
    emulated = EmulatedDrives(MODULE.name, load="inertia", num_machines=AXES * len(nodes), num_threads=1, seed=4)
    world.add(emulated, list(nodes))
    bus = WorldBus(world)
    try:
        yield world, bus
    finally:
        bus.shutdown()
        world.close()


def cyclic_move(drives):
    """Return what a move of all axes, each its own way, shows in csp."""
    motion.enable(drives, mode="csp")
    way = np.linspace(0.0, 1.0, 40)[:, None] * 3000.0 * np.arange(1, drives.num_axes + 1)
    trace = drives.record(SAMPLED, 0.04, play={0x607A: np.rint(way).astype(np.int64)})
    motion.disable(drives)
    return np.stack([trace[name] for name in SAMPLED])


@pytest.mark.slow
def test_cyclic_targets_of_two_modules_are_what_they_are_in_process():
    with EmulatedDrives(MODULE.name, load="inertia", num_machines=2 * AXES, num_threads=1, seed=4) as inside:
        expected = cyclic_move(inside)
    with served((1, 20)) as (_, bus), CanDrives(MODULE.name, bus=bus, nodes=(1, 20), pace="lockstep") as drives:
        found = cyclic_move(drives)
    np.testing.assert_array_equal(found, expected)
    assert np.abs(expected[1, -1]).min() > 0


def cob_ids(bus, node=1):
    """Return the COB-IDs of a node's PDOs, as a second client reads them."""
    port = Port(bus, owned=False)
    client = SdoClient(port, node)
    read = {
        index: int.from_bytes(client.read(index, 1, "", 0.5), "little")
        for first in (0x1400, 0x1800)
        for index in range(first, first + 0x40 * AXES)
        if index & 0x3F < 4
    }
    port.subscribe(0x580 + node, None)
    return read


def test_pdos_of_further_axes_borrow_identifiers_and_give_them_back():
    with served() as (_, bus):
        before = cob_ids(bus)
        assert {before[0x1440 + 0x40 * k] for k in range(AXES - 1)} == {0xC0000000}
        with CanDrives(MODULE.name, bus=bus, pace="lockstep") as drives:
            cyclic_move(drives)
            during = cob_ids(bus)
            # One received PDO an axis; the statusword and the position in one PDO, the speed in the next.
            assert [during[0x1400 + 0x40 * axis] & 0x7FF for axis in range(AXES)] == [0x201 + k for k in range(AXES)]
            assert [during[0x1800 + 0x40 * axis] & 0x7FF for axis in range(AXES)] == [0x181 + k for k in range(AXES)]
            assert not any(during[0x1440 + 0x40 * k] >> 31 for k in range(AXES - 1))
        assert cob_ids(bus) == before


def test_a_dry_run_shows_whom_it_would_ask():
    lines = []
    with CanDrives(MODULE.name, dry_run=lines.append, safety=False) as drives:
        drives.record(SAMPLED, 0.002)
    asked = [line[:3] for line in lines if line[4:].split("]")[1].split()[:3] == ["40", "00", "10"]]
    assert [f"60{node}" for node in range(2, 7)] == [who for who in asked if who != "601"]


# --- what the axes have in common -------------------------------------------------------------------------------------
def test_inputs_and_outputs_of_the_module(wire):
    wire.drives.machine.digital_inputs = 0b1010
    assert wire.value(0x3002) == 0b1010 << 16
    assert wire.drives.machine.digital_inputs.tolist() == [0b1010] * AXES
    assert wire.value(0x60FD) == wire.value(0x8860 + 0x9D) == 0x0F, "those of the axes are others"
    for sub, bits in ((2, 0b0110), (1, 0b0011)):
        assert wire.download(0x3003, sub, bits << 16, 4) == 0
    assert wire.drives.machine.outputs[0] == 0b0010
    for wrong in (256, -1, 0.5):
        with pytest.raises(ValueError, match="0 to 255, a bit for each"):
            wire.drives.machine.digital_inputs = wrong
    with (
        EmulatedDrives(num_threads=1) as other,
        pytest.raises(ObjectAccessError, match="no digital inputs that belong"),
    ):
        other.machine.digital_inputs = 1
