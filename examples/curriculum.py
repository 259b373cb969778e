"""A curriculum: machines that are nearly alike at first, and as different as they come in the end.

    python examples/curriculum.py --steps 200000

`stage` scales the ranges of the random machines, 0 (the default machine) to 1; it acts at each environment's next
episode. A schedule that depends on the steps alone needs no callback: the
table `curriculum` of the distributions holds one.
"""

import argparse
from dataclasses import dataclass

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from drive_env.envs.stable_baselines import DriveVecEnv
from drive_env.envs.tracking import Tracking


@dataclass
class Arguments:
    steps: int = 200_000  # of all environments together
    environments: int = 32
    full_at: float = 0.6  # of the run: from here on the stage is 1
    seed: int = 0


class Curriculum(BaseCallback):
    """Raises the stage with each rollout."""

    def __init__(self, envs: Tracking, full_steps: float) -> None:
        super().__init__()
        self._envs, self._full_steps = envs, full_steps

    def _on_rollout_start(self) -> None:
        stage = min(1.0, self.num_timesteps / self._full_steps)
        self._envs.stage = stage
        self.logger.record("curriculum/stage", stage)

    def _on_step(self) -> bool:
        return True


def main(arguments: Arguments) -> None:
    envs = Tracking(arguments.environments, load="two_mass", mode="csp", action="offset", distributions="two_mass",
                     duration=0.25, autoreset_mode="SameStep")  # fmt: skip
    model = PPO("MlpPolicy", DriveVecEnv(envs), n_steps=64, batch_size=512, seed=arguments.seed, device="cpu")
    model.learn(arguments.steps, callback=Curriculum(envs, arguments.full_at * arguments.steps))
    print(f"trained up to stage {envs.stage:.2f}")
    envs.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in vars(Arguments()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    main(Arguments(**vars(parser.parse_args())))
