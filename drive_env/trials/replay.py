"""Repeats a recorded move of a real machine on emulated ones: returns their deviation, and fits machines to the record.

The log is the CSV that `drive-env scope` writes. The commands are played again, and the responses compared.
"""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.drives import motion
from drive_env.drives.interface import CYCLE
from drive_env.randomisation.random_machines import BESIDE, Distributions, Law
from mechanics.arrays import Floats, Integers, Mask
from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import read_rows

if TYPE_CHECKING:
    from drive_env.emulator.emulated_drives import EmulatedDrives


# Commands in the order of search: recorded object, mode in which it is played, and object that plays it.
# A position demand comes first: the drive's profile (pp) has already turned the target into a path.
COMMANDS: tuple[tuple[Key, str, Key], ...] = (
    ((cia402.POSITION_DEMAND, 0), "csp", (cia402.TARGET_POSITION, 0)),
    ((cia402.TARGET_POSITION, 0), "csp", (cia402.TARGET_POSITION, 0)),
    ((cia402.TARGET_VELOCITY, 0), "csv", (cia402.TARGET_VELOCITY, 0)),
    ((cia402.TARGET_TORQUE, 0), "cst", (cia402.TARGET_TORQUE, 0)),
)
RESPONSES: tuple[Key, ...] = ((cia402.POSITION_ACTUAL, 0), (cia402.VELOCITY_ACTUAL, 0), (cia402.TORQUE_ACTUAL, 0))
_POSITIONS: tuple[Key, ...] = ((cia402.POSITION_DEMAND, 0), (cia402.POSITION_ACTUAL, 0), (cia402.TARGET_POSITION, 0))
MAX_SHIFT = 0.02  # s, greatest time shift of a response that is searched
LATEST = 1e7  # s: at 1e300 a float has no resolution of milliseconds left
AT_REST = 0.1  # of the range of the speed: noise of a quiet axis
_COLUMN = re.compile(r"^([0-9A-Fa-f]{4})h:([0-9A-Fa-f]{2}) [^()]*?(?: \[[^]]*\])?(?: \((.+)\))?$")


class Log(NamedTuple):
    """A recorded move: times `t` [s], shape (n,), and integers of each object, shape (n, axes)."""

    t: Floats
    objects: Mapping[Key, Integers]

    @property
    def num_axes(self) -> int:
        """Number of axes in the log."""
        return int(next(iter(self.objects.values())).shape[1])

    @property
    def every(self) -> int:
        """Communication cycles between two samples."""
        return max(1, round(float(self.t[1] - self.t[0]) / CYCLE))


class LogDifference(NamedTuple):
    """The deviation of one object of emulated machines from the log, each of shape (num_machines,).

    nrmse: RMS of the difference over the log's range (greatest less least), sample by sample.
    shift: Time [s] by which the emulator is late: shifted back by it, the difference is least.
    shifted: NRMSE with this shift.
    """

    nrmse: Floats
    shift: Floats
    shifted: Floats


class LogFit(NamedTuple):
    """Machines that fit a log.

    distributions: The given distributions, with fitted parameters replaced by the range of the accepted machines.
    accepted: Fitted parameter -> values of the accepted machines [SI], best first.
    distance: Their distances, mean NRMSE over objects and axes, best first.
    nominal: Distance of the nominal machine.
    narrowed: Fitted parameter -> width of the accepted machines' middle 90 % over that of the given distribution, in
        0...1.
    """

    distributions: Distributions
    accepted: dict[str, Floats]
    distance: Floats
    nominal: float
    narrowed: dict[str, float]

    def is_seen(self, name: str) -> bool:
        """Return whether the log determines a fitted parameter."""
        return self.narrowed[name] < UNSEEN

    def to_toml(self) -> str:
        """Return the fitted set as TOML for `Distributions.load`, with the results of the fit as comments."""
        lines = [
            "# Fitted to a recorded move: the range of the machines that respond like it, 5th to 95th percentile.",
            f"# Distance (mean NRMSE): nominal machine {self.nominal:.4f}, best {self.distance[0]:.4f}, "
            f"worst accepted {self.distance[-1]:.4f} of {len(self.distance)}.",
        ]
        for name, share in self.narrowed.items():
            seen = "" if self.is_seen(name) else ": the log does not determine it, its distribution is the one given"
            lines.append(f"# {name}: {100.0 * share:.0f} % of the range given{seen}")
        return "\n".join(lines) + "\n\n" + self.distributions.to_toml()


UNSEEN = 0.8  # share of the range above which a parameter counts as not identified


def read_log(path: str | Path) -> Log:
    """Read a log from a CSV of `drive-env scope`.

    Raises:
        ValueError: For an invalid file; the message names the line.
    """
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"there is no log {file}; record one with drive-env scope")
    try:
        rows = read_rows(file)
        columns = _columns(file, next(rows, []))
        t, raw = _samples(file, rows, sum(map(len, columns.values())))
    except UnicodeDecodeError:
        raise ValueError(f"{file} is not a text file; give the CSV that drive-env scope writes") from None
    except csv.Error as error:
        raise ValueError(f"{file} is not CSV: {error}; give the one that drive-env scope writes") from None
    if not np.all(np.abs(t) <= LATEST):
        wrong = int(np.argmax(~(np.abs(t) <= LATEST)))
        raise ValueError(
            f"{file}: line {wrong + 2} has the time {t[wrong]:g} s; times must lie within {LATEST:g} s of 0"
        )
    steps = np.diff(t)
    if steps.min() <= 0.0 or np.ptp(steps) > 0.5 * CYCLE or abs(steps[0] / CYCLE - round(steps[0] / CYCLE)) > 0.01:
        raise ValueError(f"{file}: times must increase by the same whole number of milliseconds from line to line")
    if len({len(places) for places in columns.values()}) > 1:
        raise ValueError(f"{file}: every object must be there for the same axes")
    return Log(t, {key: raw[:, places] for key, places in columns.items()})


def _columns(file: Path, head: list[str]) -> dict[Key, list[int]]:
    """Return the columns of each object, one for each axis, from the first line of a log."""
    if len(head) < 2 or head[0] != "t [s]":
        raise ValueError(f"{file}: the first line must begin with 't [s]', as drive-env scope writes it")
    columns: dict[Key, list[int]] = {}
    for k, title in enumerate(head[1:]):
        found = _COLUMN.match(title)
        if found is None:
            raise ValueError(f"{file}: column {title!r} names no object; it must begin as '6064h:00 '")
        columns.setdefault((int(found[1], 16), int(found[2], 16)), []).append(k)
    return columns


def _samples(file: Path, rows: Iterator[list[str]], width: int) -> tuple[Floats, Integers]:
    """Read times [s] and integers, shape (n, width), from a log's rows, with little more memory than these need."""
    times, values = array("d"), array("q")
    for number, row in enumerate(rows, 2):
        try:
            if len(row) != width + 1:
                raise ValueError(f"line {number} has {len(row)} values")
            times.append(float(row[0]))
            values.extend(map(int, row[1:]))
        except (ValueError, OverflowError) as error:
            raise ValueError(f"{file}: every line needs a time and {width} whole numbers: {error}") from None
    if len(times) < 10:
        raise ValueError(f"{file}: needs at least 10 lines of {width + 1} values each")
    return np.array(times), np.array(values, np.int64).reshape(len(times), width)


def replay(drives: EmulatedDrives, log: Log, settings: Mapping[Any, int] | None = None) -> dict[Key, Integers]:
    """Repeat a log's command on every emulated machine, from rest; return the log's objects, (n, num_axes) each.

    Machines are reset first, but keep their parameters. Positions begin at the log's first.

    Args:
        drives: Emulated drives whose machines have as many axes as the log.
        log: The recorded move.
        settings: Objects of the real drive (gains, limits): name -> integer; `drive-env parameters backup` reads them.

    Raises:
        ValueError: If the log has no command, or another number of axes.
    """
    command, mode, played = command_of(log)
    axes = drives.num_axes // drives.num_machines
    if axes != log.num_axes:
        raise ValueError(f"the log is of {log.num_axes} axes, a machine of load {drives.load.name!r} has {axes}")
    drives.machine.reset()
    for name, value in (settings or {}).items():
        drives.write(name, value)
    values = log.objects[command]
    told = _between(values, log.every) if mode == "csp" else np.repeat(values, log.every, axis=0)
    start = told[0] - drives.read((cia402.POSITION_ACTUAL, 0))[:axes] if mode == "csp" else np.zeros(axes, np.int64)
    rows = np.tile(told - start, (1, drives.num_machines))
    if mode == "csp":
        drives.write(played, rows[0])
    motion.enable(drives, mode)
    if command == (cia402.POSITION_DEMAND, 0):
        # A demand holds for its own cycle; a target played in csp is reached one cycle later.
        rows = np.concatenate([rows[1:], rows[-1:]])
    names = [name for name in RESPONSES if name in log.objects]
    trace = drives.record(names, len(rows) * CYCLE, play={played: rows}, period=log.every * CYCLE)
    shift = np.tile(start, drives.num_machines)
    return {name: trace[name] + (shift if name in _POSITIONS else 0) for name in names}


def command_of(log: Log) -> tuple[Key, str, Key]:
    """Return the object of a log that is the command, the mode that plays it, and the object that it is played as.

    Raises:
        ValueError: If the log has no such object, naming the possible ones, or begins in the middle of a move.
    """
    speed = log.objects.get((cia402.VELOCITY_ACTUAL, 0))
    if speed is not None and np.any(np.abs(speed[0]) > AT_REST * np.maximum(np.ptp(speed, axis=0), 1)):
        raise ValueError("the log begins in the middle of a move; record it from rest, with scope --before")
    for key, mode, played in COMMANDS:
        if key in log.objects and (mode != "csp" or _is_a_path(log.objects[key])):
            return key, mode, played
    known = ", ".join(f"{key[0]:04X}h" for key, *_ in COMMANDS)
    raise ValueError(f"the log has no command that changes step by step; record one of {known} with the response")


def compare(log: Log, found: Mapping[Key, Integers], num_machines: int = 1) -> dict[Key, LogDifference]:
    """Return the deviation of replayed objects from the log; the worst axis of a machine counts.

    Args:
        log: The recorded move.
        found: Result of `replay`.
        num_machines: Number of machines in it.
    """
    report: dict[Key, LogDifference] = {}
    for key, values in found.items():
        axes = log.num_axes
        want = log.objects[key].astype(float)
        have = values.astype(float).reshape(len(want), num_machines, axes)
        span = np.maximum(np.ptp(want, axis=0), 1.0)
        plain = (_rms(have - want[:, None]) / span).max(axis=-1)
        shift, shifted = _best_shift(want, have, span, log.every * CYCLE)
        report[key] = LogDifference(plain, shift, shifted)
    return report


def fittable(laws: Distributions) -> list[str]:
    """Return the parameters of a set of distributions that can be fitted: those drawn from a range."""
    return [name for name, law in laws.laws.items() if name not in BESIDE and law.law != "choice"]


def fit(
    drives: EmulatedDrives,
    log: Log,
    distributions: Distributions | str,
    parameters: Sequence[str],
    *,
    settings: Mapping[Any, int] | None = None,
    rounds: int = 4,
    accept: float = 0.1,
    slack: float = 1.2,
    seed: int = 0,
) -> LogFit:
    """Fit distributions to a log: draw machines, keep those with a similar response, draw around them, and repeat.

    A population Monte Carlo search without likelihood: every machine of `drives` is a candidate. The first round draws
    from the given distributions, later rounds around the best candidates so far, `accept` of a round, spread by their
    covariance. The accepted machines are those within `slack` times the least distance. Their range is not a confidence
    interval: it contains the machines that this log cannot distinguish from the best one by more than that.

    Args:
        drives: Emulated drives, at least 16 machines; more give a better fit.
        log: The recorded move.
        distributions: Distributions, or a set's name; parameters that are not fitted stay nominal.
        parameters: Names of the parameters to fit.
        settings: As in `replay`.
        rounds: Number of rounds, 1 or more.
        accept: Share of a round's machines around which the next round is drawn.
        slack: Greatest distance of an accepted machine over the least one.
        seed: Seed of the search.

    Raises:
        ValueError: For a parameter without a distribution, or too few machines.
    """
    laws = Distributions.load(distributions)
    machine = drives.machine
    nominal = {name: values.copy() for name, values in machine.parameters.items()}
    candidates = drives.num_machines
    known = fittable(laws)
    for name in parameters:
        if name not in known:
            near = did_you_mean(name, known)
            raise ValueError(f"{name!r} cannot be fitted{near}; there are {', '.join(known)}")
    if candidates < 16 or not parameters:
        raise ValueError(f"a fit needs at least 16 machines and one parameter, not {candidates} and {len(parameters)}")
    rng = np.random.default_rng(seed)
    default = {name: float(nominal[name][0]) for name in parameters}
    # The search uses quantiles of each distribution, 0...1: there all distributions are uniform.
    tried = np.empty((0, len(parameters)))
    distances = np.empty(0)
    try:
        base = float(_distances(drives, log, settings).min())
        for _ in range(rounds):
            shares = _candidates(rng, tried, distances, candidates, len(parameters), accept)
            values = {
                name: np.array([laws.laws[name].value(share, default[name]) for share in shares[:, k]])
                for k, name in enumerate(parameters)
            }
            possible = _give(drives, values)
            found = np.where(possible, _distances(drives, log, settings), np.inf)
            tried, distances = np.concatenate([tried, shares]), np.concatenate([distances, found])
    finally:
        machine.set_all({name: nominal[name] for name in parameters})
        machine.reset()
    order = np.argsort(distances, kind="stable")
    order = order[distances[order] <= slack * distances[order[0]]]
    return _result(laws, parameters, default, tried[order], distances[order], base)


# --- private functions ------------------------------------------------------------------------------------------------
def _candidates(
    rng: np.random.Generator, tried: Floats, distances: Floats, count: int, width: int, accept: float
) -> Floats:
    if not len(tried):
        # Stratified: the range of every distribution is covered evenly.
        strata = np.stack([rng.permutation(count) for _ in range(width)], axis=1)
        return (strata + rng.random((count, width))) / count
    best = np.argsort(distances, kind="stable")[: max(2 * width, round(accept * count), 4)]
    # Twice the population's covariance, as in Beaumont et al. 2009 (adaptive approximate Bayesian computation).
    spread = 2.0 * np.atleast_2d(np.cov(tried[best], rowvar=False)) + 1e-10 * np.eye(width)
    around = tried[rng.choice(best, count)] + rng.multivariate_normal(np.zeros(width), spread, count)
    # Reflected at the ends of the distributions, so that a parameter at its limit can be reached.
    folded = np.mod(around, 2.0)
    return np.asarray(np.where(folded > 1.0, 2.0 - folded, folded))


def _give(drives: EmulatedDrives, values: Mapping[str, Floats]) -> Mask:
    """Set parameters; return the machines for which they are possible."""
    machine, possible = drives.machine, np.ones(drives.num_machines, bool)
    try:
        machine.set_all(values)
    except ValueError:
        for k in range(drives.num_machines):
            try:
                machine.set_all(values, np.arange(drives.num_machines) == k)
            except ValueError:
                possible[k] = False
    return possible


def _distances(drives: EmulatedDrives, log: Log, settings: Mapping[Any, int] | None) -> Floats:
    report = compare(log, replay(drives, log, settings), drives.num_machines)
    return np.asarray(np.mean([difference.nrmse for difference in report.values()], axis=0))


def _result(
    laws: Distributions,
    parameters: Sequence[str],
    default: Mapping[str, float],
    shares: Floats,
    distances: Floats,
    base: float,
) -> LogFit:
    fitted = dict(laws.laws)
    accepted: dict[str, Floats] = {}
    narrowed: dict[str, float] = {}
    for k, name in enumerate(parameters):
        law = laws.laws[name]
        accepted[name] = np.array([law.value(share, default[name]) for share in shares[:, k]])
        low, high = np.quantile(shares[:, k], (0.05, 0.95))
        narrowed[name] = float(min((high - low) / 0.9, 1.0))
        if narrowed[name] >= UNSEEN:
            continue
        scale = default[name] if law.relative else 1.0
        ends = sorted(float(law.value(share, default[name]) / scale) for share in (low, high))
        log_law = law.law == "loguniform" and ends[0] > 0.0
        fitted[name] = Law("loguniform" if log_law else "uniform", law.relative, ends[0], ends[1])
    return LogFit(Distributions(fitted, laws.curriculum, laws.faults), accepted, distances, base, narrowed)


def _best_shift(want: Floats, have: Floats, span: Floats, period: float) -> tuple[Floats, Floats]:
    """Return the shift [s] with the least NRMSE, to a tenth of a sample, and this NRMSE, shape (machines,)."""
    n, machines = len(want), have.shape[1]
    reach = min(max(1, math.floor(MAX_SHIFT / period)), n // 4)
    inner = slice(reach, n - reach)
    grid = np.arange(-10 * reach, 10 * reach + 1) / 10.0
    errors = np.empty((len(grid), machines))
    for k, shift in enumerate(grid):
        whole = math.floor(shift)
        share = shift - whole
        index = np.arange(n)[inner] + whole
        moved = (1.0 - share) * have[index] + share * have[np.minimum(index + 1, n - 1)]
        errors[k] = (_rms(moved - want[inner, None]) / span).max(axis=-1)
    best = errors.argmin(axis=0)
    return grid[best] * period, errors[best, np.arange(machines)]


def _is_a_path(values: Integers) -> bool:
    """Return whether set-points form a path from cycle to cycle; the target of a profile jumps."""
    travel = np.ptp(values, axis=0).max()
    return bool(travel == 0 or np.abs(np.diff(values, axis=0)).max() < 0.5 * travel)


def _between(values: Integers, every: int) -> Integers:
    """Interpolate positions for every cycle from samples of every few cycles."""
    rows = [np.linspace(a, b, every, endpoint=False) for a, b in pairwise(values)]
    last = np.repeat(values[-1:], every, axis=0)
    return np.asarray(np.rint(np.concatenate([*rows, last])), np.int64)


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))
