"""The same program on emulated drives and on a bus: enable, move, follow a profile, report.

python examples/on_the_bus.py                                              emulated
python examples/on_the_bus.py --channel socket://127.0.0.1:29636           the emulator served by `drive-env serve`
python examples/on_the_bus.py --interface socketcan --channel can0         a real drive: know what its motor turns!
"""

import argparse
import contextlib

import numpy as np

from drive_env import CanDrives, EmulatedDrives, Limits, motion

TURN = 65536  # increments of a revolution


def open_drives(options):
    if options.channel is None:
        return EmulatedDrives("tmcm1636", "inertia")
    limits = Limits(velocity=50 * TURN)  # pps; position and current limits are the drive's own
    return CanDrives(
        "tmcm1636",
        interface=options.interface,
        channel=options.channel,
        nodes=[options.node],
        safety=limits,
        dry_run=options.dry_run,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--interface", help="python-can interface")
    parser.add_argument("--channel", help="channel; without one the drives are emulated in this process")
    parser.add_argument("--node", type=int, default=1, help="node-ID")
    parser.add_argument("--dry-run", action="store_true", help="print the frames and send none")
    options = parser.parse_args()
    with contextlib.closing(open_drives(options)) as drives:
        motion.enable(drives, mode="pp")
        start = int(drives.read("Position actual value")[0])
        motion.move_to(drives, TURN, relative=True)
        moved = int(drives.read("Position actual value")[0]) - start
        print(f"moved by {moved / TURN:.3f} revolutions")

        motion.select_mode(drives, "csv")
        profile = np.rint(5 * TURN * np.sin(np.linspace(0.0, 2.0 * np.pi, 500))).astype(int)  # pps, one row per ms
        trace = drives.record(["Velocity actual value", "Torque actual value"], 0.5, play={"Target velocity": profile})
        error = trace["Velocity actual value"][:, 0] - profile
        print(f"velocity follows within {np.abs(error).max() * 60 / TURN:.0f} rpm")
        print(f"largest current {np.abs(trace[0x6077]).max()} mA")
        motion.disable(drives)


if __name__ == "__main__":
    main()
