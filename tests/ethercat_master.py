"""pysoem, an independent master (SOEM), brings all slaves to Op and moves process data; says what it saw as JSON."""

from __future__ import annotations

import json
import sys
import time

import pysoem


def main(interface: str, cycles: int) -> None:
    """Run on an interface until that many output images have come back in the inputs."""
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
    seen["wrong"], done = 0, 0
    while done < cycles and time.monotonic() < end:
        sent = [bytes((done & 0xFF, k, 3, 4)) for k in range(len(master.slaves))]
        for slave, data in zip(master.slaves, sent, strict=True):
            slave.output = data
        seen["wrong"] += exchange(master) != master.expected_wkc
        done += all(slave.input[:4] == data for slave, data in zip(master.slaves, sent, strict=True))
    seen["cycles"] = done
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    print(json.dumps(seen))


def exchange(master: pysoem.Master) -> int:
    """Send process data and return the working counter of what came back."""
    master.send_processdata()
    return int(master.receive_processdata(20_000))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
