"""pysoem brings a TGZ-D to Op by one of its maker's sequences, and moves both axes; says what it saw as JSON.

python tests/ethercat_tgz_master.py INTERFACE SEQUENCE [SYNC1_DELAY]

With a delay [ns] the clocks make SYNC0, each millisecond, and SYNC1, so much later.
"""

from __future__ import annotations

import json
import sys
import time

import pysoem
from ethercat_drive_master import exchange, patiently
from rigs.tgz_sequences import SEQUENCES, move

CYCLE = 1_000_000  # ns
PATIENCE = 60.0  # s


def main(interface: str, name: str, delay: int | None) -> None:
    """Bring the first slave on an interface to Op, and move its axes."""
    sequence = SEQUENCES[name]
    master = pysoem.Master()
    master.open(interface)
    seen = {"slaves": master.config_init()}
    drive = master.slaves[0]
    for index, sub, data in sequence.rows:
        patiently(lambda row=(index, sub, data): drive.sdo_write(*row))
    if delay is not None:
        master.config_dc()
        drive.dc_sync(True, CYCLE, 0, delay)
    master.config_map()
    seen["sizes"] = [len(drive.output), len(drive.input)]
    seen["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, 5_000_000) == pysoem.SAFEOP_STATE
    seen["type"] = int.from_bytes(patiently(lambda: drive.sdo_read(0x1C32, 1)), "little")
    master.state = pysoem.OP_STATE
    master.write_state()
    end = time.monotonic() + PATIENCE
    seen["op"] = False
    drive.output = bytes(sequence.size)
    while not seen["op"] and time.monotonic() < end:
        exchange(master)
        seen["op"] = master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE

    def one(outputs: bytes) -> bytes:
        drive.output = outputs
        exchange(master)
        return bytes(drive.input)

    for _ in range(0 if delay is None else 300):  # until the pulses have begun
        one(bytes(sequence.size))
    seen |= move(sequence, one)._asdict()
    seen["still_op"] = master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE
    seen["pulses"] = int.from_bytes(patiently(lambda: drive.sdo_read(0x200E, 0)), "little")
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    print(json.dumps(seen))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]) if len(sys.argv) > 3 else None)
