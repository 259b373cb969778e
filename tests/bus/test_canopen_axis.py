"""One axis seen by a node against the dictionary of all axes, and one set of drives as many nodes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.canopen.frames import Frame
from drive_env.devices import find_device
from drive_env.firmware.record import set_lanes
from drive_env.firmware.servo.stages import FIRMWARE
from drive_env.node.axis import Axis

DEVICE = find_device("tmcm1636")
ENTRIES = list(DEVICE.new_dictionary())


@pytest.fixture(scope="module")
def shared():
    with EmulatedDrives(load="inertia", num_machines=10, num_threads=1) as made:
        yield made


@pytest.fixture
def drives(shared):
    """Ten drives: two records of eight lanes."""
    shared.machine.reset()
    return shared


# --- the same integers as the dictionary of all axes ------------------------------------------------------------------
def test_every_object_reads_alike_while_the_axes_move(drives):
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, np.arange(10) * 70_000 - 300_000)
    drives.advance(0.05)
    for number in range(10):
        axis = Axis(drives.inside.objects, number)
        for entry in ENTRIES:
            assert axis.port(entry).read() == drives.read((entry.index, entry.sub))[number], entry.label


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.data())
def test_every_bound_object_reads_alike_whatever_is_in_the_record(shared, data):
    """Also what no healthy axis has: infinities, no number, positions beyond the counter."""
    entry = data.draw(st.sampled_from([e for e in ENTRIES if (e.index, e.sub) in DEVICE.bindings]))
    binding = DEVICE.bindings[entry.index, entry.sub]
    field = next(f for f in FIRMWARE.layout.fields if f.name == binding.field)
    if field.name == "position_scaler":
        return
    if field.kind == "f8":
        value = data.draw(st.floats(-1e9, 1e9) | st.sampled_from([np.inf, -np.inf, np.nan, 0.0, 0.5e-3, 1.5e-3]))
    else:
        value = data.draw(st.integers(-(2**31), 2**31 - 1))
    before = shared.inside.records[field.name].copy()
    with np.errstate(all="ignore"):
        set_lanes(shared.inside.records, field.name, np.full(10, value), part=binding.part)
        try:
            expected = int(shared.read((entry.index, entry.sub))[9])
            assert Axis(shared.inside.objects, 9).port(entry).read() == expected, (entry.label, value)
        finally:
            shared.inside.records[field.name] = before


@pytest.mark.every(7)
@pytest.mark.parametrize(
    "entry",
    [e for e in ENTRIES if e.access == "rw" and e.bits and (e.index, e.sub) not in DEVICE.unsupported],
    ids=lambda e: f"{e.index:04X}:{e.sub}",
)
def test_every_write_does_what_the_dictionary_of_all_axes_does(drives, entry):
    key = entry.index, entry.sub
    axis = Axis(drives.inside.objects, 9)
    port = axis.port(entry)
    only = np.arange(10) == 8
    for raw in {entry.low - 1, entry.low, entry.low + 1, 0, 2, 3, 15, entry.default, entry.high, entry.high + 1}:
        code = refused = 0
        try:
            drives.write(key, raw, where=only)
        except ObjectAccessError as error:
            code = error.abort_code
        try:
            port.check(raw)
            port.write(raw)
        except ObjectAccessError as error:
            refused = error.abort_code
        assert refused == code, (entry.label, raw)
        assert drives.read(key)[8] == drives.read(key)[9] == port.read()
        assert drives.read(key)[7] == drives.read(key)[0]
    for field in FIRMWARE.layout.fields:
        if field.name != "random":  # each axis has its own noise
            block = drives.inside.records[field.name].reshape(2, -1, 8)[1]
            assert np.array_equal(block[:, 0], block[:, 1], equal_nan=True), field.name


def test_emergencies_of_one_axis_leave_the_others_alone(drives):
    drives.machine.enable_input = True
    motion.enable(drives, mode="pv")
    drives.machine.enable_input = np.arange(10) % 2 == 0
    drives.advance(0.001)
    axis = Axis(drives.inside.objects, 3)
    assert [e.error_register for e in axis.take_emergencies()] == [0x81]
    assert axis.take_emergencies() == []
    assert [m.axis for m in drives.emergencies()] == [1, 5, 7, 9]
    drives.machine.enable_input = True


def test_a_trip_takes_one_axis_from_operation_enabled_only(drives):
    drives.machine.enable_input = True
    some = np.arange(10) != 4
    motion.enable(drives, mode="pv", where=some)
    assert Axis(drives.inside.objects, 3).trip()
    assert not Axis(drives.inside.objects, 4).trip()
    drives.advance(0.01)
    fault = drives.read(0x6041) & 0x4F == 0x08
    assert fault.tolist() == [k == 3 for k in range(10)]
    assert drives.emergencies() == [], "whoever trips it tells why"
    motion.reset_fault(drives, where=fault)
    assert (drives.read(0x6041) & 0x4F)[3] == 0x40


def test_nothing_is_compiled_once_a_node_is_there(drives):
    """A kernel takes seconds to compile, and each kind of array has its own; a master would wait for it."""
    axis = Axis(drives.inside.objects, 0)
    kernels = (FIRMWARE.write_events, FIRMWARE.trip)
    assert [len(one.signatures) for one in kernels] == [1, 1]
    still = np.full(10, 1)
    still.flags.writeable = False
    for modes in (3, still, np.full(20, 3)[::2], [1] * 10):
        drives.write(0x6060, modes, where=np.ones(20, bool)[::2])
    axis.port(next(e for e in ENTRIES if e.index == 0x6040)).write(6)
    assert axis.trip() in (True, False)
    assert [len(one.signatures) for one in kernels] == [1, 1]


# --- as many nodes ----------------------------------------------------------------------------------------------------
def test_ten_nodes_of_one_set(drives):
    """One set of emulated drives may be as many nodes."""
    drives.machine.enable_input = True
    wires = [Wire(drives, node_id=k + 1, first_axis=k) for k in range(10)]
    for k, wire in enumerate(wires):
        assert wire.download(0x6081, 0, 1000 + k, 4) == 0
    assert drives.read(0x6081).tolist() == [1000 + k for k in range(10)]
    for wire in wires:
        wire.node.receive(Frame(0, b"\x81\x03"), 0.0)
    assert [bool(wire.take()) for wire in wires] == [k == 2 for k in range(10)]
    assert (drives.read(0x6081) != 1000 + np.arange(10)).tolist() == [k == 2 for k in range(10)]
