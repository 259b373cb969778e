"""Train a tuner with plain Stable-Baselines3: one line makes its VecEnv, the rest is as with any other environment.

    python examples/train_with_sb3.py --steps 20000 --out mine

One step is one trial of gains on a machine that the agent does not know; an episode is its trials on one machine.
"""

import argparse
from dataclasses import dataclass

from stable_baselines3 import PPO

from drive_env import make_vec_env


@dataclass
class Arguments:
    steps: int = 20_000  # of all environments together
    environments: int = 64  # machines side by side
    seed: int = 0
    out: str = "mine"  # mine.zip


def main(arguments: Arguments) -> None:
    env = make_vec_env("ServoDrive/GainTuning-v0", num_envs=arguments.environments, distributions="two_mass")
    model = PPO("MlpPolicy", env, n_steps=20, batch_size=256, gamma=1.0, seed=arguments.seed, device="cpu")
    model.learn(arguments.steps)
    returns = [episode["r"] for episode in model.ep_info_buffer]
    mean = sum(returns) / len(returns)
    print(f"{model.num_timesteps} trials, mean return of the last {len(returns)} episodes {mean:.2f}")
    model.save(arguments.out)
    env.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in vars(Arguments()).items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    main(Arguments(**vars(parser.parse_args())))
