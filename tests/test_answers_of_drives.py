"""What a drive's own words are called: abort codes of CiA 301, its emergencies, a node's identity."""

from __future__ import annotations

import tomllib

import pytest

from drive_env.master.description import EMERGENCY_NAMES
from drive_env.master.errors import refused
from drive_env.master.identity import Identity


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
