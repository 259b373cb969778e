"""Your own machine: drives on the joints of a MuJoCo model, here a SCARA.

python examples/own_machine.py --gear 50
"""

import argparse
from pathlib import Path

import numpy as np

from drive_env import EmulatedDrives, motion
from mechanics import Load, Parameter

SCARA = Path(__file__).parent / "models" / "scara.xml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gear", type=float, default=50.0, help="rotor turns per turn of a joint")
    parser.add_argument("--tool", type=float, default=0.3, help="mass of the tool [kg]")
    options = parser.parse_args()
    # Without `joints`, the model's actuators say what is driven. Any number of the model can be made a parameter.
    tool = Parameter("tool", "kg", "body_mass", "quill", 0.5, 3.0, "of the tool")
    scara = Load(SCARA, joints=("shoulder", "elbow"), gear=options.gear, parameters=(tool,))
    with EmulatedDrives(load=scara, parameters={"load.tool": options.tool}) as drives:
        motion.enable(drives, mode="pp")
        turns = options.gear / (2 * np.pi)  # of the rotor per rad of the joint
        for degrees in ((45, -60), (-30, 90), (0, 0)):
            motion.move_to(drives, np.round(np.radians(degrees) * turns * 65536).astype(int))
            drives.advance(0.2)
            reached = np.degrees(drives.machine.joint_positions[0])
            print(f"asked for {degrees} degrees, the joints are at {reached.round(2)}")
        motion.disable(drives)


if __name__ == "__main__":
    main()
