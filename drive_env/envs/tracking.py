"""Tracking: the agent is the outer controller, at 500 Hz or 1 kHz, of drives in csp, csv or cst."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from drive_env import cia402
from drive_env.devices import Device, find_device
from drive_env.dictionary.roles import Role
from drive_env.drives import motion
from drive_env.drives.currents import counts_per_ampere, read_current_limit
from drive_env.drives.interface import CYCLE, Drives, device_of
from drive_env.drives.speeds import per_increment
from drive_env.emulator.cyclic_control import Hooks, cyclic_control
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.envs import tracking_cycle as cycle
from drive_env.envs.bus_delays import BusDelays
from drive_env.envs.configuration import configured
from drive_env.envs.highest_speed import highest_speeds
from drive_env.envs.pictures import Pictures
from drive_env.envs.trajectories import TRAJECTORIES, Trajectory, checked, draw
from drive_env.envs.vector_environment import Info, Observation, Reward, Stepped, VectorEnvironment, check_choice
from drive_env.motors import Motor, find_motor
from drive_env.phase_current import amplitude, rated_setting
from drive_env.randomisation.random_machines import Distributions, RandomMachines, laws_of, shipped
from mechanics.arrays import Floats, Mask, Singles, Texts
from mechanics.loads import find_load
from mechanics.shaft import one, way

# Mode -> target object, offset object (CiA 402).
OBJECTS = {
    "csp": (cia402.TARGET_POSITION, cia402.POSITION_OFFSET),
    "csv": (cia402.TARGET_VELOCITY, cia402.VELOCITY_OFFSET),
    "cst": (cia402.TARGET_TORQUE, cia402.TORQUE_OFFSET),
}
SAMPLED = (cia402.STATUSWORD, cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL)
# For a stepper, which has no target current: the rotor's lag behind its steps shows the torque.
SAMPLED_OF_STEPPERS = (*SAMPLED[:3], cia402.POSITION_DEMAND)
ENCODER, ENCODER_OFF = 0, -1  # values of 606Ah
WEIGHTS = {"tracking": 1.0, "speed": 0.2, "load": 1.0, "carried": 0.0, "effort": 0.05, "smoothness": 0.05, "pace": 0.0,
           "trip": 10.0}  # fmt: skip
TERMS = tuple(WEIGHTS)
RATES = (500, 1000)
WITHIN_TRAVEL = 0.8  # of an axis' travel to its end stops: the most that a trajectory uses
ACTIONS = ("direct", "offset", "ramp")
RETURN_SPEED = 0.25  # of the trajectory's, back to the start on a bus
RESTARTS = 3  # tries to return to the start on a bus: hasty braking may trip once more
RESET_PAUSE, RESET_TIME = 0.1, 2.0  # s between two fault resets, and in all: a filled DC link empties slowly
REST_SPEED, REST_TIME = 0.02, 0.5  # of the trajectory's speed, below which it is at rest; s allowed until then


@dataclass(frozen=True)
class Task:
    """A task with a load: the defaults of a configuration.

    mode: csp, csv or cst.
    trajectory: A row of trajectories.TRAJECTORIES.
    amplitude: Amplitude of the trajectory, and the scale of positions [rev of the motor].
    speed: Its highest speed, and the scale of velocities [rev/s].
    joint: Number of the load's joint with a sensor of the master; None: no such sensor.
    length: Length of its pendulum, from the pivot to the bob [m].
    fall: Angle of that joint that ends the episode [rad].
    together: Whether all axes follow one trajectory, as the ends of one beam must.
    """

    mode: str
    trajectory: str
    amplitude: float
    speed: float
    joint: int | None = None
    length: float = 0.3
    fall: float = np.inf
    together: bool = False


TASKS = {
    "two_mass": Task("cst", "moves", 2.0, 20.0),
    "gantry": Task("csv", "moves", 3.0, 15.0, together=True),
    "cart_pendulum": Task("csv", "moves", 5.0, 15.0, joint=1),
    "inverted_pendulum": Task("csv", "hold", 5.0, 25.0, joint=1, fall=0.6),
}
OTHER = Task("cst", "moves", 1.0, 10.0)  # of every other load
STEPPER_SPEED = 5.0  # rev/s of a stepper at most: beyond it torque falls


def of_stepper(task: Task) -> Task:
    """Return a task adapted to a stepper: position instead of torque, at a speed at which it has torque."""
    return replace(task, mode="csp" if task.mode == "cst" else task.mode, speed=min(task.speed, STEPPER_SPEED))


@dataclass(frozen=True)
class TrackingConfig:
    """Configuration of Tracking; None takes the load's own (TASKS).

    load, device, motor, friction: As `EmulatedDrives` takes them; without a motor the device's usual one.
    mode: "csp", "csv" or "cst". None: csv for gantry, cart_pendulum and inverted_pendulum,
        else cst, of steppers csp. Steppers have no cst here.
    action: "direct": the action is the target, of a full scale: current limit, 1.25 times speed or amplitude.
        "offset": the target follows the profile, and the action is 60B0h, 60B1h or 60B2h besides, up to `offset` times
        that full scale. The profile of cst is the current that the commissioned inertia needs.
        "ramp": the target changes by the action times `ramp`, within the full scale: what explores does not leap.
    offset: Share of full scale.
    ramp: Most that the target changes by [full scales per second].
    rate: Actions per second [Hz], 500 or 1000.
    duration: Of an episode [s].
    delay: From the drive's sample to the action's effect [communication cycles], 1 or more: an agent on a real bus
        has one cycle to answer.
    trajectory, amplitude [rev], speed [rev/s]: What is followed, drawn anew in each episode, within 80 % of an axis'
        travel. "hold": the start;
        "moves": to random places within the amplitude, with rests of up to 0.1 s; "sines": three sines of 0.5 to 5 Hz;
        "run": on at `speed` from the first moment. Each axis has its own, the ends of a gantry the same.
        A function of your own is called with the environment's generator, the number of samples and their period [s],
        and returns position [rev], velocity [rev/s] and acceleration [rev/s^2], shape (3, samples).
        None: hold, 5 rev and 25 rev/s for inverted_pendulum, else moves: two_mass 2 and 20, gantry 3 and 15,
        cart_pendulum 5 and 15, every other load 1 and 10; of steppers 5 rev/s at most.
    distributions: What else is drawn anew in each episode, as `randomisation.Distributions` takes it; None: noise
        alone, on the machine with its default parameters.
    stage: Of its curriculum, 0...1.
    tilt: Least and greatest angle of the pendulum's joint at the start, drawn evenly [rad].
    fall: Angle of that joint that ends the episode [rad], inf for none; None: 0.6 for inverted_pendulum.
    weights: Of the reward's terms; those left out keep theirs.
    margins: Errors that are worth 0.1 of a term (tracking [amplitude], speed [speed], load [rad], effort [current
        limit], smoothness [1]); those left out keep theirs.
    num_threads: As `EmulatedDrives` takes it.
    """

    load: Any = "two_mass"
    device: str = "tmcm1636"
    motor: str | Motor | None = None
    friction: str = "stribeck"
    mode: str | None = None
    action: str = "direct"
    offset: float = 0.3
    ramp: float = 5.0
    rate: int = 1000
    duration: float = 1.0
    delay: int = 1
    trajectory: str | Trajectory | None = None
    amplitude: float | None = None
    speed: float | None = None
    distributions: Any = None
    stage: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)
    fall: float | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    margins: Mapping[str, float] = field(default_factory=dict)
    num_threads: int | None = None

    def __post_init__(self) -> None:
        if self.motor is None:
            object.__setattr__(self, "motor", find_device(self.device).default_motor)
        task = self.task
        for name in ("mode", "trajectory", "amplitude", "speed", "fall"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, getattr(task, name))
        check_choice("mode", self.mode, tuple(OBJECTS))
        check_choice("action", self.action, ACTIONS)
        check_choice("rate", self.rate, RATES)
        if not callable(self.trajectory):
            check_choice("trajectory, if no function,", self.trajectory, TRAJECTORIES)
        for name in self.weights:
            check_choice("a weight's name", name, tuple(WEIGHTS))
        object.__setattr__(self, "weights", {**WEIGHTS, **self.weights})
        for name, margin in self.margins.items():
            check_choice("a margin's name", name, tuple(cycle.MARGINS))
            if not 0.0 < margin < np.inf:
                raise ValueError(f"the margin of {name} must be above 0 and finite, not {margin:g}")
        object.__setattr__(self, "margins", {**cycle.MARGINS, **self.margins})
        object.__setattr__(self, "tilt", self._checked_tilt())
        for name in ("offset", "ramp", "duration", "amplitude", "speed"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be above 0 and finite, not {getattr(self, name):g}")
        if not 1 <= self.delay <= cycle.LONGEST_DELAY or self.delay != int(self.delay):
            raise ValueError(f"delay is 1...{cycle.LONGEST_DELAY} communication cycles, not {self.delay}")
        if not 0.0 <= self.stage <= 1.0:
            raise ValueError(f"stage of the curriculum must lie in 0...1, not {self.stage:g}")

    def _checked_tilt(self) -> tuple[float, float]:
        low, high = map(float, self.tilt)
        if not -2.0 * np.pi <= low <= high <= 2.0 * np.pi:
            raise ValueError(f"tilt is [low, high] within a turn, in order, not {list(self.tilt)}")
        if (low, high) != (0.0, 0.0) and self.task.joint is None:
            raise ValueError(f"tilt is of a pendulum, and load {self.load!r} has none; leave it out")
        if not float(self.fall or 0.0) > max(abs(low), abs(high)):
            raise ValueError(
                f"fall ({self.fall:g} rad) must be beyond the greatest tilt, {max(abs(low), abs(high)):g} rad"
            )
        return low, high

    @property
    def task(self) -> Task:
        """The task of the load's row."""
        task = TASKS.get(self.load, OTHER) if isinstance(self.load, str) else OTHER
        return of_stepper(task) if turns_steppers(find_device(self.device)) else task

    @property
    def cycles(self) -> int:
        """Communication cycles per action."""
        return 1000 // self.rate

    @property
    def steps(self) -> int:
        """Actions per episode."""
        return max(1, round(self.duration * self.rate))


def turns_steppers(device: Device | None) -> bool:
    """Return whether drives are stepper drives: positions in microsteps, no current limit in amperes."""
    return device is not None and Role.FULL_STEPS in device.roles and Role.CURRENT_LIMIT not in device.roles


def _check_device(device: Device | None, mode: str) -> None:
    """Raise ValueError for drives that lack an observed object, or the mode."""
    if device is None or ((cia402.TORQUE_ACTUAL, 0) in device.bindings and Role.CURRENT_LIMIT in device.roles):
        return
    if not turns_steppers(device):
        raise ValueError(
            f"{device.name} has no torque actual value (6077h) or no current limit, both of which Tracking observes "
            "and rewards; take GainTuning, or a drive that has them"
        )
    if mode == "cst":
        raise ValueError(f"mode='cst': {device.name} drives steppers, which are not asked for a current; take csp, csv")


class Tracking(VectorEnvironment):
    """`ServoDrive/Tracking-v0`: follow a trajectory, or stabilise the load.

    A step is one action: 1 ms at the default `rate` of 1000 Hz; an episode is `duration` times `rate` steps. It begins
    at rest at 0, enabled (on a bus: where the axes stood at first), with a trajectory drawn from the seed.

    Action, float32, one entry per axis a = 0, 1, ... of the machine:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | a | target or offset, see `TrackingConfig.action` | full scale | -1 | 1 |

    Observation, float32, for each axis a of the machine (8 entries each), of the drive's sample that the agent has
    when it acts; amplitude and speed are those of the configuration:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | 8a + 0 | reference - position actual value (6064h) | amplitude | -4 | 4 |
    | 8a + 1 | reference velocity - velocity actual value (606Ch) | speed | -4 | 4 |
    | 8a + 2 | position actual value, from the episode's start | amplitude | -4 | 4 |
    | 8a + 3 | velocity actual value | speed | -4 | 4 |
    | 8a + 4 | torque actual value (6077h) | current limit (2003h) | -4 | 4 |
    | 8a + 5 | reference velocity | speed | -2 | 2 |
    | 8a + 6 | reference velocity 10 ms later | speed | -2 | 2 |
    | 8a + 7 | last action | 1 | -1 | 1 |

    and, with a load whose row has a sensor (cart_pendulum, inverted_pendulum), after those of all A axes:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | 8A + 0 | angle of the pendulum | rad | -pi | pi |
    | 8A + 1 | its rate | rad/s | -50 | 50 |

    The reward is the sum of terms in 0...1 (`info["reward_terms"]`) times their weights, less the last. Those of axes
    are means over them; g(e, m) = 1 / (1 + 9 (e/m)²) is 1 without an error and 0.1 at e = m:

    | term | value | weight |
    | --- | --- | --- |
    | tracking | g(position error, 0.25 amplitude), or the configuration's margin, as below | 1 |
    | speed | g(velocity error, 0.5 speed) | 0.2 |
    | load | g(angle of the pendulum, 0.2 rad); 0 of a load without sensor | 1 |
    | carried | g(error of where the bob is, 0.25 amplitude); 0 of a load without sensor | 0 |
    | effort | g(torque actual value, current limit) | 0.05 |
    | smoothness | g(change of the action, 1) | 0.05 |
    | pace | (velocity / its highest)² forwards, at most 1; what the highest is stands below | 0 |
    | trip | 1 in the step in which a drive tripped or the pole fell | 10, subtracted |

    A stepper is observed by its encoder (606Ah = 0, written where the drives are emulated). Demand less position (6062h
    - 6064h) stands for its torque actual value, a full step for its current limit: so far behind it gives the most
    torque that it has; beyond two it loses steps, and 6065h trips.

    The highest velocity of a pace with a weight is that at which an emulated stepper just stays in step with a disc
    (load inertia; drive_env/envs/highest_speed.py); of other drives and loads, and on a bus, it is `speed`.

    `terminated`: a drive tripped, its machine left physics, or the pole fell; `truncated`: time ran out.

    `info`: "reward_terms"; "parameters" of environments that begin, the true machine, not on a bus; "fault" once an
    environment ended so, a name or several, "" for the others.

    Args:
        num_envs: Number of environments.
        config: A `TrackingConfig`, a table like it, or a TOML file.
        drives: Drives to act on, `num_envs` machines; emulated ones of the configuration by default. Without machine
            (on a bus) an episode begins with a fault reset and a move back to the start.
        sensor: Returns the pendulum's angle of each environment [rad], shape (num_envs,); needed on a bus alone.
        autoreset_mode, render_mode, reward: As `VectorEnvironment` takes them.
        options: Fields of the configuration that replace its own.

    Raises:
        ValueError: For an invalid value, naming the valid ones.
    """

    OPTIONS = (*VectorEnvironment.OPTIONS, "trajectory")
    STATE = (*VectorEnvironment.STATE, "_machines", "_bus", "_episodes", "_causes")

    def __init__(
        self,
        num_envs: int = 1,
        *,
        config: TrackingConfig | Mapping[str, Any] | str | Path | None = None,
        drives: Drives | None = None,
        sensor: Callable[[], ArrayLike] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        reward: Reward | None = None,
        **options: Any,
    ) -> None:
        if drives is not None and drives.device is not None:
            options = {"device": drives.device.name, **options}
        self.config = configured(TrackingConfig, config, options)
        device = find_device(self.config.device) if drives is None else drives.device
        _check_device(device, str(self.config.mode))
        self._is_stepper = turns_steppers(device)
        self._sampled = SAMPLED_OF_STEPPERS if self._is_stepper else SAMPLED
        self._owned = drives is None
        self.drives = self._new_drives(num_envs) if drives is None else drives
        try:
            super().__init__(
                num_envs, *self._spaces(num_envs), autoreset_mode=autoreset_mode, render_mode=render_mode, reward=reward
            )
            self._prepare(sensor)
        except BaseException:
            self._close_environments()
            raise

    @property
    def max_episode_steps(self) -> int:
        """Steps of an episode."""
        return int(self.config.steps)

    # --- construction ---------------------------------------------------------------------------------------------
    def _spaces(self, num_envs: int) -> tuple[Box, Box]:
        axes, rest = divmod(self.drives.num_axes, max(num_envs, 1))
        if rest or not axes:
            raise ValueError(f"{self.drives.num_axes} axes cannot be shared by {num_envs} environments")
        self._axes = axes
        self._has_sensor = self.config.task.joint is not None
        high = np.concatenate([np.tile(cycle.AXIS_HIGH, axes), cycle.LOAD_HIGH if self._has_sensor else []])
        bound = high.astype(np.float32)
        return Box(-bound, bound, dtype=np.float32), Box(-1.0, 1.0, (axes,), np.float32)

    def _new_machines(self) -> RandomMachines | None:
        """Return the drawn emulated machines; None on a bus, whose drives must have the observed objects."""
        distributions, machine = self.config.distributions, self.drives.machine
        if machine is not None:
            if isinstance(distributions, str) and distributions in shipped():
                distributions = laws_of(distributions, device_of(self.drives), machine.parameters)
            return RandomMachines(emulated_of(self.drives), Distributions.load(distributions or {"parameters": {}}))
        if distributions is not None:
            raise ValueError("distributions are of emulated machines; leave them out on a bus")
        if self._is_stepper and (self.drives.read(cia402.SENSOR_SELECTION) == ENCODER_OFF).any():
            raise ValueError("606Ah = -1: no encoder tells where these steppers are; write 606Ah = 0 if they have one")
        return None

    def _prepare(self, sensor: Callable[[], ArrayLike] | None) -> None:
        config, drives, n = self.config, self.drives, self.num_envs
        machine = drives.machine
        self._machines = self._new_machines()
        self._causes: list[list[str]] = [[] for _ in range(n)]  # the emergencies of each environment's episode
        self._sensor = sensor
        if self._has_sensor and sensor is None:
            if machine is None:
                raise ValueError(
                    f"{config.load} needs the pendulum's angle, which no drive measures: give sensor=, a function that "
                    "returns it"
                )
            joint = config.task.joint
            self._sensor = lambda: machine.joint_positions[:, joint]
        self._per_turn = drives.read(Role.POSITION_SCALE).astype(float)
        self._speed_counts = self._per_turn * per_increment(drives, cia402.VELOCITY_ACTUAL)
        target, offset = OBJECTS[str(config.mode)]
        play = (target, offset) if config.action == "offset" else (target,)
        self._acts_on_position = play[-1] == cia402.TARGET_POSITION
        self._control = cyclic_control(drives, self._sampled, play, config.cycles, CYCLE)
        self._bus = BusDelays(n, 2 * cycle.LONGEST_DELAY)
        self._episodes = own = cycle.Episodes(
            lanes=np.zeros(n, cycle.LANE),
            action=np.zeros(drives.num_axes),
            scales=self._scales(),
            origin=np.zeros(drives.num_axes),
            actions=self._bus.actions,
            observations=self._bus.observations,
            message=np.zeros((n, len(SAMPLED) * self._axes + 1)),
            target=np.zeros(drives.num_axes),
            slope=config.ramp * config.cycles * CYCLE,
            reference=np.zeros((drives.num_axes, 3, config.steps * config.cycles + cycle.PREVIEW + 1)),
            profile_scale=self._profile_scales(),
            last=np.zeros((drives.num_axes, 2)),
            played=self._control.played,
            sampled=self._control.sampled,
            angles=np.zeros(n),
            fastest=config.speed * self._speed_counts,
            arm=np.zeros(n),
            weights=np.array([config.weights[name] for name in TERMS], float),
            margins=np.array([config.margins[name] for name in cycle.MARGINS], float),
            observation=np.zeros((n, *(self.single_observation_space.shape or ())), np.float32),
            reward=np.zeros(n),
            terms=np.zeros((len(TERMS), n)),
            ended=np.zeros((2, n), bool),
            kind=cycle.KINDS[str(config.mode), config.action],
            fall=float(config.fall or np.inf),
            lags=int(self._is_stepper),
        )
        self._control.hooks = Hooks(cycle.act, cycle.observe, own)
        self._start = np.zeros(drives.num_axes, np.int64)
        turning = way(one(find_load(config.load)))
        room = WITHIN_TRAVEL * np.minimum(-turning.low, turning.high) / (2.0 * np.pi)
        self._amplitudes = np.minimum(float(config.amplitude or 0.0), room).tolist()
        period = config.cycles * CYCLE
        self._pictures = Pictures(drives, self.render_mode, period) if self.render_mode else None

    def _scales(self) -> Floats:
        """Return amplitude, speed, torque and full scale of the action of each axis, raw, shape (num_axes, 4)."""
        config, drives = self.config, self.drives
        scales = np.empty((drives.num_axes, 4))
        scales[:, 0] = config.amplitude * self._per_turn
        scales[:, 1] = config.speed * self._speed_counts
        if self._is_stepper:
            torque = self._per_turn / drives.read(Role.FULL_STEPS)
        else:
            torque = read_current_limit(drives) * counts_per_ampere(drives)
        scales[:, 2] = torque
        full = {"csp": 1.25 * scales[:, 0], "csv": 1.25 * scales[:, 1], "cst": torque}
        scales[:, 3] = full[str(config.mode)] * (config.offset if config.action == "offset" else 1.0)
        return scales

    def _profile_scales(self) -> Floats:
        """Return raw units of the target per raw unit of the reference: in cst counts of torque per inc/s^2, else 1."""
        config, drives = self.config, self.drives
        if config.mode != "cst":
            return np.ones(drives.num_axes)

        assert config.motor is not None
        motor = find_motor(config.motor)
        inertia = cycle.COMMISSIONED_INERTIA * motor.inertia
        per_rad = counts_per_ampere(drives) * inertia / motor.torque_constant
        return np.asarray(per_rad * 2.0 * np.pi / self._per_turn)

    # --- an episode -----------------------------------------------------------------------------------------------
    def _reset_environments(self, mask: Mask, options: Mapping[str, Any]) -> tuple[Singles, Info]:
        axes = np.repeat(mask, self._axes)
        self._draw_references(
            mask, options.get("trajectory")
        )  # first, so that they are the same on a bus, where no machine is drawn
        if self._machines is not None:
            self._machines.redraw(self.rngs, mask, self.stage, options.get("machine"))
            if self._is_stepper:
                self.drives.write(cia402.SENSOR_SELECTION, ENCODER, where=axes)
            motion.enable(self.drives, mode=self.config.mode, where=axes)
            self._tilt(mask)
            self._find_fastest(mask)
        else:
            self._return_to_start(axes)
        self._take_emergencies()
        for lane in np.flatnonzero(mask):
            self._causes[lane] = []
        samples = np.stack([self.drives.read(name) for name in self._sampled])
        own = self._episodes
        own.origin[axes] = samples[1][axes]
        neutral = samples[1] if self._acts_on_position else np.zeros(len(axes), np.int64)
        own.last[axes] = 0.0
        own.target[axes] = 0.0
        # Observation until the first sample arrives: the drives at rest, before the first cycle.
        seen = np.full((self.num_envs, len(SAMPLED) * self._axes + 1), -1.0)
        if self._is_stepper:
            samples[3] -= samples[1]
        seen[:, :-1] = samples.T.reshape(self.num_envs, -1)
        self._bus.reset(self._delays(), self.rngs, neutral.reshape(self.num_envs, -1), seen, mask)
        if self._sensor is not None:
            own.arm[mask] = self._arms()[mask]
            own.angles[mask] = np.asarray(self._sensor(), float)[mask]
            own.lanes["angle"][mask] = own.angles[mask]
        if self._pictures is not None:
            self._pictures.begin(mask)
        cycle.describe_lanes(own.address, mask)
        return self._present()

    def _present(self) -> tuple[Singles, Info]:
        observation = self._episodes.observation.copy()
        if self._machines is None:
            return observation, {}
        return observation, {"parameters": {name: values.copy() for name, values in self._machines.values.items()}}

    def _arms(self) -> Floats:
        """Return the bobs' distance from their axes at a right angle [inc], shape (num_envs,)."""
        machine = self.drives.machine
        length = self.config.task.length if machine is None else machine.parameters["load.length"]
        per_metre = find_load(self.config.load).gears[0] / (2.0 * np.pi)
        return np.asarray(length * per_metre * self._per_turn.reshape(self.num_envs, -1)[:, 0])

    def _tilt(self, mask: Mask) -> None:
        """Release the pendulums at drawn angles."""
        joint, (low, high) = self.config.task.joint, self.config.tilt
        if joint is not None and high > low:
            angles = np.zeros(self.num_envs)
            for lane in np.flatnonzero(mask):
                angles[lane] = self.rngs[lane].uniform(low, high)
            emulated_of(self.drives).machine.place(joint, angles, mask)

    def _find_fastest(self, mask: Mask) -> None:
        """Compute the machines' highest speeds, if "pace" is relative to them."""
        config, device = self.config, device_of(self.drives)
        if not (config.weights["pace"] and device.gains.is_open_loop and find_load(config.load).name == "inertia"):
            return
        assert self._machines is not None
        motor = find_motor(config.motor)
        own = {name: values[mask] for name, values in self._machines.values.items()}
        found = highest_speeds(motor, amplitude(device, rated_setting(device, motor)), own)
        self._episodes.fastest[mask] = found / (2.0 * np.pi) * self._speed_counts[mask]

    def _act(self, action: Any) -> bool:
        """Make a step; return whether any drive went into fault or a pole fell."""
        own = self._episodes
        own.action[:] = np.reshape(action, own.action.shape)
        if self._sensor is not None:
            own.angles[:] = self._sensor()
        self._control.run()
        if self._pictures is not None:
            self._pictures.look(self._followed())
        return bool(own.ended[0].any())

    def _followed(self) -> tuple[Floats, Floats]:
        """Return the reference at the drives' present time: position [inc] and velocity [606Ch], (num_axes,)."""
        own = self._episodes
        at = np.clip(own.lanes["step"] * self.config.cycles, 0, own.reference.shape[2] - 1)
        position, velocity = own.reference[np.arange(len(own.reference)), :2, np.repeat(at, self._axes)].T
        return own.origin + position, velocity

    def _step_environments(self, action: Any) -> Stepped:
        some, own = self._act(action), self._episodes
        terms, ended = own.terms.copy(), own.ended.copy()
        info: Info = {"reward_terms": dict(zip(TERMS, terms, strict=True))}
        if some:
            info["fault"] = self._faults(ended[0])
            info["_fault"] = ended[0]
        return own.observation.copy(), own.reward.copy(), ended[0], ended[1], info

    def _step_alone(self, action: Any) -> tuple[Observation, float, bool, bool, Info]:
        some, own = self._act(action), self._episodes
        info: Info = {"reward_terms": dict(zip(TERMS, own.terms[:, 0].tolist(), strict=True))}
        if some:
            info["fault"] = self._faults(own.ended[0])[0]
        terminated, truncated = own.ended[:, 0].tolist()
        return own.observation[0].copy(), own.reward.item(), terminated, truncated, info

    # --- inside ---------------------------------------------------------------------------------------------------
    def _draw_references(self, mask: Mask, given: ArrayLike | Trajectory | None) -> None:
        """Draw the trajectories of the starting environments, or use those given for this episode."""
        config, own = self.config, self._episodes
        length = own.reference.shape[2]
        kind = config.trajectory if given is None else given
        if not (isinstance(kind, str) or callable(kind)):
            rows = checked(kind, (3, length), (len(own.reference), 3, length))
        for lane in np.flatnonzero(mask):
            for axis in range(lane * self._axes, (lane + 1) * self._axes):
                if not (isinstance(kind, str) or callable(kind)):
                    turns = rows if rows.ndim == 2 else rows[axis]
                elif axis == lane * self._axes or not config.task.together:
                    turns = draw(kind, self.rngs[lane], length, CYCLE, self._amplitudes[axis % self._axes],
                                 float(config.speed or 0.0))  # fmt: skip
                own.reference[axis] = turns * self._per_turn[axis]
                own.reference[axis, 1] = turns[1] * self._speed_counts[axis]
        own.lanes["step"][mask] = 0
        own.lanes["steps"][mask] = config.steps

    def _delays(self) -> dict[str, Floats]:
        """Return the delays of the environments' buses, minus the cycle that an answer takes in any case."""
        none = np.zeros(self.num_envs)
        drawn = {} if self._machines is None else self._machines.values
        found = {name: drawn.get(f"bus.{name}", none) for name in ("action_latency", "observation_latency", "jitter")}
        found["action_latency"] = self.config.delay - 1 + np.rint(found["action_latency"])
        delays = {f"bus.{name}": np.minimum(values, float(cycle.LONGEST_DELAY)) for name, values in found.items()}
        return delays | {"bus.lost_sync": drawn.get("bus.lost_sync", none)}

    def _return_to_start(self, axes: Mask) -> None:
        """Move real axes back to the start, while the other axes do not move."""
        drives, mode = self.drives, str(self.config.mode)
        for name in OBJECTS[mode]:
            if name != cia402.TARGET_POSITION:
                drives.write(name, 0)
        for attempt in range(RESTARTS):
            self._clear(axes)
            try:
                self._come_to_rest(axes)
                self._go_back(axes)
            except RuntimeError:
                if attempt == RESTARTS - 1:
                    raise
            else:
                return

    def _come_to_rest(self, axes: Mask) -> None:
        """Hold the position in csp: otherwise the slope of the target's last step would be the initial speed of pp."""
        if self.config.mode != "csp" or not self._has_begun:
            return
        drives = self.drives
        drives.write(cia402.TARGET_POSITION, drives.read(cia402.POSITION_ACTUAL), where=axes)
        for _ in range(round(REST_TIME / CYCLE)):
            drives.advance(CYCLE)
            moving = np.abs(drives.read(cia402.VELOCITY_ACTUAL)) > REST_SPEED * self._episodes.scales[:, 1]
            if not np.any(axes & moving):
                return

    def _go_back(self, axes: Mask) -> None:
        drives, mode = self.drives, str(self.config.mode)
        position = drives.read(cia402.POSITION_ACTUAL)
        if not self._has_begun:
            self._start = position.copy()
        away = axes & (np.abs(position - self._start) > self._episodes.scales[:, 0] * 1e-3)
        if away.any():
            motion.enable(drives, mode="pp", where=away)
            speed = drives.read(cia402.PROFILE_VELOCITY)
            drives.write(
                cia402.PROFILE_VELOCITY,
                np.rint(RETURN_SPEED * self._episodes.scales[:, 1]).astype(np.int64),
                where=away,
            )
            try:
                motion.move_to(drives, self._start, where=away)
            finally:
                drives.write(cia402.PROFILE_VELOCITY, speed, where=away)
        if mode == "csp":
            drives.write(cia402.TARGET_POSITION, drives.read(cia402.POSITION_ACTUAL), where=axes)
        motion.enable(drives, mode=mode, where=axes)

    def _clear(self, axes: Mask) -> None:
        """Reset the faults of drives, once their causes are gone."""
        drives = self.drives
        tries = round(RESET_TIME / RESET_PAUSE)
        for attempt in range(tries):
            faulty = axes & cia402.matches(drives.read(cia402.STATUSWORD), cia402.FAULT_BIT)
            if not faulty.any():
                return
            try:
                motion.reset_fault(drives, where=faulty, timeout=RESET_PAUSE)
                drives.advance(RESET_PAUSE)
            except TimeoutError:
                if attempt == tries - 1:
                    raise

    def _faults(self, lanes: Mask) -> Texts:
        """Return the cause of each environment's end: emergencies by name, "diverged", "fell", "not enabled", or ""."""
        self._take_emergencies()
        machine = self.drives.machine
        diverged = machine.diverged if machine is not None else np.zeros(self.num_envs, bool)
        found = np.full(self.num_envs, "", object)
        for lane in np.flatnonzero(lanes):
            names = list(self._causes[lane])
            if diverged[lane]:
                names.append("diverged")
            if self._episodes.lanes["fallen"][lane]:
                names.append("fell")
            found[lane] = ", ".join(dict.fromkeys(names)) or "not enabled"
        return found

    def _take_emergencies(self) -> None:
        """Keep emergencies until their episodes end: a statusword may show a fault a step later."""
        for message in self.drives.emergencies():
            if message.code:
                self._causes[message.axis // self._axes].append(message.name)
