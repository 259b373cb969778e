"""A node's own objects, its dictionary and what it keeps without power, with axes of this test."""

from __future__ import annotations

import json
import os
from types import SimpleNamespace

import pytest

from drive_env.devices import find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node import store as store_module
from drive_env.node.axis import ObjectPort
from drive_env.node.node_dictionary import NodeDictionary
from drive_env.node.node_objects import NodeObjects
from drive_env.node.parameters import Parameters
from drive_env.node.store import PowerLostError, Store

SAVE = 0x65766173  # "save"


class Axis:
    """An axis whose objects are numbers; the indices are those of axis 0."""

    def __init__(self):
        self.values, self.stored = {}, None

    def port(self, entry):
        key = (entry.index, entry.sub)
        return ObjectPort(entry, lambda: self.values.get(key, entry.default), lambda raw: None,
                          lambda raw: self.values.__setitem__(key, raw))  # fmt: skip


class Axes(list):
    """Axes that note what a restart restores."""

    stored = None

    def store(self, values):
        self.stored = values


class Node:
    """The parts of a node of a device that have to do with its objects."""

    def __init__(self, name, path=None):
        self.device = find_device(name)
        entries, self.changed, self.works, self.node_id = self.device.new_dictionary(), [], 0, 5
        self.objects = NodeObjects(self.device, entries, self.changed.append)
        self.objects.restore(5, {})
        self.axes = Axes(Axis() for _ in range(self.device.num_axes))
        self.dictionary = NodeDictionary(self.device, entries, self.objects, self.axes)
        self.store = Store(path, name)
        self.parameters = Parameters(
            self.device, self.objects, self.axes, self.dictionary, self.store, lambda: self.node_id, self._work
        )
        self.parameters.add_commands()

    def _work(self):
        self.works += 1

    def write(self, index, sub, raw):
        port = self.dictionary.port(index, sub)
        port.check(raw)
        port.write(raw)

    def read(self, index, sub=0):
        return self.dictionary.port(index, sub).read()


@pytest.fixture
def node():
    return Node("tmcm1636")


@pytest.fixture
def six():
    return Node("tmcm6212")


# --- the node's own objects -------------------------------------------------------------------------------------------
def test_the_areas_of_communication_end_with_1fffh(node):
    for index, owned in ((0x0FFF, False), (0x1000, True), (0x1FFF, True), (0x2000, False)):
        assert node.objects.owns(SimpleNamespace(index=index, sub=0)) is owned


def test_values_are_numbers_and_0_of_what_is_not_there(node):
    node.write(0x1017, 0, 500)
    assert node.objects.value(0x1017) == 500 and node.objects.value(0x1017, 7) == node.objects.value(0x5FFE) == 0
    assert node.objects.has(0x1017) and not node.objects.has(0x5FFE)
    assert node.objects.subs(0x1010) == [1, 2, 3, 4] and node.objects.subs(0x1017) == []


def test_a_value_is_held_against_its_limits_and_those_that_the_device_takes(six):
    with pytest.raises(ObjectAccessError):
        six.write(0x1017, 0, 65536)
    (key, allowed), *_ = [(k, v) for k, v in six.device.allowed_values.items() if k[0] == 0x1029]
    six.write(*key, allowed[0])
    with pytest.raises(ObjectAccessError):
        six.dictionary.port(*key).check(max(allowed) + 1)


# --- which section a parameter is of ----------------------------------------------------------------------------------
@pytest.mark.parametrize(("index", "sub", "section"), [
    (0x1017, 0, "communication"), (0x1800, 1, "communication"), (0x1A00, 1, "communication"),
    (0x2704, 0, "bus"), (0x2705, 0, "bus"),
    (0x6081, 0, "profile"), (0x6065, 0, "profile"), (0x2003, 0, "motor 0"), (0x6060, 0, None), (0x2101, 0, None),
    (0x6040, 0, None), (0x6041, 0, None), (0x1000, 0, None), (0x1008, 0, None), (0x1010, 1, None),
])  # fmt: skip
def test_a_parameter_is_of_a_section_and_what_commands_is_none(node, index, sub, section):
    assert node.dictionary.section(node.dictionary.entries.find((index, sub))) == section


def test_each_axis_has_a_section_of_its_motor_and_the_module_one(six):
    found = {six.dictionary.section(entry) for entry in six.dictionary.entries} - {None}
    assert found == {"bus", "communication", "profile", "module", *(f"motor {axis}" for axis in range(6))}
    axis_2 = [e.index for e in six.dictionary.entries if six.dictionary.section(e) == "motor 2"]
    assert {index & 0xFE00 for index in axis_2} == {0x2400}


def test_some_devices_store_what_a_pdo_can_carry_unless_it_commands():
    node = Node("tgz_d")
    find = node.dictionary.entries.find
    for index in (0x6040, 0x6060, 0x607A, 0x60FF, 0x6071, 0x6840, 0x23C6, 0x24C6):
        assert node.dictionary.section(find(index)) is None, hex(index)
    kept = [e for e in node.dictionary.entries if e.pdo_mappable and node.dictionary.section(e)]
    assert kept, "a TGZ keeps profile velocities, which a PDO may carry"


# --- storing ----------------------------------------------------------------------------------------------------------
def test_what_has_its_factory_value_is_not_stored(node):
    node.write(0x1017, 0, 500)
    node.axes[0].values[0x2003, 0] = 815
    node.write(0x1010, 1, SAVE)
    assert node.works == 1
    sections = node.store.sections
    assert set(sections) == {"bus", "communication", "profile", "motor 0"}
    assert sections["communication"] == {(0x1017, 0): 500}, "COB-IDs follow the node"
    assert sections["motor 0"] == {(0x2003, 0): 815} and sections["profile"] == {}
    assert set(sections["bus"]) == {(0x2704, 0), (0x2705, 0)}, "of the bus all is kept"
    assert node.axes.stored[0][0x2003, 0] == 815


def test_a_stored_value_that_fits_no_object_is_told(node, tmp_path):
    node.store.sections = {"communication": {(0x1017, 0): 500}}
    node.parameters.check(tmp_path)
    node.store.sections = {"communication": {(0x1017, 0): 70_000}}
    with pytest.raises(ValueError, match=r"does not fit tmcm1636: .*1017h:00 .*; delete it$"):
        node.parameters.check(tmp_path)
    asked = []
    node.parameters.check(tmp_path, lambda *what: asked.append(what) or True)
    assert asked == [("communication", (0x1017, 0), 70_000)]


def test_a_section_may_make_another_void(node):
    node.parameters.replaces["bus"] = "lss"
    node.write(0x1010, 2, SAVE)
    assert "lss" not in node.store.sections, "it is not there"
    node.store.sections["lss"] = {(1, 0): 5}
    node.write(0x1010, 3, SAVE)
    assert node.store.sections["lss"] == {(1, 0): 5}
    node.write(0x1010, 2, SAVE)
    assert node.store.sections["lss"] == {}


def test_a_node_that_starts_has_what_is_stored_or_the_factory_s(node):
    assert node.read(0x1800, 1) & 0x7FF == 0x185 and node.read(0x1017) == 0
    node.write(0x1017, 0, 500)
    assert node.read(0x1017) == 500 and node.changed == [0x1017]
    node.objects.restore(7, {(0x1016, 1): 0x50064})
    assert (node.read(0x1017), node.read(0x1016, 1), node.read(0x1800, 1) & 0x7FF) == (0, 0x50064, 0x187)
    assert node.objects.factory_value(node.objects.find(0x1800, 1)) & 0x7FF == 0x181


def test_what_cannot_be_written_is_a_hardware_error(node):
    def fails(changed):
        raise OSError("disk full")

    node.store.save = fails
    with pytest.raises(ObjectAccessError, match=r"^the parameters cannot be stored: disk full ") as error:
        node.write(0x1010, 1, SAVE)
    assert error.value.abort_code == 0x06060000 and node.axes.stored is None


# --- the file ---------------------------------------------------------------------------------------------------------
def test_a_file_has_sections_and_objects_in_order(tmp_path):
    path = tmp_path / "store.json"
    store = Store(path, "tmcm1636")
    store.save({"profile": {(0x6083, 0): 2, (0x6081, 1): 1}, "bus": {}})
    assert path.read_text() == (
        '{\n "format": 1,\n "device": "tmcm1636",\n "sections": {\n  "bus": {},\n  "profile": {\n'
        '   "6081:1": 1,\n   "6083:0": 2\n  }\n }\n}\n'
    )
    assert Store(path, "tmcm1636").sections == {"profile": {(0x6083, 0): 2, (0x6081, 1): 1}, "bus": {}}
    store.save({"bus": {(0x2704, 0): 5}})
    assert Store(path, "tmcm1636").sections["profile"] == {(0x6083, 0): 2, (0x6081, 1): 1}
    assert [one.name for one in tmp_path.iterdir()] == ["store.json"]


@pytest.mark.parametrize("has_file", [True, False])
def test_where_the_power_fails_what_was_stored_before_is_stored_still(tmp_path, has_file):
    path = tmp_path / "store.json" if has_file else None
    store = Store(path, "tmcm1636")
    store.save({"bus": {(0x2704, 0): 5}})
    store.loses_power = True
    with pytest.raises(PowerLostError):
        store.save({"bus": {(0x2704, 0): 6}})
    assert store.sections == {"bus": {(0x2704, 0): 5}}
    if has_file:
        assert Store(path, "tmcm1636").sections == {"bus": {(0x2704, 0): 5}}
        whole = len(path.read_text())
        assert len((tmp_path / "store.json.new").read_text()) == whole // 2


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    path, synced = tmp_path / "store.json", []

    def fsync(number):
        synced.append((os.fstat(number).st_mode & 0o170000 == 0o040000, path.exists()))

    monkeypatch.setattr(store_module.os, "fsync", fsync)
    Store(path, "tmcm1636").save({})
    assert synced == [(False, False), (True, True)], "the file, and then its folder"


GOOD = {"format": 1, "device": "tmcm1636", "sections": {"bus": {"2704:0": 5}}}


@pytest.mark.parametrize(("change", "why"), [
    ({"format": 2}, "it is of format 2 and of a tmcm1636"), ({"device": "other"}, "it is of format 1 and of a other"),
    ({"sections": {"bus": {"2704:0": 1.5}}}, "2704:0 is 1.5, no whole number"),
    ({"sections": {"bus": {"2704:0": True}}}, "2704:0 is True, no whole number"),
    ({"sections": {"bus": {"2704": 1}}}, ""), ({"sections": {"bus": 1}}, ""), ({"sections": None}, ""),
    ({"sections": {"bus": {"27x4:0": 1}}}, ""),
])  # fmt: skip
def test_a_file_of_something_else_is_told(tmp_path, change, why):
    path = tmp_path / "store.json"
    path.write_text(json.dumps(GOOD))
    assert Store(path, "tmcm1636").sections == {"bus": {(0x2704, 0): 5}}
    path.write_text(json.dumps({**GOOD, **change}))
    with pytest.raises(
        ValueError, match=r"has no parameters of a tmcm1636 .*; give another file, or delete it"
    ) as error:
        Store(path, "tmcm1636")
    assert why in str(error.value)


@pytest.mark.parametrize("text", ["", "[]", "{}", "1", "[" * 100_000])
def test_what_is_no_such_file_is_told(tmp_path, text):
    path = tmp_path / "store.json"
    path.write_text(text)
    with pytest.raises(ValueError, match="has no parameters of a tmcm1636"):
        Store(path, "tmcm1636")
