"""Train with a reward of your own: a function, which the environments call after every step.

    python examples/own_reward.py --steps 200000

The environment's reward terms come in `info["reward_terms"]`, so it can weigh them anew or add its own.
"""

import argparse
from dataclasses import dataclass

import numpy as np
from stable_baselines3 import PPO

from drive_env import make_vec_env


@dataclass
class Arguments:
    steps: int = 200_000  # of all environments together
    environments: int = 32
    seed: int = 0


def thrifty(observations, actions, info):
    """Pay for tracking; fine copper losses, the square of the current (entry 4 of an axis), and a trip."""
    losses = np.square(observations[:, 4::8]).mean(axis=1)
    return info["reward_terms"]["tracking"] - 5.0 * losses - 10.0 * info["terminated"]


def main(arguments: Arguments) -> None:
    options = {"load": "two_mass", "mode": "csp", "action": "offset", "reward": thrifty}
    env = make_vec_env("ServoDrive/Tracking-v0", arguments.environments, **options)
    model = PPO("MlpPolicy", env, n_steps=64, batch_size=512, seed=arguments.seed, device="cpu")
    model.learn(arguments.steps)
    env.seed(1_000_000)
    observation, total = env.reset(), 0.0
    for _ in range(env.get_attr("max_episode_steps")[0]):
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
