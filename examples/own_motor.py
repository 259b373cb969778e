"""Your own motor: a file with its data sheet's numbers, the drive's preset for it, and a drive that turns it.

python examples/own_motor.py --motor examples/models/my_motor.toml
"""

import argparse

from drive_env import EmulatedDrives, motion
from drive_env.motors import find_motor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motor", default="examples/models/my_motor.toml", help="a motor's file, or a name")
    options = parser.parse_args()
    motor = find_motor(options.motor)
    print(f"{motor.title}: {motor.n_p} pole pairs, {motor.torque_constant:.4f} N*m per ampere of peak i_q")
    # The drive comes up commissioned for the motor: its preset follows from the motor's numbers.
    with EmulatedDrives(motor=motor, load="inertia", parameters={"load.inertia": 1e-4}) as drives:
        for name in ("Motor Pole Pairs", (0x2003, 0), "Torque Mode Settings.Torque_P", "Torque Mode Settings.Torque_I"):
            entry = drives.device.new_dictionary().find(name)
            print(f"{entry.index:04X}h:{entry.sub:02X} {entry.name} = {drives.read(name)[0]}")
        motion.enable(drives, mode="pv")
        drives.write("Target velocity", "1000 rpm")
        drives.advance(0.5)
        trace = drives.record(["Velocity actual value", "Torque actual value"], duration=0.2)
        print(f"mean speed {trace['Velocity actual value', 'rpm'].mean():.0f} rpm")
        motion.quick_stop(drives)
        drives.advance(0.3)
        motion.disable(drives)


if __name__ == "__main__":
    main()
