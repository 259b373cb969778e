"""The suite of learning tasks, `ServoDrive/...-v1`: each is a configuration of an environment that never changes.

A task is complete: device, load, mode, action, distributions, horizon and reward. Its reward per step lies in 0...1:
near 0 for a motor at rest, 0 after a fall or a trip, which end the episode, and 1 for a perfect step. The score of an
episode is the sum over the horizon's steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, pi
from typing import Any

# Terms of Tracking's reward, all of which a task lists, with weight 0 except its own. A later term is not added here
# unless it is a task's own, since that would change published tasks: without a weight it counts 0.
TERMS = ("tracking", "speed", "load", "carried", "effort", "smoothness", "trip")


@dataclass(frozen=True)
class SuiteTask:
    """A task of the suite.

    environment: The environment that it configures.
    about: Description of the task.
    steps: Actions of an episode.
    solved: Score above which an agent surpasses the expert, 0...1; the reward threshold is that times `steps`.
    options: The configuration.
    """

    environment: str
    about: str
    steps: int
    solved: float
    options: Mapping[str, Any] = field(default_factory=dict)


def _tracking(about: str, solved: float, reward: str, load: str, duration: float, **options: Any) -> SuiteTask:
    """Return a task of Tracking, on machines of the load's set, with one term as the reward."""
    weights = dict.fromkeys(TERMS, 0.0) | {reward: 1.0}
    own = {"load": load, "distributions": load, "duration": duration, "weights": weights}
    steps = round(options.get("rate", 1000) * duration)
    return SuiteTask("ServoDrive/Tracking-v0", about, steps, solved, own | options)


def _scheduling(about: str, solved: float, **options: Any) -> SuiteTask:
    """Return a task of GainScheduling on a disc whose inertia changes by 1 : 45, rotor included.

    The margins are those of soft dynamics as numbers, so that later changes of the table have no effect.
    """
    weights = {"tracking": 1.0, "smoothness": 0.0, "trip": 0.0}
    own = {"load": "inertia", "distributions": "payload", "duration": 2.0, "step": 0.01, "base": "middle",
           "span": 2.5, "payload_low": 0.2, "payload_high": 30.0, "dynamics": "60/12/1.5"}  # fmt: skip
    return SuiteTask("ServoDrive/GainScheduling-v0", about, 200, solved, own | options | {"weights": weights})


def _tuning(about: str, solved: float, load: str, laws: Any, gains: tuple[str, ...], **options: Any) -> SuiteTask:
    """Return a task of GainTuning: ten trials, each rewarded by the worth of its own gains."""
    own = {"load": load, "distributions": laws, "gains": gains, "trials": 10, "dynamics": "standard"}
    return SuiteTask("ServoDrive/GainTuning-v0", about, 10, solved, own | {"judged": "trial"} | options)


def _log(low: float, high: float) -> dict[str, Any]:
    """Return the distribution of a parameter between these multiples of its default."""
    return {"law": "loguniform", "low": low, "high": high, "of": "default"}


def _even(low: float, high: float) -> dict[str, Any]:
    return _log(low, high) | {"law": "uniform"}


CASCADE = ("velocity_p", "velocity_i", "position_p")
# A geared joint of 16 times the inertia, stiffness and friction, for motors of 2 N m; without parameters that
# amplifiers on mains lack.
LARGE_JOINT = {
    "include": ["geared_joint", "servo_mains"],
    "parameters": {
        "load.inertia": _log(4.8, 64.0), "load.stiffness": _log(6.4, 40.0), "load.damping": _log(8.0, 32.0),
        "load.coulomb": _even(0.0, 48.0), "load.breakaway": _even(16.0, 32.0), "load.viscous": _even(0.0, 80.0),
        "stage.idle_current": False, "stage.supply_sinks": False,
    },
}  # fmt: skip


TASKS: dict[str, SuiteTask] = {
    "ServoDrive/TorqueTracking-v1": _tracking(
        "moves of a disc on an elastic shaft by torque alone: inertia, stiffness, friction and the bus' delays differ",
        0.80, "tracking", "two_mass", 1.0, mode="cst", margins={"tracking": 0.05},
    ),
    "ServoDrive/GantryBeam-v1": _tracking(
        "two drives pull one beam along a trajectory: the agent leads both set-points, the drives close the loops",
        0.80, "tracking", "gantry", 1.0, mode="csp", action="offset", margins={"tracking": 0.007},
    ),
    "ServoDrive/Crane-v1": _tracking(
        "a load on a rope follows a trajectory: the agent accelerates the carriage; rope and mass differ",
        0.80, "carried", "cart_pendulum", 4.0, rate=500, mode="csv", action="ramp", ramp=12.0, trajectory="moves",
        amplitude=5.0, speed=5.0, margins={"tracking": 0.05},
    ),
    "ServoDrive/PoleBalance-v1": _tracking(
        "a pole that begins up to 0.2 rad beside its balance stands over the middle of the rail; a fall ends it",
        0.85, "carried", "inverted_pendulum", 3.0, rate=500, mode="csv", action="ramp", ramp=8.0, tilt=(-0.2, 0.2),
        trajectory="hold", amplitude=3.0, speed=25.0, margins={"tracking": 0.1},
    ),
    "ServoDrive/PoleSwingUp-v1": _tracking(
        "a hanging pole is swung up and held, on a rail that ends",
        0.80, "load", "inverted_pendulum", 8.0, rate=500, mode="csv", action="ramp", ramp=8.0,
        tilt=(pi - 0.25, pi + 0.25), fall=inf, trajectory="hold", amplitude=5.0, speed=25.0, margins={"load": 1.0},
    ),
    "ServoDrive/ArmPath-v1": _tracking(
        "six joints of an arm follow a path under gravity with an unknown tool: the agent leads their set-points",
        0.80, "tracking", "robot", 2.0, mode="csp", action="offset", offset=0.05, amplitude=12.0, speed=20.0,
        margins={"tracking": 0.0026},
    ),
    "ServoDrive/StepperRun-v1": _tracking(
        "a stepper in open loop runs as fast as it can: the agent changes the step rate; lost steps end the episode",
        0.85, "pace", "inertia", 2.0, device="tmcm6212", distributions="stepper_run", rate=500, mode="csv",
        action="ramp", ramp=6.0, trajectory="run", amplitude=20.0, speed=14.0,
    ),
    "ServoDrive/PayloadScheduling-v1": _scheduling(
        "gains follow a payload that changes unseen while an axis moves: little lag, and loops that keep their margins",
        0.85,
    ),
    "ServoDrive/KnownPayload-v1": _scheduling(
        "gains follow a payload that changes while an axis moves, and that is known", 0.85, payload_observed=True,
    ),
    "ServoDrive/ServoTuning-v1": _tuning(
        "gains of a servo on an elastic shaft: as fast as each machine's margins allow, in ten trials",
        0.80, "two_mass", "two_mass", CASCADE, step=3.0, half=3.0,
    ),
    "ServoDrive/AmplifierTuning-v1": _tuning(
        "gains of a servo amplifier on mains for a geared joint with play, from a new gear to a worn one",
        0.80, "geared_joint", LARGE_JOINT, CASCADE, device="tgz_d", motor="am3033_e", step=3.0, half=3.0,
    ),
}  # fmt: skip

FREE = ("num_threads",)  # options that change only the time that a task takes


def task_options(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a task's configuration with the free options of a run.

    Raises:
        ValueError: For an option that the task fixes.
    """
    task = TASKS[name]
    for option in given:
        if option not in FREE:
            raise ValueError(
                f"{name} is frozen and takes no {option!r}; for other options take {task.environment}, whose "
                "configuration this task is (drive_env.envs.suite.TASKS)"
            )
    return {**task.options, **given}
