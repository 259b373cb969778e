"""Store and restore: signatures, groups, resets, bit rate and node ID, and a file that survives being killed."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives
from drive_env.canopen.node import Node
from drive_env.node import store

SAVE = "73 61 76 65"
STORE_FILE = Path(store.__file__)


@pytest.fixture
def drives():
    with EmulatedDrives(load="inertia", num_threads=1) as made:
        yield made


@pytest.fixture
def wire(drives):
    return Wire(drives)


def power_cycled(wire):
    wire.node.power_on(wire.now)
    assert [str(frame) for frame in wire.take()] == [f"{0x700 + wire.node.node_id:03X}  00"]


# One object of each section: index, sub, size, a new value, the value of before.
PARAMETERS = {
    "communication": (0x1017, 0, 2, 1234),
    "profile": (0x6081, 0, 4, 4711),
    "motor 0": (0x2003, 0, 4, 815),
    "bus": (0x2704, 0, 2, 500),
}


def test_reset_communication_brings_stored_communication_parameters_alone(wire):
    assert wire.download(0x1017, 0, 1234, 2) == 0
    assert wire.download(0x6081, 0, 4711, 4) == 0
    assert wire.download(0x1010, 1, 0x65766173, 4) == 0
    assert wire.download(0x1017, 0, 0, 2) == 0
    assert wire.download(0x6081, 0, 1, 4) == 0
    wire.play("rx 000  82 05\ntx 705  00")
    assert wire.value(0x1017) == 1234
    assert wire.value(0x6081) == 1


# --- bit rate and node ID ---------------------------------------------------------------------------------------------
def test_the_bit_rate_is_that_of_the_bus_while_none_is_stored(drives):
    wire = Wire(drives, bit_rate=125_000)
    wire.play("""
        rx 605  40 04 27 00 00 00 00 00
        tx 585  4B 04 27 00 7D 00 00 00
        rx 605  40 07 27 00 00 00 00 00
        tx 585  4B 07 27 00 7D 00 00 00
    """)


def test_a_node_with_another_bit_rate_is_off_the_bus(drives, caplog):
    wire = Wire(drives, bit_rate=1_000_000)
    wire.play(f"""
        rx 605  2B 04 27 00 7D 00 00 00   # 125 kbit/s
        tx 585  60 04 27 00 00 00 00 00
        rx 605  23 06 27 00 {SAVE}
        tx 585  60 06 27 00 00 00 00 00
        rx 605  2B 17 10 00 0A 00 00 00
        tx 585  60 17 10 00 00 00 00 00
        rx 000  81 05
        wait 20 ms
        rx 605  40 07 27 00 00 00 00 00
        rx 000  81 05
    """)
    assert wire.node.bit_rate == 125
    assert "node 5 has 125 kbit/s stored and is off the bus, which has 1000 kbit/s" in caplog.text


def test_a_bit_rate_that_the_device_does_not_have_is_told(drives):
    with pytest.raises(ValueError, match="tmcm1636 has no bit rate of 123 bit/s; it has 20000, 50000, 100000"):
        Node(5, drives, send=lambda frame: None, bit_rate=123)


def test_2706h_stores_nothing_else(wire):
    before = wire.value(0x6081)
    assert wire.download(0x6081, 0, 4711, 4) == 0
    assert wire.download(0x1017, 0, 99, 2) == 0
    assert wire.download(0x2706, 0, 0x65766173, 4) == 0
    power_cycled(wire)
    assert (wire.value(0x6081), wire.value(0x1017)) == (before, 0)


def test_a_stored_identifier_of_its_own_stays_while_others_follow_the_node_id(wire):
    assert wire.download(0x1400, 1, 0xC000_0205, 4) == 0
    assert wire.download(0x1400, 1, 0x4000_0333, 4) == 0
    assert wire.download(0x2705, 0, 33, 1) == 0
    assert wire.download(0x1010, 1, 0x65766173, 4) == 0
    power_cycled(wire)
    assert [wire.value(0x1400, 1), wire.value(0x1401, 1)] == [0x4000_0333, 0x4000_0321]


# --- the file ---------------------------------------------------------------------------------------------------------
def test_a_file_outlives_the_node(tmp_path, drives):
    path = tmp_path / "node.json"
    first = Wire(drives, store=path)
    for index, sub, size, raw in PARAMETERS.values():
        assert first.download(index, sub, raw, size) == 0
    assert not path.exists(), "nothing was saved yet"
    assert first.download(0x1010, 1, 0x65766173, 4) == 0
    content = json.loads(path.read_text(encoding="utf-8"))
    assert content["sections"]["profile"]["6081:0"] == 4711
    assert content["sections"]["bus"] == {"2704:0": 500, "2705:0": 5}
    assert [p.name for p in tmp_path.iterdir()] == ["node.json"]
    with EmulatedDrives(load="inertia", num_threads=1) as others:
        second = Wire(others, node_id=5, store=path)
        for index, sub, _, raw in PARAMETERS.values():
            assert second.value(index, sub) == raw
        assert others.read(0x6081)[0] == 4711


def test_a_stored_node_id_replaces_the_given_one(tmp_path, drives):
    path = tmp_path / "node.json"
    wire = Wire(drives, store=path)
    assert wire.download(0x2705, 0, 33, 1) == 0
    assert wire.download(0x2706, 0, 0x65766173, 4) == 0
    assert Wire(drives, node_id=5, store=path).node.node_id == 33


# The child loads store.py alone: a start that takes 30 ms leaves time for 200.
CHILD = """
import importlib.util, json, os, sys, types
reader = types.ModuleType("mechanics.reading.untrusted")  # which needs NumPy; the parent reads with the real one
reader.read_json = lambda path: json.loads(path.read_text(encoding="utf-8"))
sys.modules |= {"mechanics": types.ModuleType("mechanics"), "mechanics.reading.untrusted": reader}
spec = importlib.util.spec_from_file_location("store", sys.argv[1])
store = importlib.util.module_from_spec(spec)
sys.modules["store"] = store
spec.loader.exec_module(store)
from pathlib import Path
memory = store.Store(Path(sys.argv[2]), "test")
generation = memory.sections["a"][0x2000, 0] if memory.sections else 0
while True:
    generation += 1
    values = {(0x2000 + k, 0): generation for k in range(60)}
    memory.save({"a": values, "b": values})
    os.write(1, b"%d\\n" % generation)
"""
KILLS = 200


@pytest.mark.slow
def test_200_kills_lose_nothing(tmp_path):
    path = tmp_path / "memory.json"
    dice = random.Random(1636)
    confirmed = 0
    for _ in range(KILLS):
        child = subprocess.Popen(
            [sys.executable, "-S", "-E", "-c", CHILD, str(STORE_FILE), str(path)], stdout=subprocess.PIPE
        )
        first = child.stdout.readline()  # it is saving now
        time.sleep(dice.uniform(0.0, 0.006))
        child.kill()
        rest, _ = child.communicate()
        confirmed = int((first + rest).split()[-1])
        memory = store.Store(path, "test")
        values = {raw for section in memory.sections.values() for raw in section.values()}
        assert {len(section) for section in memory.sections.values()} == {60}
        assert len(values) == 1, "a mixture"
        assert values <= {confirmed, confirmed + 1}, "the old set or the new"
    assert confirmed > KILLS, "the children did save"
