"""Domain randomisation as data: distributions of a machine's parameters, supply, temperatures, bus and faults.

A set of distributions is a TOML file (`distributions/`, one for every load); a curriculum widens it from the default
machine to the whole range. A machine depends only on its generator: a parameter's random number is derived from its
name, so that adding a distribution to a set changes no other parameter.
"""

from __future__ import annotations

import math
import tomllib
import zlib
from bisect import bisect_right
from collections.abc import Collection, Mapping, Sequence
from functools import cache, partial
from itertools import accumulate, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drive_env.emulator.parameters import check_known, check_parameter
from drive_env.faults.schedule import Order
from drive_env.faults.table import FAULTS, names_of
from drive_env.randomisation.random_faults import RandomFaults, check_ranges
from drive_env.saved_state import Saved
from mechanics.arrays import Floats, Mask
from mechanics.reading.untrusted import read_toml

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.emulator.emulated_drives import EmulatedDrives


SHIPPED = Path(__file__).parent / "distributions"

# Drawn quantities besides the parameters of `drives.machine`: unit and default, None if it is the drives' own.
BESIDE: dict[str, tuple[str, float | None]] = {
    "supply.voltage": ("V", None),
    "start.winding": ("degC", 25.0),
    "start.stage": ("degC", 25.0),
    "bus.action_latency": ("communication cycles", 0.0),
    "bus.observation_latency": ("communication cycles", 0.0),
    "bus.jitter": ("communication cycles", 0.0),
    "bus.lost_sync": ("1", 0.0),
}

# Values of an episode with faults: number in the table, from 1, 0 without a fault; begin [s].
FAULT_VALUES = ("fault.number", "fault.at")

LAWS = ("uniform", "loguniform", "normal", "choice")
_KEYS = {"uniform": ("low", "high"), "loguniform": ("low", "high"), "normal": ("mean", "deviation"),
         "choice": ("values",)}  # fmt: skip
_OPTIONAL = {"uniform": (), "loguniform": (), "normal": ("low", "high"), "choice": ("weights",)}
_TRIES = 20  # draws until a machine can be stepped


class Law(NamedTuple):
    """The distribution of a parameter: absolute in its unit, or as multiples of its default.

    law: "uniform" or "loguniform" over low...high; "normal" with mean and deviation, limited to low and high; "choice"
        of values, with weights.
    relative: Whether the numbers are multiples of the default.
    """

    law: str
    relative: bool = False
    low: float = -math.inf
    high: float = math.inf
    mean: float = 0.0
    deviation: float = 0.0
    values: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()

    def value(self, share: float, default: float, width: float = 1.0) -> float:
        """Return the value for a random number 0...1, closer to the default if width is below 1.

        Width 0 gives the default, 1 the whole distribution; in between the distance from the default shrinks: its
        logarithm for "loguniform", the probability of a value other than the default for "choice".
        """
        scale = default if self.relative else 1.0
        if self.law == "choice":
            if share >= width or width <= 0.0:
                return default
            chances = list(accumulate(self.weights or (1.0,) * len(self.values)))
            chosen = bisect_right(chances, share / width * chances[-1])
            return self.values[min(chosen, len(self.values) - 1)] * scale
        if self.law == "loguniform":
            drawn = scale * self.low * (self.high / self.low) ** share
            if default > 0.0 and drawn > 0.0:
                return float(default * (drawn / default) ** width)
            return float(default + width * (drawn - default))
        if self.law == "normal":
            from scipy.special import ndtr, ndtri

            low, high = (float(ndtr((edge - self.mean) / self.deviation)) for edge in (self.low, self.high))
            drawn = self.mean + self.deviation * float(ndtri(low + share * (high - low)))
            drawn = min(max(drawn, self.low), self.high)
        else:
            drawn = self.low + share * (self.high - self.low)
        return default + width * (drawn * scale - default)

    def table(self) -> dict[str, Any]:
        """Return the distribution as a TOML table."""
        found: dict[str, Any] = {"law": self.law}
        for key in (*_KEYS[self.law], *_OPTIONAL[self.law]):
            value = getattr(self, key)
            if value != () and (not isinstance(value, float) or math.isfinite(value)):
                found[key] = list(value) if isinstance(value, tuple) else value
        return found | ({"of": "default"} if self.relative else {})


class Curriculum(NamedTuple):
    """Schedule of the ranges: `stage` over training steps, and the interval in which a group or parameter widens."""

    steps: tuple[float, ...] = (0.0,)
    stage: tuple[float, ...] = (1.0,)
    opens: Mapping[str, tuple[float, float]] = {}

    def stage_at(self, steps: float) -> float:
        """Return the stage 0...1 after this number of environment steps, interpolated linearly."""
        return float(np.interp(steps, self.steps, self.stage))

    def width(self, name: str, stage: float) -> float:
        """Return the width of a parameter's distribution at a stage, 0...1."""
        start, end = self.opens.get(name, self.opens.get(name.split(".")[0], (0.0, 1.0)))
        if stage >= end:
            return 1.0
        return max(0.0, (stage - start) / (end - start))


class Distributions:
    """Distributions by the name of the parameter, and the curriculum that widens them.

    Names are those of `drives.machine.parameters` and of `BESIDE`. `faults` is the distribution of faults, or None.
    """

    def __init__(
        self, laws: Mapping[str, Law], curriculum: Curriculum | None = None, faults: RandomFaults | None = None
    ) -> None:
        self.laws = dict(laws)
        self.curriculum = curriculum or Curriculum()
        self.faults = faults
        self._marks = np.array([zlib.crc32(name.encode()) for name in self.laws], np.uint64)
        self._widths: tuple[float, list[float]] = (math.nan, [])  # at the stage of the last draw

    @classmethod
    def load(cls, source: str | Path | Mapping[str, Any] | Distributions) -> Distributions:
        """Return a set of distributions: a shipped one by its name (`shipped()`), a TOML file, or a table like one.

        Tables: `include`, names of sets that come first; `parameters`, name -> distribution; `curriculum` with `steps`
        and `stage`, and `opens`, group or parameter -> [from, to] in stages; `faults` with `probability`, `names` (of
        faults or groups), `at`, `duration` and `ranges`, as in `RandomFaults`. `false` as a distribution removes an
        included one, and so does `faults = false`.

        Raises:
            ValueError: For an unknown set, distribution or key, with the known ones, or an invalid number.
        """
        if isinstance(source, Distributions):
            return source
        if isinstance(source, Mapping):
            return _from_table("the table of distributions", source, ())
        if isinstance(source, Path) or str(source).endswith(".toml"):
            path = Path(source)
            if not path.is_file():
                raise ValueError(f"there is no file {path} of distributions")
            return _from_file(path, ())
        return _shipped_set(str(source))

    def of_machine(self, parameters: Collection[str]) -> Distributions:
        """Return the set without parameters that a machine lacks, e.g. those of another motor."""
        laws = {name: law for name, law in self.laws.items() if name in parameters or name in BESIDE}
        return Distributions(laws, self.curriculum, self.faults)

    def draw(self, rng: np.random.Generator, defaults: Mapping[str, float], stage: float = 1.0) -> dict[str, float]:
        """Draw one machine.

        Args:
            rng: The environment's generator; exactly one number is taken from it, whatever the set.
            defaults: Default by name, as in `drives.machine.parameters`; only these are drawn, and distributions of
                `BESIDE` without a default here are left out.
            stage: Stage of the curriculum, 0 (the defaults) to 1 (whole ranges).

        Raises:
            ValueError: For a stage out of range, or a distribution of a parameter that the machine lacks.
        """
        return self.draw_with_fault(rng, defaults, stage)[0]

    def draw_with_fault(
        self, rng: np.random.Generator, defaults: Mapping[str, float], stage: float = 1.0
    ) -> tuple[dict[str, float], Order | None]:
        """Draw one machine as `draw` does, and the fault of its episode, or None."""
        if not 0.0 <= stage <= 1.0:
            raise ValueError(f"stage of the curriculum must lie in 0...1, not {stage:g}")
        key = np.uint64(rng.integers(0, 2**64, dtype=np.uint64))
        shares = shares_of_chance(key, self._marks)
        if stage != self._widths[0]:
            self._widths = stage, [self.curriculum.width(name, stage) for name in self.laws]
        drawn: dict[str, float] = {}
        for (name, law), share, width in zip(self.laws.items(), shares.tolist(), self._widths[1], strict=True):
            if name in defaults:
                drawn[name] = law.value(share, float(defaults[name]), width)
            elif name not in BESIDE:
                raise ValueError(f"{name}: the machine has no such parameter; it has {', '.join(defaults)}")
        if self.faults is None:
            return drawn, None
        return drawn, self.faults.draw(partial(_chance, key), self.curriculum.width("faults", stage))

    def to_toml(self) -> str:
        """Return the set as TOML for `load`, with included sets written out."""
        lines = ["[parameters]"]
        for name, law in self.laws.items():
            lines.append(f'"{name}" = {{ {", ".join(f"{k} = {_toml(v)}" for k, v in law.table().items())} }}')
        if self.faults is not None:
            table = self.faults.table()
            ranges = table.pop("ranges", {})
            lines += ["", "[faults]", *(f"{key} = {_toml(value)}" for key, value in table.items())]
            lines += [f'ranges."{key}" = {_toml(ends)}' for key, ends in ranges.items()]
        standard = Curriculum()
        if self.curriculum != standard:
            lines += ["", "[curriculum]", f"steps = {_toml(list(self.curriculum.steps))}",
                      f"stage = {_toml(list(self.curriculum.stage))}"]  # fmt: skip
            opens = ", ".join(f'"{name}" = {_toml(list(ends))}' for name, ends in self.curriculum.opens.items())
            lines.append(f"opens = {{ {opens} }}")
        return "\n".join(lines) + "\n"


class RandomMachines(Saved):
    """Emulated machines drawn anew, environment by environment.

    Args:
        drives: The emulated drives, as built: their machines' parameters are the defaults.
        distributions: The distributions.

    Raises:
        ValueError: If a distribution names a parameter that these machines do not have.
    """

    STATE = ("values", "_orders", "_given")

    def __init__(self, drives: EmulatedDrives, distributions: Distributions) -> None:
        self.distributions = distributions
        self._drives = drives
        machines = drives.num_machines
        supply = drives.machine.supply.reshape(machines, -1)[:, 0]
        self._defaults = drives.machine.parameters | {
            name: supply if value is None else np.full(machines, value) for name, (_, value) in BESIDE.items()
        }
        unknown = [name for name in distributions.laws if name not in self._defaults]
        if unknown:
            raise ValueError(f"{unknown[0]}: {drives.load.name!r} has no such parameter; it has "
                             f"{', '.join(self._defaults)}")  # fmt: skip
        self.values = {name: values.copy() for name, values in self._defaults.items()}
        self._orders: list[Order | None] = [None] * machines
        self._given: list[str] = []  # given parameters without a distribution: default again in the next episode
        if distributions.faults is not None:
            for name in distributions.faults.names:
                drives.faults.check(Order(name))
            self.values |= {name: np.zeros(machines) for name in FAULT_VALUES}

    def redraw(
        self,
        rngs: Sequence[np.random.Generator],
        where: Mask | None = None,
        stage: float = 1.0,
        given: Mapping[str, ArrayLike] | None = None,
    ) -> None:
        """Draw the machines where the mask is true, put them to rest and restart their drives.

        Afterwards `values` has all present values by name, each of shape (num_machines,). A machine that cannot be
        stepped (a resonance too fast) is drawn again with its own generator.

        Args:
            rngs: The machines' generators.
            where: Machines.
            stage: Stage of the curriculum, 0...1.
            given: Values that replace drawn or default ones until these machines are drawn again, by name: one, or one
                per machine.

        Raises:
            ValueError: If many draws of a machine are all impossible, or a given value is.
        """
        fixed = self._checked(given or {})
        machine = self._drives.machine
        mask = np.ones(self._drives.num_machines, bool) if where is None else np.asarray(where, bool)
        if self.distributions.faults is not None:
            machine.clear_fault(where=mask)  # the next machine is drawn without faults
        for name in self._given:
            self.values[name] = np.where(mask, self._defaults[name], self.values[name])
        self._given += [name for name in fixed if name not in self.distributions.laws and name not in self._given]
        noise = np.ones(len(mask))
        for lane in map(int, np.flatnonzero(mask)):
            noise[lane] = rngs[lane].integers(1, 2**32)
            self._draw(lane, rngs[lane], stage, fixed)
        machine.seed_noise(noise, mask)
        try:
            self._set(mask)
        except ValueError:
            for lane in map(int, np.flatnonzero(mask)):
                self._set_one(lane, rngs[lane], stage, fixed)
        # Supply before the reset, which charges the link from it; temperatures after it, since it sets them to 25 degC.
        axes = np.repeat(mask, self._drives.num_axes // self._drives.num_machines)
        supply = np.where(axes, self._per_axis("supply.voltage"), machine.supply)
        machine.supply = supply[machine.links]
        machine.reset(mask)
        winding, power_stage = machine.temperatures
        machine.set_temperatures(
            np.where(axes, self._per_axis("start.winding"), winding),
            np.where(axes, self._per_axis("start.stage"), power_stage),
        )
        self.plan_faults(mask)

    def plan_faults(self, where: Mask) -> None:
        """Schedule the faults of starting episodes where the mask is true; `redraw` calls it, a reset ends them."""
        if self.distributions.faults is None:
            return
        for lane in map(int, np.flatnonzero(where)):
            order = self._orders[lane]
            for name in FAULT_VALUES:
                self.values[name][lane] = 0.0
            if order is None:
                continue
            try:
                self._drives.faults.add(order, np.arange(len(where)) == lane)
            except ValueError:  # a payload with which this machine cannot be stepped: it gets no fault
                continue
            self.values["fault.number"][lane] = 1.0 + list(FAULTS).index(order.name)
            self.values["fault.at"][lane] = order.at

    def _checked(self, given: Mapping[str, ArrayLike]) -> dict[str, Floats]:
        """Return given values of all machines; ValueError for an unknown name or a value that is not a number."""
        machines, fixed = self._drives.num_machines, {}
        for name, value in given.items():
            check_known(name, self._defaults)
            values = np.asarray(value, float)
            if values.shape not in ((), (machines,)):
                raise ValueError(f"{name} takes one value or one for each of {machines} machines, not {values.shape}")
            fixed[name] = np.broadcast_to(values, (machines,))
            check_parameter(name, fixed[name])
        return fixed

    def _draw(self, lane: int, rng: np.random.Generator, stage: float, fixed: Mapping[str, Floats]) -> None:
        defaults = {name: float(values[lane]) for name, values in self._defaults.items()}
        drawn, self._orders[lane] = self.distributions.draw_with_fault(rng, defaults, stage)
        for name, value in drawn.items():
            self.values[name][lane] = value
        for name, values in fixed.items():
            self.values[name][lane] = values[lane]

    def _set(self, mask: Mask) -> None:
        drawn = [name for name in (*self.distributions.laws, *self._given) if name not in BESIDE]
        self._drives.machine.set_all({name: self.values[name] for name in drawn}, mask)

    def _set_one(self, lane: int, rng: np.random.Generator, stage: float, fixed: Mapping[str, Floats]) -> None:
        one = np.arange(self._drives.num_machines) == lane
        for attempt in range(_TRIES):
            try:
                self._set(one)
            except ValueError as error:
                if attempt == _TRIES - 1:
                    raise ValueError(
                        f"{_TRIES} draws gave impossible machines: {error}; narrow the distributions"
                    ) from error
                self._draw(lane, rng, stage, fixed)
            else:
                return

    def _per_axis(self, name: str) -> Floats:
        return np.repeat(self.values[name], self._drives.num_axes // self._drives.num_machines)


def shipped() -> list[str]:
    """Return the names of the shipped sets."""
    return sorted(path.stem for path in SHIPPED.glob("*.toml"))


def laws_of(load: str, device: Device, parameters: Collection[str]) -> Distributions:
    """Return the shipped set of a load, adapted to the device's machines.

    Args:
        load: Name of a load that has a set.
        device: The device.
        parameters: Names of its machines' parameters; others of the set are left out.
    """
    own = "stepper" if device.gains.is_open_loop else device.firmware_name
    if own not in shipped():
        return Distributions.load(load)
    return Distributions.load({"include": [load, own], "parameters": {}}).of_machine(parameters)


# --- reading ----------------------------------------------------------------------------------------------------------
@cache
def _shipped_set(name: str) -> Distributions:
    if name not in shipped():
        raise ValueError(
            f"no set of distributions is named {name!r}; there are {', '.join(shipped())}, or give a .toml"
        )
    return _from_file(SHIPPED / f"{name}.toml", ())


def _from_file(path: Path, includers: tuple[str, ...]) -> Distributions:
    try:
        table = read_toml(path)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not TOML: {error}") from error
    return _from_table(path.name, table, includers)


def _from_table(where: str, table: Mapping[str, Any], includers: tuple[str, ...]) -> Distributions:
    _check_keys(where, table, ("include", "parameters", "curriculum", "faults"))
    laws: dict[str, Law] = {}
    faults: RandomFaults | None = None
    curriculum = Curriculum()
    include = table.get("include", [])
    for name in [include] if isinstance(include, str) else include:
        if name in includers:
            raise ValueError(f"{where}: {name!r} includes itself")
        if name not in shipped():
            raise ValueError(f"{where}: no set is named {name!r}; there are {', '.join(shipped())}")
        other = _from_file(SHIPPED / f"{name}.toml", (*includers, name))
        laws |= other.laws
        curriculum = other.curriculum
        faults = other.faults
    for name, row in _mapping(f"{where}: parameters", table.get("parameters", {})).items():
        if row is False:
            laws.pop(name, None)
        else:
            laws[name] = _law(f"{where}: {name}", name, row)
    if "curriculum" in table:
        curriculum = _curriculum(f"{where}: curriculum", table["curriculum"])
    if "faults" in table:
        faults = None if table["faults"] is False else _random_faults(f"{where}: faults", table["faults"])
    return Distributions(laws, curriculum, faults)


def _random_faults(where: str, table: Any) -> RandomFaults:
    table = _mapping(where, table)
    _check_keys(where, table, ("probability", "names", "at", "duration", "ranges"))
    names = table.get("names", [])
    if not isinstance(names, list | tuple) or not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{where}: names must be a list of faults or groups, as ['encoder_stuck', 'load']")
    try:
        known = tuple(dict.fromkeys(name for chosen in names for name in names_of(chosen)))
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None
    pairs = {key: _pair(f"{where}: {key}", table[key]) for key in ("at", "duration") if key in table}
    ranges = _mapping(f"{where}: ranges", table.get("ranges", {})).items()
    faults = RandomFaults(
        _numbers(f"{where}: probability", table.get("probability", 0.0)), known, pairs.get("at", (0.0, 1.0)),
        pairs.get("duration"), {key: _pair(f"{where}: ranges: {key}", ends) for key, ends in ranges},
    )  # fmt: skip
    check_ranges(where, faults)
    return faults


def _pair(where: str, value: Any) -> tuple[float, float]:
    pair = _numbers(where, value)
    if not isinstance(pair, tuple) or len(pair) != 2:
        raise ValueError(f"{where} must be [low, high], not {value!r}")
    return pair


def _law(where: str, name: str, row: Any) -> Law:
    row = dict(_mapping(where, row))
    kind = row.pop("law", None)
    if kind not in LAWS:
        raise ValueError(f"{where}: law = {kind!r} is unknown; there are {', '.join(LAWS)}")
    of = row.pop("of", None)
    if of not in (None, "default"):
        raise ValueError(f'{where}: of = {of!r}; leave it out for absolute numbers, or write of = "default"')
    _check_keys(where, row, (*_KEYS[kind], *_OPTIONAL[kind]))
    missing = [key for key in _KEYS[kind] if key not in row]
    if missing:
        raise ValueError(f"{where}: law = {kind!r} needs {missing[0]!r}")
    numbers = {key: _numbers(f"{where}: {key}", value) for key, value in row.items()}
    law = Law(kind, of == "default", **numbers)
    _check_law(where, law)
    if name.startswith("bus.") and name not in BESIDE:
        raise ValueError(f"{where}: a bus has no {name!r}; it has {', '.join(n for n in BESIDE if n[:4] == 'bus.')}")
    return law


def _check_law(where: str, law: Law) -> None:
    if law.low > law.high:
        raise ValueError(f"{where}: low {law.low:g} is above high {law.high:g}")
    if law.law == "loguniform" and law.low <= 0.0:
        raise ValueError(f"{where}: law = 'loguniform' needs a low above 0, not {law.low:g}")
    if law.law == "normal" and law.deviation <= 0.0:
        raise ValueError(f"{where}: deviation must be above 0, not {law.deviation:g}")
    if law.law == "choice":
        if not law.values:
            raise ValueError(f"{where}: law = 'choice' needs at least one value")
        if law.weights and (len(law.weights) != len(law.values) or min(law.weights) < 0.0 or sum(law.weights) <= 0.0):
            raise ValueError(f"{where}: weights must be {len(law.values)} numbers, none negative, not all 0")


def _curriculum(where: str, table: Any) -> Curriculum:
    table = _mapping(where, table)
    _check_keys(where, table, ("steps", "stage", "opens"))
    steps = _numbers(f"{where}: steps", table.get("steps", [0]))
    stage = _numbers(f"{where}: stage", table.get("stage", [1]))
    if not isinstance(steps, tuple) or not isinstance(stage, tuple) or len(steps) != len(stage) or not steps:
        raise ValueError(f"{where}: steps and stage must be arrays of the same length")
    if any(b <= a for a, b in pairwise(steps)):
        raise ValueError(f"{where}: steps must increase")
    if min(stage) < 0.0 or max(stage) > 1.0:
        raise ValueError(f"{where}: stage must lie in 0...1")
    opens: dict[str, tuple[float, float]] = {}
    for name, ends in _mapping(f"{where}: opens", table.get("opens", {})).items():
        pair = _numbers(f"{where}: opens: {name}", ends)
        if not isinstance(pair, tuple) or len(pair) != 2 or not 0.0 <= pair[0] < pair[1] <= 1.0:
            raise ValueError(f"{where}: opens: {name} must be [from, to] with 0 <= from < to <= 1, not {ends}")
        opens[name] = (pair[0], pair[1])
    return Curriculum(steps, stage, opens)


def _numbers(where: str, value: Any) -> Any:
    """Return a finite number as a float, an array of them as a tuple."""
    if isinstance(value, list | tuple):
        return tuple(_numbers(where, item) for item in value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{where} must be a finite number, not {value!r}")
    return float(value)


def _mapping(where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} must be a table, not {value!r}")
    return value


def _check_keys(where: str, table: Mapping[str, Any], known: Sequence[str]) -> None:
    for key in table:
        if key not in known:
            raise ValueError(f"{where}: key {key!r} is unknown; there are {', '.join(known)}")


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return f'"{value}"' if isinstance(value, str) else repr(float(value))


# --- chance -----------------------------------------------------------------------------------------------------------
def shares_of_chance(key: np.uint64 | NDArray[np.uint64], marks: NDArray[np.uint64]) -> Floats:
    """Return random numbers in [0, 1) for keys and marks: splitmix64 of both (Steele, Lea, Flood 2014).

    Each number can be computed alone and in any order.
    """
    with np.errstate(over="ignore"):
        z = key + marks * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return np.asarray((z >> np.uint64(11)).astype(np.float64) * 2.0**-53)


def _chance(key: np.uint64, name: str) -> float:
    return float(shares_of_chance(key, np.array([zlib.crc32(name.encode())], np.uint64))[0])
