"""Random set-point sequences near the ends of an axis' travel, with the envelope and without, told by the rotor itself.

    python tests/travel_sequences.py --count 10000 --processes 2

A sequence enables a device's axes in a mode of operation, steps, ramps and swings their set-points, changes modes while
they move, and ends. Both ways it is the same commands, but for those that the envelope refused before it sent them.
What counts is the angle of each rotor inside the emulator, and how far outside its travel it was at its farthest:

- with the envelope no farther than without it, but for `SAME`;
- and no farther than `Comparison.slack` says (docs/safety.md, "How far outside").
"""

from __future__ import annotations

import argparse
import multiprocessing
import random
import time
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from adversary import end_with_parent, quiet
from rigs.fault_injection import EXPECTED, eds_read_once
from rigs.in_memory_link import MemoryBus, MemoryDrives

from drive_env import EmulatedDrives, Limits, SafetyError, motion
from drive_env.devices import find_device

DEVICES = ("tmcm1636", "tgz_d", "tmcm3313", "tmcm6212")
LOADS = ("inertia", "two_mass", "belt", "ball_screw")
POSITION, VELOCITY, TORQUE, METHOD, HOMING_SPEED = 0x607A, 0x60FF, 0x6071, 0x6098, 0x6099
TARGETS = {"pp": POSITION, "csp": POSITION, "pv": VELOCITY, "csv": VELOCITY, "cst": TORQUE}
TURN = 2.0 * np.pi  # rad
AFTERWARDS = 600  # cycles after the last command
ENABLING = 0.03  # s at most
SAME = 0.05  # rev: a stop begins some milliseconds before a turn of the set-point would have, and settles
FASTEST, FASTEST_STEPPER = 70.0, 8.0  # rev/s that are asked for
# How far outside an axis may be [rev], by the modes that it was in: it speeds up until its ramp begins, and its loops
# overshoot (docs/safety.md).
SLACK = {"pp": 0.15, "csp": 0.6, "pv": 0.3, "csv": 0.6, "cst": 1.0, "hm": 0.6}
SHARE = 0.07  # by which each further axis of a device is asked for less


class TracedBus(MemoryBus):
    """A node, and the rotor angles [rad] of its axes after every cycle."""

    def __init__(self, drives):
        super().__init__(drives)
        self.angles = []
        self._angle = drives.inside.records["theta_m"]

    def cycle(self):
        super().cycle()
        self.angles.append(self._angle.reshape(-1)[: self.drives.num_axes].copy())


@dataclass
class Machine:
    """The axes of an emulated device, and what a count of their set-points is.

    turn: Increments of a revolution; speed: counts of 60FFh of a revolution a second; current: counts of 6071h of all
    the current there is; modes: its modes of operation; homing: its methods; fastest: speed that is asked for at most
    [rev/s].
    """

    drives: EmulatedDrives
    turn: float
    speed: float
    current: int
    modes: tuple[str, ...]
    homing: tuple[int, ...]
    fastest: float


@cache
def machine(device: str, load: str) -> Machine:
    """Return the axes of a device, each with a load of its own."""
    drives = EmulatedDrives(device, load=load, num_machines=find_device(device).num_axes, num_threads=1)
    records = drives.inside.records

    def si_per_count(index, name, value):
        drives.write(index, value)
        found = float(records[name].reshape(-1)[0])
        drives.write(index, 0)
        return found / value

    is_servo = "i_q" in records.dtype.names
    current = 0
    if is_servo:
        current = round(float(records["i_max"].reshape(-1)[0]) / si_per_count(TORQUE, "target_torque", 100))
    return Machine(
        drives,
        TURN / si_per_count(POSITION, "target_position", 100_000),
        TURN / si_per_count(VELOCITY, "target_velocity", 1000),
        current,
        (*TARGETS, "hm") if is_servo else ("pp", "csp", "pv", "csv", "hm"),
        tuple(find_device(device).allowed_values[(METHOD, 0)]),
        FASTEST if is_servo else FASTEST_STEPPER,
    )


# --- sequences ----------------------------------------------------------------------------------------------------
@dataclass
class Step:
    """What is done: "mode", "play" of rows, "write" by SDO, "move" in pp, "home"; then so many cycles pass."""

    kind: str
    mode: str
    rows: list[int] = field(default_factory=list)
    speed: int = 0
    wait: int = 0

    def __str__(self):
        rows = f" {self.rows[0]} to {self.rows[-1]} in {len(self.rows)}" if self.rows else ""
        return f"{self.kind} {self.mode}{rows}{f' at {self.speed}' * bool(self.speed)}, then {self.wait} cycles"


@dataclass
class Sequence:
    """What is done to which device and load within which travel [rev]."""

    number: int
    device: str
    load: str
    travel: tuple[float, float]
    steps: list[Step]

    def __str__(self):
        head = f"sequence {self.number}: {self.device}, {self.load}, {self.travel[0]:.2f} to {self.travel[1]:.2f} rev"
        return "\n    ".join([head, *map(str, self.steps)])


def draw(number: int, seed: int = 0) -> Sequence:
    """Return sequence `number` of a seed: devices, loads and first modes by turns."""
    rng = random.Random(f"sequence {number} of {seed}")
    device, load = DEVICES[number % 4], LOADS[number // 4 % 4]
    axes = machine(device, load)
    travel = (-rng.uniform(0.5, 4.0), rng.uniform(0.5, 4.0))
    mode = axes.modes[number // 16 % len(axes.modes)]
    steps = [Step("mode", mode)]
    for _ in range(rng.randrange(1, 5)):
        if rng.random() < 0.2:
            mode = rng.choice(axes.modes)
            steps.append(Step("mode", mode))
        steps.append(_draw_step(rng, axes, mode, travel))
    return Sequence(number, device, load, travel, steps)


def _draw_step(rng, axes, mode, travel):
    wait = rng.choice((1, 5, 20, 60, 150))
    if mode == "hm":
        speed = round(axes.speed * axes.fastest * rng.choice((0.02, 0.1, 0.5)))
        return Step("home", mode, [rng.choice(axes.homing)], speed, rng.choice((20, 150, 600)))
    goal = _draw_value(rng, axes, mode, travel)
    if mode == "pp":
        return Step("move", mode, [goal], round(axes.speed * axes.fastest * rng.choice((0.1, 0.5, 1.0))), wait)
    cycles = rng.choice((1, 10, 40, 100))
    if rng.random() < 0.2:
        return Step("write", mode, [goal], wait=wait)
    way = rng.choice(("step", "step", "ramp", "swing"))
    begin = _draw_value(rng, axes, mode, travel) if way == "ramp" and rng.random() < 0.3 else 0
    share = {
        "step": np.ones(cycles),
        "ramp": np.linspace(0.0, 1.0, cycles + 1)[1:],
        "swing": np.sign(np.sin(np.arange(cycles) * 2.0 * np.pi / rng.choice((8, 20, 60)) + 0.1)),
    }[way]
    return Step("play", mode, np.rint(begin + (goal - begin) * share).astype(int).tolist(), wait=wait)


def _draw_value(rng, axes, mode, travel):
    """Return a set-point: a place within the travel, often near an end; a speed; a current."""
    if mode in ("pp", "csp"):
        end = rng.choice(travel)
        return round(axes.turn * rng.choice((end, 0.97 * end, 0.8 * end, rng.uniform(*travel))))
    most = axes.current if mode == "cst" else axes.speed * axes.fastest
    return rng.choice((-1, 1)) * round(most * rng.choice((1.0, 0.5, 0.2, rng.random())))


# --- what comes of them -------------------------------------------------------------------------------------------
@dataclass
class Outcome:
    """How far outside each rotor was at its farthest [rev], negative within; the steps refused; what stopped it."""

    farthest: np.ndarray
    refused: set[int]
    stopped: str = ""


def run(sequence: Sequence, *, envelope: bool, leave_out: Iterable[int] = ()) -> Outcome:
    """Run a sequence but for some of its steps."""
    axes, leave_out = machine(sequence.device, sequence.load), set(leave_out)
    axes.drives.machine.reset()
    bus = TracedBus(axes.drives)
    low, high = (round(end * axes.turn) for end in sequence.travel)
    found = Outcome(np.zeros(0), set())
    safety = Limits(position=(low, high), oscillation=False) if envelope else False
    with suppress(*EXPECTED), MemoryDrives(bus, safety=safety) as drives:
        for number, step in enumerate(sequence.steps):
            if number in leave_out:
                continue
            try:
                _take(drives, step)
            except SafetyError as error:
                if "nothing was sent" not in str(error) and "was not enabled" not in str(error):
                    found.stopped = str(error)
                    break
                found.refused.add(number)
            except EXPECTED as error:
                found.stopped = f"{type(error).__name__}: {error}"
                break
        for _ in range(0 if envelope else AFTERWARDS):  # nobody stops it
            bus.cycle()
    for _ in range(AFTERWARDS if envelope else 0):
        bus.cycle()
    turns = np.array(bus.angles) / TURN
    found.farthest = np.maximum(sequence.travel[0] - turns, turns - sequence.travel[1]).max(axis=0)
    return found


def _take(drives, step):
    """Do one step."""
    rows = np.rint(np.multiply.outer(step.rows, 1.0 - SHARE * np.arange(drives.num_axes))).astype(int)
    if step.kind == "mode":
        motion.enable(drives, mode=step.mode, timeout=ENABLING)
    elif step.kind == "move":
        drives.write(0x6081, step.speed)
        drives.write(POSITION, rows[0])
        drives.write(0x6040, 0x0F)
        drives.write(0x6040, 0x3F)
    elif step.kind == "home":
        drives.write(METHOD, step.rows[0])
        for sub in (1, 2):
            drives.write((HOMING_SPEED, sub), step.speed)
        for word in (0x0F, 0x1F):
            drives.write(0x6040, word)
    elif step.kind == "write":
        drives.write(TARGETS[step.mode], rows[0])
    else:
        drives.record([0x6064], len(step.rows) * 0.001, play={TARGETS[step.mode]: rows})
    drives.advance(step.wait * 0.001)


@dataclass
class Comparison:
    """A sequence with the envelope and without."""

    sequence: Sequence
    watched: Outcome
    alone: Outcome

    @property
    def worse_by(self) -> float:
        """How much farther outside an axis was with the envelope [rev]."""
        return float((self.watched.farthest - np.maximum(self.alone.farthest, 0.0)).max())

    @property
    def farthest(self) -> float:
        """How far outside an axis was with the envelope [rev]."""
        return float(self.watched.farthest.max())

    @property
    def slack(self) -> float:
        """How far outside an axis may be with the envelope [rev]."""
        modes = {step.mode for step in self.sequence.steps}
        return max(SLACK[mode] for mode in modes)

    @property
    def is_wrong(self) -> bool:
        """Whether the envelope made it worse, or left an axis farther outside than its slack."""
        return self.worse_by > SAME or self.farthest > self.slack

    def __str__(self):
        with_it, without = (np.round(one.farthest, 3).tolist() for one in (self.watched, self.alone))
        return (
            f"{self.sequence}\n    outside with the envelope {with_it}, without {without} rev: {self.watched.stopped}"
        )


def compare(numbers: Iterable[int], seed: int = 0) -> list[Comparison]:
    """Return what came of sequences."""
    found = []
    with eds_read_once(), quiet():
        for number in numbers:
            sequence = draw(number, seed)
            watched = run(sequence, envelope=True)
            found.append(Comparison(sequence, watched, run(sequence, envelope=False, leave_out=watched.refused)))
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=10_000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seed", type=int, default=0, help="of the sequences")
    parser.add_argument("--processes", type=int, default=2, help="how many at once")
    given = parser.parse_args()
    begin, numbers, found = time.perf_counter(), range(given.first, given.first + given.count), []
    with ProcessPoolExecutor(
        given.processes, multiprocessing.get_context("spawn"), initializer=end_with_parent
    ) as pool:
        jobs = [pool.submit(compare, numbers[k : k + 100], given.seed) for k in range(0, given.count, 100)]
        for job in as_completed(jobs):
            part = job.result()
            found += part
            for one in part:
                if one.is_wrong:
                    print(one, flush=True)
            print(f"{len(found)} sequences, {time.perf_counter() - begin:.0f} s", flush=True)
    kinds = Counter((one.sequence.device, one.sequence.steps[0].mode) for one in found)
    for kind in sorted(kinds):
        these = [one for one in found if (one.sequence.device, one.sequence.steps[0].mode) == kind]
        print(f"{kind}: {len(these)}, farthest outside {max(one.farthest for one in these):.3f} rev, worse by "
              f"{max(one.worse_by for one in these):.3f} rev")  # fmt: skip
    bad = sum(one.is_wrong for one in found)
    stopped, outside = (sum(map(bool, rows)) for rows in (
        (one.watched.stopped for one in found), (one.alone.farthest.max() > 0 for one in found)
    ))  # fmt: skip
    print(f"{bad} of {len(found)} farther outside with the envelope, or by more than their slack; {stopped} stopped, "
          f"{outside} outside without it")  # fmt: skip
    raise SystemExit(bool(bad))


if __name__ == "__main__":
    main()
