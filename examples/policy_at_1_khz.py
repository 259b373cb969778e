"""A policy at 1 kHz over PDO: each millisecond a sample comes in, the policy acts, a set-point goes out.

python examples/policy_at_1_khz.py                                         emulated
python examples/policy_at_1_khz.py --channel socket://127.0.0.1:29636      the emulator served by `drive-env serve`
python examples/policy_at_1_khz.py --interface socketcan --channel can0    a real drive: know what its motor turns!

Of drive-agent only agents/policies/policy.py is needed, which needs NumPy alone: `--agent agent.npz` takes one that was
trained on a velocity error. Without one a PI law acts.
"""

import argparse
import contextlib

import numpy as np

from agents.policies.policy import load_policy
from drive_env import CanDrives, EmulatedDrives, Limits, motion

TURN = 65536  # increments of a revolution
POSITION, VELOCITY, TARGET_CURRENT = "Position actual value", "Velocity actual value", "Target torque"
CURRENT = 3000  # mA, of an action of 1


class PiLaw:
    total = 0.0

    def act(self, observation):
        self.total = float(np.clip(self.total + 0.02 * observation[0], -1.0, 1.0))
        return np.clip(2.0 * observation[:1] + self.total, -1.0, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("interface", "channel", "agent"):
        parser.add_argument(f"--{name}")
    parser.add_argument("--seconds", type=float, default=1.0, help="how long it acts [s]")
    options = parser.parse_args()
    policy = load_policy(options.agent) if options.agent else PiLaw()
    limits = Limits(velocity=60 * TURN, stall=0.1)  # a policy that stalls for 100 ms is quick-stopped
    drives = EmulatedDrives(load="inertia") if options.channel is None else CanDrives(
        interface=options.interface, channel=options.channel, safety=limits)  # fmt: skip
    with contextlib.closing(drives):
        motion.enable(drives, mode="cst")
        speed, errors = float(drives.read(VELOCITY)[0]), []
        for k in range(round(1000 * options.seconds)):
            wanted = 10 * TURN * np.sin(2.0 * np.pi * k / 500)  # pps
            observation = np.array([(wanted - speed) / (20 * TURN), wanted / (20 * TURN)], np.float32)
            current = np.array([round(CURRENT * float(policy.act(observation)[0]))])
            trace = drives.record([POSITION, VELOCITY], 0.001, play={TARGET_CURRENT: current})  # one RPDO, SYNC, TPDOs
            speed = float(trace[VELOCITY][-1, 0])
            errors.append(wanted - speed)
        print(f"velocity follows within {np.abs(errors[len(errors) // 2 :]).max() * 60 / TURN:.0f} rpm")
        motion.quick_stop(drives)
        drives.advance(0.3)
        motion.disable(drives)


if __name__ == "__main__":
    main()
