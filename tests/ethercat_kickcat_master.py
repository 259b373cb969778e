"""KickCAT, a master that shares no line with SOEM, moves all axes of a drive in csp; says what it saw as JSON.

python tests/ethercat_kickcat_master.py INTERFACE DEVICE CYCLES
"""

from __future__ import annotations

import json
import struct
import sys
import time
from datetime import timedelta
from itertools import count

import kickcat
from kickcat import State

SECOND = timedelta(seconds=1)
PATIENCE = 120.0  # s; the computer may be busy
# For an answer; where there is no second cable KickCAT waits that long at many frames of its scan.
SHORTEST = timedelta(milliseconds=5)
RUNNING = kickcat.mailbox.request.MessageStatus.RUNNING
WORDS = (0x80, 0x00, 0x06, 0x07, 0x0F)  # reset a fault, to operation enabled
CSP = {  # what is written in Pre-Op: index, bytes
    "tmcm3313": [(0x6060 + 0x800 * axis, b"\x08") for axis in range(3)],
    "tgz_d": [(0x6060, b"\x08"), (0x6860, b"\x08"), (0x2303, b"\x03\0\0\0"), (0x2403, b"\x03\0\0\0")],
}
# Bytes at which each axis has statusword and position in the inputs, and alike controlword and target in the outputs.
PLACES = {"tmcm3313": ((0, 2), (10, 12), (20, 22)), "tgz_d": ((12, 0), (32, 20))}
STEP = 4  # increments in a cycle of the first axis; the others k times as many


class Master:
    """A bus of one slave."""

    def __init__(self, interface: str, device: str) -> None:
        self.device = device
        waits = (SHORTEST * 2**k for k in count())
        self.bus = patiently(lambda: scanned(interface, next(waits)))
        (self.slave,) = self.bus.slaves()
        self.wrong = 0

    def read(self, index: int, sub: int = 0, access: kickcat.Access = kickcat.PARTIAL) -> bytes:
        """Return what an object has."""
        return patiently(lambda: self.bus.read_sdo(self.slave, index, sub, access, 64, SECOND))

    def write(self, index: int, sub: int, data: bytes) -> int:
        """Return the status of a download: 0 for success."""
        sent = self.slave.mailbox.write_sdo(index, sub, False, data, SECOND)
        while sent.status() == RUNNING:
            patiently(self.bus.process_mailboxes)
        return sent.status()

    def go(self, state: State) -> bool:
        """Request a state, and exchange process data until it is there."""
        patiently(lambda: self.bus.request_state(state))
        has_data = state in (State.SAFE_OP, State.OPERATIONAL)
        self.bus.wait_for_state(
            state, timedelta(seconds=PATIENCE), self.bus.process_data_no_check if has_data else lambda: None
        )
        return bool(self.bus.get_state(self.slave) == state)

    def exchange(self, words, targets) -> None:
        """One cycle; KickCAT raises where a working counter is not what it must be."""
        image = bytearray(self.slave.output_size)
        for (at_word, at_target), word, target in zip(PLACES[self.device], words, targets, strict=True):
            struct.pack_into("<H", image, at_word, word)
            struct.pack_into("<i", image, at_target, target)
        self.slave.set_output_bytes(bytes(image))
        try:
            self.bus.process_data()
        except RuntimeError:
            self.wrong += 1

    def inputs(self):
        """Return statuswords and positions."""
        data = self.slave.input_data
        places = PLACES[self.device]
        words = [struct.unpack_from("<H", data, at)[0] for at, _ in places]
        return words, [struct.unpack_from("<i", data, at)[0] for _, at in places]


def scanned(interface: str, wait: timedelta) -> kickcat.Bus:
    """Return a bus whose slaves are found, have been read, and are in Pre-Op."""
    link = kickcat.create_link(interface, "")
    link.set_timeout(wait)
    bus = kickcat.Bus(link)
    bus.init(timedelta(milliseconds=100))  # the watchdog's time
    link.set_timeout(SECOND)
    return bus


def patiently(call):
    """Return what a call brings; on a busy machine an answer may come too late for it."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return call()
        except RuntimeError:
            if time.monotonic() > end:
                raise


def main(interface: str, device: str, cycles: int) -> None:
    """Find the drive, read it, bring it to Op, move it, and stop it."""
    master = Master(interface, device)
    seen = {
        "identity": [struct.unpack("<I", master.read(0x1018, sub))[0] for sub in (1, 2, 3)],
        "whole": master.read(0x1018, 0, kickcat.COMPLETE).hex(),
        "object": patiently(lambda: master.bus.read_object_description(master.slave, 0x6041)),
        "entry": patiently(lambda: master.bus.read_entry_description(master.slave, 0x6041, 0)),
        "configured": [master.write(index, 0, data) for index, data in CSP[device]],
    }
    patiently(lambda: master.bus.create_mapping(4096))
    seen["sizes"] = [master.slave.output_size, master.slave.input_size]
    seen["safe_op"] = master.go(State.SAFE_OP)
    master.slave.set_output_bytes(bytes(master.slave.output_size))
    seen["op"] = master.go(State.OPERATIONAL)
    for word in WORDS:
        for _ in range(60):
            _, positions = master.inputs()
            master.exchange([word] * len(positions), positions)
    words, start = master.inputs()
    seen["words"] = [word & 0x6F for word in words]
    master.wrong = 0
    for k in range(cycles + 300):
        targets = [before + min(k, cycles) * STEP * (axis + 1) for axis, before in enumerate(start)]
        master.exchange([0x0F] * len(start), targets)
    seen["wrong"] = master.wrong
    seen["moved"] = [now - before for now, before in zip(master.inputs()[1], start, strict=True)]
    seen["safe_op_again"] = master.go(State.SAFE_OP)
    for _ in range(500):
        master.exchange([0x0F] * len(start), targets)
    seen["stopped"] = [word & 0x4F for word in master.inputs()[0]]
    master.wrong = 0
    seen["init"] = master.go(State.INIT)
    for _ in range(5):
        master.exchange([0] * len(start), targets)
    seen["wrong_in_init"] = master.wrong
    print(json.dumps(seen))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
