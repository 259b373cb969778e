"""Six steppers on one node: a table-top arm on a TMCM-6212 goes from pose to pose, all joints at once.

python examples/stepper_arm.py
"""

import argparse

import numpy as np

from drive_env import EmulatedDrives, motion
from drive_env.dictionary.roles import Role
from mechanics.loads import find_load

RUN_CURRENT = 0x2003  # in 255ths of 1.5 A
SENSOR = 0x606A  # 0: 6064h is the encoder's, -1: the counted microsteps
POSES = ((40, -20, 30, 60, -45, 90), (-40, 25, -30, -60, 45, -90), (0, 0, 0, 0, 0, 0))  # degrees


def move(drives: EmulatedDrives, degrees: tuple[float, ...], turns: float) -> None:
    """Let all joints arrive at the same time; the fastest rotor turns so often a second."""
    gear = np.array(drives.load.gears)
    microsteps = drives.read(Role.POSITION_SCALE)
    target = np.radians(degrees) * gear / (2 * np.pi) * microsteps
    way = np.abs(target - drives.read("Position demand value"))
    share = np.maximum(way / way.max(), 0.01)
    drives.write("Profile velocity", np.round(turns * microsteps * share).astype(int))
    for name in ("Profile acceleration", "Profile deceleration"):
        drives.write(name, np.round(20 * microsteps * share).astype(int))
    motion.move_to(drives, np.round(target).astype(int))
    drives.advance(0.2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--turns", type=float, default=4.0, help="of the fastest rotor [1/s]")
    parser.add_argument("--weak", type=int, default=16, help="run current of the shoulder in the last move, of 255")
    options = parser.parse_args()
    with EmulatedDrives("tmcm6212", find_load("robot")) as drives:
        motion.enable(drives, mode="pp")
        for degrees in POSES:
            move(drives, degrees, options.turns)
            print(f"asked for {degrees}, the joints are at {np.degrees(drives.machine.joint_positions[0]).round(1)}")
        # Too little current: the shoulder's rotor loses steps. No step counter sees that; its encoder does.
        shoulder = np.arange(6) == 1
        drives.write(RUN_CURRENT, options.weak, where=shoulder)
        move(drives, POSES[0], options.turns)
        counted = drives.read("Position actual value")
        drives.write(SENSOR, 0)
        drives.advance(0.002)
        lost = (counted - drives.read("Position actual value")) * 200 / drives.read(Role.POSITION_SCALE)
        print(f"full steps lost: {lost.round().astype(int).tolist()}")
        print(f"emergencies: {[(message.axis, message.name) for message in drives.emergencies()]}")
        motion.disable(drives, where=~shoulder)


if __name__ == "__main__":
    main()
