"""pysoem, an independent master (SOEM), brings echo devices to Op; says what it saw as JSON.

    python tests/ethercat_master.py INTERFACE NUMBER

That many output images must come back in the inputs.
"""

from __future__ import annotations

import json
import sys
import time

import pysoem

PATIENCE = 500_000  # us, for a frame: the machine is shared


def main(interface: str, number: int) -> None:
    """Run on an interface."""
    pysoem.settings.timeouts.ret = PATIENCE
    master = pysoem.Master()
    master.open(interface)
    seen = {"slaves": master.config_init()}
    seen["names"] = [slave.name for slave in master.slaves]
    seen["identities"] = [(slave.man, slave.id, slave.rev) for slave in master.slaves]
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
    seen |= echo(master, number, end)
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


def exchange(master: pysoem.Master) -> int:
    """Send process data and return the working counter of what came back."""
    master.send_processdata()
    return int(master.receive_processdata(PATIENCE))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
