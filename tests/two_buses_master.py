"""Moves one gantry whose left motor has a drive on CAN and whose right one has a drive on EtherCAT; says what it saw.

python tests/two_buses_master.py CAN_CHANNEL UDP_PORT
"""

from __future__ import annotations

import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np

from drive_env import CanDrives, EtherCatDrives, Limits, SafetyError, motion

CYCLES, WAY = 1000, 48_000  # increments in a second
SLOW = 2.0  # rad/s; the move is faster
LIVE = 0x6F
PATIENT = {"timeout": 10.0}


def opened(stack: ExitStack, can: str, port: str, **right_limits: float):
    """Return the drives of both ends; their envelopes bear a computer that is busy."""
    limits = {"stall": 20.0, "silence": 2.0}
    left = CanDrives("tgz_s", interface="slcan", channel=can, nodes=[1], safety=Limits(**limits), **PATIENT)
    right = EtherCatDrives(
        "tgz_s", interface="ethercat-udp", channel=port, safety=Limits(**limits, **right_limits), **PATIENT
    )
    return stack.enter_context(left), stack.enter_context(right)


def move(both, way: int):
    """Move both ends at once by so many increments; returns how far each got."""
    course = np.round(way * (1.0 - np.cos(np.pi * np.arange(CYCLES) / CYCLES)) / 2.0).astype(int)
    starts = [drives.read(0x6064) for drives in both]
    with ThreadPoolExecutor(len(both)) as pool:
        runs = [
            pool.submit(drives.record, [0x6041, 0x6064], 1e-3 * CYCLES, {0x607A: start + course[:, None]})
            for drives, start in zip(both, starts, strict=True)
        ]
        for run in runs:
            run.result()
    for drives in both:
        drives.advance(0.3)
    return [int(drives.read(0x6064)[0] - start[0]) for drives, start in zip(both, starts, strict=True)]


def main(can: str, port: str) -> None:
    """Drag, move and stop the gantry."""
    seen = {}
    with ExitStack() as stack:
        left, right = both = opened(stack, can, port)
        before = right.read(0x6064)
        motion.enable(left, mode="csp")
        move([left], WAY)
        seen["dragged"] = int(right.read(0x6064)[0] - before[0])
        motion.enable(right, mode="csp")
        seen["moved"] = move(both, WAY)
        seen["words"] = [int(drives.read(0x6041)[0]) & LIVE for drives in both]
        for drives in both:
            motion.disable(drives)
    seen["stopped"] = ""
    with ExitStack() as stack:
        both = opened(stack, can, port, velocity=SLOW)
        for drives in both:
            motion.enable(drives, mode="csp")
        try:
            move(both, -WAY)
        except SafetyError as error:
            seen["stopped"] = str(error)
    with ExitStack() as stack:
        both = opened(stack, can, port)
        seen["off"] = [int(drives.read(0x6041)[0]) & LIVE for drives in both]
        places = [int(drives.read(0x6064)[0]) for drives in both]
        time.sleep(0.5)
        seen["at_rest"] = [abs(int(d.read(0x6064)[0]) - place) for d, place in zip(both, places, strict=True)]
    print(json.dumps(seen))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
