"""An algorithm of your own in one file: the cross-entropy method finds a linear policy, with NumPy alone.

    python examples/own_algorithm.py --generations 20

Each candidate acts on some machines of its own environments, all at
the same time; the best fifth make the next generation.
"""

import argparse
from dataclasses import dataclass

import numpy as np

from drive_env.envs.tracking import Tracking


@dataclass
class Arguments:
    generations: int = 20
    candidates: int = 32  # per generation
    machines: int = 8  # per candidate, the same for all
    duration: float = 0.5  # of an episode [s]
    seed: int = 0


def following_error(envs, weights, seed, machines):
    """Return the RMS following error [amplitudes] of each candidate, mean over its machines."""
    observation, _ = envs.reset(seed=[seed + k % machines for k in range(envs.num_envs)])
    rows = np.repeat(weights, machines, axis=0)
    squares, tripped = np.zeros(envs.num_envs), np.zeros(envs.num_envs, bool)
    for _ in range(envs.config.steps):
        action = np.sum(rows * observation, axis=1, keepdims=True).clip(-1.0, 1.0).astype(np.float32)
        observation, _, terminated, _, _ = envs.step(action)
        squares += np.square(observation[:, 0])
        tripped |= terminated
    rms = np.where(tripped, 1.0, np.sqrt(squares / envs.config.steps))
    return rms.reshape(-1, machines).mean(axis=1)


def main(arguments: Arguments) -> None:
    envs = Tracking(arguments.candidates * arguments.machines, load="two_mass", mode="csp", action="offset",
                     duration=arguments.duration, distributions="two_mass")  # fmt: skip
    rng = np.random.default_rng(arguments.seed)
    mean, deviation = np.zeros(8), np.full(8, 0.5)
    for generation in range(arguments.generations):
        weights = mean + deviation * rng.standard_normal((arguments.candidates, 8))
        weights[0] = mean
        errors = following_error(envs, weights, 1000 * generation, arguments.machines)
        elite = weights[np.argsort(errors)[: max(2, arguments.candidates // 5)]]
        mean, deviation = elite.mean(axis=0), 0.9 * elite.std(axis=0) + 0.02
        print(f"generation {generation}: mean policy {errors[0]:.4f}, best {errors.min():.4f} of the amplitude")
    print("weights of the observation's entries:", np.round(mean, 2).tolist())
    envs.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in vars(Arguments()).items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    main(Arguments(**vars(parser.parse_args())))
