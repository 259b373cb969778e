"""What a master knows of a device: keys of its axes, bytes of its values, time-outs and emergencies."""

from __future__ import annotations

import struct

import pytest
from rigs.small_eds import eds_of

from drive_env.devices import find_device
from drive_env.dictionary.aborts import WRONG_TYPE, ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.description import CIA_402, LONGEST_TIMEOUT, NODE_CODES, check_timeout, describe

SERVO = describe("tmcm1636", None)
SERVO_EDS = find_device("tmcm1636").eds


STATUS = (0x6041, "u16", "ro")


def test_a_known_device_brings_its_own():
    assert (SERVO.name, SERVO.num_axes, SERVO.cycle) == ("tmcm1636", 1, 0.001)
    assert SERVO.role(Role.CURRENT_LIMIT) == (0x2003, 0) and SERVO.device is not None
    with pytest.raises(ValueError, match="give the name of a device, or the EDS of the drive"):
        describe(None, None)


def test_any_other_drive_is_its_eds_and_the_defaults_of_cia_402(tmp_path):
    found = describe(None, eds_of(tmp_path, STATUS, (0x6841, "u16", "ro"), (0x7041, "u16", "ro")))
    assert (found.name, found.num_axes, found.device, found.hints) == ("some", 3, None, CIA_402)
    assert found.role(Role.CURRENT_LIMIT) == (0x6073, 0)
    status = found.dictionary.find(0x6041)
    assert [found.key(status, axis) for axis in range(3)] == [(0x6041, 0), (0x6841, 0), (0x7041, 0)]
    assert found.key(found.dictionary.find(0x1000), 2) == (0x1000, 0)
    assert found.label(status, 2) == "7041h:00 object 6041"
    assert found.of_further_axes() == {(0x6841, 0): (status, 1), (0x7041, 0): (status, 2)}
    assert describe(None, SERVO_EDS).of_further_axes() == {}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([(0x6040, "u16", "rw")], "describes no CiA 402 drive: it has no statusword 6041h"),
        (
            [STATUS, (0x6064, "i16", "ro")],
            r"6064h object 6064 is an integer of 16 bits \(0003h\), and CiA 402 has it with 32",
        ),
        ([(0x6041, "u8", "ro")], "6041h object 6041 is an integer of 8 bits"),
        ([STATUS, (0x6841, "u16", "ro"), (0x6864, "f32", "ro")], r"6864h object 6864 is of no integer type \(0008h\)"),
        ([STATUS, (0x6060, "i64", "rw")], "6060h .* CiA 402 has it with 8 bits; a drive needs an integer of 8 to 32"),
    ],
)
def test_what_decides_what_a_drive_does_has_cia_402s_length(tmp_path, rows, message):
    with pytest.raises(ValueError, match=message):
        describe(None, eds_of(tmp_path, *rows))


def test_a_file_that_is_none(tmp_path):
    with pytest.raises(ValueError, match=r"there is no EDS at .*nowhere\.eds; give the path"):
        describe(None, tmp_path / "nowhere.eds")


@pytest.mark.parametrize(
    ("kind", "value", "data"),
    [
        ("u8", 200, "c8"), ("i8", -2, "fe"), ("u16", 0xABCD, "cd ab"), ("i16", -2, "fe ff"),
        ("u24", 0x123456, "56 34 12"),
        ("u32", 2**32 - 1, "ff ff ff ff"), ("i32", -(2**31), "00 00 00 80"), ("i64", -2, "fe ff ff ff ff ff ff ff"),
        ("bool", 1, "01"), ("text", "Gerät", "47 65 72 c3 a4 74"),
    ],
)  # fmt: skip
def test_bytes_of_a_value_and_back(tmp_path, kind, value, data):
    found = describe(None, eds_of(tmp_path, STATUS, (0x2000, kind, "rw")))
    entry, raw = found.dictionary.find(0x2000), bytes.fromhex(data)
    assert found.encode(entry, value) == raw and found.decode(entry, raw) == value
    assert found.is_number(entry) == (kind != "text")
    if kind != "text":
        assert found.size(entry) == len(raw)
        assert found.decode(entry, raw + b"\x55") == value  # more than the type has is forgiven
        with pytest.raises(
            ObjectAccessError, match=f"has {len(raw)} bytes by the EDS, and {len(raw) - 1} came"
        ) as caught:
            found.decode(entry, raw[:-1])
        assert caught.value.abort_code == WRONG_TYPE
    else:
        assert found.decode(entry, raw + b"\0\0") == value and found.decode(entry, b"\xff\0") == "\ufffd"


def test_what_is_neither_number_nor_text_is_its_bytes(tmp_path):
    found = describe(None, eds_of(tmp_path, STATUS, (0x2000, "octets", "rw"), (0x2001, "f32", "rw")))
    assert found.decode(found.dictionary.find(0x2000), b"\1\xab") == "01 ab"
    assert found.decode(found.dictionary.find(0x2001), struct.pack("<f", 1.5)) == 1.5
    assert not found.is_number(found.dictionary.find(0x2001))


def test_a_mode_that_can_only_be_written_is_shown_by_another(tmp_path):
    found = describe(None, eds_of(tmp_path, STATUS, (0x6060, "i8", "wo"), (0x6061, "i8", "ro"), (0x6040, "u16", "wo")))
    mode, shown, word = (found.dictionary.find(index) for index in (0x6060, 0x6061, 0x6040))
    assert found.shown_by(mode) is shown and found.shown_by(word) is word and found.shown_by(shown) is shown
    found = describe(None, eds_of(tmp_path, STATUS, (0x6060, "i8", "rw"), (0x6061, "i8", "ro")))
    mode = found.dictionary.find(0x6060)
    assert found.shown_by(mode) is mode
    found = describe(None, eds_of(tmp_path, STATUS, (0x6060, "i8", "wo")))
    mode = found.dictionary.find(0x6060)
    assert found.shown_by(mode) is mode


def test_how_long_an_answer_may_take(tmp_path):
    found = describe(None, eds_of(tmp_path, STATUS, (0x1010, "u32", "rw"), (0x2000, "u32", "rw")))
    store, other = found.dictionary.find(0x1010), found.dictionary.find(0x2000)
    found.timeout = 0.25
    assert (found.patience(other), found.patience(store)) == (0.25, 10.0)  # it erases flash
    found.timeout = 20.0
    assert found.patience(store) == 20.0
    found.timeouts[0x1010, 0] = 0.125
    assert (found.patience(store), found.patience(other)) == (0.125, 20.0)
    assert CIA_402.timeout == 0.5 and CIA_402.timeouts == {0x1010: 10.0, 0x1011: 10.0} and CIA_402.rpdo_type == 1


@pytest.mark.parametrize(("timeout", "holds"), [(1e-9, True), (LONGEST_TIMEOUT, True), (0.0, False), (-1.0, False),
                                                (3600.1, False), (float("inf"), False),
                                                (float("nan"), False)])  # fmt: skip
def test_a_time_out_ends(timeout, holds):
    if holds:
        assert check_timeout(timeout) == timeout
        return
    with pytest.raises(ValueError, match=r"is impossible; give one above 0 s, e.g. 0.5, up to an hour"):
        check_timeout(timeout)


def test_errors_of_a_node_are_those_of_its_software_and_of_its_communication():
    """CiA 301, table 26: 60xxh to 6Fxxh, and 80xxh to 82xxh."""
    codes = [code for code in range(0x100) if any(code in group for group in NODE_CODES)]
    assert codes == [*range(0x60, 0x70), 0x80, 0x81, 0x82]


def test_emergencies_have_the_devices_name_or_cia_301s_or_their_code(tmp_path):
    found = describe(None, eds_of(tmp_path, STATUS))
    assert found.emergency(0x8130, (0,) * 5) == ("heartbeat_lost", 0)
    assert found.emergency(0xFFAA, (0,) * 5) == ("emergency_FFAAh", 0)
    assert list(found.axes_of_emergency("anything", 0)) == [0]
    codes = [row.code for row in SERVO.device.emergencies.values()]
    for name, row in SERVO.device.emergencies.items():
        if codes.count(row.code) == 1:
            assert SERVO.emergency(row.code, (0,) * 5) == (name, 0)
