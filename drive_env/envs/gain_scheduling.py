"""`ServoDrive/GainScheduling-v0`: gains change on line while a motion programme with changing payload runs."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.devices.gains import BASELINE_RULE, rule_gains, small_time_constants
from drive_env.dictionary.roles import Role
from drive_env.drives import motion
from drive_env.drives.currents import ampere_per_count
from drive_env.drives.interface import CYCLE, Drives, device_of
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.drives.speeds import per_increment
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.envs.bus_delays import BusDelays
from drive_env.envs.changing_payload import NO_PAYLOAD, PayloadChanges, find_payload
from drive_env.envs.configuration import configured
from drive_env.envs.motion_programme import EXCITATIONS, Programme, Reach
from drive_env.envs.online_margins import OnlineMargins
from drive_env.envs.pictures import Pictures
from drive_env.envs.vector_environment import Info, Reward, Stepped, VectorEnvironment, check_choice
from drive_env.loops.dynamics import find_dynamics
from drive_env.motors import Motor, find_motor
from drive_env.randomisation.random_machines import Distributions, RandomMachines, laws_of, shipped
from mechanics.arrays import Floats, Integers, Mask, Singles, Texts
from mechanics.loads import find_load
from mechanics.shaft import one, shaft_load, way

if TYPE_CHECKING:
    from mechanics.load import Load


STEPS = (0.005, 0.020)  # s, shortest and longest time between two sets of gains
MODES = ("csp", "csv")
BASES = ("rule", "middle", "present")
ROUGH = 0.03  # increment of current between samples, of rated current: DESIGN's score counts it so

POSITION, VELOCITY, CURRENT, STATUSWORD = (
    (cia402.POSITION_ACTUAL, 0),
    (cia402.VELOCITY_ACTUAL, 0),
    (cia402.TORQUE_ACTUAL, 0),
    (cia402.STATUSWORD, 0),
)
TARGETS = {"csp": (cia402.TARGET_POSITION, 0), "csv": (cia402.TARGET_VELOCITY, 0)}
LAG = 0.2  # share of the top speed whose lag is the error scale in csp

# Entries of an axis before its gains: name, unit, low, high.
ENTRIES = (
    ("error", "of the error scale", -20.0, 20.0),
    ("error_rms", "of the error scale, over the step", 0.0, 20.0),
    ("error_peak", "of the error scale, over the step", 0.0, 20.0),
    ("velocity", "of the programme's top speed", -4.0, 4.0),
    ("velocity_demand", "of the programme's top speed", -2.0, 2.0),
    ("next_velocity_demand", "of the programme's top speed, a step ahead", -2.0, 2.0),
    ("acceleration_demand", "of the programme's top acceleration", -2.0, 2.0),
    ("next_acceleration_demand", "of the programme's top acceleration, a step ahead", -2.0, 2.0),
    ("current", "of rated, mean over the step", -8.0, 8.0),
    ("current_rms", "of rated, over the step", 0.0, 8.0),
    ("current_increment", "of rated, RMS from sample to sample over the step", 0.0, 4.0),
)


WEIGHTS = {"tracking": 1.0, "smoothness": 0.3, "trip": 20.0}


@dataclass(frozen=True)
class GainSchedulingConfig:
    """Configuration of GainScheduling.

    load, device, motor, friction: As `EmulatedDrives` takes them; without a motor the device's usual one.
    mode: "csp" (position) or "csv" (velocity).
    excitation: The programme: "moves" from point to point, or "sine".
    step: Time between two sets of gains [s], 5 to 20 ms, whole milliseconds.
    duration: Of an episode [s].
    gains: Which gains the agent sets, of the velocity and the position loop; all of those by default: velocity_p,
        velocity_i, position_p of the TMCM-1636.
    base: What an action of 0 means: "rule", the baseline rule's gains for the nominal machine; "middle", those for the
        geometric mean of the inertia with the lightest and with the heaviest payload; or "present", those that the
        drives hold when the environment is made; on a bus it is always these.
    span: ln of the largest factor on a gain.
    payload: Parameter of the load that changes; "auto" takes its payload, mass or inertia, "none" changes nothing.
    payload_low, payload_high: Range of its factor on the nominal value; None is the load's own.
    payload_every: Mean time between two changes [s].
    payload_observed: Whether the agent sees the payload, as a machine knows it that picks by a recipe.
    dynamics: Whose margins the outer loops must keep with the payload of the moment, as `dynamics.find_dynamics` takes
        it: the tracking term is multiplied by how far they do. None asks for no margins.
    distributions: The machines, as `randomisation.Distributions` takes them; None is the load's shipped set,
        {"parameters": {}} the nominal machine in every episode.
    stage: Of its curriculum, 0...1.
    weights: Of the reward's terms; those left out keep theirs.
    num_threads: As `EmulatedDrives` takes it.
    """

    load: Any = "belt"
    device: str = "tmcm1636"
    motor: str | Motor | None = None
    friction: str = "stribeck"
    mode: str = "csp"
    excitation: str = "moves"
    step: float = 0.010
    duration: float = 2.0
    gains: tuple[str, ...] | None = None
    base: str = "rule"
    span: float = 1.0
    payload: str = "auto"
    payload_low: float | None = None
    payload_high: float | None = None
    payload_every: float = 0.4
    payload_observed: bool = False
    dynamics: str | None = None
    distributions: Any = None
    stage: float = 1.0
    weights: Mapping[str, float] = field(default_factory=dict)
    num_threads: int | None = None

    def __post_init__(self) -> None:
        if self.motor is None:
            object.__setattr__(self, "motor", find_device(self.device).default_motor)
        check_choice("mode", self.mode, MODES)
        check_choice("excitation", self.excitation, EXCITATIONS)
        check_choice("base", self.base, BASES)
        # Gains of a current loop depend on R and L, not on the payload.
        outer = find_device(self.device).gains.outer
        if self.gains is not None and (
            isinstance(self.gains, str) or not self.gains or len(set(self.gains)) != len(self.gains)
        ):
            raise ValueError(f"gains must be different ones of {', '.join(outer)}, not {self.gains!r}")
        object.__setattr__(self, "gains", outer if self.gains is None else tuple(self.gains))
        for name in self.chosen:
            check_choice("a gain", name, outer)
        for name in self.weights:
            check_choice("a weight's name", name, tuple(WEIGHTS))
        object.__setattr__(self, "weights", {**WEIGHTS, **self.weights})
        cycles = self.step / CYCLE
        if not STEPS[0] - 1e-9 <= self.step <= STEPS[1] + 1e-9 or abs(cycles - round(cycles)) > 1e-6:
            raise ValueError(f"step must be {STEPS[0]:g}...{STEPS[1]:g} s in whole milliseconds, not {self.step:g} s")
        if self.dynamics is not None:
            find_dynamics(self.dynamics)
        for name in ("duration", "span", "payload_every"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be above 0 and finite, not {getattr(self, name):g}")
        if self.duration < self.step:
            raise ValueError(f"duration must be at least one step of {self.step:g} s, not {self.duration:g} s")
        if not 0.0 <= self.stage <= 1.0:
            raise ValueError(f"stage of the curriculum must lie in 0...1, not {self.stage:g}")

    @property
    def motor_row(self) -> Motor:
        """The motor, by name or as it was given."""
        assert self.motor is not None
        return find_motor(self.motor)

    @property
    def chosen(self) -> tuple[str, ...]:
        """The gains that the agent sets."""
        return self.gains or ()


def base_inertia(config: GainSchedulingConfig) -> Floats:
    """Return the inertia for the base's gains, rotor included [kg*m^2], shape (axes,); not for "present"."""
    row = find_load(config.load)
    payload = find_payload(row, config.payload, config.payload_low, config.payload_high)
    rotor, load = config.motor_row.inertia, shaft_load(one(row)).inertia[0]
    if config.base == "middle":
        return np.asarray(np.sqrt((rotor + payload.low * load) * (rotor + payload.high * load)))
    return np.asarray(rotor + load)


class GainScheduling(VectorEnvironment):
    """Gains that follow the machine: set every 5 to 20 ms, while a programme with changing payload runs.

    Action, float32, for each axis, with G gains of the configuration; a gain is written by SDO between two cycles, as
    it would be on a bus, and the programme's set-points are played as PDOs:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | 0 ... G-1 | ln(gain / base), in the configuration's order | span | -1 | 1 |

    Observation, float32, for each axis, from the samples of the last step as they have come over the bus:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | 0 | error: set-point less actual | of the error scale | -20 | 20 |
    | 1 | error_rms, over the step | of the error scale | 0 | 20 |
    | 2 | error_peak, over the step | of the error scale | 0 | 20 |
    | 3 | velocity | of the programme's top speed | -4 | 4 |
    | 4 | velocity_demand | of the programme's top speed | -2 | 2 |
    | 5 | next_velocity_demand, a step ahead | of the programme's top speed | -2 | 2 |
    | 6 | acceleration_demand | of the programme's top acceleration | -2 | 2 |
    | 7 | next_acceleration_demand, a step ahead | of the programme's top acceleration | -2 | 2 |
    | 8 | current, mean over the step | of rated | -8 | 8 |
    | 9 | current_rms, over the step | of rated | 0 | 8 |
    | 10 | current_increment, RMS from sample to sample | of rated | 0 | 4 |
    | 11 ... 10+G | the last action's entries for this axis | span | -1 | 1 |

    and, with `payload_observed`, one more after those of all axes:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | last | payload: logarithm of its factor, from the least to the greatest | 1 | -1 | 1 |

    The error scale is what the baseline rule's gains would leave: in csp, where this drive has no feed-forward and lags
    by v/k_v, at a fifth of the programme's top speed; in csv a/w_v at its top acceleration. What lies beyond its bounds
    is cut off there.

    Reward: the weighted sum of the terms, each in 0...1: tracking = 1/(1 + (error_rms/scale)^2), smoothness =
    1/(1 + (current_increment/3 %)^2), the worst axis counting, less trip when the drive trips. With `dynamics` tracking
    is multiplied by how far velocity and position loop (in csv the velocity loop) keep the margins with the payload and
    the gains at the step's end: 1 where all are kept, 0 where a loop is unstable, by the true machine's linear model.

    `terminated`: a drive went into fault, or its machine left physics; `truncated`: the programme's time ran out.

    `info`: "reward_terms" by name; "parameters", not on a bus, the true machine as it is now; "fault", the name of the
    emergency that ended the episode, "diverged", or "".

    Args:
        num_envs: Number of environments.
        config: A `GainSchedulingConfig`, a table like it, or a TOML file.
        drives: Drives to act on, `num_envs` machines of the configured load; emulated ones of the configuration by
            default. On a bus an episode begins with a fault reset and a move back to the start.
        autoreset_mode, render_mode, reward: As `VectorEnvironment` takes them.
        options: Fields of the configuration that replace its own.

    Raises:
        ValueError: For an invalid value, naming the valid ones.
    """

    STATE = (
        *VectorEnvironment.STATE, "_machines", "_payload_changes", "_programme", "_bus", "_gain_bus", "_now", "_origin",
        "_action", "_acting", "_parameters", "_samples", "_margins",
    )  # fmt: skip

    def __init__(
        self,
        num_envs: int = 1,
        *,
        config: GainSchedulingConfig | Mapping[str, Any] | str | Path | None = None,
        drives: Drives | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        reward: Reward | None = None,
        **options: Any,
    ) -> None:
        self.config = configured(GainSchedulingConfig, config, options)
        row = find_load(self.config.load)
        self._axes = row.num_axes
        width = len(self.config.chosen)
        bounds = [[entry[k] for entry in ENTRIES] + [sign] * width for k, sign in ((2, -1.0), (3, 1.0))]
        beside = [1.0] * self.config.payload_observed  # of the machine, after those of its axes
        self._low, self._high = (
            np.array([*bound * self._axes, *(sign * one for one in beside)], np.float32)
            for bound, sign in zip(bounds, (-1.0, 1.0), strict=True)
        )
        super().__init__(
            num_envs,
            Box(self._low, self._high, dtype=np.float32),
            Box(-1.0, 1.0, (self._axes * width,), np.float32),
            autoreset_mode=autoreset_mode,
            render_mode=render_mode,
            reward=reward,
        )
        self._cycles = round(self.config.step / CYCLE)
        self._steps = round(self.config.duration / self.config.step)
        self._action: Floats = np.zeros(0)  # of every axis
        nothing = np.zeros((self._cycles, num_envs * self._axes))
        self._samples = nothing, nothing, nothing  # of the last step, as received: error, velocity, current
        self._parameters: dict[str, Floats] = {}  # the true machines
        self._margins: OnlineMargins | None = None
        c = self.config
        self._payload = find_payload(row, c.payload, c.payload_low, c.payload_high)
        self._owned = drives is None
        self.drives = self._new_drives(num_envs) if drives is None else drives
        try:
            if render_mode:
                self._pictures = Pictures(self.drives, render_mode)
            self._prepare(row)
        except BaseException:
            self._close_environments()
            raise

    @property
    def max_episode_steps(self) -> int:
        """Steps of an episode."""
        return int(self._steps)

    # --- Environments
    # ----------------------------------------------------------------------------------------------------
    def _reset_environments(self, mask: Mask, options: Mapping[str, Any]) -> tuple[Singles, Info]:
        axes = np.repeat(mask, self._axes)
        # First, so that it is the same on a bus, where no machine is drawn.
        self._programme.draw(self.config.excitation, self.reach, self.rngs, mask)
        if self._machines is not None:
            self._machines.redraw(self.rngs, mask, self.stage, options.get("machine"))
            self._payload_changes.draw(self.rngs, mask)
            self._parameters = {name: values.copy() for name, values in self._machines.values.items()}
        else:
            self._bring_back(axes)
        self._now[mask] = 0
        self._action[axes] = 0.0
        write_gains(self.drives, self.base_gains, where=axes)
        if self._margins is not None:
            self._margins.take_in(self.base_gains, mask)
        position = self.drives.read(POSITION)
        self._origin[axes] = position[axes]
        self.drives.write(TARGETS[self.config.mode], self._origin if self.config.mode == "csp" else 0, where=axes)
        motion.enable(self.drives, self.config.mode, where=axes)
        first = self._set_points(np.zeros(1, np.int64))[0]
        self._acting[mask] = first[mask]
        if self._machines is not None:
            at_rest = np.zeros((self.num_envs, 3 * self._axes))
            self._bus.reset(self._machines.values, self.rngs, first, at_rest, mask)
            gains = self._gains_of(self._action).reshape(self.num_envs, -1)
            self._gain_bus.reset(self._machines.values, self.rngs, gains, at_rest, mask)
        if self._pictures is not None:
            self._pictures.begin(mask)
        error, velocity, current = (np.where(axes, 0.0, rows) for rows in self._samples)
        self._samples = error, velocity, current
        return self._present()

    def _present(self) -> tuple[Singles, Info]:
        return self._observe(*self._samples), self._tell(np.full(self.num_envs, "", object))

    def _step_environments(self, action: Any) -> Stepped:
        chosen = np.clip(np.asarray(action, float).reshape(self._action.shape), -1.0, 1.0)
        self._action = np.nan_to_num(chosen)
        if self._machines is not None:
            before = self._parameters
            self._parameters = self._payload_changes.apply(self._now, before)
            if self._margins is not None and self._parameters is not before:
                name = self._payload.name
                self._margins.take_in(self.base_gains, self._parameters[name] != before[name])
        targets = self._through_bus()
        rows = self._run(targets)
        error, velocity, current = self._measured(targets, rows)
        self._now += 1
        tripped = cia402.matches(rows[STATUSWORD], cia402.FAULT_BIT).any(axis=0)
        fault = self._faults(tripped)
        terminated = fault != ""
        terms = self._terms(error, current, terminated)
        reward = sum(weight * terms[name] for name, weight in self.config.weights.items())
        self._samples = self._seen(error, velocity, current)
        info = self._tell(fault) | {"reward_terms": terms}
        return self._observe(*self._samples), np.asarray(reward, float), terminated, self._now >= self._steps, info

    # --- construction ---------------------------------------------------------------------------------------------
    def _prepare(self, load: Load) -> None:
        n, axes = self.num_envs, self.drives.num_axes
        if axes != n * self._axes:
            raise ValueError(
                f"{n} environments of load {load.name!r} with {self._axes} axes each need {n * self._axes} drives, "
                f"not {axes}"
            )
        self._prepare_scales(load)
        self._prepare_machines()
        self._prepare_gains()
        self._programme = Programme(n, self._steps * self._cycles, 2 * self._cycles, CYCLE)
        self._bus, self._gain_bus = BusDelays(n), BusDelays(n)
        self._now = np.zeros(n, np.int64)  # steps since the environment's reset
        self._origin = np.zeros(axes, np.int64)
        self._action = np.zeros((axes, len(self.config.chosen)))
        self._in_force = self.base_gains.copy()  # raw gains of the drives at a step's end
        self._acting = np.zeros((n, self._axes), np.int64)

    def _prepare_scales(self, load: Load) -> None:
        """Set the programme's limits: half of what motor and travel allow, with the heaviest payload."""
        motor, alone = self.config.motor_row, one(load)
        shaft, turning = shaft_load(alone), way(alone)
        heaviest = motor.inertia + self._payload.high * shaft.inertia[0]
        torque = np.maximum(motor.rated_torque - shaft.gravity[0] - shaft.friction[0], 0.3 * motor.rated_torque)
        room = np.minimum(np.minimum(-turning.low, turning.high) * 0.8, 4.0 * 2.0 * np.pi)
        self.reach = Reach(
            distance=room, speed=np.full(self._axes, 0.4 * motor.rated_speed), acceleration=0.5 * torque / heaviest
        )
        device = device_of(self.drives)
        small = float(small_time_constants(device, device.stage["velocity_filter"].default))
        w_v = BASELINE_RULE.speed / small
        lag = LAG * self.reach.speed / (BASELINE_RULE.position * w_v)
        scale = lag if self.config.mode == "csp" else self.reach.acceleration / w_v
        self._error_scale = np.tile(scale, self.num_envs)
        self._speed_scale = np.tile(self.reach.speed, self.num_envs)
        self._acceleration_scale = np.tile(self.reach.acceleration, self.num_envs)
        self._rated_current = motor.rated_current
        self._ampere = ampere_per_count(self.drives)
        self._per_rad = self.drives.read(Role.POSITION_SCALE) / (2.0 * np.pi)
        self._speed_counts = self._per_rad * per_increment(self.drives, VELOCITY)
        self._counts = self._per_rad if self.config.mode == "csp" else self._speed_counts  # of the set-point

    def _prepare_machines(self) -> None:
        machine, laws = self.drives.machine, self.config.distributions
        self._machines: RandomMachines | None = None
        if machine is None:
            for name in ("distributions", "dynamics", "payload_observed"):
                if getattr(self.config, name):
                    raise ValueError(
                        f"{name}: needs emulated machines, whose parameters are known; leave it out on a bus"
                    )
            return
        if self.config.payload_observed and self._payload.name == NO_PAYLOAD:
            raise ValueError(
                "payload_observed: the load has no payload that changes; name a parameter of it as payload"
            )
        if laws is None:
            load, known = self.config.load, self.drives.device
            laws = laws_of(load, known, machine.parameters) if known and load in shipped() else {"parameters": {}}
        self._machines = RandomMachines(emulated_of(self.drives), Distributions.load(laws))
        changes = max(1, round(self.config.duration / self.config.payload_every))
        self._payload_changes = PayloadChanges(self._payload, machine, self.num_envs, self._steps, changes)

    def _prepare_gains(self) -> None:
        """Store the raw gains of every axis for an action of 0, shape (num_axes, count)."""
        drives, device = self.drives, device_of(self.drives)
        if drives.machine is None or self.config.base == "present":
            self.base_gains = read_gains(drives)
        else:
            rule = rule_gains(device, self.config.motor_row, base_inertia(self.config))
            self.base_gains = np.tile(rule, (self.num_envs, 1))
        known = device.gains
        columns = known.columns(self.config.chosen)
        self._gain_objects = [known.keys[column] for column in columns]
        self._columns, self._scheduled, self._highest = columns, self.base_gains[:, columns], known.highest[columns]
        self._powers = known.powers[columns]
        if self.config.dynamics is not None:
            self._margins = OnlineMargins(drives, find_dynamics(self.config.dynamics), self.config.mode)

    # --- a step ---------------------------------------------------------------------------------------------------
    def _gains_of(self, action: Floats) -> Integers:
        """Return raw gains, shape (num_axes, gains)."""
        raw = np.rint(self._scheduled * np.exp(self.config.span * action * self._powers))
        return np.asarray(np.clip(raw, 1, self._highest), np.int64)

    def _set_points(self, cycles: Integers) -> Integers:
        """Return set-points [drive units] of cycles from the present step on, (cycles, num_envs, axes)."""
        position, velocity, _ = self._programme.rows(self._now * self._cycles, cycles, self.reach)
        way, start = (position, self._origin) if self.config.mode == "csp" else (velocity, 0)
        found: Integers = start + np.rint(way * self._counts).astype(np.int64)
        return found.reshape(len(cycles), self.num_envs, self._axes)

    def _through_bus(self) -> Integers:
        """Return the set-points on which the drives act in each cycle of this step."""
        sent = self._set_points(np.arange(1, self._cycles + 1))
        return np.asarray(self._bus.act(sent), np.int64)

    def _run(self, targets: Integers) -> dict[tuple[int, int], Integers]:
        """Let the step pass; gains act when they arrive, between two cycles."""
        wanted = self._gains_of(self._action)
        play = {TARGETS[self.config.mode]: targets.reshape(self._cycles, -1)}
        if self._machines is None:  # on a bus no PDO carries gains
            for key, values in zip(self._gain_objects, wanted.T, strict=True):
                self.drives.write(key, values)
        else:
            sent = np.broadcast_to(wanted, (self._cycles, *wanted.shape))
            by_lane = self._gain_bus.act_unlatched(sent.reshape(self._cycles, self.num_envs, -1))
            arriving = by_lane.reshape(sent.shape)
            self._in_force[:, self._columns] = arriving[-1]
            play |= {key: arriving[:, :, k] for k, key in enumerate(self._gain_objects)}
        objects = (POSITION, VELOCITY, CURRENT, STATUSWORD)
        # A picture is updated in every cycle.
        at_once = 1 if self._pictures is not None and self._pictures.is_looking else self._cycles
        traces = []
        with warnings.catch_warnings():
            # A machine that diverges ends its environment; `info` reports it.
            warnings.filterwarnings("ignore", "machine .* left the range of physics", RuntimeWarning)
            for begin in range(0, self._cycles, at_once):
                part = {key: values[begin : begin + at_once] for key, values in play.items()}
                traces.append(self.drives.record(objects, at_once * CYCLE, play=part))
                if self._pictures is not None:
                    self._pictures.look()
        return {name: np.concatenate([trace[name] for trace in traces]) for name in objects}

    def _measured(self, targets: Integers, rows: Mapping[tuple[int, int], Integers]) -> tuple[Floats, Floats, Floats]:
        """Return error [rad or rad/s], velocity [rad/s] and current [A], each (cycles, num_axes).

        A sample is compared with the previous cycle's set-point, which the drive should have reached by then.
        """
        due = np.concatenate([self._acting[None], targets[:-1]])
        self._acting = targets[-1]
        velocity = np.asarray(rows[VELOCITY] / self._speed_counts, float)
        actual = rows[POSITION] if self.config.mode == "csp" else rows[VELOCITY]
        error = np.asarray((due.reshape(self._cycles, -1) - actual) / self._counts, float)
        return error, velocity, np.asarray(rows[CURRENT] * self._ampere, float)

    def _seen(self, error: Floats, velocity: Floats, current: Floats) -> tuple[Floats, Floats, Floats]:
        """Return error, velocity and current as received by the master."""
        if not self._bus.is_there:
            return error, velocity, current
        sampled = np.stack([error, velocity, current], 1).reshape(self._cycles, 3, self.num_envs, self._axes)
        sent = sampled.transpose(0, 2, 1, 3).reshape(self._cycles, self.num_envs, -1)
        came = self._bus.observe(sent).reshape(self._cycles, self.num_envs, 3, self._axes)
        arrived = came.transpose(2, 0, 1, 3).reshape(3, self._cycles, -1)
        return arrived[0], arrived[1], arrived[2]

    def _observe(self, error: Floats, velocity: Floats, current: Floats) -> Singles:
        ahead = np.array([0, self._cycles])
        _, speeds, accelerations = self._programme.rows(self._now * self._cycles, ahead, self.reach)
        scaled = error / self._error_scale
        amperes = current / self._rated_current
        columns = [
            scaled[-1],
            _rms(scaled),
            np.abs(scaled).max(axis=0),
            velocity[-1] / self._speed_scale,
            *(speeds / self._speed_scale),
            *(accelerations / self._acceleration_scale),
            amperes.mean(axis=0),
            _rms(amperes),
            _rms(np.diff(amperes, axis=0)),
        ]
        found = np.concatenate([np.stack(columns, axis=-1), self._action], axis=1).reshape(self.num_envs, -1)
        if self.config.payload_observed:
            found = np.column_stack([found, self._payload_share()])
        return np.clip(np.nan_to_num(found.astype(np.float32)), self._low, self._high)

    def _payload_share(self) -> Floats:
        """Return the logarithm of each payload's factor, -1 for the least, 1 for the greatest, (num_envs,)."""
        name, low, high = self._payload
        factor = self._parameters[name] / self._payload_changes.nominal
        return np.asarray(2.0 * np.log(factor / low) / np.log(high / low) - 1.0)

    def _terms(self, error: Floats, current: Floats, terminated: Mask) -> dict[str, Floats]:
        off = _rms(error / self._error_scale)
        rough = _rms(np.diff(current, axis=0)) / self._rated_current / ROUGH
        per_axis = {"tracking": 1.0 / (1.0 + off**2), "smoothness": 1.0 / (1.0 + rough**2)}
        terms = {name: values.reshape(self.num_envs, -1).min(axis=1) for name, values in per_axis.items()}
        if self._margins is not None:
            terms["tracking"] *= self._margins.share(self._in_force)
        return terms | {"trip": -1.0 * terminated}

    def _faults(self, tripped: Mask) -> Texts:
        """Return the emergency or other cause that ended each environment, "" if it continues."""
        names = np.full(self.num_envs, "", object)
        if tripped.any():
            names[tripped.reshape(self.num_envs, -1).any(axis=1)] = "unknown"
            for message in self.drives.emergencies():
                if tripped[message.axis] and message.code:
                    names[message.axis // self._axes] = message.name
        if self.drives.machine is not None:
            names[self.drives.machine.diverged] = "diverged"
        return names

    def _tell(self, fault: Texts) -> Info:
        info: Info = {"fault": fault}
        if self._machines is not None:
            info["parameters"] = self._parameters
        return info

    # --- on a bus -------------------------------------------------------------------------------------------------
    def _bring_back(self, axes: Mask) -> None:
        """Move real axes back to the start of the first programme."""
        if self._has_begun:
            motion.enable(self.drives, "pp", where=axes)
            motion.move_to(self.drives, self._origin, where=axes)


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))
