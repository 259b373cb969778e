"""`EtherCatDrives` on a network interface, by pysoem, moves all axes of a drive in csp; says what it saw as JSON.

python tests/ethercat_drives_master.py INTERFACE CYCLES PACE DEVICE SYNC0
"""

from __future__ import annotations

import json
import sys

import numpy as np

from drive_env import motion
from drive_env.master.ethercat_drives import EtherCatDrives
from drive_env.master.identity import read_identity


def main(channel: str, cycles: int, pace: str, device: str, sync0: bool) -> None:
    """Move axis k by (k + 1) * 4 steps in each cycle."""
    with EtherCatDrives(device, channel=channel, pace=pace, timeout=20.0, sync0=sync0) as drives:
        identity = read_identity(drives)
        motion.enable(drives, mode="csp")
        start = drives.read(0x6064)
        targets = start + np.minimum(np.arange(cycles + 100), cycles)[:, None] * 4 * np.arange(1, drives.num_axes + 1)
        trace = drives.record([0x6041, 0x6064], (cycles + 100) * 0.001, {0x607A: targets})
        seen = {
            "name": identity.name,
            "moved": (drives.read(0x6064) - start).tolist(),
            "rows": trace[0x6064].tolist(),
            "words": (drives.read(0x6041) & 0x6F).tolist(),
            "detection": drives.link.watch.detection_time if pace == "real-time" else None,
        }
        motion.disable(drives)
        seen["disabled"] = (drives.read(0x6041) & 0x4F).tolist()
        seen["emergencies"] = len(drives.emergencies())
    print(json.dumps(seen))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), sys.argv[3], sys.argv[4], sys.argv[5] == "sync0")
