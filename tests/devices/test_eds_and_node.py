"""What an EDS says of a node on CAN, as python-canopen reads it, is what the node does."""

from __future__ import annotations

import io

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.dictionary.aborts import CANNOT_BE_STORED, READ_ONLY, VALUE_RANGE, VALUE_TOO_HIGH, VALUE_TOO_LOW
from drive_env.dictionary.entries import eds_text

DEVICES = ("tmcm1636", "tmcm1636_fw109", "tmcm3313", "tmcm6212", "tgz_d")
NODE = 5


@pytest.fixture(scope="module", params=DEVICES)
def name(request):
    return request.param


@pytest.fixture(scope="module")
def variables(name):
    """Return the variables of the EDS by index and sub-index."""
    source = io.StringIO(eds_text(find_device(name).eds))
    source.name = f"{name}.eds"
    found = {}
    for item in canopen.import_od(source, NODE).values():
        for one in [item] if isinstance(item, ODVariable) else item.values():
            found[one.index, one.subindex] = one
    return found


@pytest.fixture
def wire(name):
    """A node with factory values."""
    axes = find_device(name).num_axes
    with EmulatedDrives(name, "inertia", num_machines=axes, num_threads=1, commissioned=False) as drives:
        yield Wire(drives, NODE)


def numbers(variables):
    """Return the integers that an expedited transfer carries."""
    return [one for one in variables.values() if one.data_type in datatypes.INTEGER_TYPES and len(one) <= 32]


@pytest.mark.every(3)
def test_both_limits_of_an_object_are_taken(name, wire, variables):
    """Not in each state, and not each number between them: `[values]` of the device's data has the steps."""
    without = find_device(name).unsupported
    writable = [
        one for one in numbers(variables) if "w" in one.access_type and (one.index, one.subindex) not in without
    ]
    ends = [(one, raw) for one in writable for raw in (one.min, one.max)]
    refused = {VALUE_RANGE, VALUE_TOO_HIGH, VALUE_TOO_LOW, CANNOT_BE_STORED, READ_ONLY}
    wrong = [
        f"{one.index:04X}:{one.subindex} {raw}"
        for one, raw in ends
        if raw is not None and wire.download(one.index, one.subindex, raw, len(one) // 8) in refused
    ]
    assert len(ends) > 100 and wrong == []


def test_the_limits_are_those_of_the_values_that_the_device_knows(name, variables):
    device = find_device(name)
    for key, known in device.allowed_values.items():
        if key in variables and "w" in variables[key].access_type and key not in device.unsupported:
            one = variables[key]
            low = one.min if one.min is not None else 0
            high = one.max if one.max is not None else 2 ** len(one) - 1
            assert (low, high) == (min(known), max(known)), f"{key[0]:04X}h:{key[1]}"


def test_what_can_be_written_has_a_service_behind_it_or_a_reason(name, wire, variables):
    """Of the TMCM-3313 everything has: what EtherCAT alone can write is read only."""
    device = find_device(name)
    without = {
        (one.index, one.subindex)
        for one in numbers(variables)
        if one.access_type in ("rw", "wo")
        and one.index not in (0x1010, 0x1011)  # which take their signatures alone
        and wire.download(one.index, one.subindex, int(one.default or 0), len(one) // 8) == CANNOT_BE_STORED
    }
    assert without <= device.unsupported.keys()
    assert name != "tmcm3313" or without == set()
