"""EEPROM and ESI, made from a device's data: each says the same as the dictionary, and as the other."""

from __future__ import annotations

import struct
import xml.etree.ElementTree as ET
from collections import Counter

import pytest
from rigs.eeproms import categories, pdos
from typer.testing import CliRunner

from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.devices.ethercat import ethercat_of
from drive_env.ethercat.esi import esi_text
from drive_env.ethercat.object_descriptions import describe
from drive_env.ethercat.sii_content import sii_content

DEVICE = find_device("tmcm3313")


def strings(content):
    found, at = [""], 1
    for _ in range(content[0]):
        found.append(content[at + 1 : at + 1 + content[at]].decode())
        at += 1 + content[at]
    return found


NINE = [(index + 0x800 * axis, 0, bits) for axis in range(3) for index, bits in ((0, 16), (1, 32), (2, 32))]
OUTPUTS = [((0x6040, 0x607A, 0x60FF)[k % 3] + 0x800 * (k // 3), 0, row[2]) for k, row in enumerate(NINE)]  # table 22
INPUTS = [((0x6041, 0x6064, 0x606C)[k % 3] + 0x800 * (k // 3), 0, row[2]) for k, row in enumerate(NINE)]  # table 24


def test_the_eeprom():
    content = sii_content(DEVICE, serial=7, alias=0x55)
    assert len(content) == 2048
    assert struct.unpack_from("<4I", content, 0x10) == (0x286, 3313, 0x10009, 7)
    assert struct.unpack_from("<H", content, 8) == (0x55,)
    assert struct.unpack_from("<4H", content, 0x28) == (0x1000, 256, 0x1100, 256), "of the bootstrap"
    assert struct.unpack_from("<5H", content, 0x30) == (0x1000, 256, 0x1100, 256, 0x0C), "mailboxes; CoE and FoE"
    assert struct.unpack_from("<2H", content, 0x7C) == (15, 1), "2 KiB in units of 128 bytes, less one"
    parts = categories(content)
    assert list(parts) == [10, 30, 40, 41, 50, 51, 60]
    names = strings(parts[10])
    assert names[parts[30][3]] == "Trinamic TMCM-3313"
    rows = [struct.unpack_from("<HHBBBB", parts[41], 8 * k) for k in range(4)]
    assert [(row[0], row[1], row[5]) for row in rows] == [
        (0x1000, 256, 1), (0x1100, 256, 2), (0x1200, 30, 3), (0x1300, 30, 4)
    ]  # fmt: skip
    assert pdos(parts[51]) == [(0x1600, 2, OUTPUTS)]
    assert pdos(parts[50]) == [(0x1A00, 3, INPUTS)]
    modes = [struct.unpack_from("<IiihHhBB", parts[60], 24 * k) for k in range(2)]
    assert [mode[4] for mode in modes] == [0, 0x300]


def test_the_esi_has_every_object_once_and_says_what_the_eeprom_says():
    root = ET.fromstring(esi_text(DEVICE))
    device = root.find("Descriptions/Devices/Device")
    indices = Counter(int(one.text[2:], 16) for one in device.findall("Profile/Dictionary/Objects/Object/Index"))
    assert set(indices) == set(describe(DEVICE))
    assert set(indices.values()) == {1}
    types = [one.text for one in device.findall("Profile/Dictionary/DataTypes/DataType/Name")]
    assert len(types) == len(set(types))
    used = {one.text for one in device.iter("Type")} - {"TMCM3313"}
    assert used == set(types), "each type is there, and is used"
    for tag, expected in (("RxPdo", OUTPUTS), ("TxPdo", INPUTS)):
        entries = device.findall(f"{tag}/Entry")
        assert [
            (int(one.findtext("Index")[2:], 16), int(one.findtext("SubIndex")), int(one.findtext("BitLen")))
            for one in entries
        ] == expected
    managers = [(one.text, one.get("StartAddress"), one.get("DefaultSize")) for one in device.findall("Sm")]
    assert managers == [
        ("MBoxOut", "#x1000", "256"), ("MBoxIn", "#x1100", "256"),
        ("Outputs", "#x1200", "30"), ("Inputs", "#x1300", "30"),
    ]  # fmt: skip
    assert root.findtext("Vendor/Id") == "#x00000286"
    kind = device.find("Type")
    assert (kind.get("ProductCode"), kind.get("RevisionNo")) == ("#x00000CF1", "#x00010009")
    content = sii_content(DEVICE)
    assert bytes.fromhex(device.findtext("Eeprom/ConfigData")) == content[:14]
    assert bytes.fromhex(device.findtext("Eeprom/BootStrap")) == content[0x28:0x30]
    # The order of ETG.2000's schema, which is a sequence.
    order = [one.tag for one in device]
    assert list(dict.fromkeys(order)) == [
        "Type", "Name", "GroupType", "Profile", "Fmmu", "Sm", "RxPdo", "TxPdo", "Mailbox", "Dc", "Eeprom",
    ]  # fmt: skip


def test_the_command_prints_it():
    done = CliRunner().invoke(app, ["export", "esi", "-", "--device", "tmcm3313"])
    assert done.exit_code == 0
    assert done.output == esi_text(DEVICE)
    done = CliRunner().invoke(app, ["export", "esi", "-", "--device", "tmcm1636"])
    assert done.exit_code == 2
    assert "tmcm1636 has no EtherCAT; its data (device.toml) have no table [ethercat]" in done.output


GOOD = {
    "receive": [0x1000, 256], "send": [0x1100, 256], "bootstrap_receive": [0x1000, 256],
    "bootstrap_send": [0x1100, 256], "outputs": 0x1200, "inputs": 0x1300, "only_on_can": "", "shortest_cycle": 1e-3,
    "eeprom": 2048,
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"recieve": [1, 2]}, "ethercat has no 'recieve'; did you mean 'receive'?"),
        ({"send": [0x0F00, 256]}, "ethercat.send = 0F00h, 256 bytes: a mailbox has 32 bytes or more, between 1000h"),
        ({"send": [0x1000, 16]}, "ethercat.send = 1000h, 16 bytes: a mailbox has 32 bytes or more"),
        ({"eeprom": 1000}, "ethercat.eeprom = 1000 bytes must be a multiple of 128"),
    ],
)
def test_what_cannot_be_in_the_table_is_told(change, message):
    with pytest.raises(ValueError) as caught:
        ethercat_of({**GOOD, **change})
    assert str(caught.value).startswith(message)


def test_a_table_that_lacks_something_is_told():
    with pytest.raises(ValueError, match="ethercat lacks outputs, inputs"):
        ethercat_of({key: value for key, value in GOOD.items() if key not in ("outputs", "inputs")})
