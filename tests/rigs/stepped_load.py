"""A packed load stepped through a series of torques: one kernel for all tests, since each takes 10 s to compile."""

from typing import NamedTuple

import numpy as np

from mechanics.kernels.compiled import cached
from mechanics.stepping import step


class Stepped(NamedTuple):
    """What was found after each of n steps of C copies with A axes, D joints and B contacts."""

    theta: np.ndarray  # (n, C A) [rad]
    omega: np.ndarray  # (n, C A) [rad/s]
    reaction: np.ndarray  # (n, C A) [N m]
    qpos: np.ndarray  # (n, C D)
    qvel: np.ndarray  # (n, C D)
    carried: np.ndarray  # (n, C, B) [N or N m]


@cached()
def _steps(plant, torque, moment, h, motion, qpos, qvel, carried):
    for n in range(torque.shape[0]):
        step(plant, torque[n], moment[n], h, motion[0, n], motion[1, n], motion[2, n], motion[3, n])
        qpos[n] = plant.qpos
        qvel[n] = plant.qvel
        carried[n] = plant.carried


def stepped(plant, torque, h, moment=None):
    """Step all copies through torques, (n,) of one axis or (n, C A), and their first moments; None: all are 0."""
    torque = np.ascontiguousarray(np.reshape(torque, (len(torque), -1)), float)
    moment = np.zeros_like(torque) if moment is None else np.ascontiguousarray(np.reshape(moment, torque.shape), float)
    motion = np.zeros((4, *torque.shape))
    qpos, qvel = np.zeros((len(torque), len(plant.qpos))), np.zeros((len(torque), len(plant.qvel)))
    carried = np.zeros((len(torque), *plant.carried.shape))
    _steps(plant, torque, moment, h, motion, qpos, qvel, carried)
    return Stepped(motion[0], motion[1], motion[2], qpos, qvel, carried)
