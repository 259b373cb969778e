"""pysoem moves any drive in csp by the images that it is assigned, and reads its EEPROM; says what it saw as JSON.

python tests/ethercat_new_master.py INTERFACE AXES DISTANCE CYCLES
"""

from __future__ import annotations

import json
import sys
import time

import pysoem
from ethercat_drive_master import exchange, patiently

PATIENCE = 60.0  # s
ENABLED, HAS_STATE = 0x27, 0x6F
# Statuswords, under the mask 006Fh, and the controlword that leads on; 004Fh would do for the first three.
NEXT = {0x40: 6, 0x60: 6, 0x21: 7, 0x31: 7, 0x23: 15, 0x33: 15, 0x27: 15}


def places(drive, assignment):
    """Return first byte and length of each object in the image of an assignment, and its mapping objects."""
    found, pdos, bit = {}, [], 0
    for k in range(1, patiently(lambda: drive.sdo_read(assignment, 0))[0] + 1):
        pdo = int.from_bytes(patiently(lambda k=k: drive.sdo_read(assignment, k)), "little")
        pdos.append(pdo)
        for sub in range(1, patiently(lambda pdo=pdo: drive.sdo_read(pdo, 0))[0] + 1):
            raw = int.from_bytes(patiently(lambda pdo=pdo, sub=sub: drive.sdo_read(pdo, sub)), "little")
            if raw >> 16:
                found[raw >> 16] = (bit // 8, (raw & 0xFF) // 8)
            bit += raw & 0xFF
    return found, pdos, bit // 8


def main(interface: str, axes: int, distance: int, cycles: int) -> None:
    """Bring the first slave on an interface to Op, enable its axes, and lead each over a distance [inc]."""
    master = pysoem.Master()
    master.open(interface)
    seen = {"slaves": master.config_init()}
    drive = master.slaves[0]
    seen["identity"] = [drive.man, drive.id, drive.rev]
    seen["name"] = drive.name
    words = (patiently(lambda k=k: drive.eeprom_read(k)) for k in range(0, 0x400, 2))
    seen["eeprom"] = b"".join(word[:4] for word in words).hex()
    outputs, seen["outputs"], size_out = places(drive, 0x1C12)
    inputs, seen["inputs"], size_in = places(drive, 0x1C13)
    for axis in range(axes):
        if 0x6060 + 0x800 * axis not in outputs:
            patiently(lambda axis=axis: drive.sdo_write(0x6060 + 0x800 * axis, 0, b"\x08"))
    master.config_map()
    seen["sizes"] = [len(drive.output), len(drive.input)] == [size_out, size_in]
    seen["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, 5_000_000) == pysoem.SAFEOP_STATE
    master.state = pysoem.OP_STATE
    master.write_state()

    def read(index):
        start, size = inputs[index]
        return int.from_bytes(drive.input[start : start + size], "little", signed=index & 0x7FF == 0x64)

    def send(words, targets):
        image = bytearray(size_out)
        for axis in range(axes):
            rows = ((0x6040, words[axis], False), (0x607A, targets[axis], True), (0x6060, 8, True))
            for index, value, signed in rows:
                if index + 0x800 * axis in outputs:
                    start, size = outputs[index + 0x800 * axis]
                    image[start : start + size] = value.to_bytes(size, "little", signed=signed)
        drive.output = bytes(image)
        exchange(master)

    exchange(master)
    start = [read(0x6064 + 0x800 * axis) for axis in range(axes)]
    end = time.monotonic() + PATIENCE
    seen["op"] = False
    while not seen["op"] and time.monotonic() < end:
        send([0] * axes, start)
        seen["op"] = master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE
    done = 0
    while done < cycles + 300 and time.monotonic() < end:
        states = [read(0x6041 + 0x800 * axis) & HAS_STATE for axis in range(axes)]
        if all(state == ENABLED for state in states):
            done += 1
        now = [before + distance * min(done, cycles) // cycles for before in start]
        send([NEXT.get(state, 0) for state in states], now)
    seen["enabled"] = [read(0x6041 + 0x800 * axis) & HAS_STATE == ENABLED for axis in range(axes)]
    seen["moved"] = [read(0x6064 + 0x800 * axis) - before for axis, before in enumerate(start)]
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    print(json.dumps(seen))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:5]))
