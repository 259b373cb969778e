"""Gain tuning: commissioning as an episode, one trial of gains per step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.drives.interface import Drives, machine_of
from drive_env.drives.raw_gains import read_gains
from drive_env.emulator.emulated_drives import emulated_of
from drive_env.envs.configuration import configured
from drive_env.envs.gain_observation import RATIO_MAX, TRIED, identified_entries, rows_of, tried_entries, true_entries
from drive_env.envs.pictures import Pictures
from drive_env.envs.vector_environment import Info, Reward, Stepped, VectorEnvironment, check_choice
from drive_env.loops.dynamics import DEFAULT, find_dynamics
from drive_env.motors import Motor, find_motor
from drive_env.randomisation.random_machines import Distributions, RandomMachines, laws_of, shipped
from drive_env.trials.gain_trial import PHASES, Identified, Trial, measured_cost
from drive_env.trials.load_detection import is_load_detection
from drive_env.trials.method import check_tried, method_of, new_score
from drive_env.trials.positioning import TRIAL, reach
from drive_env.trials.score import RobustScore
from mechanics.arrays import Floats, Integers, Mask, Texts

JUDGED = ("incumbent", "trial")


@dataclass(frozen=True)
class GainTuningConfig:
    """Configuration of GainTuning.

    load, device, motor, friction: As `EmulatedDrives` takes them; without a motor the device's usual one.
    gains: Which gains the action changes, of the device's: those of the TMCM-1636 are torque_p, torque_i, velocity_p,
        velocity_i, position_p; the TGZ-D has feed_forward, too. None is those of the velocity and the position loop.
    trials: Of an episode.
    step: Change of a gain's logarithm that an action of 1 makes; the reach of gains, 10.4, is the most that makes
        sense.
    distributions: The machines, as `randomisation.Distributions` takes them; None is the load's shipped set, and of a
        load of your own the default machine in every episode, as {"parameters": {}} is.
    stage: Of its curriculum, 0...1.
    abort_cost: What a stopped trial of other gains than the incumbent's takes from the reward.
    waveform: Points of the last move's error that are observed besides, 0...250.
    privileged: Whether the observation is a dict with the true machine beside it, for asymmetric critics.
    travel: How far the rotors may turn from where they are, with the sign [rev]; None is the load's own.
    dynamics: What the loops must keep for the robust cost: soft, standard, stiff, or numbers as 45/8/2.0.
    judged: "incumbent": actions change the incumbent's gains, and what these improve is rewarded; "trial": actions
        change the rule's gains, and what each trial's own are worth is rewarded, 0...1.
    half: Robust cost of a trial that is worth 0.5.
    num_threads: As `EmulatedDrives` takes it.
    """

    load: Any = "two_mass"
    device: str = "tmcm1636"
    motor: str | Motor | None = None
    friction: str = "stribeck"
    gains: tuple[str, ...] | None = None
    trials: int = 10
    step: float = 0.7
    distributions: Any = None
    stage: float = 1.0
    abort_cost: float = 0.05
    waveform: int = 0
    privileged: bool = False
    travel: float | None = None
    num_threads: int | None = None
    dynamics: str = DEFAULT
    judged: str = "incumbent"
    half: float = 3.0

    def __post_init__(self) -> None:
        known = find_device(self.device).gains
        if self.motor is None:
            object.__setattr__(self, "motor", find_device(self.device).default_motor)
        object.__setattr__(self, "gains", known.outer if self.gains is None else tuple(self.gains))
        for name in self.chosen:
            check_choice("a gain", name, known.searched)
        if known.is_open_loop:
            check_tried(find_device(self.device), self.chosen)
        if not self.chosen or len(set(self.chosen)) != len(self.chosen):
            raise ValueError(f"gains must be different ones of {', '.join(known.searched)}, not {self.gains}")
        find_dynamics(self.dynamics)
        check_choice("judged", self.judged, JUDGED)
        if self.trials < 1:
            raise ValueError(f"trials must be 1 or more, not {self.trials}")
        if not 0.0 < self.step < math.inf:
            raise ValueError(f"step must be finite and more than 0, not {self.step:g}")
        if not 0 <= self.waveform <= TRIAL:
            raise ValueError(f"waveform must be 0...{TRIAL} points, not {self.waveform}")
        if not 0.0 <= self.stage <= 1.0:
            raise ValueError(f"stage of the curriculum must lie in 0...1, not {self.stage:g}")
        if not 0.0 <= self.abort_cost < math.inf:
            raise ValueError(f"abort_cost must be 0 or more, not {self.abort_cost:g}")
        if not 0.0 < self.half < math.inf:
            raise ValueError(f"half must be finite and more than 0, not {self.half:g}")
        if self.travel is not None and not 0.0 < abs(self.travel) < math.inf:
            raise ValueError(f"travel must be finite and not 0, not {self.travel:g} rev")

    @property
    def chosen(self) -> tuple[str, ...]:
        """The gains that the action changes."""
        return self.gains or ()


class GainTuning(VectorEnvironment):
    """`ServoDrive/GainTuning-v0`: find the gains of an unknown machine in a few trials.

    An episode identifies the machine, starts at the baseline rule's gains and tries them; each step tries others: a
    positioning move, the reversal and the gain probe (the move with velocity P x 1.5), 250 ms each. An axis that
    oscillates or goes into fault is stopped within 50 ms, the fault is reset, and the incumbent returns. The incumbent
    is the trial with the least J by measured terms, the rule's included; it is the answer (`info["gains"]`).

    All axes of a machine move at once: what is identified is the inertia that an axis sees in that motion, coupling
    included. The pole of the inverted pendulum falls meanwhile, and shakes its cart.

    Action, float32, for each axis of the machine, with G gains of the configuration; gains are rounded and stay within
    the device's range:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | 0 ... G-1 | ln of the gain over the incumbent's or the rule's (`judged`) | `step` | -1 | 1 |

    Observation, float32, for each axis of the machine, with W points of waveform:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | 0 | ln of total inertia over three rotors, identified | 1 | -5 | 7 |
    | 1 | dry friction, identified | rated current | 0 | 5 |
    | 2 | viscous friction at rated speed, identified | rated current | 0 | 5 |
    | 3 | constant load, identified | rated current | -5 | 5 |
    | 4 ... 3+G | ln of the last trial's gain over the rule's | 1 | -10.4 | 10.4 |
    | 4+G ... 3+2G | ln of the incumbent's gain over the rule's | 1 | -10.4 | 10.4 |
    | 4+2G | last trial's move: ln t_s/t_0 | 1 | 0 | 5 |
    | 5+2G | last trial's move: ln(1 + n/3 %) | 1 | 0 | 7 |
    | 6+2G | last trial's move: overshoot | the move | 0 | 5 |
    | 7+2G | last trial's move: ln of the following error's integral over the rule's | 1 | -10 | 10 |
    | 8+2G | last trial's move: stopped: it oscillated or tripped | 1 | 0 | 1 |
    | 9+2G | last trial's reversal: ln t_s/t_0 | 1 | 0 | 5 |
    | 10+2G | last trial's reversal: ln(1 + n/3 %) | 1 | 0 | 7 |
    | 11+2G | last trial's reversal: overshoot | the move | 0 | 5 |
    | 12+2G | last trial's reversal: ln of the following error's integral over the rule's | 1 | -10 | 10 |
    | 13+2G | last trial's reversal: stopped: it oscillated or tripped | 1 | 0 | 1 |
    | 14+2G | last trial's probe: ln t_s/t_0 | 1 | 0 | 5 |
    | 15+2G | last trial's probe: ln(1 + n/3 %) | 1 | 0 | 7 |
    | 16+2G | last trial's probe: overshoot | the move | 0 | 5 |
    | 17+2G | last trial's probe: ln of the following error's integral over the rule's | 1 | -10 | 10 |
    | 18+2G | last trial's probe: stopped: it oscillated or tripped | 1 | 0 | 1 |
    | 19+2G | last trial: ln J by measured terms, of the environment | 1 | -10 | 4 |
    | 20+2G ... 35+2G | incumbent's trial: as 4+2G ... 19+2G | | | |
    | 36+2G ... 35+2G+W | error of the last trial's move, demand less actual | the move | -5 | 5 |

    and, after those of all axes:

    | index | name | unit | low | high |
    | --- | --- | --- | --- | --- |
    | -1 | trials left | those of an episode | 0 | 1 |

    With `privileged` it is a dict of "observation" and "privileged": each true parameter's difference from its default
    over the default's size (where that is 0, the parameter itself), in the order of `info["parameters"]`, -100...100.

    The reward is the decrease of ln of the incumbent's robust cost (drive_env/trials/score.py), meant for a
    discount of 1, less `abort_cost` for a trial of other gains than the incumbent's that was stopped. On given drives,
    and of the settings of a load detection, there is no robust cost; it is that of ln J by measured terms. The episode
    is `truncated` when its trials are used up, `terminated` if a given drive cannot be cleared.

    With `judged` = "trial" it is what the trial's gains are worth instead, 1 / (1 + (robust cost / `half`)^2), which is
    hardly anything where the constraints are broken (30 and more) or a trial is stopped. Nothing is earned or lost
    besides: what a trial is good for later, it must earn later.

    `info`: "reward_terms" ("tuning", "abort"; or "worth"); "gains", the incumbent's, (environments, axes, count) raw
    integers in the order of the device's set; "measured", its J by measured terms, and "robust_cost";
    "trial_robust_cost", that of this step's trial; "trial_gains" and "trial_measured" too; "aborted", whether it was
    stopped, and "faults", names of the trial's emergencies, tuples, of the rule's trial at the begin as well;
    "parameters", the true machine. Given drives have no robust cost.

    Args:
        num_envs: Number of environments.
        config: A `GainTuningConfig`, a table like it, or a TOML file.
        drives: Drives to tune as they are, `num_envs` machines, commissioned with gains that are stable; emulated ones
            of the configuration by default, of which every trial begins at rest at zero. On a bus the safety envelope
            stops all drives where one oscillates, with a SafetyError; `Limits(oscillation=False)` leaves that to the
            trial, which stops the environment alone.
        reach: How far each rotor of given drives may turn from where it stands, with its sign [rad], shape
            (num_axes,); by the configuration's load or travel if not given.
        autoreset_mode, render_mode, reward: As `VectorEnvironment` takes them.
        options: Fields of the configuration that replace its own.

    Raises:
        ValueError: For an invalid value, naming the valid ones.
    """

    STATE = (
        *VectorEnvironment.STATE, "_machines", "_score", "_trials", "_identified", "_move", "_origin", "_direction",
        "_safe", "_rule", "_best", "_last", "_best_is_stable", "_following", "_last_features", "_best_features",
        "_wave", "_measured", "_robust_cost", "_left", "_noise", "_trial", "_parameters",
    )  # fmt: skip

    def __init__(
        self,
        num_envs: int = 1,
        *,
        config: GainTuningConfig | Mapping[str, Any] | str | Path | None = None,
        drives: Drives | None = None,
        reach: ArrayLike | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        reward: Reward | None = None,
        **options: Any,
    ) -> None:
        self.config = configured(GainTuningConfig, config, options)
        self.motor, self._device = find_motor(self.config.motor), find_device(self.config.device)
        self._machines: RandomMachines | None = None
        self._score: RobustScore | None = None
        self._owned = drives is None
        self.drives = self._new_drives(num_envs) if drives is None else drives
        try:
            axes, rest = divmod(self.drives.num_axes, max(num_envs, 1))
            if rest or not axes:
                raise ValueError(f"{self.drives.num_axes} axes cannot be shared by {num_envs} environments")
            self._axes = axes
            if self._owned:
                self._make_world(num_envs)
                if reach is not None:
                    raise ValueError("reach is of given drives; give travel in the configuration, or leave it out")
            elif self.config.distributions is not None or self.config.privileged:
                raise ValueError("leave distributions and privileged out for given drives, whose machine is not known")
            super().__init__(
                num_envs, *self._spaces(), autoreset_mode=autoreset_mode, render_mode=render_mode, reward=reward
            )
            if render_mode:
                self._pictures = Pictures(self.drives, render_mode)
            self._prepare(reach)
        except BaseException:
            self._close_environments()
            raise

    @property
    def max_episode_steps(self) -> int:
        """Steps of an episode."""
        return int(self.config.trials)

    # --- construction ---------------------------------------------------------------------------------------------
    def _make_world(self, num_envs: int) -> None:
        c = self.config
        laws = c.distributions
        if laws is None:
            known = machine_of(self.drives).parameters
            laws = laws_of(c.load, self._device, known) if c.load in shipped() else {"parameters": {}}
        self._machines = RandomMachines(emulated_of(self.drives), Distributions.load(laws))
        self._defaults = machine_of(self.drives).parameters
        if not is_load_detection(self._device, c.chosen):  # otherwise there is only J by measured terms
            self._score = new_score(
                c.device,
                c.load,
                c.motor,
                num_envs,
                gains=c.chosen,
                num_threads=c.num_threads,
                friction=c.friction,
                dynamics=c.dynamics,
            )

    def _spaces(self) -> tuple[gymnasium.Space[Any], Box]:
        c = self.config
        known = self._device.gains
        greatest = known.highest[known.columns(c.chosen)] if known.is_open_loop else known.highest
        rows = rows_of(self._axes, len(c.chosen), c.waveform, int(greatest.max()))
        low, high = (np.array([getattr(row, end) for row in rows], np.float32) for end in ("low", "high"))
        self._low, self._high = low, high
        observation: gymnasium.Space[Any] = Box(low, high, dtype=np.float32)
        if c.privileged:
            true = Box(-RATIO_MAX, RATIO_MAX, (len(self._defaults),), np.float32)
            observation = gymnasium.spaces.Dict({"observation": observation, "privileged": true})
        return observation, Box(-1.0, 1.0, (self._axes * len(c.chosen),), np.float32)

    def _prepare(self, given_reach: ArrayLike | None) -> None:
        c, n, axes = self.config, self.num_envs, self.drives.num_axes
        self._method = method_of(self._device, self.motor, c.chosen)
        self._highest = self._method.highest()
        self._trials = self._method.trials(self.drives, self._axes)
        self._columns = self._device.gains.columns(c.chosen)
        one = reach(c.load) if c.travel is None else np.full(self._axes, c.travel * 2.0 * math.pi)
        self._reach = np.tile(one, n) if given_reach is None else np.broadcast_to(np.asarray(given_reach, float), axes)
        zero = np.zeros(axes)
        self._identified = Identified(zero, zero, zero, zero)
        rotor = Identified(zero + self.motor.inertia, zero, zero, zero)
        self._move = self._method.plan(rotor, 1.0, zero)
        self._origin, self._direction = np.zeros(axes, np.int64), np.ones(axes, np.int64)
        self._safe, self._rule, self._best, self._last = (
            np.ones((axes, self._device.gains.count), np.int64) for _ in range(4)
        )
        self._best_is_stable = np.ones(axes, bool)
        self._following = np.ones((len(PHASES), axes))  # of the rule's trial
        blank = np.zeros((axes, len(TRIED)))
        self._last_features, self._best_features = blank, blank.copy()
        self._wave = np.zeros((axes, c.waveform))
        self._measured, self._robust_cost = np.ones(n), np.ones(n)
        self._left = np.zeros(n, np.int64)
        self._noise, self._trial = np.ones(n), np.zeros(n)
        self._parameters: dict[str, Floats] = {}

    # --- an episode -----------------------------------------------------------------------------------------------
    def _reset_environments(self, mask: Mask, options: Mapping[str, Any]) -> tuple[Any, Info]:
        drives, axes = self.drives, np.repeat(mask, self._axes)
        if self._machines is not None:
            self._machines.redraw(self.rngs, mask, self.stage, options.get("machine"))
            for lane in np.flatnonzero(mask):
                self._noise[lane] = self.rngs[lane].integers(1, 2**31)
            self._trial[mask] = 0.0
            self._parameters = machine_of(drives).parameters
        self._begin_trial(mask)
        self._safe = np.where(axes[:, None], read_gains(drives), self._safe)
        found, origin = self._trials.identify(self._reach, axes)
        self._identified = Identified(*(np.where(axes, a, b) for a, b in zip(found, self._identified, strict=True)))
        self._origin = np.where(axes, origin, self._origin)
        self._direction = np.where(axes, 1, self._direction)
        scaler = drives.read(Role.POSITION_SCALE)
        planned = self._method.plan(self._identified, scaler, self._reach)
        # Environments outside the mask keep theirs, since nothing that it depends on has changed.
        self._move = planned
        volts = self.motor.voltage if drives.device is None else drives.device.supply_of(self.motor)
        supply = np.full(drives.num_axes, volts)
        rule = self._method.keep(self._method.rule(self._identified, planned, supply), self._safe)
        self._rule = np.where(axes[:, None], rule, self._rule)
        self._best = np.where(axes[:, None], self._rule, self._best)
        self._best_is_stable = np.where(axes, False, self._best_is_stable)
        drives.emergencies()  # of before
        tried = self._try(self._rule, mask)
        faults = self._faults()
        self._following = np.where(axes, tried.following, self._following)
        measured = self._measure(self._rule, tried)
        self._take(mask, self._rule, tried, measured)
        self._left[mask] = self.config.trials
        if self._score is not None:
            self._score.set_machines(self._parameters, self._volts(), mask)
            self._score.set_moves(self._move, mask)
            robust_cost = self._score.score_rule(self._rule, mask).robust_cost
            self._robust_cost = np.where(mask, robust_cost, self._robust_cost)
        drives.emergencies()
        info = self._told()
        info["aborted"] = mask & self._stopped(tried)
        info["faults"] = faults
        return self._observe(), info

    def _present(self) -> tuple[Any, Info]:
        return self._observe(), self._told()

    def _step_environments(self, action: Any) -> Stepped:
        n = self.num_envs
        active = self._left > 0
        zero = np.zeros(n)
        if not active.any():  # the step between the end of all episodes and their autoreset
            return self._observe(), zero, np.zeros(n, bool), np.ones(n, bool), self._told()
        gains = self._changed(action)
        other = (gains != self._best).reshape(n, -1).any(axis=1)
        tried = self._try(gains, active)
        measured = self._measure(gains, tried)
        better = active & (measured < self._measured)
        before = self._measured.copy() if self._score is None else self._robust_cost.copy()
        trial_robust_cost = None if self._score is None else self._score.score(gains).robust_cost
        self._take(active, gains, tried, measured, better)
        if trial_robust_cost is not None:
            self._robust_cost = np.where(better, trial_robust_cost, self._robust_cost)
        after = self._measured if self._score is None else self._robust_cost
        aborted = active & self._stopped(tried)
        if self.config.judged == "trial":
            cost = measured if trial_robust_cost is None else trial_robust_cost
            terms = {"worth": active / (1.0 + (cost / self.config.half) ** 2)}
        else:
            terms = {"tuning": np.log(before / after), "abort": -self.config.abort_cost * (aborted & other)}
        self._left[active] -= 1
        info = self._told()
        info["reward_terms"] = terms
        info["trial_gains"] = gains.reshape(n, self._axes, -1)
        info["trial_measured"] = measured.copy()
        info["aborted"] = aborted
        info["faults"] = self._faults()
        if trial_robust_cost is not None:
            info["trial_robust_cost"] = trial_robust_cost
        dead = zero.astype(bool) if self._owned else active & self._dead()
        return self._observe(), np.asarray(sum(terms.values())), dead, self._left <= 0, info

    def gains_of(self, action: ArrayLike) -> Integers:
        """Return the gains of an action, without trying them: (environments, axes, count), as `info["gains"]`."""
        return self._changed(action).reshape(self.num_envs, self._axes, -1)

    def _changed(self, action: ArrayLike) -> Integers:
        change = self.config.step * np.nan_to_num(np.clip(np.asarray(action, float), -1.0, 1.0))
        change = change.reshape(-1, len(self._columns))
        since = self._best if self.config.judged == "incumbent" else self._rule
        return self._device.gains.changed(since, change, self._columns, self._highest)

    # --- a trial --------------------------------------------------------------------------------------------------
    def _begin_trial(self, mask: Mask) -> None:
        """Bring drives to the start of a trial: enabled, in pp; emulated machines at rest at zero.

        An emulated machine is reset, so that its trial depends only on machine, gains and the environment's noise, not
        on the time that resets of other environments take.
        """
        drives, axes, pictures = self.drives, np.repeat(mask, self._axes), self._pictures
        if self._machines is not None:
            machine, values = emulated_of(drives).machine, self._machines.values
            machine.seed_noise(self._noise + self._trial, mask)
            self._trial[mask] += 1.0
            machine.reset(mask)
            winding, stage = machine.temperatures
            new = (np.repeat(values[name], self._axes) for name in ("start.winding", "start.stage"))
            machine.set_temperatures(*(np.where(axes, a, b) for a, b in zip(new, (winding, stage), strict=True)))
            self._machines.plan_faults(mask)
            self._trials.power_up(axes)
        else:
            self._trials.recover(axes)
        if pictures is not None:
            pictures.begin(mask)  # a recording per trial: between two the machine jumps back to zero
            self._trials.look = pictures.look if pictures.is_looking else None

    def _try(self, gains: Integers, mask: Mask) -> Trial:
        axes = np.repeat(mask, self._axes)
        self._begin_trial(mask)
        fallback = np.where(self._best_is_stable[:, None], self._best, self._safe)
        direction = np.ones_like(self._direction) if self._owned else self._direction
        tried = self._trials.run(gains, fallback, self._move, self._origin, direction, axes)
        if not (self._owned or self._trials.returns):  # it ends where its move did; the next one goes back
            self._origin = np.where(axes, self._origin + self._direction * self._move.distance, self._origin)
            self._direction = np.where(axes, -self._direction, self._direction)
        return tried

    def _measure(self, gains: Integers, tried: Trial) -> Floats:
        """Return J by measured terms of each environment: that of its worst axis."""
        softness = self._method.softness
        costs = measured_cost(tried.costs(softness(gains) / softness(self._rule)))
        return np.asarray(costs.reshape(self.num_envs, -1).max(axis=1))

    def _stopped(self, tried: Trial) -> Mask:
        return np.asarray(tried.aborted.any(axis=0).reshape(self.num_envs, -1).any(axis=1))

    def _take(self, mask: Mask, gains: Integers, tried: Trial, measured: Floats, better: Mask | None = None) -> None:
        """Store a trial as the last one where the mask is true, and as the incumbent where it is better."""
        better = mask if better is None else better
        axes, best = np.repeat(mask, self._axes), np.repeat(better, self._axes)
        self._last = np.where(axes[:, None], gains, self._last)
        features = tried_entries(tried, self._following, np.repeat(measured, self._axes))
        self._last_features = np.where(axes[:, None], features, self._last_features)
        if self.config.waveform:
            at = np.linspace(0, TRIAL - 1, self.config.waveform).round().astype(int)
            self._wave = np.where(axes[:, None], tried.error[at].T, self._wave)
        self._best = np.where(best[:, None], gains, self._best)
        self._best_features = np.where(best[:, None], features, self._best_features)
        self._best_is_stable = np.where(best, ~tried.aborted[:2].any(axis=0), self._best_is_stable)
        self._measured = np.where(better, measured, self._measured)

    # --- observations and info -------------------------------------------------------------------------------------
    def _observe(self) -> Any:
        identified = identified_entries(self._identified, self.motor)
        known = self._device.gains
        last, best = (known.change(gains, self._rule, self._columns) for gains in (self._last, self._best))
        axes = np.concatenate([identified, last, best, self._last_features, self._best_features, self._wave], axis=1)
        left = self._left[:, None] / self.config.trials
        values = np.concatenate([axes.reshape(self.num_envs, -1), left], axis=1)
        observation = np.clip(np.nan_to_num(values), self._low, self._high).astype(np.float32)
        if not self.config.privileged:
            return observation
        return {"observation": observation, "privileged": true_entries(self._parameters, self._defaults)}

    def _told(self) -> Info:
        n = self.num_envs
        info: Info = {"gains": self._best.reshape(n, self._axes, -1).copy(), "measured": self._measured.copy()}
        if self._score is not None:
            info["robust_cost"] = self._robust_cost.copy()
        if self._owned:
            info["parameters"] = self._parameters
        return info

    def _faults(self) -> Texts:
        found = np.empty(self.num_envs, object)
        found[:] = [()] * self.num_envs
        for message in self.drives.emergencies():
            lane = message.axis // self._axes
            if message.code and message.name not in found[lane]:
                found[lane] = (*found[lane], message.name)
        return found

    def _dead(self) -> Mask:
        return np.asarray(self._trials.down().reshape(self.num_envs, -1).any(axis=1))

    def _volts(self) -> Floats:
        return np.asarray(machine_of(self.drives).supply.reshape(self.num_envs, -1)[:, 0])

    def _close_environments(self) -> None:
        if self._score is not None:
            self._score.close()
        super()._close_environments()
