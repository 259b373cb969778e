"""One axis seen by a node against the dictionary of all axes; several axes in one node; the error history."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.canopen.frames import Frame
from drive_env.devices import AxisOffset, find_device
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


# --- a device of several axes -----------------------------------------------------------------------------------------
OFFSETS = (
    AxisOffset(0x2000, 0x26FF, 0x800),
    AxisOffset(0x6000, 0x67FF, 0x800),
    AxisOffset(0x1400, 0x143F, 0x40),
)


def several_axes(folder, num_axes, history=0):
    """Return a device like ours with more axes, profile objects at +800h, PDO sets at +40h, and an error history."""
    text = DEVICE.eds.read_text(encoding="utf-8")
    sections = re.findall(r"\[([0-9A-F]{4})(sub[0-9A-F]+)?\]\n(.*?)(?=\n\[|\Z)", text, re.S)
    more = []
    for axis in range(1, num_axes):
        for index, sub, body in sections:
            number = int(index, 16)
            if 0x6000 <= number < 0x6800 or 0x2000 <= number < 0x2700:
                number += 0x800 * axis
            elif 0x1400 <= number < 0x1C00:
                number += 0x40 * axis
                if sub == "sub1" and number >> 8 in (
                    0x14,
                    0x18,
                ):  # the other axes' PDOs are off, as no identifiers are left
                    body = re.sub(r"DefaultValue=.*", "DefaultValue=0xC0000000", body)
                body = re.sub(
                    r"DefaultValue=0x(6[0-9A-F]{3})([0-9A-F]{4})",
                    lambda m, shift=0x800 * axis: f"DefaultValue=0x{int(m[1], 16) + shift:04X}{m[2]}",
                    body,
                )
            else:
                continue
            body = re.sub(r"ParameterName=(.*)", rf"ParameterName=\1 axis {axis}", body)
            more.append(f"[{number:04X}{sub}]\n{body}\n")
    if history:
        more.append(f"[1003]\nParameterName=Pre-defined error field\nObjectType=0x8\nSubNumber={history + 1}\n")
        for sub in range(history + 1):
            kind, access = ("0x0005", "rw") if sub == 0 else ("0x0007", "ro")
            more.append(
                f"[1003sub{sub:X}]\nParameterName=Error {sub}\nObjectType=0x7\nDataType={kind}\nAccessType={access}\n"
                f"DefaultValue=0\nPDOMapping=0\n"
            )
    # A second consumer of heartbeats.
    more.append(
        "[1016sub2]\nParameterName=Consumer heartbeat time 2\nObjectType=0x7\nDataType=0x0007\nAccessType=rw\n"
        "DefaultValue=0\nPDOMapping=0\n"
    )
    path = folder / "several.eds"
    path.write_text(text + "\n" + "\n".join(more), encoding="utf-8")
    groups = {1: ("bus", "communication", "profile", *(f"motor {k}" for k in range(num_axes)))}
    canopen = DEVICE.canopen._replace(store_groups=groups)
    return DEVICE._replace(num_axes=num_axes, eds=path, axis_offsets=OFFSETS, canopen=canopen)


@pytest.fixture
def two(tmp_path, monkeypatch):
    """A node of two axes, and an axis beside it that is none of its."""
    device = several_axes(tmp_path, 2, history=3)
    monkeypatch.setattr("drive_env.emulator.emulated_drives.find_device", lambda name: device)
    with EmulatedDrives(load="inertia", num_machines=3, num_threads=1) as drives:
        yield Wire(drives, first_axis=0)


@pytest.mark.parametrize(
    ("index", "axis", "base"),
    [(0x6040, 0, 0x6040), (0x6840, 1, 0x6040), (0x7040, 0, 0x7040), (0x2041, 0, 0x2041), (0x2841, 1, 0x2041),
     (0x1400, 0, 0x1400), (0x1440, 1, 0x1400), (0x1017, 0, 0x1017), (0x2704, 0, 0x2704)],
)  # fmt: skip
def test_indices_of_axes(two, index, axis, base):
    assert two.drives.device.locate(index) == (axis, base)


def test_each_axis_has_its_automaton(two):
    two.play("""
        rx 605  2B 40 68 00 06 00 00 00
        tx 585  60 40 68 00 00 00 00 00
        rx 605  40 41 68 00 00 00 00 00
        tx 585  4B 41 68 00 31 02 00 00
        rx 605  40 41 60 00 00 00 00 00
        tx 585  4B 41 60 00 50 02 00 00
        rx 605  23 83 68 00 01 02 03 04
        tx 585  60 83 68 00 00 00 00 00
        rx 605  40 41 70 00 00 00 00 00   # no third
        tx 585  80 41 70 00 00 00 02 06
        rx 605  40 41 68 01 00 00 00 00
        tx 585  80 41 68 01 11 00 09 06
    """)
    assert (two.drives.read(0x6041) & 0x6F).tolist() == [0x40, 0x21, 0x40]
    assert two.drives.read(0x6083)[1] == 0x0403_0201


def test_each_axis_has_its_pdos(two):
    for index, cob_id in ((0x1440, 0x4000_0211), (0x1840, 0x4000_0191)):
        assert two.download(index, 1, cob_id, 4) == 0
    two.play("""
        rx 000  01 05
        wait 1 ms
        tx 185  50 02
        tx 285  50 02 00
        tx 191  50 02
        rx 211  06 00
        wait 1 ms
        tx 191  31 02
        rx 205  06 00
        wait 1 ms
        tx 185  31 02
        tx 285  31 02 00
    """)


def test_a_fault_of_one_axis_and_the_register_of_both(two):
    two.enable()
    for raw, sub in ((3, 0x6860), (6, 0x6840), (7, 0x6840), (15, 0x6840)):
        assert two.download(sub, 0, raw, 1 if sub == 0x6860 else 2) == 0
    two.drives.machine.enable_input = np.array([True, False, True])
    two.play("""
        wait 1 ms
        tx 085  41 54 81 00 FF 00 00 00
        rx 605  40 03 10 00 00 00 00 00
        tx 585  4F 03 10 00 01 00 00 00
        rx 605  40 03 10 01 00 00 00 00
        tx 585  43 03 10 01 41 54 01 00   # axis 1
    """)
    assert two.value(0x6041) & 0x6F == 0x27
    two.receive(0, "01 05")
    two.receive(0, "02 05")
    two.wait(5)
    two.receive(0, "80 05")
    assert (two.drives.read(0x6041) & 0x4F).tolist() == [0x08, 0x08, 0x40], "stopping takes every axis of the node"


def test_a_node_is_watched_once(two):
    two.play("""
        rx 605  23 16 10 01 64 00 07 00   # node 7, 100 ms
        tx 585  60 16 10 01 00 00 00 00
        rx 605  23 16 10 02 C8 00 07 00   # once more
        tx 585  80 16 10 02 43 00 04 06   # abort 0604 0043h: general parameter incompatibility
        rx 605  23 16 10 01 32 00 07 00   # the same entry may change
        tx 585  60 16 10 01 00 00 00 00
        rx 605  23 16 10 02 C8 00 08 00
        tx 585  60 16 10 02 00 00 00 00
        rx 605  23 16 10 02 00 00 07 00   # a time of 0 watches nobody
        tx 585  60 16 10 02 00 00 00 00
    """)


def test_the_error_history(two):
    two.start()
    two.play("""
        rx 605  40 03 10 00 00 00 00 00
        tx 585  4F 03 10 00 00 00 00 00
        rx 605  40 03 10 01 00 00 00 00
        tx 585  80 03 10 01 24 00 00 08   # no data available
        rx 205  06
        tx 085  10 82 11 00 FF 00 00 00
        rx 205  06 00 00
        tx 085  20 82 11 00 FF 00 00 00
        rx 305  00 00 02
        tx 085  20 63 31 00 FF 00 00 00
        rx 305  00
        tx 085  10 82 11 00 FF 00 00 00
        rx 605  40 03 10 00 00 00 00 00
        tx 585  4F 03 10 00 03 00 00 00   # three fit
        rx 605  40 03 10 01 00 00 00 00
        tx 585  43 03 10 01 10 82 00 00   # the newest first
        rx 605  40 03 10 03 00 00 00 00
        tx 585  43 03 10 03 20 82 00 00
        rx 605  2F 03 10 00 01 00 00 00
        tx 585  80 03 10 00 30 00 09 06
        rx 605  2F 03 10 00 00 00 00 00
        tx 585  60 03 10 00 00 00 00 00
        rx 605  40 03 10 00 00 00 00 00
        tx 585  4F 03 10 00 00 00 00 00
    """)


def test_store_and_reset_of_several_axes(two):
    assert two.download(0x6883, 0, 4711, 4) == 0
    assert two.download(0x2803, 0, 1234, 4) == 0
    assert two.download(0x6083, 0, 815, 4) == 0
    assert two.download(0x1010, 1, 0x65766173, 4) == 0
    two.drives.write(0x6083, 99)
    two.receive(0, "81 05")
    assert two.drives.read(0x6083).tolist() == [815, 4711, 99], "the axis that is not the node's is left alone"
    assert two.drives.read(0x2003)[1] == 1234


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
