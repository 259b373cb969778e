"""A drive of the catalogue on EtherCAT, in lockstep, and a master's hands: mailbox, states, process data."""

from __future__ import annotations

import struct

from drive_env.ethercat.application import AlState
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.datagrams import Datagram, DatagramCommand
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.world import EtherCatWorld
from rigs.ethercat_rig import STATION, Rig

COE = 3


class CoeRig(Rig):
    """One slave with a drive behind it."""

    def __init__(self, drives, *, lockstep=True):
        self.world = EtherCatWorld(lockstep=lockstep)
        self.node = CoeNode(drives)
        self.drives = drives
        self.world.add(EtherCatSlave(self.node))
        self.world.drives.append(drives)
        self.slaves = self.world.segment.slaves
        self.world.power_on()
        self.number = 0
        self.emergencies = []
        self.address()

    @property
    def slave(self):
        return self.slaves[0]

    def bring_to(self, state, station=STATION, outputs=30, inputs=30):
        if self.slave.state is AlState.INIT:
            layout = self.node.layout
            for address, place, control in ((0x0800, layout.receive, 0x26), (0x0808, layout.send, 0x22)):
                self.write(address, struct.pack("<HHBBBB", place.start, place.length, control, 0, 1, 0))
            assert self.request(2) == (2, 0)
        if state is AlState.PRE_OP:
            return
        if self.slave.state is AlState.PRE_OP:
            self.configure(outputs, inputs)
            assert self.request(4) == (4, 0)
        if state is AlState.OP:
            assert self.request(8) == (8, 0)

    def configure(self, outputs, inputs):
        """Set sync managers 2 and 3 and the FMMUs of both."""
        places = self.node.layout.outputs, self.node.layout.inputs
        self.write(0x0810, bytes(16))
        self.write(0x0810, struct.pack("<HHBBBB", places[0], outputs, 0x64, 0, 1, 0))
        self.write(0x0818, struct.pack("<HHBBBB", places[1], inputs, 0x20, 0, 1, 0))
        self.write(0x0600, struct.pack("<IHBBHBBB", 0x10000, outputs, 0, 7, places[0], 0, 2, 1))
        self.write(0x0610, struct.pack("<IHBBHBBB", 0x10000 + outputs, inputs, 0, 7, places[1], 0, 1, 1))

    def ask(self, service, content):
        """Return the services and contents of all messages that answer a CoE request; emergencies are kept aside."""
        self.number = self.number % 7 + 1
        message = struct.pack("<HHBB", len(content) + 2, 0, 0, COE | self.number << 4)
        message += struct.pack("<H", service << 12) + content
        assert self.write(self.node.layout.receive.start, message.ljust(256, b"\0")) == 1
        return self.answers()

    def answers(self):
        found = []
        while (data := self.read(self.node.layout.send.start, 256)) is not None:
            length, _, _, kind = struct.unpack_from("<HHBB", data)
            if kind & 15 != COE:
                found.append((-(kind & 15) - 1, data[6 : 6 + length]))
                continue
            service, content = data[7] >> 4, data[8 : 6 + length]
            if service == 1:
                self.emergencies.append(content)
            else:
                found.append((service, content))
        return found

    def sdo(self, text):
        """Return the answer to an SDO request, both in hexadecimal."""
        ((service, content),) = self.ask(2, bytes.fromhex(text))
        return f"{service} {content.hex(' ').upper()}"

    def upload(self, index, sub=0, complete=False):
        """Return what an upload brings, or the abort code."""
        head = struct.pack("<HB", index, sub)
        ((_, data),) = self.ask(2, bytes((0x50 if complete else 0x40,)) + head + bytes(4))
        if data[0] == 0x80:
            return int.from_bytes(data[4:8], "little")
        if data[0] & 2:
            return data[4 : 8 - (data[0] >> 2 & 3)]
        size, content, toggle = int.from_bytes(data[4:8], "little"), data[8:], 0
        while len(content) < size:
            ((_, part),) = self.ask(2, bytes((0x60 | toggle,)) + bytes(7))
            content += part[1 : (8 - (part[0] >> 1 & 7)) if len(part) == 8 else None]
            toggle ^= 0x10
        return content

    def download(self, index, sub, content, complete=False):
        """Return 0 or the abort code."""
        first = 0x31 if complete else 0x21
        head = bytes((first,)) + struct.pack("<HBI", index, sub, len(content))
        ((_, data),) = self.ask(2, head + content)
        return int.from_bytes(data[4:8], "little") if data[0] == 0x80 else 0

    def exchange_image(self, outputs, inputs=30):
        """Return the inputs and the working counter of one exchange, after which the drives pass a cycle."""
        answer = self.send(Datagram(DatagramCommand.LRW, 0x10000, outputs + bytes(inputs)))[0]
        return answer.data[len(outputs) :], answer.counter
