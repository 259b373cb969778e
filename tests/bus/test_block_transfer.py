"""Block SDO transfers, as transcripts (CiA 301, 7.2.4.3.9 and following), and strings and domains in segments.

An independent client is python-canopen's, whose block transfers run against the same server.
"""

from __future__ import annotations

import random

import canopen
import pytest
from rigs import TESTS

from drive_env import EmulatedDrives
from drive_env.canopen.frames import Frame
from drive_env.canopen.node import Node

DEVICE = str(TESTS / "all_services.toml")
TEXT, DATA = 0x2F00, 0x2F01
LONGEST = 4096


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(DEVICE, load="inertia", num_threads=1) as made:
        yield made


def written(wire, text, index=DATA):
    """Let an object hold a text, by the port and not by a transfer."""
    wire.node.dictionary.port(index, 0).write_text(text)


# --- download ---------------------------------------------------------------------------------------------------------
def test_a_download_of_one_block(wire):
    wire.play("""
        rx 605  C6 01 2F 00 09 00 00 00   # initiate: the client has a CRC, nine bytes will come
        tx 585  A4 01 2F 00 7F 00 00 00   # the server has one, too, and takes 127 segments
        rx 605  01 31 32 33 34 35 36 37
        rx 605  82 38 39 00 00 00 00 00   # the last
        tx 585  A2 02 7F 00 00 00 00 00   # two came in order
        rx 605  D5 C3 31 00 00 00 00 00   # end: five bytes of the last segment are none, and the CRC
        tx 585  A1 00 00 00 00 00 00 00
    """)
    assert wire.value(DATA) == "123456789"


def test_a_number_may_come_in_a_block(wire):
    wire.play("""
        rx 605  C2 81 60 00 04 00 00 00
        tx 585  A4 81 60 00 7F 00 00 00
        rx 605  81 78 56 34 12 00 00 00
        tx 585  A2 01 7F 00 00 00 00 00
        rx 605  CD 00 00 00 00 00 00 00
        tx 585  A1 00 00 00 00 00 00 00
    """)
    assert wire.value(0x6081) == 0x1234_5678


@pytest.mark.parametrize(
    ("initiate", "code"),
    [
        ("C2 41 60 00 02 00 00 00", "02 00 01 06"),  # read only
        ("C2 99 99 00 02 00 00 00", "00 00 02 06"),
        ("C2 01 2F 01 02 00 00 00", "11 00 09 06"),
        ("C2 81 60 00 05 00 00 00", "12 00 07 06"),
        ("C2 81 60 00 02 00 00 00", "13 00 07 06"),
        ("C2 01 2F 00 01 10 00 00", "05 00 04 05"),  # 4097 bytes: out of memory
        ("C2 01 2F 00 FF FF FF FF", "05 00 04 05"),
        ("A0 01 2F 00 00 00 00 00", "02 00 04 05"),  # upload in blocks of none
        ("A0 01 2F 00 80 00 00 00", "02 00 04 05"),  # or of 128
        ("A0 99 99 00 7F 00 00 00", "00 00 02 06"),
    ],
)
def test_an_initiate_request_is_refused(wire, initiate, code):
    wire.play(f"rx 605  {initiate}\ntx 585  80 {initiate[3:11]} {code}")
    wire.play("rx 605  40 41 60 00 00 00 00 00\ntx 585  4B 41 60 00 50 02 00 00")


@pytest.mark.parametrize("begin", ["C2 01 2F 00 15 00 00 00", "A0 00 2F 00 7F 00 00 00"])
def test_a_silent_client_ends_a_block_transfer(wire, begin):
    assert wire.receive(0x605, begin)[0].data[0] in (0xA4, 0xC6)
    wire.wait(999)
    assert wire.take() == []
    wire.play(f"wait 1 ms\ntx 585  80 {begin[3:11]} 00 00 04 05")
    wire.play("rx 605  40 41 60 00 00 00 00 00\ntx 585  4B 41 60 00 50 02 00 00")


# --- upload -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("command", ["81 05", "82 05", "02 05"])
def test_a_reset_and_a_stop_end_a_block_transfer(wire, command):
    wire.play("rx 605  C2 01 2F 00 15 00 00 00\ntx 585  A4 01 2F 00 7F 00 00 00")
    wire.receive(0x000, command)
    wire.receive(0x000, "80 05")
    wire.play("rx 605  40 41 60 00 00 00 00 00\ntx 585  4B 41 60 00 50 02 00 00")


# --- strings and domains in segments ----------------------------------------------------------------------------------
@pytest.mark.parametrize("restart", ["81 05", "power"])
def test_a_text_lives_until_the_firmware_starts_anew(wire, restart):
    written(wire, "left axis", TEXT)
    wire.receive(0x000, "82 05")
    assert wire.value(TEXT) == "left axis"
    if restart == "power":
        wire.node.power_on(wire.now)
    else:
        wire.receive(0x000, restart)
    assert wire.value(TEXT) == "none"


def test_the_node_holds_its_own_eds(wire):
    assert wire.value(0x1021).encode("latin-1").decode() == wire.drives.device.eds.read_text()
    assert wire.value(0x1022) == 0  # as it is


# --- python-canopen's block transfers ---------------------------------------------------------------------------------
class Loopback(canopen.Network):
    """python-canopen's network in front of one node; frames may be lost on the way, by their number."""

    def __init__(self, drives):
        super().__init__()
        self.answers, self.lost, self.count = [], set(), 0
        self.node = Node(5, drives, send=self.answers.append)
        self.node.power_on(0.0)
        self.answers.clear()

    def send_message(self, can_id, data, remote=False):
        self.count += 1
        if self.count not in self.lost:
            self.node.receive(Frame(can_id, bytes(data), remote), 0.0)
        for frame in self.answers:
            self.notify(frame.can_id, bytearray(frame.data), 0.0)
        self.answers.clear()


@pytest.fixture
def network(drives):
    drives.machine.reset()
    return Loopback(drives)


def sdo_of(network):
    remote = network.add_node(5, canopen.ObjectDictionary())
    remote.sdo.RESPONSE_TIMEOUT = 0.2
    return remote.sdo


@pytest.mark.parametrize("size", [1, 6, 7, 8, 126 * 7, 127 * 7, 127 * 7 + 1, 128 * 7, LONGEST])
@pytest.mark.parametrize("has_crc", [True, False])
def test_canopen_writes_and_reads_any_length(network, size, has_crc):
    sdo, content = sdo_of(network), random.Random(size).randbytes(size)
    with sdo.open(DATA, 0, "wb", size=size, block_transfer=True, request_crc_support=has_crc) as file:
        file.write(content)
    assert sdo.upload(DATA, 0) == content
    with sdo.open(DATA, 0, "rb", block_transfer=True, request_crc_support=has_crc) as file:
        assert file.read() == content


@pytest.mark.parametrize("lost", [{2}, {5}, {100}, {127}, {3, 4, 131}])
def test_canopen_sends_again_what_was_lost(network, lost):
    """Frame 1 initiates; 2 to 128 are the first sub-block, whose last must come for the server to answer.

    Of the last sub-block python-canopen cannot send anything again; drive_env's client can (test_block_client.py).
    """
    sdo, content = sdo_of(network), random.Random(7).randbytes(1400)
    network.lost = lost
    with sdo.open(DATA, 0, "wb", size=len(content), block_transfer=True) as file:
        file.write(content)
    assert network.count > 1400 // 7 + 2
    assert sdo.upload(DATA, 0) == content


def test_canopen_reads_the_eds_from_the_node(network, drives):
    with sdo_of(network).open(0x1021, 0, "rb", block_transfer=True) as file:
        assert file.read().decode() == drives.device.eds.read_text()


# --- whatever comes ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("seed", range(8))
def test_any_order_of_steps_leaves_a_server_that_answers(wire, seed):
    dice = random.Random(seed)
    firsts = (0xA0, 0xA1, 0xA2, 0xA3, 0xA4, 0xC0, 0xC1, 0xC2, 0xC6, 0x80, 0x81, 0xFF, 0x40, 0x21, 0x60, 0x00)
    for k in range(4000):
        first = dice.choice(firsts) if dice.random() < 0.6 else dice.randrange(256)
        index = dice.choice((TEXT, DATA, 0x1021, 0x6081, 0x6041))
        rest = index.to_bytes(2, "little") + bytes(
            (0, dice.choice((0, 1, 2, 127, 128)), dice.choice((0, 9, 255)), 0, 0)
        )
        length = 8 if dice.random() < 0.95 else dice.randrange(8)
        data = bytes((first,)) + (rest if dice.random() < 0.7 else dice.randbytes(7))
        wire.node.receive(Frame(0x605, data[:length]), wire.now)
        sent = wire.take()
        assert len(sent) <= 127
        assert all(len(frame.data) == 8 and frame.can_id == 0x585 for frame in sent)
        if k % 100 == 99:
            wire.wait(1)
            wire.take()
    wire.receive(0x605, "80 00 00 00 00 00 00 00")
    assert len(wire.value(TEXT)) <= LONGEST
    assert len(wire.value(DATA)) <= LONGEST
    wire.play("rx 605  40 41 60 00 00 00 00 00\ntx 585  4B 41 60 00 .. .. 00 00")
