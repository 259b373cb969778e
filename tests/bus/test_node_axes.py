"""Axes of a node whose objects show parts of others, are shared by all axes, or are texts; and all axes together."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.firmware.record import EMERGENCY_QUEUE
from drive_env.node.axis import Axis, QueuedEmergency
from drive_env.node.node_axes import NodeAxes

SERIAL = (0x1018, 4)


@pytest.fixture(scope="module")
def made():
    with EmulatedDrives("tgz_d", num_machines=4, num_threads=1) as found:
        yield found


@pytest.fixture
def drives(made):
    """Four axes: two modules of two."""
    made.machine.reset()
    return made


def axes(drives):
    return [Axis(drives.inside.objects, k) for k in range(drives.num_axes)]


def port(drives, axis, index, sub=0):
    return axis.port(drives.inside.objects.entries.find((index, sub)))


# --- parts, and what all axes share -----------------------------------------------------------------------------------
def test_parts_of_other_objects_read_as_the_dictionary_of_all_axes_reads_them(drives):
    drives.write((0x60FE, 1), 0x00250000)
    drives.inside.objects.records["fsa"][:] = 3
    for key in drives.device.parts:
        expected = drives.read(key)
        assert [port(drives, axis, *key).read() for axis in axes(drives)] == expected.tolist(), key
    assert port(drives, axes(drives)[3], 0x4001).read() == 0x25, "six bits from bit 16 on"


def test_a_part_of_an_axis_that_is_not_there_shows_the_default():
    with EmulatedDrives("tgz_s", num_machines=1, num_threads=1) as one:
        entry = one.inside.objects.entries.find((0x4003, 2))
        assert one.device.num_axes == 1
        assert Axis(one.inside.objects, 0).port(entry).read() == entry.default


def test_what_all_axes_share_is_written_where_it_is_new(drives):
    first, second, third, _ = axes(drives)
    written, objects = [], drives.inside.objects
    write_checked = objects.write_checked
    objects.write_checked = lambda *what: written.append(what[1:]) or write_checked(*what)
    try:
        port(drives, second, 0x60FE, 1).write(0x00010000)
        port(drives, first, 0x60FE, 1).write(0x00010000)
        port(drives, first, 0x4001).write(2)
    finally:
        del objects.write_checked
    assert written[0] == (0x00010000, 1) and len(written) == 2
    assert [port(drives, axis, 0x4001).read() for axis in (first, second, third)] == [2, 2, 0], "of their module"


# --- texts ------------------------------------------------------------------------------------------------------------
def test_a_text_is_kept_until_the_firmware_starts_anew():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        node = NodeAxes(drives, 1)
        axis, other = node[0], Axis(drives.inside.objects, 0)
        text = drives.inside.objects.entries.find(0x1008)
        assert text.bits is None
        before = axis.port(text).read()
        axis.port(text).write_text("anything")
        assert axis.port(text).read() == "anything" and other.port(text).read() == before
        node.restart()
        assert axis.port(text).read() == before
        with pytest.raises(ObjectAccessError, match="is a text that cannot be written ") as error:
            axis.port(text).write(1)
        assert error.value.abort_code == 0x08000020


# --- the record -------------------------------------------------------------------------------------------------------
def test_emergencies_are_taken_in_their_order_and_once(drives):
    """A word has the firmware's row, from 1 on, in its low byte, and the error register above."""
    records = drives.inside.objects.records
    lane = 2
    records["emergency_count"][0, lane] = 3
    for k, word in enumerate((0x2101, 0xFF05, 0x00FF)):
        records["emergency"][0, k, lane] = word
    axis = axes(drives)[lane]
    assert axis.take_emergencies() == [QueuedEmergency(0, 0x21), QueuedEmergency(4, 0xFF), QueuedEmergency(0xFE, 0)]
    assert axis.take_emergencies() == [] and records["emergency_count"][0, lane] == 0
    records["emergency_count"][0, lane] = EMERGENCY_QUEUE
    assert len(axis.take_emergencies()) == EMERGENCY_QUEUE


def test_state_and_error_register_are_the_axis_s(drives):
    records = drives.inside.objects.records
    records["error_register"][0, :4] = (1, 2, 4, 8)
    records["fsa"][0, :4] = (1, 2, 3, 4)
    assert [(axis.error_register, axis.state) for axis in axes(drives)] == [(1, 1), (2, 2), (4, 3), (8, 4)]


def test_ports_are_made_once(drives):
    axis = axes(drives)[0]
    assert port(drives, axis, 0x6041) is port(drives, axis, 0x6041)


# --- all axes of a node -----------------------------------------------------------------------------------------------
def test_a_node_has_its_device_s_axes_in_their_order(drives):
    node = NodeAxes(drives, 2)
    assert len(node) == 2 and [axis.number for axis in node] == [2, 3]
    assert node[1].number == 3 and [axis.number for axis in node[:1]] == [2]


@pytest.mark.parametrize("first", [-1, 3])
def test_axes_that_the_drives_do_not_have_are_told(drives, first):
    with pytest.raises(ValueError, match=rf"^first_axis={first}: tgz_d has 2 of the 4 axes there are; use 0 to 2$"):
        NodeAxes(drives, first)
    NodeAxes(drives, 0)


def test_what_is_done_to_a_node_is_done_to_its_axes_alone(drives):
    node, key = NodeAxes(drives, 2), (0x6083, 0)
    before = drives.read(0x6083)
    node.store([{key: 1234}, {key: 5678}])
    node.restart()
    assert drives.read(0x6083).tolist() == [before[0], before[1], 1234, 5678]
    node.store([{key: int(before[2])}, {key: int(before[3])}])
    node.restart()


def test_a_serial_number_is_engraved_into_the_node_s_axes(drives):
    node = NodeAxes(drives, 2)
    node.engrave(SERIAL, 77)
    assert drives.read(SERIAL).tolist()[2:] == [77, 77] and 77 not in drives.read(SERIAL).tolist()[:2]


def test_every_axis_is_tripped_though_the_first_was(drives):
    node = NodeAxes(drives, 0)
    tripped = []
    for k, was in ((0, True), (1, False)):
        node[k].trip = lambda told, k=k, was=was: tripped.append((k, told)) or was
    assert node.trip("heartbeat_lost") is True
    assert tripped == [(0, "heartbeat_lost"), (1, "heartbeat_lost")]
    node[0].trip = lambda told: False
    assert node.trip() is False


def test_spare_axes_are_the_node_s_last_ones(drives):
    with EmulatedDrives("tgz_d", num_machines=1, num_threads=1) as spare:
        node = NodeAxes(drives, 3, spare)
        assert [axis.number for axis in node] == [3, 0]
        assert node[1]._objects is spare.inside.objects
        node.engrave(SERIAL, 99)
        assert drives.read(SERIAL).tolist()[2:] == [77, 99] and spare.read(SERIAL).tolist() == [99]
        with pytest.raises(ValueError, match=r"^first_axis=4: tgz_d has 1 of the 4 axes there are; use 0 to 3$"):
            NodeAxes(drives, 4, spare)
    np.testing.assert_equal(len(node), 2)
