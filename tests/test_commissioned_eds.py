"""EDS and DCF with a drive's own values (CiA 306): which of an EDS's lines get one, and which stay as they are."""

from __future__ import annotations

import pytest

from drive_env.devices import find_device
from drive_env.dictionary.eds_file import object_section
from drive_env.dictionary.entries import EdsText, eds_file
from drive_env.master.commissioned_eds import commissioned_eds

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
