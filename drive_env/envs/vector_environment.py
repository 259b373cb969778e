"""Base of all environments: many episodes at the same time over one set of drives, and a single one as an Env.

An environment is a machine with its drives and its episode. The episode follows only from its seed and its actions, so
that it is the same among 1, 8 or 64 environments and with any number of threads.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from drive_env.emulator.emulated_drives import EmulatedDrives, emulated_of
from drive_env.randomisation.random_machines import Curriculum, Distributions
from drive_env.saved_state import Saved, State, check_alike
from mechanics.arrays import Floats, Mask, Texts

if TYPE_CHECKING:
    from drive_env.envs.pictures import Pictures

Info = dict[str, Any]
Observation = Any  # an array with environments first, or a dict of such arrays
Stepped = tuple[Observation, Floats, Mask, Mask, Info]
# Observations after a step, its actions, and its info, for all environments -> rewards, shape (num_envs,).
Reward = Callable[[Observation, Any, Info], ArrayLike]

RENDER_MODES = ("rgb_array", "human")


class VectorEnvironment(VectorEnv[Any, Any, Any], Saved):
    """Base of the vector environments; `config` is a subclass's configuration.

    A subclass implements `_reset_environments` and `_step_environments`. Their arrays are handed to callers without a
    copy: they must be new in each step.

    In next-step mode the reset of an ended environment takes place after the others' step, so that an episode is the
    same in every mode; the environment's action of that step is ignored, its reward is 0.

    Args:
        num_envs: Number of environments.
        observation_space: Of one environment.
        action_space: Of one environment.
        autoreset_mode: When an ended environment begins anew: "NextStep", "SameStep", or "Disabled": by
            `reset(options={"reset_mask": ...})` alone.
        render_mode: None, "rgb_array" or "human".
        reward: Called after every step with the observations, the actions and the info of all environments, of which
            info["reward_terms"] are the environment's own terms, and info["terminated"] and info["truncated"] how
            episodes end, (num_envs,) each; returns the rewards, (num_envs,), in place of the environment's.

    Raises:
        ValueError: For an unknown mode, or less than one environment; in a step for a reward of another shape, or one
            that is not a number.
    """

    OPTIONS: tuple[str, ...] = ("reset_mask", "state", "machine")  # of reset
    STATE: tuple[str, ...] = ("_ended", "_some_ended", "_has_begun", "_stage", "_np_random_seed")
    config: Any
    drives: Any
    _owned = False  # whether the drives were made by it
    _pictures: Pictures | None = None

    def __init__(
        self,
        num_envs: int,
        observation_space: gymnasium.Space[Any],
        action_space: gymnasium.Space[Any],
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        reward: Reward | None = None,
    ) -> None:
        if reward is not None and not callable(reward):
            raise ValueError(f"reward is a function of observations, actions and info, not {reward!r}")
        if num_envs < 1:
            raise ValueError(f"num_envs must be 1 or more, not {num_envs}")
        check_choice("render_mode", render_mode, (None, *RENDER_MODES))
        self.num_envs = num_envs
        self.single_observation_space = observation_space
        self.single_action_space = action_space
        self.observation_space = batch_space(observation_space, num_envs)
        self.action_space = batch_space(action_space, num_envs)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.render_mode = render_mode
        self.reward_function = reward
        self.metadata = {"render_modes": list(RENDER_MODES), "autoreset_mode": self.autoreset_mode}
        self.rngs = [seeding.np_random()[0] for _ in range(num_envs)]
        self._ended: Mask = np.zeros(num_envs, bool)
        self._some_ended = False
        self._has_begun = False
        self._stage: float | None = None
        self._spec: EnvSpec | None = None

    # --- what a subclass gives ------------------------------------------------------------------------------------
    def _reset_environments(self, mask: Mask, options: Mapping[str, Any]) -> tuple[Observation, Info]:
        """Begin an episode in the environments where the mask is true, drawing only from `rngs` of these environments.

        Returns:
            Observations of all environments, of which only the masked are used; and arrays for their info.
        """
        raise NotImplementedError

    def _step_environments(self, action: Any) -> Stepped:
        """Act in every environment; return observation, reward, terminated, truncated and info of all environments."""
        raise NotImplementedError

    def _step_alone(self, action: Any) -> tuple[Observation, float, bool, bool, Info]:
        """Act in the only environment; return the tuple of `gymnasium.Env.step`."""
        observation, reward, terminated, truncated, info = self._step_rewarded(_batch_of_one(action))
        return one_of(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), one_of(info)

    def _step_rewarded(self, action: Any) -> Stepped:
        """Act in every environment, with the rewards of the user's function if one was given."""
        observation, reward, terminated, truncated, info = self._step_environments(action)
        if self.reward_function is None:
            return observation, reward, terminated, truncated, info
        ends = {"terminated": terminated.copy(), "truncated": truncated.copy()}
        own = np.asarray(self.reward_function(observation, action, info | ends), float)
        if own.shape != (self.num_envs,) or not np.isfinite(own).all():
            raise ValueError(
                f"reward returned {own!r}; it must return {self.num_envs} numbers, one for each environment"
            )
        return observation, own.copy(), terminated, truncated, info

    def _present(self) -> tuple[Observation, Info]:
        """Return the observations and info of the present state, as a reset returns them."""
        raise NotImplementedError

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which an episode is truncated; None if there is no such number."""
        return None

    # --- what it may replace --------------------------------------------------------------------------------------
    def _new_drives(self, num_envs: int) -> Any:
        from drive_env.emulator.emulated_drives import EmulatedDrives

        c = self.config
        count = max(num_envs, 1)
        return EmulatedDrives(c.device, c.load, c.motor, count, friction=c.friction, num_threads=c.num_threads)

    def _render_environment(self, lane: int) -> NDArray[np.uint8] | None:
        return None if self._pictures is None else self._pictures.draw(lane)

    def _close_environments(self) -> None:
        if self._pictures is not None:
            self._pictures.close()
        if self._owned:
            self.drives.close()

    # --- the curriculum -------------------------------------------------------------------------------------------
    @property
    def stage(self) -> float:
        """Stage of the curriculum, 0...1, of machines that are drawn from now on; the configuration's until it is set.

        A training sets it, with `curriculum.stage_at(environment steps so far)`.
        """
        return float(self.config.stage if self._stage is None else self._stage)

    @stage.setter
    def stage(self, stage: float) -> None:
        if not 0.0 <= stage <= 1.0:
            raise ValueError(f"stage of the curriculum must lie in 0...1, not {stage:g}")
        self._stage = stage

    @property
    def curriculum(self) -> Curriculum:
        """Schedule of the stage that the distributions have; of drives that are taken as they are, a constant."""
        machines = getattr(self, "_machines", None)
        return Curriculum() if machines is None else machines.distributions.curriculum

    # --- states ---------------------------------------------------------------------------------------------------
    def save_state(self) -> State:
        """Return the complete state as plain data that can be pickled: continued from it, environments do the same.

        It has drives, machines, trajectories, delays, random generators and the progress of each episode, but not the
        user's functions (reward, trajectory).

        Raises:
            ValueError: On a bus: real drives cannot be restored.
        """
        return {
            "of": self._description(),
            "drives": self._emulated_drives().save_state(),
            "rngs": [rng.bit_generator.state for rng in self.rngs],
        } | super().save_state()

    def restore_state(self, state: State) -> None:
        """Restore a state saved by these environments, or by others of the same configuration.

        Raises:
            ValueError: For a state of another configuration, naming what differs; on a bus.
        """
        drives = self._emulated_drives()
        if not isinstance(state, Mapping) or "of" not in state:
            raise ValueError(f"{state!r} is no state of environments; give what save_state() has returned")
        check_alike("environments", state["of"], self._description())
        drives.restore_state(state["drives"])
        super().restore_state(state)
        for rng, saved in zip(self.rngs, state["rngs"], strict=True):
            rng.bit_generator.state = saved
        if (pictures := self._pictures) is not None:
            pictures.begin(np.ones(self.num_envs, bool))

    def _emulated_drives(self) -> EmulatedDrives:
        if self.drives.machine is None:
            raise ValueError(
                "only emulated drives have a state that can be saved and restored; real machines cannot be put back"
            )
        return emulated_of(self.drives)

    def _description(self) -> State:
        """Return the properties that must be equal in two vectors of environments to restore the other's state."""
        table = {one.name: _text(getattr(self.config, one.name)) for one in fields(self.config)}
        table.pop("num_threads", None)
        return {"environment": type(self).__name__, "version": version("drive-env"), "num_envs": self.num_envs, **table}

    def __reduce__(self) -> tuple[Any, ...]:
        if not self._owned:
            raise TypeError(
                "an environment on drives that were given to it can neither be pickled nor copied: they are no part of "
                "it"
            )
        how = {"config": self.config, "autoreset_mode": self.autoreset_mode, "render_mode": self.render_mode}
        how |= {"reward": self.reward_function}
        return _restored, (type(self), self.num_envs, how, self.save_state(), self._spec)

    # --- gymnasium.vector.VectorEnv -------------------------------------------------------------------------------
    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """Its spec, with the configured steps of an episode; None if it was not made by Gymnasium."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # Gymnasium would wrap an environment registered with a number of steps into its own limit, whatever the
        # duration.
        self._spec = copy.copy(spec)
        if self._spec is not None and self._spec.max_episode_steps is None:
            self._spec.max_episode_steps = self.max_episode_steps

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, Info]:
        """Begin an episode in every environment, or in those of `options["reset_mask"]`.

        Args:
            seed: Seed of all; environment k has the generator of `SeedSequence(seed, spawn_key=(k,))`, so that
                neighbouring seeds share no generator. Environment 0 is the single environment of that seed. Or one seed
                per environment, as of single environments. None: each environment's generator continues.
            options: "reset_mask", shape (num_envs,), bool. "state": continue from a result of `save_state` instead of
                beginning; no other argument is allowed then. "machine": true parameters for these episodes, by name,
                one value or one for each environment, instead of drawn ones; not on a bus. Other options depend on the
                environment.

        Raises:
            ValueError: For an unknown option, naming the known ones, or a value out of its range.
        """
        options = dict(options or {})
        for name in options:
            check_choice("an option of reset", name, self.OPTIONS)
        if (state := options.pop("state", None)) is not None:
            if options or seed is not None:
                raise ValueError(f"a state is all that a reset begins from; leave {', '.join(options) or 'seed'} out")
            self.restore_state(state)
            return self._present()
        if not isinstance(machine := options.get("machine") or {}, Mapping):
            raise ValueError(f"machine is {machine!r}; give a dict of parameters by name, such as load.inertia")
        if machine and self.drives.machine is None:
            raise ValueError("machine is of emulated machines; leave it out on a bus")
        mask = self._reset_mask(options.pop("reset_mask", None))
        for lane, (one, place) in enumerate(self._seeds(seed)):
            if one is not None and mask[lane]:
                self.rngs[lane] = _generator(int(one), place)
                self._np_random_seed = int(one)
        observation, info = self._reset_environments(mask, options)
        self._ended = self._ended & ~mask
        self._some_ended = bool(self._ended.any())
        self._has_begun = True
        return observation, info

    def step(self, actions: Any) -> Stepped:
        """Act in every environment; `autoreset_mode` decides what follows the end of an episode.

        Raises:
            gymnasium.error.ResetNeeded: Before the first reset, or, with autoreset disabled, while an environment has
                ended.
            ValueError: For an action of another shape or not finite, before anything is sent to a drive; actions of
                ended environments are ignored.
        """
        if not self._has_begun:
            raise gymnasium.error.ResetNeeded("call reset() before the first step()")
        before = self._ended
        if self._some_ended and self.autoreset_mode is AutoresetMode.DISABLED:
            raise gymnasium.error.ResetNeeded(
                f"environment {int(np.flatnonzero(before)[0])} has ended and autoreset is disabled; "
                'call reset(options={"reset_mask": ended})'
            )
        if not _are_finite(actions, self.action_space):
            actions = _finite_actions(actions, before)
        observation, reward, terminated, truncated, info = self._step_rewarded(actions)
        if self._some_ended:
            begun, told = self._reset_environments(before, {})
            observation = merge(begun, observation, before)
            info = merge_info(told, info, before)
            reward[before] = 0.0
            terminated[before] = truncated[before] = False
        ended = terminated | truncated
        self._some_ended = bool(ended.any())
        self._ended = ended
        if self._some_ended and self.autoreset_mode is AutoresetMode.SAME_STEP:
            final, final_info = observation, info
            begun, told = self._reset_environments(ended, {})
            observation = merge(begun, final, ended)
            info = merge_info(told, final_info, ended)
            info["final_obs"] = _rows(final, ended)
            info["final_info"] = final_info
            info["_final_obs"] = info["_final_info"] = ended
            self._ended = np.zeros(self.num_envs, bool)
            self._some_ended = False
        return observation, reward, terminated, truncated, info

    def render(self) -> tuple[Any, ...] | None:
        """Return all pictures, uint8 of shape (height, width, 3); "human" shows the first and returns None."""
        if self.render_mode is None:
            return None
        if self.render_mode == "human":
            self._render_environment(0)
            return None
        return tuple(self._render_environment(lane) for lane in range(self.num_envs))

    def render_environment(self, lane: int) -> NDArray[np.uint8] | None:
        """Return the picture of one environment; with "human", show it and return None."""
        return None if self.render_mode is None else self._render_environment(lane)

    def close_extras(self, **kwargs: Any) -> None:
        """Release drives and pictures."""
        self._close_environments()

    # --- inside ---------------------------------------------------------------------------------------------------
    def _reset_mask(self, mask: Any) -> Mask:
        if mask is None:
            return np.ones(self.num_envs, bool)
        chosen = np.asarray(mask)
        if chosen.shape != (self.num_envs,) or chosen.dtype != bool or not chosen.any():
            raise ValueError(
                f"reset_mask must be a boolean array of shape ({self.num_envs},) that is true somewhere, not "
                f"{chosen.dtype} {chosen.shape}"
            )
        if not self._has_begun and not chosen.all():
            raise ValueError("the first reset must be of all environments; leave reset_mask out")
        return chosen

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[tuple[int | None, int]]:
        """Return each environment's seed, and its number among those of that seed."""
        if seed is None or isinstance(seed, (int, np.integer)):
            return [(seed, lane) for lane in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(
                f"{len(seed)} seeds do not fit {self.num_envs} environments; give one number or one per environment"
            )
        return [(one, 0) for one in seed]


def _generator(seed: int, place: int) -> np.random.Generator:
    """Return the generator of an environment; for the first one of a seed it is Gymnasium's own for that seed."""
    first: np.random.Generator = seeding.np_random(seed)[0]
    if place == 0:
        return first
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(place,))))


class SingleEnvironment(gymnasium.Env[Any, Any]):
    """A single environment as a gymnasium.Env: the same episode as environment 0 of a vectorised one with that seed.

    Args:
        vector: A vectorised environment with num_envs=1 and autoreset disabled.
    """

    def __init__(self, vector: VectorEnvironment) -> None:
        if vector.num_envs != 1 or vector.autoreset_mode is not AutoresetMode.DISABLED:
            raise ValueError("a single environment needs num_envs=1 and autoreset_mode='Disabled'")
        self.vector = vector
        self.observation_space = vector.single_observation_space
        self.action_space = vector.single_action_space
        self.render_mode = vector.render_mode
        self.metadata = {"render_modes": list(RENDER_MODES), "render_fps": 50}

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """The vectorised environment's spec."""
        return self.vector.spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self.vector.spec = spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Info]:
        """Begin an episode."""
        super().reset(seed=seed)
        observation, info = self.vector.reset(seed=seed, options=options)
        if options and options.get("state"):
            self._restore_generator(options["state"])
        return one_of(observation), one_of(info)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Info]:
        """Act once; ValueError for an action of another shape or not finite, before anything is sent to the drive."""
        vector = self.vector
        if vector._some_ended or not vector._has_begun:
            raise gymnasium.error.ResetNeeded("the episode has ended or none has begun; call reset()")
        if not _are_finite(action, self.action_space):
            _finite_actions(_batch_of_one(action), np.zeros(1, bool))
        # A user's reward needs all environments' arrays; without one there is a faster way.
        stepped = (
            vector._step_alone(action)
            if vector.reward_function is None
            else VectorEnvironment._step_alone(vector, action)
        )
        if stepped[2] or stepped[3]:
            vector._ended = np.ones(1, bool)
            vector._some_ended = True
        return stepped

    def render(self) -> Any:
        """Return the picture, uint8 of shape (height, width, 3); "human" shows it and returns None."""
        return self.vector.render_environment(0)

    def save_state(self) -> State:
        """Return the complete state of the environment, as `VectorEnvironment.save_state`."""
        rng = self._np_random
        return self.vector.save_state() | {"np_random": None if rng is None else rng.bit_generator.state}

    def restore_state(self, state: State) -> None:
        """Restore a state saved by this environment, or by another one of the same configuration.

        Raises:
            ValueError: As `VectorEnvironment.restore_state`.
        """
        self.vector.restore_state(state)
        self._restore_generator(state)

    def _restore_generator(self, state: State) -> None:
        if (saved := state.get("np_random")) is not None:
            self.np_random.bit_generator.state = saved

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.vector,), {"_np_random": self._np_random, "_np_random_seed": self._np_random_seed}

    def close(self) -> None:
        """Release drives and pictures."""
        self.vector.close()


# --- arrays with environments first, and dicts of them
# -----------------------------------------------------------------------
def merge(chosen: Observation, others: Observation, mask: Mask) -> Observation:
    """Return `chosen` where the mask is true and `others` elsewhere; neither is changed."""
    if isinstance(others, dict):
        return {key: merge(chosen[key], others[key], mask) for key in others}
    rows = np.array(others)
    rows[mask] = chosen[mask]
    return rows


def merge_info(chosen: Info, others: Info, mask: Mask) -> Info:
    """Return merged infos: `chosen` where the mask is true; an entry of only one side keeps its values.

    As in Gymnasium, such an entry has a mask, named with a leading underscore.
    """
    merged: Info = {}
    for key in [*others, *(key for key in chosen if key not in others)]:
        if key.startswith("_"):
            continue
        side = chosen if key in chosen else others
        if key in chosen and key in others:
            inside = isinstance(side[key], dict)
            merged[key] = (merge_info if inside else merge)(chosen[key], others[key], mask)
        else:
            merged[key] = side[key]
        there = np.where(mask, _told(chosen, key, mask), _told(others, key, mask))
        if not there.all():
            merged[f"_{key}"] = there
    return merged


def one_of(tree: Any) -> Any:
    """Return environment 0 of an array, or of a dict of arrays; masked entries only where they are valid."""
    if not isinstance(tree, dict):
        return tree[0]
    if not any(key.startswith("_") for key in tree):
        return {key: one_of(value) for key, value in tree.items()}
    return {
        key: one_of(value)
        for key, value in tree.items()
        if not key.startswith("_") and (f"_{key}" not in tree or tree[f"_{key}"][0])
    }


def _restored(kind: Any, num_envs: int, how: dict[str, Any], state: State, spec: EnvSpec | None) -> VectorEnvironment:
    made: VectorEnvironment = kind(num_envs, **how)
    made.restore_state(state)
    made.spec = spec
    return made


def _text(value: Any) -> str:
    """Return a field of a configuration as text; equal values give equal texts."""
    if isinstance(value, Distributions):
        return value.to_toml()
    return f"{value.__module__}.{value.__qualname__}" if inspect.isroutine(value) else repr(value)


def check_choice(what: str, value: Any, valid: Sequence[Any]) -> None:
    """Raise ValueError, naming the valid ones, unless a value is one of them."""
    if value not in valid:
        raise ValueError(f"{what} is one of {', '.join(repr(one) for one in valid)}, not {value!r}")


def _told(info: Info, key: str, mask: Mask) -> Mask:
    """Return the mask of the environments that an entry is about."""
    if key not in info:
        return np.zeros(len(mask), bool)
    there: Mask = info.get(f"_{key}", np.ones(len(mask), bool))
    return there


def _rows(tree: Observation, mask: Mask) -> Texts:
    """Return one observation per environment where the mask is true, None elsewhere: Gymnasium's final observations."""
    rows = np.full(len(mask), None, object)
    for lane in np.flatnonzero(mask):
        rows[lane] = {k: v[lane] for k, v in tree.items()} if isinstance(tree, dict) else tree[lane]
    return rows


def _are_finite(actions: Any, space: gymnasium.Space[Any]) -> bool:
    """Return whether all are finite numbers, also False if their sum overflows; ValueError for another number of them.

    A sum in Python takes half the time of NumPy's check of each number.
    """
    values = np.asarray(actions)
    if values.size != math.prod(space.shape or ()):
        raise ValueError(f"the action has shape {values.shape}, and {space.shape} is taken; nothing was sent")
    return math.isfinite(sum(values.ravel().tolist()))


def _finite_actions(actions: Any, ignored: Mask) -> NDArray[Any]:
    """Return actions with 0 for those that are not a number, in environments whose action is ignored.

    Raises:
        ValueError: For a NaN elsewhere, whose conversion to an integer is arbitrary.
    """
    values = np.array(actions, float)
    rows = values.reshape(len(ignored), -1)
    wrong = np.argwhere(~np.isfinite(rows) & ~ignored[:, None])
    if wrong.size:
        lane, entry = wrong[0]
        raise ValueError(
            f"entry {entry} of the action of environment {lane} is {rows[lane, entry]:g}, not a finite number; "
            "nothing was sent. A policy whose training diverged returns such actions: use an earlier checkpoint of it"
        )
    rows[ignored & ~np.isfinite(rows).all(axis=1)] = 0.0
    return values


def _batch_of_one(action: Any) -> Any:
    if isinstance(action, dict):
        return {key: _batch_of_one(value) for key, value in action.items()}
    return np.asarray(action)[None]


def _autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    check_choice("autoreset_mode", mode, [one.value for one in AutoresetMode])
    return AutoresetMode(mode)
