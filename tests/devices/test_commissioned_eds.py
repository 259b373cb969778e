"""EDS and DCF with a drive's own values (CiA 306): which of an EDS's lines get one, and which stay as they are."""

from __future__ import annotations

from types import SimpleNamespace

import canopen
import numpy as np
import pytest
from typer.testing import CliRunner

from drive_env import EmulatedDrives
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.wire import Wire
from drive_env.bus.world import World
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.dictionary.eds_file import object_section
from drive_env.dictionary.entries import EdsText, eds_file
from drive_env.fieldbus.description import describe
from drive_env.master import commissioned_eds as module
from drive_env.master.commissioned_eds import commissioned_eds, commissioned_values

EDS = find_device("tmcm1636").eds
VELOCITY, PRODUCER, LACKING, SUB_LACKING = (0x6081, 0), (0x1017, 0), (0x5ABC, 0), (0x607D, 9)


def sections(text):
    return eds_file(EdsText("own", text), 1).sections


def own():
    return eds_file(EDS, 1).sections


@pytest.mark.parametrize(("node_id", "line"), [(None, "DefaultValue"), (7, "ParameterValue")])
def test_values_stand_where_the_eds_has_the_object_and_nowhere_else(node_id, line):
    """A drive may have more than its EDS tells, as after an update of its firmware: that is left out, with no error."""
    values = {VELOCITY: 4321, LACKING: 1, SUB_LACKING: 2}
    found = sections(commissioned_eds(EDS, values, "own.eds", node_id=node_id))
    assert found[object_section(VELOCITY[0])] == own()[object_section(VELOCITY[0])] | {line: "4321"}
    assert object_section(LACKING[0]) not in found and object_section(*SUB_LACKING) not in found
    changed = {name for name, row in found.items() if row != own().get(name)}
    assert changed == {object_section(VELOCITY[0]), "FileInfo"} | ({"DeviceComissioning"} if node_id else set())


def test_what_emulated_drives_have_now_are_the_parameters_of_each_axis():
    device = find_device("tmcm6212")
    read = []

    def value(name):
        read.append(name)
        return np.array([10, 11, 12])

    found = commissioned_values(SimpleNamespace(bus=None, device=device, num_axes=3, read=value))
    assert [found[0x6081 + 0x800 * axis, 0] for axis in range(3)] == [10, 11, 12]
    assert (0x6081 + 0x1800, 0) not in found, "there are three axes of six"
    assert not {index for index, _ in found} & {0x6040, 0x6041, 0x6840, 0x1010, 0x1008}
    assert {name[0] for name in read} & {0x6881, 0x7081} == set(), "an axis is asked for by the first one's index"


def test_what_drives_on_a_bus_have_are_the_parameters_of_one_of_its_nodes(monkeypatch):
    bus = SimpleNamespace(description=describe("tmcm6212", None))
    monkeypatch.setattr(module, "read_parameters", lambda drives, axis: {VELOCITY: axis, PRODUCER: 7})
    found = commissioned_values(SimpleNamespace(bus=bus), 1)
    assert found == {PRODUCER: 7, **{(0x6081 + 0x800 * axis, 0): 6 + axis for axis in range(6)}}


def test_a_default_that_is_the_drives_stays_as_it_is_written():
    row = own()[object_section(PRODUCER[0])]
    same = int(row.get("DefaultValue", "0") or "0", 0)
    found = sections(commissioned_eds(EDS, {PRODUCER: same}, "own.eds"))
    assert found[object_section(PRODUCER[0])] == row


def test_a_dcf_names_its_node_and_counts_its_revision():
    before = own()["FileInfo"]
    found = sections(commissioned_eds(EDS, {}, "own.dcf", node_id=9, bit_rate=500))
    assert (found["DeviceComissioning"]["NodeID"], found["DeviceComissioning"]["Baudrate"]) == ("9", "500")
    assert found["FileInfo"]["LastEDS"] == before["FileName"] and found["FileInfo"]["FileName"] == "own.dcf"
    assert int(found["FileInfo"]["FileRevision"]) == int(before.get("FileRevision", "0")) + 1


def test_a_dcf_of_a_drive_on_a_bus_has_the_bit_rate_that_it_reports(tmp_path, monkeypatch):
    world = World(wire=Wire(bit_rate=500_000, instant=True))
    monkeypatch.chdir(tmp_path)
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        emulated.advance(0.001)  # compiles: a node that does would not answer in time
        world.add(emulated, [3])
        hub = Hub()
        with Server(world, hub):
            bus = ("--interface", "slcan", "--channel", hub.channel, "--node", "3")
            done = CliRunner().invoke(app, ["export", "dcf", "a.dcf", *bus])
            assert done.exit_code == 0 and "as node 3 at 500 kbit/s" in done.stdout, done.output
            assert canopen.import_od("a.dcf").bitrate == 500_000
        world.close()
