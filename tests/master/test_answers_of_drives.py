"""What a drive's own words are called: abort codes of CiA 301, its emergencies, a node's identity."""

from __future__ import annotations

import tomllib
from types import SimpleNamespace

import pytest

from drive_env.dictionary import aborts
from drive_env.dictionary.aborts import NO_SUCH_OBJECT, ObjectAccessError
from drive_env.fieldbus.description import EMERGENCY_NAMES
from drive_env.fieldbus.errors import _ABORTS, refused
from drive_env.master.identity import Identity, OtherDriveError, check_same_drive, load_identity, read_identity


# CiA 301, table 22.
@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x06070010, "length does not match the data type"),
        (0x06070012, "too long for the data type"),
        (0x06070013, "too short for the data type"),
        (0x06090011, "no such sub-index"),
        (0x06090030, "out of range"),
        (0x06090031, "too high; choose a lower one"),
        (0x06090032, "too low; choose a higher one"),
        (0x08000020, "cannot be stored"),
        (0x08000021, "local control"),
        (0x08000022, "present state does not allow it"),
        (0x06090033, "an abort code that CiA 301 does not list"),
    ],
)
def test_an_abort_code_in_words(code, words):
    error = refused("node 3", "the write of 7 to 6060h:00", code)
    assert str(error).startswith("node 3 refused the write of 7 to 6060h:00: ") and words in str(error)
    assert error.abort_code == code


def test_emergencies_of_the_communication():
    """CiA 301, table 26, and CiA 402's data error."""
    assert EMERGENCY_NAMES == {
        0x0000: "error_reset", 0x8110: "can_overrun", 0x8120: "can_error_passive", 0x8130: "heartbeat_lost",
        0x8140: "bus_off_recovered", 0x8210: "pdo_too_short", 0x8220: "pdo_too_long", 0x6320: "pdo_data_refused",
    }  # fmt: skip


def test_an_identity_is_written_as_people_read_it_without_what_is_not_known():
    lines = Identity("tmcm1636", node=3, name="Gerät 4", serial=17).to_toml()
    assert lines == ['device = "tmcm1636"', "node = 3", 'name = "Gerät 4"', "serial = 17"]
    assert tomllib.loads("\n".join(lines)) == {"device": "tmcm1636", "node": 3, "name": "Gerät 4", "serial": 17}


# CiA 301, table 22 of version 4.2; 0601 0003h is of ETG.1000.6.
CODES = """
    05030000 05040000 05040001 05040002 05040003 05040004 05040005 06010000 06010001 06010002 06010003 06020000 06040041
    06040042 06040043 06060000 06070010 06070012 06070013 06090011 06090030 06090031 06090032 08000000 08000020 08000021
    08000022
"""


def test_every_abort_code_has_its_meaning_and_what_to_try():
    assert set(_ABORTS) == {int(code, 16) for code in CODES.split()}
    own = {code for name, code in vars(aborts).items() if name.isupper() and isinstance(code, int)}
    assert own - set(_ABORTS) == {aborts.NO_DATA}  # of an error history that is empty
    assert "it can only be written" in _ABORTS[aborts.WRITE_ONLY][0]
    assert "it can only be read" in _ABORTS[aborts.READ_ONLY][0]
    assert all(meaning and remedy for meaning, remedy in _ABORTS.values())
    assert len({meaning for meaning, _ in _ABORTS.values()}) == len(_ABORTS)


# --- which drive it is ------------------------------------------------------------------------------------------------
SAID = {
    (0x1008, 0): b"TMCM-1636\0\0", (0x1009, 0): b" V1.2\n", (0x100A, 0): b"1.09", (0x1018, 1): b"\x86\2\0\0",
    (0x1018, 2): b"\x64\6\0\0", (0x1018, 3): b"\1\0\1\0", (0x1018, 4): b"\x11\0\0\0",
}  # fmt: skip
WHOLE = Identity("tmcm1636", 9, "TMCM-1636", "V1.2", "1.09", 0x286, 1636, 0x10001, 17)


def identity_of(said, node=1):
    def read(index, sub, label, timeout):
        assert label == f"{index:04X}h:{sub:02X}" and timeout == 0.3
        if (index, sub) not in said:
            raise ObjectAccessError(NO_SUCH_OBJECT, label)
        return said[index, sub]

    description = SimpleNamespace(name="tmcm1636", answer_timeout=0.3)
    clients = [None, SimpleNamespace(read=read)]
    return read_identity(SimpleNamespace(description=description, nodes=(3, 9), sdo=clients.__getitem__), node)


def test_what_a_node_says_of_itself():
    assert identity_of(SAID) == WHOLE
    assert identity_of(SAID | {(0x1018, 4): bytes(4)}).serial is None  # 0 is no number of a drive
    assert identity_of({}) == Identity("tmcm1636", 9)
    assert identity_of({(0x1008, 0): b"\xff A\x07B "}).name == "\ufffd AB"


def test_an_identity_reads_back_and_half_of_one_is_none():
    table = tomllib.loads("\n".join(WHOLE.to_toml()))
    assert load_identity(table) == WHOLE
    assert load_identity(table | {"something": 1, "serial": "17", "name": 5}) == WHOLE._replace(serial=None, name="")
    for name in ("device", "node", "vendor", "product"):
        assert load_identity({key: value for key, value in table.items() if key != name}) is None
    assert load_identity(table | {"node": True}) is None  # no number
    for name in ("name", "hardware", "software", "revision", "serial"):
        assert load_identity({key: value for key, value in table.items() if key != name}) is not None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, None),
        ({"node": 4}, None),  # the serial number tells
        ({"name": "x", "hardware": "x", "software": "x"}, None),
        ({"device": "tmcm6212"}, "read from device tmcm6212, and here is tmcm1636. Nothing was written"),
        ({"vendor": 1}, "vendor 1h, and here is 286h"),
        ({"product": 0x6212}, "product code 6212h, and here is 664h"),
        ({"revision": None}, "revision none, and here is 10001h"),
        ({"serial": 18}, "serial number 18, and here is 17"),
        ({"serial": None}, "serial number none, and here is 17"),
        ({"serial": 18, "vendor": 1}, "vendor 1h, and here is 286h; serial number 18, and here is 17"),
    ],
)
def test_a_file_of_another_drive(change, said):
    written = WHOLE._replace(**change)
    check_same_drive("backup.toml", written, WHOLE, other_drive=True)
    if said is None:
        check_same_drive("backup.toml", written, WHOLE)
        return
    with pytest.raises(OtherDriveError, match=said) as caught:
        check_same_drive("backup.toml", written, WHOLE)
    assert str(caught.value).startswith("backup.toml is of another drive: it was ")


def test_a_drive_without_a_serial_number_is_told_by_its_node_and_a_file_that_does_not_say_fits_any():
    here = WHOLE._replace(serial=None)
    check_same_drive("f", here, here)
    check_same_drive("f", None, here)
    with pytest.raises(OtherDriveError, match="read from node 4, and here is 9"):
        check_same_drive("f", here._replace(node=4), here)
