"""An adversary at the controls: random and designed scripts against the envelope, in lockstep, judged from inside.

    python tests/adversary.py --episodes 100000 --processes 2

An episode opens the drive of one of 20 randomised machines with limits of its own, does up to a dozen things that a
policy, a careless script or another master might do, and closes it. The verdict knows nothing of the envelope:

- no axis has current available beyond its travel plus the stopping distance of its machine, measured beforehand, at
  the speed at which it passed the end of its travel, or that it had when it was enabled out there; an axis whose loops
  were changed brakes as well as these let it, and may have current as long as that brings it to rest within a second
  (seen over SLOWING cycles; the voltage goes NOTICED cycles after that ends), and for a stop of LONGEST_STOP at most;
  nobody but the drive itself ends its fault reaction (CiA 402), which has as long;
- no axis whose loops, sensors and limits of current are as commissioned gets there at all, by power or by momentum, if
  its power was on when it passed the end;
- no end stop is met at more than END_STOP_SPEED by such an axis;
- no current stays above its limit, as long as the drive's current sensors are adjusted as they were;
- no axis is left enabled.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import os
import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
from rigs.fault_injection import ANSWER, EXPECTED, ON, RADIANS, TURN, ObservedWorld, WorldBus, eds_read_once

from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError, cia402, motion
from drive_env.canopen.frames import Frame
from drive_env.cia402 import State
from drive_env.devices import find_device

# --- the numbers of the verdict -----------------------------------------------------------------------------------
REACTION = 0.025  # from the end of the travel to the beginning of the ramp: 20 ms, and the cycles at both ends [s]
RAMP_SHARE = 0.5  # of the deceleration that the machine showed when it was commissioned
SLACK = 0.1 * 2.0 * np.pi  # [rad]
SLOW_OUTSIDE = 2.0 * np.pi  # a rotor that creeps back or settles out there [rad/s]
END_STOP_SPEED = 10.0  # of the rotor [rad/s]
CURRENT_MARGIN, CURRENT_TIME = 1.25, 0.030  # of the limit; 10 ms, and the 20 ms in which an envelope acts [s]
SLOWING, LONGEST = 20, 1.0  # cycles over which an axis is seen to slow down; [s] in which it must stand then
NOTICED = 85  # cycles: two measurements of 20 ms, a third that lies across, the baseline of the speed, the command
LONGEST_STOP = 2.1  # [s]
KINDS = ("left enabled", "beyond the travel", "an end stop", "above the limit")
AFTERWARDS = 1500  # cycles after the program's end for the drive's own reaction to a fault, a ramp and a second at most

LOADS = ("inertia", "two_mass", "three_mass", "belt", "ball_screw", "geared_joint", "winder", "belt", "two_mass", "fan")
MACHINES = 20

# Sensors, commutation and loops; what shortens the current that brakes. Whoever writes them may find no brake left.
COMMISSIONING = range(0x2000, 0x3000)
SCALE = 0x2058  # which is no such thing: it moves limits, not loops
CURRENT_SENSORS = 0x2060  # offsets: neither the drive nor whoever reads it can see a current that they hide
UNWRITTEN = (0x1010, 0x1011, 0x2706)  # stores and restores: they outlive the episode, and take seconds


@dataclass
class Bench:
    """A machine, its limits and what it can."""

    number: int
    drives: EmulatedDrives
    limits: Limits
    travel: tuple[float, float]  # of the rotor [rad]
    deceleration: float  # of the rotor [rad/s^2]
    kick: float  # what a quick stop from full torque, with which the velocity loop then begins, adds to its way [rad]
    stops: tuple[float, float] | None  # end stops, as `Truth.load` [rad or m]


def build_bench(number: int, seed: int = 0) -> Bench:
    """Return machine `number` of a seed, with its limits and its measured deceleration."""
    rng = random.Random(f"machine {number} of {seed}")
    drives = EmulatedDrives(
        load=LOADS[number % len(LOADS)], num_threads=1, seed=seed, first_machine=number, randomise=True
    )
    turns = (-rng.uniform(0.5, 3.0), rng.uniform(0.5, 3.0))
    position = (round(turns[0] * TURN), round(turns[1] * TURN))
    velocity, current = round(rng.uniform(8.0, 25.0) * TURN), rng.randrange(2000, 6500)
    travel = drives.load.travel[0] if drives.load.travel else None
    deceleration = measure_deceleration(drives, velocity, current)
    return Bench(
        number,
        drives,
        Limits(position=position, velocity=velocity, current=current),
        (position[0] * RADIANS, position[1] * RADIANS),
        deceleration,
        measure_kick(drives, current),
        travel,
    )


def measure_deceleration(drives: EmulatedDrives, speed: int, current: int) -> float:
    """Return the deceleration of a quick stop from a speed [pps] with a current [mA], measured [rad/s^2]."""
    drives.machine.reset()
    drives.write(0x2003, current)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, speed)
    drives.advance(0.25)
    start, omega = drives.machine.rotor_angle[0], drives.machine.rotor_speed[0]
    motion.quick_stop(drives)
    drives.advance(0.5)
    return float(omega**2 / (2.0 * abs(drives.machine.rotor_angle[0] - start)))


def measure_kick(drives: EmulatedDrives, current: int) -> float:
    """Return the way of a quick stop that begins at a torque [mA], a few milliseconds after standstill [rad]."""
    drives.machine.reset()
    drives.write(0x2003, current)
    motion.enable(drives, mode="cst")
    drives.write(0x6071, current)
    drives.advance(0.005)
    start = drives.machine.rotor_angle[0]
    motion.quick_stop(drives)
    way = 0.0
    for _ in range(100):
        drives.advance(0.005)
        way = max(way, abs(drives.machine.rotor_angle[0] - start))
    return way


# --- what is done -------------------------------------------------------------------------------------------------
class Attack:
    """One episode's program: it acts on drives by a random generator and keeps a diary of what it did."""

    def __init__(self, drives: CanDrives, world: ObservedWorld, bench: Bench, rng: random.Random) -> None:
        self.drives, self.world, self.bench, self.rng = drives, world, bench, rng
        self.diary: list[str] = []
        self.intact = True  # loops, sensors and limits of current are as commissioned
        self.measured = True  # the sensors of the current are
        self.refusals = 0

    def act(self) -> None:
        """Do one thing, whatever comes of it."""
        (action,) = self.rng.choices(ACTIONS, WEIGHTS)
        self.diary.append(action.__name__)
        try:
            action(self)
        except SafetyError as error:
            self.refusals += 1
            self.diary.append(f"  SafetyError: {error}")
        except EXPECTED as error:
            self.diary.append(f"  {type(error).__name__}")

    def write(self, name: int | tuple[int, int], value: int) -> None:
        """Write an object, and note what that does to the axis."""
        index = name if isinstance(name, int) else name[0]
        self.diary.append(f"  write {index:04X}h {'' if isinstance(name, int) else name[1]} = {value}")
        if index in COMMISSIONING and index != SCALE:
            self.intact = False
            self.measured &= index != CURRENT_SENSORS
        with suppress(*(error for error in EXPECTED if error is not KeyboardInterrupt)):
            self.drives.write(name, value)

    def foreign(self, can_id: int, data: bytes) -> None:
        """Have another master send a frame."""
        self.diary.append(f"  another master: {can_id:03X} {data.hex(' ')}")
        with self.world.lock:
            self.world.receive(Frame(can_id, data), "another master")

    def position(self) -> int:
        """Return a position near an end of the travel, beyond it, or anywhere."""
        low, high = self.bench.limits.position or (0, 0)
        end = self.rng.choice((low, high))
        return self.rng.choice((end, end * 2, round(end * 0.9), 10 * end, self.rng.randrange(low, high), 0, 2**31 - 1))

    def speed(self) -> int:
        top = self.bench.limits.velocity or 0
        return self.rng.choice((-1, 1)) * self.rng.choice((top, top // 2, top // 10, top + 1, 2**31 - 1, 0))

    def torque(self) -> int:
        top = self.bench.limits.current or 0
        return self.rng.choice((-1, 1)) * self.rng.choice((top, top // 2, top // 10, top + 1, 0))


def enable(attack: Attack) -> None:
    mode = attack.rng.choice(("pp", "pv", "csp", "csv", "cst"))
    attack.diary.append(f"  {mode}")
    motion.enable(attack.drives, mode=mode, timeout=0.02)


def run(attack: Attack) -> None:
    """Enable and be off: the commonest beginning."""
    mode = attack.rng.choice(("pv", "csv", "cst", "pp"))
    motion.enable(attack.drives, mode=mode, timeout=0.02)
    attack.diary.append(f"  {mode}")
    if mode == "cst":
        attack.write(0x6071, attack.torque())
    elif mode == "pp":
        attack.write(0x6081, abs(attack.speed()))
        attack.write(0x607A, attack.position())
        attack.drives.write(0x6040, attack.rng.choice((0x1F, 0x5F, 0x3F)))
    else:
        attack.write(0x60FF, attack.speed())
    attack.drives.advance(attack.rng.choice((0.02, 0.05, 0.15)))


def wait(attack: Attack) -> None:
    attack.drives.advance(attack.rng.choice((0.001, 0.01, 0.03, 0.1)))


def look(attack: Attack) -> None:
    """Poll, which lets no time pass in lockstep, and then let some."""
    for _ in range(attack.rng.randrange(10)):
        attack.drives.read(attack.rng.choice((0x6041, 0x6064, 0x606C, 0x6077)))
    attack.drives.advance(0.005)


def controlword(attack: Attack) -> None:
    words = (0x00, 0x02, 0x06, 0x07, 0x0F, 0x1F, 0x3F, 0x5F, 0x7F, 0x80, 0x8F, 0x10F, 0x0B, attack.rng.getrandbits(16))
    attack.write(0x6040, attack.rng.choice(words))


def change_mode(attack: Attack) -> None:
    attack.write(0x6060, attack.rng.choice((*cia402.MODES.values(), 0, 2, 7, -1)))


def set_target(attack: Attack) -> None:
    name = attack.rng.choice((0x607A, 0x60FF, 0x6071, 0x60B0, 0x60B1, 0x60B2))
    value = {0x607A: attack.position, 0x60B0: attack.position, 0x6071: attack.torque, 0x60B2: attack.torque}
    attack.write(name, value.get(name, attack.speed)())


def set_profile(attack: Attack) -> None:
    name = attack.rng.choice((0x6081, 0x6083, 0x6084, 0x6085, 0x605A, 0x605D, 0x605E, 0x60F2, (0x60C2, 1)))
    attack.write(name, attack.rng.choice((0, 1, 2, 6, 1000, TURN, 500 * TURN, 2**31 - 1)))


def set_limits(attack: Attack) -> None:
    name = attack.rng.choice(((0x607D, 1), (0x607D, 2), 0x6065, 0x6067, 0x607C, 0x6098))
    attack.write(name, attack.rng.choice((0, 35, -(2**31), 2**31 - 1, attack.position(), TURN)))


def change_scale(attack: Attack) -> None:
    attack.write(SCALE, attack.rng.choice((1, 256, 1024, 65535, 65536, 131072)))


def write_anything(attack: Attack) -> None:
    entry = attack.rng.choice(WRITABLE)
    low, high = entry.low or 0, entry.high or 0
    value = attack.rng.choice((low, high, 0, 1, (low + high) // 2, attack.rng.randint(low, high)))
    attack.write((entry.index, entry.sub), value)


def change_gains(attack: Attack) -> None:
    name = attack.rng.choice(((0x2041, 1), (0x2041, 2), (0x2042, 1), (0x2042, 2), (0x2043, 1)))
    attack.write(name, attack.rng.choice((0, 1, 50, 1000, 10_000, 32_767)))


def move_relatively(attack: Attack) -> None:
    """Stack moves: each is inside, counted from where the axis is now."""
    motion.select_mode(attack.drives, "pp")
    low, high = attack.bench.limits.position or (0, 0)
    distance = round(attack.rng.choice((low, high)) * attack.rng.uniform(0.3, 0.9))
    for _ in range(attack.rng.randrange(1, 5)):
        attack.diary.append(f"  relative by {distance}")
        motion.start_move(attack.drives, distance, relative=True, timeout=0.01)
    attack.drives.advance(0.05)


def home(attack: Attack) -> None:
    """Call this place home, or look for it."""
    attack.write(0x6098, attack.rng.choice((35, 35, 35, 17, 18, 19, 21)))
    for name in ((0x6099, 1), (0x6099, 2)):
        attack.write(name, abs(attack.speed()))
    attack.write(0x609A, 500 * TURN)
    motion.home(attack.drives, timeout=0.1)


def play(attack: Attack) -> None:
    """A policy: rows of set-points, all at once or cycle by cycle, the last towards an end of the travel."""
    mode, name, value = attack.rng.choice((
        ("csp", 0x607A, attack.position), ("csv", 0x60FF, attack.speed), ("cst", 0x6071, attack.torque),
        ("csp", 0x60B0, attack.position), ("csv", 0x60B1, attack.speed),
    ))  # fmt: skip
    attack.diary.append(f"  {mode} by {name:04X}h")
    motion.enable(attack.drives, mode=mode, timeout=0.02)
    cycles = attack.rng.randrange(5, 80)
    goal, way = value(), attack.rng.choice(("step", "ramp", "bang-bang"))
    share = {
        "step": np.ones(cycles),
        "ramp": np.linspace(0, 1, cycles),
        "bang-bang": np.sign(np.sin(np.arange(cycles))),
    }
    rows = np.clip(np.rint(goal * share[way]), -(2**31), 2**31 - 1).astype(int)
    watched = attack.rng.choice(
        ([0x6064], [0x606C, 0x6077], [0x6041], [0x6062, 0x6063, 0x606C, 0x60FF, 0x60B0, 0x60B1])
    )
    attack.diary.append(f"  {way} to {goal} in {cycles} cycles, {len(watched)} objects recorded")
    if attack.rng.random() < 0.5:
        attack.drives.record(watched, cycles * 0.001, play={name: rows})
        return
    for row in rows:
        attack.drives.record(watched, 0.001, play={name: [row]})


def play_words(attack: Attack) -> None:
    """Enable by rows of controlwords, a set-point beside them."""
    motion.select_mode(attack.drives, attack.rng.choice(("pv", "cst")))
    words = np.repeat([0x06, 0x07, 0x0F, attack.rng.choice((0x0F, 0x8F, 0x02, 0x10F))], [5, 5, 60, 30])
    attack.drives.record([0x6041], 0.1, play={0x6040: words, 0x60FF: np.full(100, attack.speed())})


def be_another_master(attack: Attack) -> None:
    """NMT for everybody, a set-point, an enabling word."""
    node = 1
    frames = (
        (0x000, bytes((attack.rng.choice((0x01, 0x02, 0x80, 0x82)), 0))),
        (0x600 + node, b"\x23\xff\x60\x00" + attack.speed().to_bytes(4, "little", signed=True)),
        (0x600 + node, bytes.fromhex("2B 40 60 00 0F 00 00 00")),
        (0x600 + node, bytes.fromhex("2F 60 60 00 03 00 00 00")),
        (0x77F, b"\x05"),
    )
    for _ in range(attack.rng.randrange(1, 4)):
        attack.foreign(*attack.rng.choice(frames))


def reset_fault(attack: Attack) -> None:
    motion.reset_fault(attack.drives, timeout=0.01)
    attack.drives.emergencies()


def stop_and_go(attack: Attack) -> None:
    motion.quick_stop(attack.drives)
    attack.drives.advance(attack.rng.choice((0.001, 0.01, 0.05)))
    enable(attack)


_WEIGHTED: dict[Callable[[Attack], None], float] = {
    enable: 6, run: 14, wait: 10, look: 3, controlword: 5, change_mode: 4, set_target: 8, set_profile: 4, set_limits: 3,
    change_scale: 2, write_anything: 4, change_gains: 3, move_relatively: 4, home: 2, play: 14, play_words: 2,
    be_another_master: 3, reset_fault: 2, stop_and_go: 3,
}  # fmt: skip
ACTIONS, WEIGHTS = list(_WEIGHTED), list(_WEIGHTED.values())
WRITABLE = [
    entry
    for entry in find_device("tmcm1636").new_dictionary()
    if entry.access == "rw" and entry.bits is not None and entry.index not in UNWRITTEN
]


# --- one episode --------------------------------------------------------------------------------------------------
@dataclass
class Episode:
    """What came of one: what is wrong, what was done, and what shows that something happened."""

    number: int
    problems: list[str]
    diary: list[str]
    refused: bool = False
    outside: bool = False
    cycles: int = 0


def run_episode(bench: Bench, number: int, seed: int = 0, *, envelope: bool = True) -> Episode:
    """Run episode `number` of a seed on a machine; without the envelope the verdict should have much to say."""
    rng = random.Random(f"episode {number} of {seed}")
    bench.drives.machine.reset()
    world = ObservedWorld(bench.drives, lockstep=True)
    bus = WorldBus(world)
    attack, crash = None, []
    try:
        with CanDrives(bus=bus, pace="lockstep", timeout=ANSWER, safety=bench.limits if envelope else False) as drives:
            attack = Attack(drives, world, bench, rng)
            for _ in range(rng.randrange(3, 10)):
                attack.act()
            if rng.random() < 0.3:
                raise KeyboardInterrupt
    except EXPECTED:
        pass
    except Exception as error:  # a mistake of ours, to be told with the script that leads to it
        crash = [f"{type(error).__name__}: {error}"]
    end = world.cycles
    while world.cycles == end or (world.truth.is_on()[0] and world.cycles < end + AFTERWARDS):
        world.cycle()
    bus.shutdown()
    diary = attack.diary if attack else []
    found = judge(bench, world, attack is None or attack.intact, attack is None or attack.measured)
    episode = Episode(number, crash + found, diary, cycles=world.cycles)
    theta = world.truth.theta()[:, 0]
    episode.refused = attack is not None and attack.refusals > 0
    episode.outside = bool(((theta < bench.travel[0]) | (theta > bench.travel[1])).any())
    return episode


def judge(bench: Bench, world: ObservedWorld, intact: bool, measured: bool = True) -> list[str]:
    """Return what is wrong with what a machine did in an episode.

    Args:
        bench: The machine.
        world: What it did.
        intact: Loops, sensors and limits of current were as commissioned.
        measured: The sensors of the current were.
    """
    truth = world.truth
    theta, omega = truth.theta()[:, 0], truth.omega()[:, 0]
    on, current = np.isin(truth.fsa()[:, 0], ON), truth.current()[:, 0]
    brakes = braking(omega, truth.fsa()[:, 0] == State.QUICK_STOP_ACTIVE)
    brakes |= reacting(truth.fsa()[:, 0] == State.FAULT_REACTION_ACTIVE)
    found = []
    if on[-1]:
        found.append("left enabled")
    for outside, outward in ((bench.travel[0] - theta, -omega), (theta - bench.travel[1], omega)):
        for first, last in excursions(outside > 0.0, truth.fsa()[:, 0] == State.OPERATION_ENABLED):
            speed = np.abs(omega[first : first + round(REACTION * 1000) + 1]).max()
            predicted = speed * REACTION + speed**2 / (2.0 * RAMP_SHARE * bench.deceleration) + bench.kick + SLACK
            # Power, or the momentum of an axis that could have been stopped.
            # Weak loops may swing an axis back towards its travel.
            counts = (on[first:last] | on[first]) if intact else (on & ~brakes & (outward > 0.0))[first:last]
            way = outside[first:last] - max(outside[first - 1] if first else 0.0, 0.0)
            beyond = (way > predicted) & counts & (np.abs(omega[first:last]) > SLOW_OUTSIDE)
            if beyond.any():
                worst = outside[first:last][beyond].max()
                found.append(
                    f"{worst / 2 / np.pi:.2f} turns beyond the travel, {predicted / 2 / np.pi:.2f} predicted at "
                    f"{speed / 2 / np.pi:.1f} turns/s{'' if intact else ' (loops not as commissioned)'}"
                )
    if bench.stops is not None and intact:
        hit = (truth.load()[:, 0] <= bench.stops[0]) | (truth.load()[:, 0] >= bench.stops[1])
        for first, _ in runs(hit):
            if abs(omega[first]) > END_STOP_SPEED and on[max(first - 100, 0) : first].any():
                found.append(f"an end stop met at {abs(omega[first]):.0f} rad/s")
    limit = (bench.limits.current or 0) * 1e-3
    longest = max((last - first for first, last in runs(current > CURRENT_MARGIN * limit)), default=0)
    if measured and longest > CURRENT_TIME * 1000:
        found.append(f"{current.max():.1f} A, above the limit of {limit:.1f} A for {longest} ms")
    return found


def braking(omega: np.ndarray, stopping: np.ndarray) -> np.ndarray:
    """Return the cycles in which an axis in a quick stop [rad/s] is slowing down, or was so a moment ago."""
    before = np.abs(np.concatenate([omega[:1].repeat(SLOWING), omega])[: len(omega)])
    rate = (before - np.abs(omega)) / (SLOWING * 0.001)
    cycle = np.arange(len(omega))
    begun = np.maximum.accumulate(np.where(stopping, -1, cycle))  # the last cycle before the stop
    slowed = np.maximum.accumulate(np.where(~stopping | (rate * LONGEST >= np.abs(omega)), cycle, -1))
    return stopping & (cycle - slowed <= NOTICED) & (cycle - begun <= LONGEST_STOP * 1000)


def reacting(reaction: np.ndarray) -> np.ndarray:
    """Return the cycles of fault reactions that the drive has not ended too late."""
    cycle = np.arange(len(reaction))
    return reaction & (cycle - np.maximum.accumulate(np.where(reaction, -1, cycle)) <= LONGEST_STOP * 1000)


def excursions(outside: np.ndarray, enabled: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end of each run outside; whoever is enabled out there begins another."""
    found = []
    for first, last in runs(outside):
        starts = [first, *(first + 1 + np.flatnonzero(enabled[first + 1 : last] & ~enabled[first : last - 1])).tolist()]
        found += zip(starts, [*starts[1:], last], strict=True)
    return found


def runs(true: np.ndarray) -> list[tuple[int, int]]:
    """Return begin and end of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], true.astype(int), [0]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


# --- many ---------------------------------------------------------------------------------------------------------
@dataclass
class Tally:
    """What came of many episodes."""

    episodes: int = 0
    refused: int = 0  # episodes in which the envelope refused or stopped something
    outside: int = 0  # in which the axis left its travel at all
    bad: list[Episode] = field(default_factory=list)

    def add(self, episode: Episode) -> None:
        self.episodes += 1
        self.refused += episode.refused
        self.outside += episode.outside
        if episode.problems:
            self.bad.append(episode)

    def merge(self, other: Tally) -> None:
        self.episodes += other.episodes
        self.refused += other.refused
        self.outside += other.outside
        self.bad += other.bad

    def text(self, most: int = 10) -> str:
        """Return the episodes that went wrong, empty if none did."""
        if not self.bad:
            return ""
        shown = [
            "\n".join([f"episode {one.number}: {'; '.join(one.problems)}", *(f"    {line}" for line in one.diary)])
            for one in sorted(self.bad, key=lambda one: len(one.diary))[:most]
        ]
        return "\n".join([f"{len(self.bad)} of {self.episodes} episodes: {self.kinds()}", *shown])

    def kinds(self) -> dict[str, int]:
        """Return how many problems of each kind there were."""
        return dict(Counter(kind_of(problem) for one in self.bad for problem in one.problems))


def kind_of(problem: str) -> str:
    """Return what kind of problem a text of `judge` tells."""
    return next((kind for kind in KINDS if kind in problem), "mistake of ours")


@contextmanager
def quiet() -> Iterator[None]:
    """Have the library's log silent: it tells each of thousands of stops."""
    before = logging.root.manager.disable
    logging.disable()
    try:
        yield
    finally:
        logging.disable(before)


def attack_machines(numbers: Iterable[int], seed: int = 0) -> Tally:
    """Run episodes; machine k has those whose number leaves the rest k by division by 20."""
    tally, benches = Tally(), {}
    with eds_read_once(), quiet():
        for number in numbers:
            machine = number % MACHINES
            if machine not in benches:
                benches[machine] = build_bench(machine, seed)
            tally.add(run_episode(benches[machine], number, seed))
    for bench in benches.values():
        bench.drives.close()
    return tally


def end_with_parent() -> None:
    """Have a worker process end when the program that started it does, however that ended: its queue is long."""
    parent = multiprocessing.parent_process()
    assert parent is not None, "only workers have a parent"

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=100_000, help="how many")
    parser.add_argument("--first", type=int, default=0, help="number of the first; one alone is told with its diary")
    parser.add_argument("--seed", type=int, default=0, help="of machines and scripts")
    parser.add_argument("--processes", type=int, default=2, help="how many at once")
    given = parser.parse_args()
    from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    numbers = range(given.first, given.first + given.episodes)
    chunk = max(min(500, given.episodes // given.processes), 1)
    tally, begin = Tally(), time.perf_counter()
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn(), TextColumn("{task.fields[bad]} wrong"))
    with (
        ProcessPoolExecutor(given.processes, multiprocessing.get_context("spawn"), initializer=end_with_parent) as pool,
        Progress(*columns, TimeRemainingColumn()) as progress,
    ):
        task = progress.add_task("episodes", total=given.episodes, bad=0)
        jobs = [pool.submit(attack_machines, numbers[k : k + chunk], given.seed) for k in range(0, len(numbers), chunk)]
        for job in as_completed(jobs):
            part = job.result()
            tally.merge(part)
            progress.update(task, advance=part.episodes, bad=len(tally.bad))
            if part.bad:  # at once: a long run may be ended before its end
                print(part.text(), flush=True)
            if not progress.console.is_terminal:
                print(f"{tally.episodes} of {given.episodes} episodes, {len(tally.bad)} wrong", flush=True)
    seconds = time.perf_counter() - begin
    print(f"{tally.episodes} episodes in {seconds:.0f} s, {tally.episodes / seconds:.0f}/s; in {tally.refused} the "
          f"envelope refused or stopped something, in {tally.outside} the axis left its travel")  # fmt: skip
    print(f"{len(tally.bad)} went wrong: {tally.kinds()}" if tally.bad else "nothing went wrong")
    raise SystemExit(bool(tally.bad))


if __name__ == "__main__":
    main()
