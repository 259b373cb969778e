"""Three axes together: a stepper module moves the tool of a portal down a helix, each axis in csp.

python examples/portal.py --radius 0.1
"""

import argparse

import numpy as np

from drive_env import EmulatedDrives, motion
from drive_env.dictionary.roles import Role

CYCLE = 1e-3  # s, between two set-points
SETTLE = 1.5  # s, in which the tool comes to rest, and a late axis arrives


def helix(radius: float, depth: float, turns: int, speed: float, ramp: float = 0.3) -> np.ndarray:
    """Return the tool's path [m], one row per cycle; it speeds up, and slows down, for `ramp` [s]."""
    length = np.hypot(2 * np.pi * turns * radius, depth)
    duration = length / speed + ramp
    t = np.arange(CYCLE, duration, CYCLE)
    way = np.cumsum(np.minimum(1.0, np.minimum(t, duration - t) / ramp))
    share = way / way[-1]
    angle = 2 * np.pi * turns * share
    return np.column_stack([radius * (1 - np.cos(angle)), radius * np.sin(angle), -depth * share])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--radius", type=float, default=0.08, help="of the helix [m]")
    parser.add_argument("--depth", type=float, default=0.06, help="how far down it goes [m]")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--speed", type=float, default=0.2, help="along the path [m/s]")
    parser.add_argument("--closed-loop", action="store_true", help="let the encoders commutate")
    options = parser.parse_args()
    path = helix(options.radius, options.depth, options.turns, options.speed)
    with EmulatedDrives("tmcm3313", load="portal") as drives:
        drives.write("Sensor selection code", 0)  # positions by the encoders: lost steps would show
        motion.enable(drives, mode="csp")
        if options.closed_loop:
            drives.write("Following error window", 0)  # it may fall behind, and catches up
            drives.write(Role.LOOP_MODE, 1)
            while not drives.read(Role.LOOP_INITIALISED).all():
                drives.advance(0.1)
        # A rotor's turn is so many microsteps, and moves the axis so far.
        microsteps = drives.read(Role.POSITION_SCALE) * np.array(drives.load.gears) / (2 * np.pi)
        targets = drives.read("Position actual value") + np.rint(path * microsteps).astype(int)
        targets = np.vstack([targets, np.tile(targets[-1], (round(SETTLE / CYCLE), 1))])
        trace = drives.record(["Position actual value"], len(targets) * CYCLE, play={"Target position": targets})
        behind = np.abs(trace["Position actual value"][1:] - targets[:-1]) / microsteps
        print(f"{len(path) * CYCLE:.1f} s of path, {options.turns} turns of {options.radius:g} m")
        for name, worst, end in zip("xyz", behind.max(axis=0), behind[-1], strict=True):
            print(f"{name}: at most {1e6 * worst:.0f} um behind its set-point, {1e6 * end:.0f} um at the end")
        sway = drives.machine.joint_positions[0, 3:]
        print(f"the tool stands still to {1e3 * np.abs(sway).max() * 0.12:.2f} mm")
        emergencies = drives.emergencies()
        for emergency in emergencies:
            print(f"axis {emergency.axis}: {emergency.name}")
        if not emergencies:
            motion.disable(drives)


if __name__ == "__main__":
    main()
