"""Roles: which object plays which part on a device, and that a part which nobody plays is an answer."""

from __future__ import annotations

import re
import tomllib

import pytest
from rigs import ROOT

from drive_env import EmulatedDrives, ObjectAccessError
from drive_env.devices import FOLDER, device_names, find_device
from drive_env.dictionary.entries import ObjectDictionary
from drive_env.dictionary.roles import Role


@pytest.mark.parametrize("name", device_names())
def test_every_role_of_a_device_is_an_object_that_it_has(name):
    device = find_device(name)
    dictionary = device.new_dictionary()
    for role, key in device.roles.items():
        assert dictionary.find(role) is dictionary.find(key)
        assert dictionary.has(role)


@pytest.mark.parametrize("name", device_names())
def test_what_the_record_has_as_a_position_a_speed_a_time_or_a_current_has_its_unit_in_the_eds(name):
    """A master knows units from there: commands take `300 rpm`, and the envelope counts speeds and ramps in them."""
    device = find_device(name)
    dictionary = device.new_dictionary()
    plain = {"counter": "inc", "position window": "inc", "position limit": "inc"}
    for key, row in device.bindings.items():
        if row.unit in ("pps", "pps^2", "pps^3", "rpm", "inc", "ms", "10ms", "mA", *plain):
            assert dictionary.find(key).unit == plain.get(row.unit, row.unit), dictionary.find(key).label


def test_every_row_of_a_table_of_roles_is_a_role():
    for path in FOLDER.glob("*/roles.toml"):
        assert set(tomllib.loads(path.read_text(encoding="utf-8"))) <= {role.name.lower() for role in Role}


def test_an_object_is_read_written_and_recorded_by_its_part():
    with EmulatedDrives("tmcm1636", "inertia", num_threads=1) as drives:
        drives.write(Role.CURRENT_LIMIT, 1234)
        assert drives.read(0x2003).tolist() == [1234]
        assert drives.read(Role.POSITION_SCALE).tolist() == drives.read((0x2058, 0)).tolist()
        trace = drives.record(Role.TORQUE_ERROR, 0.002)
        assert trace[Role.TORQUE_ERROR].tolist() == trace[0x2041, 3].tolist()


def test_a_part_that_no_object_plays_is_an_answer():
    dictionary = ObjectDictionary(find_device("tmcm1636").eds, roles={Role.CURRENT_LIMIT: (0x2003, 0)})
    assert not dictionary.has(Role.HALL_POLARITY)
    with pytest.raises(ObjectAccessError, match="this drive has no polarity of the hall sensors"):
        dictionary.find(Role.HALL_POLARITY)


def test_outside_the_devices_nobody_writes_an_index_of_a_manufacturer():
    written = []
    for package in ("drive_env", "mechanics", "tuning", "agents", "research"):
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            if name.startswith(("drive_env/devices/", "drive_env/firmware/", "drive_env/bus/")):
                continue
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                found = re.findall(r"\b0x[2-5][0-9A-Fa-f]{3}\b", line.split("#")[0])
                # 2000h is where the manufacturer's area begins (CiA 301); 3400h are bits of the statusword in homing.
                written += [f"{name}:{number} {word}" for word in found if word not in ("0x2000", "0x3400")]
    assert written == []
