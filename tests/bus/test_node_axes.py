"""Axes of a node whose objects show parts of others, are shared by all axes, or are texts; and all axes together."""

from __future__ import annotations

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node.axis import Axis
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


# --- all axes of a node -----------------------------------------------------------------------------------------------
def test_a_node_has_its_device_s_axes_in_their_order(drives):
    node = NodeAxes(drives, 2)
    assert len(node) == 2 and [axis.number for axis in node] == [2, 3]
    assert node[1].number == 3 and [axis.number for axis in node[:1]] == [2]


def test_spare_axes_are_the_node_s_last_ones(drives):
    with EmulatedDrives("tgz_d", num_machines=1, num_threads=1) as spare:
        node = NodeAxes(drives, 3, spare)
        assert [axis.number for axis in node] == [3, 0]
        assert node[1]._objects is spare.inside.objects
        before = int(drives.read(SERIAL)[2])
        node.engrave(SERIAL, 99)
        assert drives.read(SERIAL).tolist()[2:] == [before, 99] and spare.read(SERIAL).tolist() == [99]
        with pytest.raises(ValueError, match=r"^first_axis=4: tgz_d has 1 of the 4 axes there are; use 0 to 3$"):
            NodeAxes(drives, 4, spare)
    np.testing.assert_equal(len(node), 2)
