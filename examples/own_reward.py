"""Train with a reward of your own: wrap the environments, and give the wrapper to Stable-Baselines3.

    python examples/own_reward.py --steps 200000

The environment's reward terms come in `info["reward_terms"]`, so a wrapper can weigh them anew or add its own.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from gymnasium.vector import VectorWrapper
from stable_baselines3 import PPO

from drive_env.envs.stable_baselines import DriveVecEnv
from drive_env.envs.tracking import Tracking


@dataclass
class Arguments:
    steps: int = 200_000  # of all environments together
    environments: int = 32
    seed: int = 0


class Thrifty(VectorWrapper):
    """Pays for tracking and fines copper losses: the square of the current, entry 4 of an axis."""

    def __getattr__(self, name):  # DriveVecEnv needs more than Gymnasium's wrappers hand through
        return getattr(self.env, name)

    def step(self, actions):
        observation, _, terminated, truncated, info = self.env.step(actions)
        ended = info.get("final_info", info)  # of environments that ended, the episode's last step
        current = observation[:, 4::8]
        reward = ended["reward_terms"]["tracking"] - 5.0 * np.square(current).mean(axis=1) - 10.0 * terminated
        return observation, reward, terminated, truncated, info


def main(arguments: Arguments) -> None:
    envs = Tracking(arguments.environments, load="two_mass", mode="csp", action="offset", autoreset_mode="SameStep")
    env = DriveVecEnv(Thrifty(envs))
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=512, seed=arguments.seed, device="cpu")
    model.learn(arguments.steps)
    env.seed(1_000_000)
    observation, total = env.reset(), 0.0
    for _ in range(envs.config.steps):
        observation, reward, _, _ = env.step(model.predict(observation, deterministic=True)[0])
        total += float(reward.mean())
    print(f"mean return of {arguments.environments} episodes with seeds of their own: {total:.1f}")
    env.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=Arguments.steps, help="steps of all environments together")
    parser.add_argument("--environments", type=int, default=Arguments.environments, help="environments side by side")
    parser.add_argument("--seed", type=int, default=Arguments.seed, help="seed of the training")
    main(Arguments(**vars(parser.parse_args())))
