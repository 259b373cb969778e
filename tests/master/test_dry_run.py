"""A dry run: frames as candump shows them, and an imagined drive whose statusword follows its controlword."""

from __future__ import annotations

import pytest
from rigs.small_eds import eds_of

from drive_env.fieldbus.description import describe
from drive_env.master.can.dry_run import DryPort, DrySdoClient, show_frame


@pytest.mark.parametrize(("frame", "text"), [
    ((0x80, b""), "080   [0]"), ((0x601, bytes([0x40, 0x41, 0x60, 0])), "601   [4]  40 41 60 00"),
    ((0x701, b"", 4), "701   [4]  remote request"), ((0x5, b"\xab"), "005   [1]  AB"),
])  # fmt: skip
def test_a_frame_as_candump_shows_it(frame, text):
    assert show_frame(*frame) == text


def test_a_port_writes_frames_down_and_waits_for_nothing():
    lines = []
    port = DryPort(lines.append)
    port.subscribe(0x581, None)
    port.send(0x80)
    port.send(0x701, remote=True, length=1)
    assert lines == ["080   [0]", "701   [1]  remote request"]
    assert port.receive(10.0) is False and port.wait(lambda: False, 10.0) is True
    port.close()


@pytest.fixture
def client(tmp_path):
    """An imagined drive of four axes."""
    objects = [(0x6041, "u16", "ro"), (0x6040, "u16", "rw"), (0x6060, "i8", "rw"), (0x6061, "i8", "ro")]
    rows = [(index + 0x800 * axis, kind, access) for axis in range(4) for index, kind, access in objects]
    lines = []
    made = DrySdoClient(DryPort(lines.append), 5, describe(None, eds_of(tmp_path, *rows)))
    made.lines = lines
    return made


def word(client, value, axis=0):
    client.write(0x6040 + 0x800 * axis, 0, value.to_bytes(2, "little"), "", 1.0)
    return int.from_bytes(client.read(0x6041 + 0x800 * axis, 0, "", 1.0), "little")


def test_the_statusword_follows_the_controlword(client):
    """CiA 402: shutdown, switch on, enable operation, a new set-point, quick stop, fault reset."""
    assert int.from_bytes(client.read(0x6041, 0, "", 1.0), "little") == 0x0240
    found = [word(client, value) for value in (0x06, 0x07, 0x0F, 0x1F, 0x3F, 0x0F, 0x02, 0x0F, 0x00, 0x80, 0x16)]
    assert found == [0x0221, 0x0233, 0x0637, 0x1637, 0x1637, 0x0637, 0x0240, 0x0637, 0x0240, 0x0240, 0x0221]


def test_each_axis_has_its_own_statusword_and_mode(client):
    assert word(client, 0x0F, 3) == 0x0637
    assert int.from_bytes(client.read(0x6041, 0, "", 1.0), "little") == 0x0240
    client.write(0x6060, 0, b"\x08", "", 1.0)
    client.write(0x7060, 0, b"\x09", "", 1.0)
    assert client.read(0x6061, 0, "", 1.0) == b"\x08" and client.read(0x7061, 0, "", 1.0) == b"\x09"
    assert client.read(0x6861, 0, "", 1.0) not in (b"\x08", b"\x09")


def test_what_is_not_of_the_profile_is_kept_and_commands_nothing(client):
    client.write(0x2040, 0, b"\x0f\0", "", 1.0)
    assert int.from_bytes(client.read(0x6041, 0, "", 1.0), "little") == 0x0240
    assert client.read(0x2040, 0, "", 1.0) == b"\x0f\0"
    assert client.read(0x5FFE, 7, "", 1.0) == bytes(4)  # nobody knows it
    client.command(0x6081, 0, b"\1\2\3\4")
    assert client.ask(0x6081, 0, 0.1) == b"\1\2\3\4"
    client.put_back(0x6081, 0, b"\4\3\2\1", "", 1.0)
    assert client.read(0x6081, 0, "", 1.0) == b"\4\3\2\1"


@pytest.mark.parametrize(("data", "line"), [
    (b"\x08", "605   [8]  2F 60 60 00 08 00 00 00"), (b"\x0f\0", "605   [8]  2B 60 60 00 0F 00 00 00"),
    (b"\1\2\3", "605   [8]  27 60 60 00 01 02 03 00"), (b"\1\2\3\4", "605   [8]  23 60 60 00 01 02 03 04"),
    (b"12345", "605   [8]  21 60 60 00 05 00 00 00"),
])  # fmt: skip
def test_requests_are_those_of_cia_301(client, data, line):
    client.write(0x6060, 0, data, "", 1.0)
    client.read(0x6061, 0, "", 1.0)
    assert client.lines == [line, "605   [8]  40 61 60 00 00 00 00 00"]
