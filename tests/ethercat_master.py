"""pysoem, an independent master (SOEM), brings slaves to Op; says what it saw as JSON.

    python tests/ethercat_master.py INTERFACE echo|drive NUMBER

Of echo devices that many output images must come back; the first axis of a TMCM-3313 goes that many cycles in csp.
"""

from __future__ import annotations

import json
import struct
import sys
import time

import pysoem

PATIENCE = 500_000  # us, for a frame: the machine is shared
STEP = 10  # increments in a cycle


def main(interface: str, kind: str, number: int) -> None:
    """Run on an interface."""
    pysoem.settings.timeouts.ret = PATIENCE
    master = pysoem.Master()
    master.open(interface)
    seen = {"slaves": master.config_init()}
    seen["names"] = [slave.name for slave in master.slaves]
    seen["identities"] = [(slave.man, slave.id, slave.rev) for slave in master.slaves]
    if kind == "drive":
        seen["name"] = master.slaves[0].sdo_read(0x1008, 0).decode()
        seen["objects"] = len(master.slaves[0].od)
        master.slaves[0].sdo_write(0x6060, 0, b"\x08")  # cyclic synchronous position
    master.config_map()
    seen["clocks"] = bool(master.config_dc())
    seen["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, 5_000_000) == pysoem.SAFEOP_STATE
    seen["expected"] = master.expected_wkc
    exchange(master)
    master.state = pysoem.OP_STATE
    master.write_state()
    end = time.monotonic() + 40
    seen["op"] = False
    while not seen["op"] and time.monotonic() < end:
        exchange(master)
        seen["op"] = master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE
    seen |= move(master, number) if kind == "drive" else echo(master, number, end)
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    print(json.dumps(seen))


def echo(master: pysoem.Master, number: int, end: float) -> dict[str, int]:
    """Return how many output images came back, and how many working counters were wrong meanwhile."""
    wrong = done = 0
    while done < number and time.monotonic() < end:
        sent = [bytes((done & 0xFF, k, 3, 4)) for k in range(len(master.slaves))]
        for slave, data in zip(master.slaves, sent, strict=True):
            slave.output = data
        wrong += exchange(master) != master.expected_wkc
        done += all(slave.input[:4] == data for slave, data in zip(master.slaves, sent, strict=True))
    return {"wrong": wrong, "cycles": done}


def move(master: pysoem.Master, number: int) -> dict[str, object]:
    """Enable the first axis, move it by a step in each of some cycles, and disable it; returns what it told."""
    drive = master.slaves[0]
    rest = bytes(len(drive.output) - 6)
    told: dict[str, object] = {"wrong": 0, "words": []}

    def cycle(controlword: int, target: int) -> tuple[int, int]:
        drive.output = struct.pack("<Hi", controlword, target) + rest
        told["wrong"] += exchange(master) != master.expected_wkc
        return struct.unpack_from("<Hi", drive.input)

    start = cycle(0, 0)[1]
    for controlword in (6, 7, 15):
        for _ in range(20):
            word, _ = cycle(controlword, start)
        told["words"].append(word & 0x6F)
    for k in range(1, number + 1):
        cycle(15, start + STEP * k)
    for _ in range(100):
        word, position = cycle(15, start + STEP * number)
    told |= {"asked": STEP * number, "moved": position - start, "end": word & 0x6F}
    for _ in range(20):
        word, _ = cycle(0, start + STEP * number)
    return told | {"off": word & 0x6F}


def exchange(master: pysoem.Master) -> int:
    """Send process data and return the working counter of what came back."""
    master.send_processdata()
    return int(master.receive_processdata(PATIENCE))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
