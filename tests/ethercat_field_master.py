"""pysoem writes the start-up of a master in the field and moves a drive of three axes by it; says what it saw as JSON.

python tests/ethercat_field_master.py INTERFACE NAME CYCLES
"""

from __future__ import annotations

import json
import sys
import time

import pysoem
from ethercat_drive_master import exchange, patiently, refusal
from rigs.field_masters import AXES, ENABLED, HAS_STATE, STARTUPS, FieldAxis

PATIENCE = 60.0  # s


def main(interface: str, name: str, cycles: int) -> None:
    """Bring the first slave on an interface to Op, and move its axes for that many cycles."""
    startup = STARTUPS[name]
    master = pysoem.Master()
    master.open(interface)
    seen = {"slaves": master.config_init(), "refused": []}
    drive = master.slaves[0]
    for index, sub, data in startup.rows():
        code = refusal(lambda row=(index, sub or 0, data, sub is None): patiently(lambda: drive.sdo_write(*row)))
        if code:
            seen["refused"].append([index, sub, code])
    master.config_map()
    seen["sizes"] = [len(drive.output), len(drive.input)]
    seen["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, 5_000_000) == pysoem.SAFEOP_STATE
    master.state = pysoem.OP_STATE
    master.write_state()
    axes = [FieldAxis(4 * (k + 1), cycles) for k in range(AXES)]
    drive.output = startup.pack([axis.now for axis in axes])
    end = time.monotonic() + PATIENCE
    seen["op"] = False
    while not seen["op"] and time.monotonic() < end:
        exchange(master)
        seen["op"] = master.state_check(pysoem.OP_STATE, 2000) == pysoem.OP_STATE
    while min(axis.enabled for axis in axes) < cycles + 300 and time.monotonic() < end:
        for axis, shown in zip(axes, startup.unpack(drive.input), strict=True):
            axis.take(shown)
        drive.output = startup.pack([axis.now for axis in axes])
        exchange(master)
    seen["enabled"] = [axis.shown["word"] & HAS_STATE == ENABLED for axis in axes]
    seen["moved"] = [axis.shown["position"] - axis.start for axis in axes]
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    print(json.dumps(seen))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
