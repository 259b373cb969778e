"""The layer setting services, row by row (CiA 305): transcripts, python-canopen as master, and what never happens."""

from __future__ import annotations

import json
import random

import canopen
import canopen.lss
import pytest
from rigs import TESTS
from rigs.canopen_wire import Wire

from drive_env import EmulatedDrives
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.canopen.lss import BIT_RATES, REQUEST, RESPONSE, LssSlave
from drive_env.canopen.nmt import NmtState
from drive_env.canopen.node import Node

DEVICE = str(TESTS / "all_services.toml")
IDENTITY = (0x286, 0x664, 0x10009, 5)  # of 1018h; the serial number is the node's first number


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(DEVICE, load="inertia", num_threads=1) as made:
        yield made


class Unconfigured(Wire):
    """A node without a node-ID."""

    def __init__(self, drives, store=None, serial=77):
        self.drives, self.now, self.sent = drives, 0.0, []
        self.node = Node(255, drives, send=self.sent.append, store=store, bit_rate=1_000_000, serial=serial)
        self.node.power_on(self.now)


@pytest.fixture
def fresh(drives):
    drives.machine.reset()
    made = Unconfigured(drives)
    assert made.sent == []  # no boot-up message
    return made


CONFIGURE = "rx 7E5  04 01 00 00 00 00 00 00\n"
WAIT = "rx 7E5  04 00 00 00 00 00 00 00\n"


# --- switch state -----------------------------------------------------------------------------------------------------
def test_a_slave_that_waits_answers_no_configuration(wire):
    for service in (0x11, 0x13, 0x15, 0x17, 0x5A, 0x5B, 0x5C, 0x5D, 0x5E):
        wire.play(f"rx 7E5  {service:02X} 05 00 00 00 00 00 00")


def test_switch_all(wire):
    wire.play(CONFIGURE + "rx 7E5  5E 00 00 00 00 00 00 00\ntx 7E4  5E 05 00 00 00 00 00 00")
    wire.play(WAIT + "rx 7E5  5E 00 00 00 00 00 00 00")
    wire.play("rx 7E5  04 02 00 00 00 00 00 00\nrx 7E5  5E 00 00 00 00 00 00 00")  # no such mode


def test_switch_the_one_with_this_identity(wire):
    wire.play("""
        rx 7E5  40 86 02 00 00 00 00 00
        rx 7E5  41 64 06 00 00 00 00 00
        rx 7E5  42 09 00 01 00 00 00 00
        rx 7E5  43 05 00 00 00 00 00 00
        tx 7E4  44 00 00 00 00 00 00 00
        rx 7E5  5E 00 00 00 00 00 00 00
        tx 7E4  5E 05 00 00 00 00 00 00
    """)


@pytest.mark.parametrize("wrong", range(4))
def test_another_identity_switches_nobody(wire, wrong):
    for part, number in enumerate(IDENTITY):
        number += part == wrong
        wire.play(f"rx 7E5  {0x40 + part:02X} {number.to_bytes(4, 'little').hex(' ')} 00 00 00")
    wire.play("rx 7E5  5E 00 00 00 00 00 00 00")


def test_an_identity_out_of_order_switches_nobody(wire):
    for part in (0, 2, 1, 3):
        wire.play(f"rx 7E5  {0x40 + part:02X} {IDENTITY[part].to_bytes(4, 'little').hex(' ')} 00 00 00")
    wire.play("rx 7E5  5E 00 00 00 00 00 00 00")


# --- inquire and identify ---------------------------------------------------------------------------------------------
def test_inquire_the_identity(wire):
    wire.play(CONFIGURE)
    wire.play("""
        rx 7E5  5A 00 00 00 00 00 00 00
        tx 7E4  5A 86 02 00 00 00 00 00
        rx 7E5  5B 00 00 00 00 00 00 00
        tx 7E4  5B 64 06 00 00 00 00 00
        rx 7E5  5C 00 00 00 00 00 00 00
        tx 7E4  5C 09 00 01 00 00 00 00
        rx 7E5  5D 00 00 00 00 00 00 00
        tx 7E4  5D 05 00 00 00 00 00 00
    """)


@pytest.mark.parametrize(
    ("revisions", "serials", "is_there"),
    [
        ((0x10009, 0x10009), (5, 5), True),
        ((0, 0xFFFF_FFFF), (0, 0xFFFF_FFFF), True),
        ((0x1000A, 0xFFFF_FFFF), (5, 5), False),
        ((0, 0x10008), (5, 5), False),
        ((0x10009, 0x10009), (6, 9), False),
        ((0x10009, 0x10009), (0, 4), False),
    ],
)
def test_identify_a_slave_within_ranges(wire, revisions, serials, is_there):
    numbers = (IDENTITY[0], IDENTITY[1], *revisions, *serials)
    for part, number in enumerate(numbers[:-1]):
        wire.play(f"rx 7E5  {0x46 + part:02X} {number.to_bytes(4, 'little').hex(' ')} 00 00 00")
    last = f"rx 7E5  4B {numbers[-1].to_bytes(4, 'little').hex(' ')} 00 00 00"
    wire.play(last + ("\ntx 7E4  4F 00 00 00 00 00 00 00" if is_there else ""))


def test_only_a_slave_without_a_node_id_says_so(wire, fresh):
    wire.play("rx 7E5  4C 00 00 00 00 00 00 00")
    fresh.play("rx 7E5  4C 00 00 00 00 00 00 00\ntx 7E4  50 00 00 00 00 00 00 00")


# --- node-ID ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("node_id", "code"), [(0, 1), (1, 0), (127, 0), (128, 1), (254, 1), (255, 0)])
def test_the_range_of_node_ids(wire, node_id, code):
    wire.play(CONFIGURE)
    wire.play(f"rx 7E5  11 {node_id:02X} 00 00 00 00 00 00\ntx 7E4  11 {code:02X} 00 00 00 00 00 00")


def test_a_node_id_takes_effect_with_reset_communication_and_no_sooner(wire):
    wire.play(CONFIGURE)
    wire.play("""
        rx 7E5  11 09 00 00 00 00 00 00
        tx 7E4  11 00 00 00 00 00 00 00
        rx 7E5  5E 00 00 00 00 00 00 00   # the active one is told
        tx 7E4  5E 05 00 00 00 00 00 00
        rx 7E5  04 00 00 00 00 00 00 00
        rx 605  40 41 60 00 00 00 00 00
        tx 585  4B 41 60 00 50 02 00 00
        rx 000  82 05
        tx 709  00
        rx 605  40 41 60 00 00 00 00 00
        rx 609  40 14 10 00 00 00 00 00
        tx 589  43 14 10 00 89 00 00 00   # COB-IDs follow
        rx 609  40 08 27 00 00 00 00 00
        tx 589  4F 08 27 00 09 00 00 00   # the device's own object shows it
    """)


def test_a_node_id_that_is_not_stored_is_gone_with_the_power(wire):
    wire.play(CONFIGURE)
    wire.play("rx 7E5  11 09 00 00 00 00 00 00\ntx 7E4  11 00 00 00 00 00 00 00\nrx 000  81 05\ntx 709  00")
    wire.node.power_on(wire.now)
    assert [str(frame) for frame in wire.take()] == ["705  00"]


def test_stored_it_stays(drives, tmp_path):
    path = tmp_path / "node.json"
    wire = Wire(drives, store=path)
    wire.play(CONFIGURE)
    wire.play("""
        rx 7E5  11 09 00 00 00 00 00 00
        tx 7E4  11 00 00 00 00 00 00 00
        rx 7E5  17 00 00 00 00 00 00 00
        tx 7E4  17 00 00 00 00 00 00 00
    """)
    wire.node.power_on(wire.now)
    assert [str(frame) for frame in wire.take()] == ["709  00"]
    again = Wire(drives, store=path)  # another life, with the number of the first
    assert again.node.node_id == 9
    again.receive(0x609, "2F 05 27 00 0C 00 00 00")  # the device's own way to store a node-ID comes later, and counts
    again.receive(0x609, "23 06 27 00 73 61 76 65")
    assert Wire(drives, store=path).node.node_id == 12


@pytest.mark.parametrize("row", ['"0000:1": 0', '"0000:1": 128', '"0000:2": 77', '"0000:3": 1'])
def test_a_store_that_lss_never_wrote_is_refused(drives, tmp_path, row):
    path = tmp_path / "node.json"
    sections = json.loads(f'{{"lss": {{{row}}}}}')
    path.write_text(json.dumps({"format": 1, "device": drives.device.name, "sections": sections}))
    with pytest.raises(ValueError, match="LSS has stored nothing like"):
        Wire(drives, store=path)


def test_a_store_that_fails_says_so(drives, tmp_path):
    wire = Wire(drives, store=tmp_path / "no folder" / "node.json")
    wire.play(CONFIGURE + "rx 7E5  17 00 00 00 00 00 00 00\ntx 7E4  17 02 00 00 00 00 00 00")


# --- without a node-ID ------------------------------------------------------------------------------------------------
def test_a_node_without_a_node_id_hears_lss_alone(fresh):
    fresh.play("""
        rx 000  01 00                     # no NMT, SDO, SYNC or guarding
        rx 605  40 41 60 00 00 00 00 00
        rx 080
        rx 7FF  RTR
        wait 100 ms
    """)
    assert fresh.node.state is NmtState.INITIALISING
    assert fresh.node.leds() == ("flickering", "flickering")


def test_it_boots_when_it_has_one_and_waits_again(fresh):
    fresh.play(CONFIGURE)
    fresh.play("""
        rx 7E5  5E 00 00 00 00 00 00 00
        tx 7E4  5E FF 00 00 00 00 00 00
        rx 7E5  11 09 00 00 00 00 00 00
        tx 7E4  11 00 00 00 00 00 00 00
        rx 7E5  04 00 00 00 00 00 00 00
        tx 709  00
        rx 609  40 41 60 00 00 00 00 00
        tx 589  4B 41 60 00 50 02 00 00
        rx 609  40 18 10 04 00 00 00 00
        tx 589  43 18 10 04 4D 00 00 00
    """)
    assert fresh.node.state is NmtState.PRE_OPERATIONAL
    assert fresh.node.leds().run == "blinking"


def test_none_configured_it_waits_on(fresh):
    fresh.play(CONFIGURE + WAIT + "rx 7E5  4C 00 00 00 00 00 00 00\ntx 7E4  50 00 00 00 00 00 00 00")


def test_255_takes_the_node_off_the_bus_with_the_next_reset(wire):
    wire.play(CONFIGURE)
    wire.play("""
        rx 7E5  11 FF 00 00 00 00 00 00
        tx 7E4  11 00 00 00 00 00 00 00
        rx 7E5  04 00 00 00 00 00 00 00
        rx 605  40 41 60 00 00 00 00 00
        tx 585  4B 41 60 00 50 02 00 00
        rx 000  82 00
        rx 605  40 41 60 00 00 00 00 00
        rx 7E5  4C 00 00 00 00 00 00 00
        tx 7E4  50 00 00 00 00 00 00 00
    """)


def test_only_a_device_with_lss_may_be_without_a_node_id():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        with pytest.raises(ValueError, match="tmcm1636 has no LSS, so it needs one"):
            Node(255, drives, send=print)
        wire = Wire(drives)
        for first in range(256):
            assert wire.receive(REQUEST, f"{first:02X} 01 00 00 00 00 00 00") == []


# --- bit timing -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("table", [0, 1])
@pytest.mark.parametrize("row", range(11))
def test_the_table_of_bit_rates(wire, table, row):
    code = 0 if table == 0 and BIT_RATES.get(row) in (1000, 500, 250, 125) else 1
    wire.play(CONFIGURE)
    wire.play(f"rx 7E5  13 {table:02X} {row:02X} 00 00 00 00 00\ntx 7E4  13 {code:02X} 00 00 00 00 00 00")


def test_a_bit_rate_that_is_not_activated_changes_nothing(wire):
    wire.play(CONFIGURE)
    wire.play("rx 7E5  13 00 02 00 00 00 00 00\ntx 7E4  13 00 00 00 00 00 00 00")
    wire.play("rx 000  81 05\ntx 705  00")
    assert wire.node.bit_rate == 1000


def test_activation_without_anything_configured_is_none(wire):
    wire.play(
        CONFIGURE + "rx 7E5  15 64 00 00 00 00 00 00\nrx 7E5  5E 00 00 00 00 00 00 00\ntx 7E4  5E 05 00 00 00 00 00 00"
    )


def test_a_node_with_another_bit_rate_than_the_bus_is_deaf_until_power_on(drives):
    wire = Wire(drives, bit_rate=1_000_000)
    wire.play(CONFIGURE)
    wire.play("""
        rx 7E5  13 00 02 00 00 00 00 00
        tx 7E4  13 00 00 00 00 00 00 00
        rx 7E5  15 00 00 00 00 00 00 00
        rx 605  40 41 60 00 00 00 00 00
        rx 000  81 05
        wait 10 ms
    """)
    assert wire.node.bit_rate == 500
    wire.node.power_on(wire.now)
    assert [str(frame) for frame in wire.take()] == ["705  00"]
    assert wire.node.bit_rate == 1000


def test_a_stored_bit_rate_is_the_one_after_power_on(drives, tmp_path):
    path = tmp_path / "node.json"
    wire = Wire(drives, store=path, bit_rate=1_000_000)
    wire.play(CONFIGURE)
    wire.play("""
        rx 7E5  13 00 03 00 00 00 00 00
        tx 7E4  13 00 00 00 00 00 00 00
        rx 7E5  17 00 00 00 00 00 00 00
        tx 7E4  17 00 00 00 00 00 00 00
    """)
    assert Wire(drives, store=path, bit_rate=250_000).node.bit_rate == 250


def test_in_real_time_the_node_is_silent_for_twice_the_delay(drives):
    drives.machine.reset()
    wire = Wire(drives)
    wire.node._takes_time = True
    wire.node._frames_left = wire.node._frames_per_cycle = 16
    for text in ("04 01", "13 00 02", "15 14 00"):  # 20 ms
        wire.node.receive(Frame(REQUEST, bytes.fromhex(text).ljust(8, b"\0")), wire.now)
    wire.wait(39)
    wire.take()
    wire.node.receive(Frame(0x605, bytes.fromhex("40 41 60 00 00 00 00 00")), wire.now)
    wire.wait(2)
    wire.node.answer(wire.now)
    assert [frame for frame in wire.take() if frame.can_id == 0x585] == []
    wire.node.receive(Frame(0x605, bytes.fromhex("40 41 60 00 00 00 00 00")), wire.now)
    wire.wait(1)
    wire.node.answer(wire.now)
    assert len([frame for frame in wire.take() if frame.can_id == 0x585]) == 1


# --- fastscan ---------------------------------------------------------------------------------------------------------
def test_fastscan_asks_bit_by_bit(fresh):
    """The vendor is 286h: a request is answered where the bits from `bit` up are the slave's."""
    fresh.play("""
        rx 7E5  51 00 00 00 00 1F 00 00   # nothing before it begins
        rx 7E5  51 00 00 00 00 80 00 00
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  51 00 00 00 00 1F 00 00   # bit 31 is 0
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  51 00 00 00 00 0A 00 00   # bits 31 to 10 are 0
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  51 00 00 00 00 09 00 00   # bit 9 is not
        rx 7E5  51 00 02 00 00 09 00 00
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  51 86 02 00 00 00 00 01   # all of it; on to the product
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  51 86 02 00 00 00 00 01   # which the vendor is not
        rx 7E5  51 64 06 00 00 00 01 02
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  51 09 00 01 00 00 02 03
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  51 4D 00 00 00 00 03 00   # the serial number: into configuration
        tx 7E4  4F 00 00 00 00 00 00 00
        rx 7E5  5E 00 00 00 00 00 00 00
        tx 7E4  5E FF 00 00 00 00 00 00
    """)


@pytest.mark.parametrize("request_", ["20 00 00", "1F 04 00", "1F 00 04", "1F 01 00", "81 00 00"])
def test_a_scan_that_cannot_be_is_not_answered(fresh, request_):
    fresh.play("rx 7E5  51 00 00 00 00 80 00 00\ntx 7E4  4F 00 00 00 00 00 00 00")
    fresh.play(f"rx 7E5  51 00 00 00 00 {request_}")


def test_a_configured_slave_takes_no_part_in_a_scan(wire):
    wire.play("rx 7E5  51 00 00 00 00 80 00 00")


class Master(canopen.Network):
    """python-canopen's LSS master in front of a world in lockstep."""

    def __init__(self, world):
        super().__init__()
        self.world, self.boots = world, []
        self.lss.RESPONSE_TIMEOUT = 0.002
        world.listeners.append(self._heard)

    def _heard(self, ended):
        frame = ended.frame
        if frame.can_id == RESPONSE:
            self.lss.on_message_received(frame.can_id, frame.data, 0.0)
        if frame.can_id & 0x780 == 0x700 and frame.data == b"\0":
            self.boots.append(frame.can_id & 0x7F)

    def send_message(self, can_id, data, remote=False):
        self.world.receive(Frame(can_id, bytes(data), remote))


def test_canopen_finds_three_nodes_by_fastscan_and_gives_each_its_number(monkeypatch):
    monkeypatch.setattr(canopen.lss.time, "sleep", lambda seconds: None)
    with EmulatedDrives(DEVICE, load="inertia", num_machines=3, num_threads=1) as drives:
        world = World()
        nodes = world.add(drives, (255, 255, 255))
        world.power_on()
        master = Master(world)
        found = []
        for node_id in (11, 12, 13):
            is_found, identity = master.lss.fast_scan()
            assert is_found
            found.append(tuple(identity))
            assert master.lss.inquire_node_id() == 255
            master.lss.configure_node_id(node_id)
            master.lss.store_configuration()
            master.lss.send_switch_state_global(master.lss.WAITING_STATE)
        assert master.lss.fast_scan() == (False, None)
        assert sorted(found) == sorted(tuple(node.identity()) for node in nodes)
        assert master.boots == [11, 12, 13]
        for node_id, identity in zip((11, 12, 13), found, strict=True):
            assert master.lss.send_switch_state_selective(*identity)
            assert master.lss.inquire_node_id() == node_id
            assert master.lss.inquire_lss_address(canopen.lss.CS_INQUIRE_SERIAL_NUMBER) == identity[3]
            master.lss.send_switch_state_global(master.lss.WAITING_STATE)


# --- no motor runs on -------------------------------------------------------------------------------------------------
def running(drives, **options):
    drives.machine.reset()
    wire = Wire(drives, **options)
    wire.start()
    wire.enable()
    assert wire.download(0x60FF, 0, 51_200, 4) == 0
    wire.wait(300)
    wire.take()
    assert abs(drives.machine.rotor_speed[0]) > 1.0
    return wire


def is_enabled(wire):
    return wire.value(0x6041) & 0x6F == 0x27


def stops(wire):
    """The axis leaves operation enabled within a cycle, and the motor comes to rest."""
    wire.wait(1)
    assert not is_enabled(wire)
    wire.wait(3000)
    return abs(wire.drives.machine.rotor_speed[0]) < 0.1


def test_configuring_a_running_axis_changes_nothing(drives):
    wire = running(drives)
    for text in ("04 01", "11 09", "13 00 02", "17", "5E", "04 00"):
        wire.node.receive(Frame(REQUEST, bytes.fromhex(text).ljust(8, b"\0")), wire.now)
    wire.wait(50)
    assert is_enabled(wire)
    assert wire.node.node_id == 5
    assert abs(drives.machine.rotor_speed[0]) > 1.0


@pytest.mark.every(5)
@pytest.mark.parametrize("node_id", [9, 255])
@pytest.mark.parametrize("reset", ["82 05", "82 00", "81 05"])
def test_a_new_node_id_stops_the_axis_as_it_takes_effect(drives, node_id, reset):
    wire = running(drives)
    wire.play(CONFIGURE)
    wire.receive(REQUEST, f"11 {node_id:02X} 00 00 00 00 00 00")
    wire.receive(0x000, reset)
    assert wire.node.node_id == node_id
    assert stops(wire)


@pytest.mark.parametrize("bus", [None, 1_000_000])
@pytest.mark.parametrize("row", [0, 2])
def test_a_new_bit_rate_stops_the_axis_before_the_node_falls_silent(drives, bus, row):
    wire = running(drives, bit_rate=bus)
    wire.play(CONFIGURE)
    wire.receive(REQUEST, f"13 00 {row:02X} 00 00 00 00 00")
    wire.receive(REQUEST, "15 E8 03 00 00 00 00 00")
    assert stops(wire)


@pytest.mark.parametrize("node_id", [9, 255])
def test_whatever_lss_does_the_nodes_old_master_cannot_move_it_afterwards(drives, node_id):
    wire = running(drives)
    wire.play(CONFIGURE)
    wire.receive(REQUEST, f"11 {node_id:02X} 00 00 00 00 00 00")
    wire.receive(0x000, "82 00")
    wire.wait(10)
    for word in ("06 00", "07 00", "0F 00"):
        wire.receive(0x205, word)
        wire.receive(0x605, f"2B 40 60 00 {word} 00 00")
        wire.receive(0x080, "")
        wire.wait(5)
    assert not is_enabled(wire)


# --- whatever comes ---------------------------------------------------------------------------------------------------
@pytest.mark.every(5)
@pytest.mark.parametrize("seed", range(6))
def test_any_requests_leave_a_slave_that_answers(drives, seed):
    drives.machine.reset()
    dice, wire = random.Random(seed), Unconfigured(drives)
    slave = wire.node._lss
    assert isinstance(slave, LssSlave)
    services = [0x04, 0x11, 0x13, 0x15, 0x17, *range(0x40, 0x52), *range(0x5A, 0x5F)]
    for _ in range(5000):
        data = bytes((dice.choice(services) if dice.random() < 0.9 else dice.randrange(256),))
        data += bytes(dice.choice((0, 1, 5, 0x80, 0xFF, dice.randrange(256))) for _ in range(7))
        if data[0] == 0x15:
            continue  # deaf for good would end the test
        wire.node.receive(Frame(REQUEST, data[: 8 if dice.random() < 0.95 else dice.randrange(9)]), wire.now)
        if dice.random() < 0.02:
            wire.node.receive(Frame(0x000, bytes((dice.choice((1, 2, 128, 129, 130)), 0))), wire.now)
        if dice.random() < 0.05:
            wire.wait(1)
        assert all(len(frame.data) <= 8 for frame in wire.take())
        assert 1 <= wire.node.node_id <= 127 or wire.node.node_id == 255
    wire.play(WAIT.strip()) if wire.node.node_id != 255 else None
    wire.receive(REQUEST, "04 01 00 00 00 00 00 00")
    wire.play(f"rx 7E5  5E 00 00 00 00 00 00 00\ntx 7E4  5E {wire.node.node_id:02X} 00 00 00 00 00 00")
