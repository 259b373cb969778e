"""One emulated drive, object by object: enable, move, change a gain, disturb the load, record.

python examples/one_drive.py --machines 8 --motor qbl4208
"""

import argparse

from drive_env import EmulatedDrives, motion
from drive_env.motors import MOTORS
from mechanics.loads import LOADS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machines", type=int, default=4, help="machines side by side")
    parser.add_argument("--motor", default="qbl4208", choices=MOTORS, help="motor")
    parser.add_argument("--load", default="two_mass", choices=LOADS, help="load")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random")
    options = parser.parse_args()
    with EmulatedDrives(
        "tmcm1636", options.load, options.motor, options.machines, options.seed, randomise=("load", "motor")
    ) as drives:
        motion.enable(drives, mode="pp")
        motion.move_to(drives, 500_000)  # increments; 65,536 are one revolution
        print("positions reached [inc]:", drives.read("Position actual value"))
        motion.select_mode(drives, "pv")
        drives.write("Velocity Mode Settings.P_Parameter", 600)
        drives.write("Target velocity", 1_092_267)  # pps, 1000 rpm
        drives.advance(0.5)
        drives.machine.load_torque = -0.02  # N*m, against the motion
        trace = drives.record(["Velocity actual value", 0x6077], duration=0.2)
        rpm = trace["Velocity actual value"] * 60 / 65536
        print("slowest speed after the load step [rpm]:", rpm.min(axis=0).round(0))
        print("current at the end [mA]:", trace[0x6077][-50:].mean(axis=0).round(0))
        motion.disable(drives)


if __name__ == "__main__":
    main()
