"""An environment on a load of your own: an MJCF, the joint that a motor turns, and a policy that acts on it.

    python examples/own_load.py --steps 100000

`load` is the path of an MJCF; its only joint gets a drive. What varies is a table of distributions.
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

from stable_baselines3 import PPO

from drive_env.envs.stable_baselines import DriveVecEnv
from drive_env.envs.tracking import Tracking

FLYWHEEL = """<mujoco model="flywheel">
  <option timestep="0.0002"/>
  <worldbody>
    <body name="wheel">
      <joint name="shaft" type="hinge" axis="0 0 1" damping="2e-5"/>
      <geom type="cylinder" size="0.03 0.005" mass="0.06" pos="0.002 0 0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""


@dataclass
class Arguments:
    steps: int = 100_000  # of all environments together
    environments: int = 32
    seed: int = 0


def main(arguments: Arguments) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flywheel.xml"
        path.write_text(FLYWHEEL)
        distributions = {"parameters": {"motor.coulomb": {"law": "uniform", "low": 0.5, "high": 2.0, "of": "default"}}}
        envs = Tracking(arguments.environments, load=str(path), mode="csp", action="offset", amplitude=1.0, speed=15.0,
                         distributions=distributions, autoreset_mode="SameStep")  # fmt: skip
        model = PPO("MlpPolicy", DriveVecEnv(envs), n_steps=64, batch_size=512, seed=arguments.seed, device="cpu")
        model.learn(arguments.steps)
        observation, _ = envs.reset(seed=1_000_000)
        error = 0.0
        for _ in range(envs.config.steps):
            observation = envs.step(model.predict(observation, deterministic=True)[0])[0]
            error += float(abs(observation[:, 0]).mean()) / envs.config.steps
        print(f"mean following error {error * envs.config.amplitude:.3f} revolutions")
        envs.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in vars(Arguments()).items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    main(Arguments(**vars(parser.parse_args())))
