"""A device behind a slave controller that is as small as can be, and a master's frames as transcripts."""

from __future__ import annotations

import re
import struct

from drive_env.ethercat import datagrams
from drive_env.ethercat.application import AlState, AlStatusCode, MailboxPlace, SlaveLayout
from drive_env.ethercat.datagrams import Datagram, DatagramCommand
from drive_env.ethercat.sii_interface import checksum
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.world import EtherCatWorld

STATION = 0x1001
RECEIVE, SEND = MailboxPlace(0x1000, 64), MailboxPlace(0x1080, 64)
LAYOUT = SlaveLayout(RECEIVE, SEND, 0x1100, 0x1180, RECEIVE, SEND)
NO_BOOTSTRAP = SlaveLayout(RECEIVE, SEND, 0x1100, 0x1180)
# What a master writes: place, length, control, status, activation of each sync manager.
MAILBOXES = "00 10 40 00 26 00 01 00  80 10 40 00 22 00 01 00"
PROCESS_DATA = "00 11 04 00 64 00 01 00  80 11 06 00 20 00 01 00"
ALIAS = 0x0777


def category(number, content):
    return struct.pack("<HH", number, (len(content) + 1) // 2) + content.ljust((len(content) + 1) // 2 * 2, b"\0")


def sii(alias=ALIAS, sizes=(4, 6)):
    """An EEPROM as ETG.2010 has it."""
    content = bytearray(struct.pack("<7H", 0x0C05, 0x2E84, 0x0064, 0, alias, 0, 0).ljust(16, b"\0"))
    content[14] = checksum(content)
    content += struct.pack("<4I", 0x1234, 0x5678, 1, 42) + bytes(8)  # vendor, product, revision, serial number
    content += struct.pack("<4H", 0x1000, 64, 0x1080, 64) * 2 + struct.pack("<H", 0x0C)  # CoE and FoE
    content = content.ljust(0x7C, b"\0") + struct.pack("<HH", 1, 1)  # 2 KiB
    content += category(10, bytes((1, 4)) + b"Echo")
    content += category(30, bytes((0, 0, 0, 1, 0, 0x03, 1, 0)) + bytes(24))  # name, CoE with SDO, FoE
    content += category(40, bytes((1, 2, 3, 0)))
    rows = ((0x1000, 64, 0x26, 1), (0x1080, 64, 0x22, 2), (0x1100, sizes[0], 0x64, 3), (0x1180, sizes[1], 0x20, 4))
    content += category(41, b"".join(struct.pack("<HHBBBB", a, n, c, 0, 1, kind) for a, n, c, kind in rows))
    for number, index, manager, size in ((51, 0x1600, 2, sizes[0]), (50, 0x1A00, 3, sizes[1])):
        entries = b"".join(struct.pack("<HBBBBH", 0x7000, k, 0, 5, 8, 0) for k in range(1, size + 1))
        content += category(number, struct.pack("<HBBBBH", index, size, manager, 0, 0, 0) + entries)
    content += b"\xff\xff"
    return bytes(content.ljust(512, b"\xff"))


class EchoDevice:
    """Outputs come back as inputs, with two bytes that count cycles; a CoE message comes back as it was."""

    identification = 0

    def __init__(self, layout=LAYOUT, sizes=(4, 6)):
        self.layout = layout
        self.output_size, self.input_size = sizes
        self.content = sii()
        self.refuses = AlStatusCode.NO_ERROR
        self.events = []
        self.pending = []
        self.power_on(0.0)

    def power_on(self, now):
        self.taken = bytes(self.output_size)
        self.cycles = 0

    def read_sii(self):
        return self.content

    def write_sii(self, content):
        self.content = content

    def request_state(self, old, new, sync_managers, clock, now):
        self.clock = clock
        return self.refuses

    def state_changed(self, new, code, now):
        self.events.append((new.name, int(code)))

    def coe(self, message, now):
        if message[0] == 0xEE:
            raise ValueError("none of CoE")
        return [message] * message[0] if message[0] < 8 else [message]

    def pending_coe(self, now):
        taken, self.pending = self.pending, []
        return taken

    def before_cycle(self, now):
        pass

    def after_cycle(self, now):
        self.cycles += 1

    def outputs(self, data, now):
        self.taken = data

    def inputs(self, now):
        return (self.taken + struct.pack("<H", self.cycles & 0xFFFF)).ljust(self.input_size, b"\0")[: self.input_size]

    def watchdog_expired(self, now):
        self.events.append(("watchdog", round(now, 6)))

    def sync0(self, now):
        self.events.append(("sync0", now))


class Rig:
    """Slaves of `EchoDevice` in a line, and a master's hands."""

    def __init__(self, number=1, layout=LAYOUT, lockstep=True, **arguments):
        self.world = EtherCatWorld(lockstep=lockstep)
        self.devices = [EchoDevice(layout) for _ in range(number)]
        for k, device in enumerate(self.devices):
            self.world.add(EtherCatSlave(device, **{name: value[k] for name, value in arguments.items()}))
        self.slaves = self.world.segment.slaves
        self.world.power_on()
        self.number = 0

    def send(self, *asked):
        """Return the datagrams of a frame as they come back."""
        return datagrams.read(self.world.receive(datagrams.build_frame(asked)), datagrams.ETHERNET)

    def write(self, address, data, station=STATION):
        data = bytes.fromhex(data) if isinstance(data, str) else data
        return self.send(datagrams.at_station(DatagramCommand.FPWR, station, address, data))[0].counter

    def read(self, address, size, station=STATION):
        answer = self.send(datagrams.at_station(DatagramCommand.FPRD, station, address, bytes(size)))[0]
        return answer.data if answer.counter else None

    def value(self, address, size=2, station=STATION):
        return int.from_bytes(self.read(address, size, station), "little")

    def address(self):
        """Give the slaves station addresses 1001h and on."""
        for k in range(len(self.slaves)):
            self.send(datagrams.at_station(DatagramCommand.APWR, -k, 0x0010, struct.pack("<H", STATION + k)))

    def request(self, state, station=STATION):
        """Return AL status and AL status code after a request."""
        self.write(0x0120, struct.pack("<H", state), station)
        return self.value(0x0130, 2, station), self.value(0x0134, 2, station)

    def bring_to(self, state, station=STATION):
        """Bring a slave to a state by the way that a master goes."""
        if state is AlState.INIT:
            return
        self.write(0x0800, MAILBOXES, station)
        if state is AlState.BOOTSTRAP:
            assert self.request(3, station) == (3, 0)
            return
        assert self.request(2, station) == (2, 0)
        if state is AlState.PRE_OP:
            return
        self.write(0x0810, PROCESS_DATA, station)
        offset = station - STATION
        self.write(0x0600, struct.pack("<IHBBHBBB", 0x10000 + 16 * offset, 4, 0, 7, 0x1100, 0, 2, 1), station)
        self.write(0x0610, struct.pack("<IHBBHBBB", 0x10004 + 16 * offset, 6, 0, 7, 0x1180, 0, 1, 1), station)
        assert self.request(4, station) == (4, 0)
        if state is AlState.OP:
            assert self.request(8, station) == (8, 0)

    def exchange(self, outputs, inputs=6, command=DatagramCommand.LRW):
        """Return data and working counter of process data."""
        answer = self.send(Datagram(command, 0x10000, outputs + bytes(inputs)))[0]
        return answer.data, answer.counter

    def mail(self, protocol, message, counter=None):
        """Write a message to the mailbox; returns the working counter."""
        if counter is None:
            self.number = counter = self.number % 7 + 1
        data = struct.pack("<HHBB", len(message), 0, 0, protocol | counter << 4) + message
        return self.write(0x1000, data.ljust(64, b"\0"))

    def fetch(self):
        """Return protocol, counter and message of the mailbox; None: it is empty."""
        data = self.read(0x1080, 64)
        if data is None:
            return None
        length, _, _, kind = struct.unpack_from("<HHBB", data)
        return kind & 15, kind >> 4, data[6 : 6 + length]

    def play(self, text):
        """Play a transcript: what is sent ("tx APRD 0000 0130 00 00") and how it must come back ("rx ... wkc 1").

        Lines sent that have a + are of the frame of the next one.
        """
        sent, answers = [], iter(())
        for line in text.strip().splitlines():
            direction, *words = line.partition("#")[0].split()
            row = " ".join(words)
            if direction == "rx":
                assert " ".join(next(answers, "nothing").split()) == row, line
                continue
            sent.append(parse(row))
            if direction == "tx":
                answers, sent = iter(datagrams.lines(self.send(*sent))), []


def parse(row):
    """A datagram from a transcript's line."""
    found = re.fullmatch(r"([A-Z]+) ([0-9A-F]{4}) ([0-9A-F]{4}) ?((?:[0-9A-F]{2} ?)*)", row)
    command, station, offset, data = found.groups()
    return datagrams.at_station(DatagramCommand[command], int(station, 16), int(offset, 16), bytes.fromhex(data))
