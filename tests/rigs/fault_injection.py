"""Faults at frame k of a master's session, and what the machine truly did meanwhile.

`ObservedWorld` is an emulated bus that notes rotor, stage and automaton after every communication cycle, read inside
the emulator: no answer of a drive and no word of a master enters the verdict. `FaultyBus` is a master's python-can bus
that loses, delays or doubles its frame k, or does something when it comes. `Programs` runs sessions as processes of
their own that send themselves a signal at frame k: a process that has imported everything forks once per case.
"""

from __future__ import annotations

import json
import os
import random
import signal
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import can
import numpy as np

from drive_env import CanDrives, Limits, ObjectAccessError, SafetyError, cia402, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.canopen.nmt import Command
from drive_env.cia402 import State
from drive_env.dictionary import entries
from drive_env.fieldbus import description
from drive_env.fieldbus.errors import BusError
from drive_env.firmware.record import LANES
from drive_env.master.can.port import open_bus

TURN = 65536  # increments
RADIANS = 2.0 * np.pi / TURN

# --- the numbers of the verdict -----------------------------------------------------------------------------------
SILENCE = 0.3  # after which a drive must have noticed that its master died [s]; a busy computer holds a heartbeat up
TRAVEL = (-3 * TURN, 3 * TURN)
LIMITS = Limits(position=TRAVEL, silence=SILENCE)
# Half of what the commissioned drives decelerate with (6085h = 1000 turns/s^2): tracking of the ramp is not perfect.
DECELERATION = 0.5 * 1000.0 * 2.0 * np.pi  # [rad/s^2]
DEAD_MASTER = SILENCE + 0.05  # from the death to the beginning of the ramp: the last heartbeat, and a cycle or two [s]
LIVING_MASTER = 0.1  # from a limit to the beginning of the ramp; 20 ms, and what a busy computer adds [s]
SLACK = 0.1 * 2.0 * np.pi  # settling, encoder error [rad]
REST = 1.0  # below this a rotor stands: cogging and noise of the sensors move it by less [rad/s]
ANSWER = 0.002  # in lockstep an answer is there before the question has returned [s]
WORLD_PATIENCE = 3.0  # of the world's time for everything to come to rest [s]
PATIENCE = 30.0  # of the wall clock, for a busy computer [s]


# --- truth --------------------------------------------------------------------------------------------------------
ON = (int(State.OPERATION_ENABLED), int(State.QUICK_STOP_ACTIVE), int(State.FAULT_REACTION_ACTIVE))


class Truth:
    """What rotors, stages and automata of a set of emulated drives did, one row per communication cycle.

    theta, omega: Rotor angle and speed [rad, rad/s], shape (cycles, num_axes).
    current: Magnitude of the motor current, of a stepper's vector [A]; fsa: state of the automaton; alike.
    load: Position of the part of the load that meets end stops [rad or m]; alike.
    """

    def __init__(self, drives):
        self.num_axes = drives.num_axes
        records = drives.inside.records
        self._currents = ("i_q", "i_d") if "i_q" in records.dtype.names else ("i_a", "i_b")
        self._fields = ("theta_m", "omega_m", *self._currents, "fsa", "load_position")
        self._views = [records[name] for name in self._fields]
        self._rows = [np.empty((4096, *view.shape), view.dtype) for view in self._views]
        self.cycles = 0
        self.sample()

    def sample(self):
        k = self.cycles
        if k == len(self._rows[0]):
            self._rows = [np.concatenate([rows, np.empty_like(rows)]) for rows in self._rows]
        for rows, view in zip(self._rows, self._views, strict=True):
            rows[k] = view
        self.cycles = k + 1

    def _get(self, name, since=0):
        rows = self._rows[self._fields.index(name)][since : self.cycles]
        return rows.reshape(len(rows), -1, LANES).reshape(len(rows), -1)[:, : self.num_axes]

    def theta(self, since=0):
        return self._get("theta_m", since)

    def omega(self, since=0):
        return self._get("omega_m", since)

    def current(self, since=0):
        return np.hypot(*(self._get(name, since) for name in self._currents))

    def fsa(self, since=0):
        return self._get("fsa", since)

    def load(self, since=0):
        return self._get("load_position", since)

    def is_on(self):
        """Whether each axis has current available now, shape (num_axes,)."""
        return np.isin(self.fsa(self.cycles - 1)[-1], ON)

    def stands(self):
        """Whether each axis has stood still for the last 20 cycles, shape (num_axes,)."""
        return (np.abs(self.omega(max(self.cycles - 20, 0))) < REST).all(axis=0)

    def at_rest(self):
        return bool((self.stands() & ~self.is_on()).all())


class ObservedWorld(World):
    """A world whose `truth` is noted after every cycle; its one set of drives is handed in."""

    def __init__(self, drives, node_ids=(1,), *, lockstep):
        super().__init__(lockstep=lockstep)
        self.add(drives, list(node_ids))
        self.truth = Truth(drives)
        self.lock = threading.RLock()  # whoever sends in lockstep runs the world

    def cycle(self):
        super().cycle()
        self.truth.sample()


def overshoot(theta, omega, travel, reaction, deceleration=DECELERATION):
    """Return by how much one axis went beyond its travel and the stopping distance predicted at its end [rad].

    Args:
        theta, omega: The axis' angle and speed [rad, rad/s], shape (cycles,).
        travel: Lowest and highest angle [rad].
        reaction: From the end of the travel to the beginning of the ramp [s].
        deceleration: Of the ramp [rad/s^2].
    """
    worst = -np.inf
    for outside in (travel[0] - theta, theta - travel[1]):
        beyond = outside > 0.0
        crossings = np.flatnonzero(beyond & ~np.concatenate([[False], beyond[:-1]]))
        for first in crossings:
            last = first + int(np.argmin(beyond[first:])) if not beyond[first:].all() else len(beyond)
            # Torque may still accelerate it until somebody reacts.
            speed = np.abs(omega[first : first + int(reaction * 1000.0) + 1]).max()
            predicted = speed * reaction + speed**2 / (2.0 * deceleration) + SLACK
            worst = max(worst, outside[first:last].max() - predicted)
    return worst


def problems(truth, travel=TRAVEL, reaction=DEAD_MASTER, since=0):
    """Return what is wrong with how the axes ended and where they were [increments, s]: a list of texts."""
    found = []
    for axis in range(truth.num_axes):
        if truth.is_on()[axis]:
            found.append(f"axis {axis} is left in {State(int(truth.fsa()[-1, axis])).name}")
        if not truth.stands()[axis]:
            found.append(f"axis {axis} turns at {truth.omega()[-1, axis]:.1f} rad/s")
        theta = truth.theta(since)[:, axis]
        ends = (travel[0] * RADIANS, travel[1] * RADIANS)
        if (over := overshoot(theta, truth.omega(since)[:, axis], ends, reaction)) > 0.0:
            turns = theta[np.argmax(np.abs(theta))] / (2.0 * np.pi)
            found.append(
                f"axis {axis} got to {turns:.2f} turns, {over / 2 / np.pi:.2f} beyond travel and stopping distance"
            )
    return found


def until(condition, what="it", patience=PATIENCE):
    """Wait for what another thread or process does."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, f"{what} never came"
        time.sleep(0.002)


@contextmanager
def no_longer_than(seconds):
    """Have the test fail that hangs in what it tests; where there are alarms."""

    def hangs(*_):
        raise HangError(f"it did not end within {seconds:g} s")

    if not hasattr(signal, "setitimer"):
        yield
        return
    before = signal.signal(signal.SIGALRM, hangs)
    signal.setitimer(signal.ITIMER_REAL, seconds, seconds)  # again and again: the way out may hang, too
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


class HangError(BaseException):
    """Something waits for ever; nothing that tidies up may catch it."""


def rest(world, within=WORLD_PATIENCE):
    """Wait until everything in a world that runs in real time is at rest, or that long has passed in it [s]."""
    end = world.cycles + round(within * 1000)
    until(lambda: world.truth.at_rest() or world.cycles >= end, "the end of the wait")


@contextmanager
def served(drives, node_ids=(1,)):
    """Serve drives in real time, in a thread of this process; yield the world and its channel."""
    drives.machine.reset()
    world, hub = ObservedWorld(drives, node_ids, lockstep=False), Hub()
    with Server(world, hub):
        yield world, hub.channel


@contextmanager
def eds_read_once():
    """Have files of object dictionaries read once: parsing is nine tenths of opening drives in lockstep."""
    before = entries.read_eds
    once = cache(before)
    entries.read_eds = description.read_eds = once
    try:
        yield
    finally:
        entries.read_eds = description.read_eds = before


# --- the master's bus ---------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Fault:
    """What happens to a frame: it is lost, doubled, or delayed until two more frames of the master have gone out."""

    kind: str  # lose, double, delay
    frame: int


OVERTAKEN_BY = 2  # frames of the master that go before a delayed one


class FaultyBus(can.BusABC):
    """A master's bus around another one: it numbers the frames of both directions and does something at some of them.

    Attributes:
        count: Frames so far.
        meets: Called with the number and the message before a frame passes; False keeps it from passing.

    Args:
        inner: The bus.
        fault: What happens to one frame.
        meets: As above.
    """

    def __init__(self, inner, fault=None, meets=None):
        super().__init__(channel="faulty")
        self.inner = inner
        self.count = 0
        self.meets = meets
        self._fault = fault
        self._held = []  # [frames of the master until it goes on, outward, message]
        self._late = deque()  # for the master
        self._lock = threading.RLock()
        self._gone = False

    def cut(self):
        """Pull the adapter out: to the drives it is the master's death."""
        self._gone = True

    def send(self, msg, timeout=None):
        if self._gone:
            raise can.CanOperationError("the adapter is gone")
        with self._lock:
            passing = self._pass(msg, True)
            released = [held for held in self._held if held[0] <= 1]
            self._held = [(left - 1, *rest) for left, *rest in self._held if left > 1] + passing[1]
            for one in passing[0]:
                self.inner.send(one, timeout)
            for _, outward, one in released:
                if outward:
                    self.inner.send(one, timeout)
                else:
                    self._late.append(one)

    def _recv_internal(self, timeout):
        if self._gone:
            raise can.CanOperationError("the adapter is gone")
        if not self._late:
            message = self.inner.recv(timeout)
            if message is None:
                return None, True
            with self._lock:
                passing, held = self._pass(message, False)
                self._late.extend(passing)
                self._held += held
        return (self._late.popleft() if self._late else None), True

    def _pass(self, message, outward):
        """Return the frames that pass now, and those that are held."""
        number, self.count = self.count, self.count + 1
        if self.meets is not None and self.meets(number, message) is False:
            return [], []
        if self._fault is None or self._fault.frame != number:
            return [message], []
        return {
            "lose": ([], []),
            "double": ([message, message], []),
            "delay": ([], [(OVERTAKEN_BY, outward, message)]),
        }[self._fault.kind]

    def shutdown(self):
        super().shutdown()
        self.inner.shutdown()


class WorldBus(can.BusABC):
    """A python-can bus with an observed world in lockstep at its other end."""

    def __init__(self, world):
        super().__init__(channel="world")
        self._world = world
        self._waiting = deque()
        self._heard = threading.Condition(world.lock)
        world.power_on()
        world.listeners.append(self._hear)

    def send(self, msg, timeout=None):
        with self._heard:
            self._world.receive(Frame(msg.arbitration_id, bytes(msg.data), msg.is_remote_frame), self)

    def _hear(self, ended):
        if ended.sender is not self:
            frame = ended.frame
            self._waiting.append(
                can.Message(
                    arbitration_id=frame.can_id, data=frame.data, is_remote_frame=frame.rtr, is_extended_id=False
                )
            )
            self._heard.notify_all()

    def _recv_internal(self, timeout):
        with self._heard:
            if not self._waiting and timeout:
                self._heard.wait(timeout)
            return (self._waiting.popleft() if self._waiting else None), True

    def shutdown(self):
        super().shutdown()
        self._world.listeners.remove(self._hear)


# --- sessions -----------------------------------------------------------------------------------------------------
# Short ones: every frame of theirs is tried.
def pp_move(drives):
    """A move, another one that replans it under way, and a stop by ramp."""
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 10 * TURN)
    motion.start_move(drives, TURN // 16)
    drives.advance(0.02)
    motion.start_move(drives, -TURN // 32, relative=True)
    drives.advance(0.01)
    stop_by_ramp(drives)


def pv_run(drives):
    """Speed, another speed, and a stop by ramp."""
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 10 * TURN)
    drives.advance(0.02)
    drives.write("Target velocity", -5 * TURN)
    drives.advance(0.01)
    stop_by_ramp(drives)


def csp_play(drives):
    """A path, played in one call, and the stop left to the end of the program."""
    motion.enable(drives, mode="csp")
    path = TURN // 16 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 30)))
    drives.record([0x6064, 0x606C], 0.03, play={0x607A: np.rint(path).astype(int)})


def cst_play(drives):
    """A policy in torque, cycle by cycle; it leaves the axis turning."""
    motion.enable(drives, mode="cst")
    for k in range(24):
        drives.record([0x6064, 0x606C, 0x6077], 0.001, play={0x6071: [900 if k < 16 else -300]})


def gain_trial(drives):
    """Gains are tried by a step of speed, and put back."""
    before = drives.read((0x2042, 1))
    motion.enable(drives, mode="pv")
    try:
        for gain in (400, 600):
            drives.write((0x2042, 1), gain)
            drives.record([0x606C, 0x6077], 0.02, play={0x60FF: np.repeat([6 * TURN, 0], 10)})
    finally:
        drives.write((0x2042, 1), before)
    motion.disable(drives)


def restarted_node(drives):
    """A node is stopped under an axis that has turned and is off, as by another master; it is started, and moves."""
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 10 * TURN)
    drives.advance(0.02)
    stop_by_ramp(drives)
    drives.link.port.send(0x000, bytes((Command.STOP, drives.nodes[0])))
    drives.start_node()
    motion.enable(drives, mode="pp")
    motion.start_move(drives, TURN // 16)
    drives.advance(0.02)
    stop_by_ramp(drives)


def stop_by_ramp(drives):
    motion.quick_stop(drives)
    for _ in range(100):
        drives.advance(0.005)
        if cia402.matches(drives.read(0x6041), cia402.SWITCH_ON_DISABLED).all():
            return
    raise TimeoutError("the ramp of the quick stop did not end in 0.5 s")


TO_AND_FRO = 5 * TURN  # pps


def run_on(drives):
    """Speed to and fro within a turn and a half, for ever."""
    motion.enable(drives, mode="pv")
    while True:
        for speed in (TO_AND_FRO, -TO_AND_FRO):
            drives.write("Target velocity", speed)
            drives.advance(0.25)


SESSIONS: dict[str, Callable[[CanDrives], None]] = {
    session.__name__: session for session in (pp_move, pv_run, csp_play, cst_play, gain_trial, restarted_node)
}


# What ends a session that met a fault; anything else is a mistake of ours.
EXPECTED = (SafetyError, BusError, ObjectAccessError, TimeoutError, RuntimeError, KeyboardInterrupt)


def run_lockstep(drives, session, fault=None, interrupts=(), limits=LIMITS):
    """Run a session in this thread, its time passing by SYNC; return its truth, its frames and what ended it.

    Args:
        drives: Emulated drives; they begin at rest at 0.
        session: The session.
        fault: What happens to one frame.
        interrupts: Frames at which Ctrl-C is pressed.
        limits: The envelope's.
    """
    drives.machine.reset()
    world = ObservedWorld(drives, lockstep=True)
    inner = WorldBus(world)

    def meets(number, _):
        if number in interrupts:
            signal.raise_signal(signal.SIGINT)

    bus = FaultyBus(inner, fault, meets if interrupts else None)
    ended = opened = None
    try:
        with CanDrives(drives.device.name, bus=bus, pace="lockstep", timeout=ANSWER, safety=limits) as opened:
            session(opened)
    except EXPECTED as error:
        ended = error
    if opened is not None:
        with suppress(*EXPECTED):
            opened.close()  # as the interpreter does on its way out
    # The program is over, and the drives' time goes on.
    for _ in range(round(WORLD_PATIENCE * 1000)):
        if world.truth.at_rest():
            break
        world.cycle()
    bus.shutdown()
    return world.truth, bus.count, ended


def run_real_time(drives, session, fault=None, limits=LIMITS):
    """Run a session in this thread against drives served in real time; return the truth and the frames."""
    with served(drives) as (world, channel):
        bus = FaultyBus(open_bus(channel=channel), fault)
        opened = None
        try:
            with CanDrives(bus=bus, timeout=0.1, safety=limits) as opened:
                session(opened)
        except EXPECTED:
            pass
        if opened is not None:
            with suppress(*EXPECTED):
                opened.close()  # as the interpreter does on its way out
        rest(world)
        bus.shutdown()
        return world.truth, bus.count


KINDS = ("lose", "double", "delay", "interrupt", "three interrupts")


def run_with(drives, session, kind, frame, limits=LIMITS, travel=TRAVEL):
    """Run a session in lockstep with a fault of KINDS at a frame; return what is wrong, as texts."""
    if "interrupt" in kind:
        pressed = (frame,) if kind == "interrupt" else (frame, frame + 1, frame + 2)
        with no_interrupt_left():
            truth, _, _ = run_lockstep(drives, session, interrupts=pressed, limits=limits)
    else:
        truth, _, _ = run_lockstep(drives, session, Fault(kind, frame), limits=limits)
    return problems(truth, travel=travel)


def sample(rng: random.Random, frames: int, count: int) -> list[int]:
    """Return `count` frames of a session's `frames`, one from each of as many equal parts."""
    edges = np.linspace(0, frames, count + 1).astype(int)
    return [rng.randrange(low, max(high, low + 1)) for low, high in pairwise(edges)]


class OtherMaster:
    """Another master on the bus, who asks nobody."""

    def __init__(self, channel, node=1):
        self._bus = open_bus(channel=channel)
        self._node = node

    def send(self, can_id, data):
        self._bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def write(self, index, value, size, sub=0):
        """Write an object by SDO and give the node time to take it."""
        command = 0x23 | (4 - size) << 2
        data = struct.pack("<BHB", command, index, sub) + value.to_bytes(size, "little", signed=value < 0)
        self.send(0x600 + self._node, data.ljust(8, b"\0"))
        time.sleep(0.02)

    def enable(self, mode):
        self.write(0x6060, mode, 1)
        for word in (0x06, 0x07, 0x0F):
            self.write(0x6040, word, 2)

    def close(self):
        self._bus.shutdown()


# --- programs as processes ----------------------------------------------------------------------------------------
def run_program(case):
    """Be the program: run a session, and send ourselves signals when frame k comes."""
    number, frame = case["signal"], case["frame"]
    reached = threading.Event()

    def repeat():
        reached.wait()
        for _ in range(case["times"] - 1):
            time.sleep(0.002)
            os.kill(os.getpid(), number)

    def meets(k, _):
        if k == frame:
            reached.set()
            os.kill(os.getpid(), number)

    if number:
        threading.Thread(target=repeat, daemon=True).start()
    bus = FaultyBus(open_bus(channel=case["channel"]), meets=meets if number else None)
    session = run_on if case["session"] == run_on.__name__ else SESSIONS[case["session"]]
    safety = LIMITS if case["safety"] == "limits" else case["safety"]
    with CanDrives(bus=bus, nodes=case["nodes"], safety=safety, timeout=1.0) as drives:
        session(drives)


class Programs:
    """Runs sessions as processes. Starting Python takes a second; a fork of one that has started, milliseconds."""

    def __init__(self):
        self._parent = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self._started = deque()
        self.ended = {}
        threading.Thread(target=self._listen, daemon=True).start()
        self._turn = threading.Lock()

    def start(self, session, channel, number=0, frame=-1, times=1, nodes=(1,), safety="limits"):
        """Return the process number of a session that has begun; `safety` True and False as CanDrives takes them."""
        case = {
            "session": session, "channel": channel, "signal": int(number), "frame": frame, "times": times,
            "nodes": nodes, "safety": safety,
        }  # fmt: skip
        with self._turn:
            self._parent.stdin.write(json.dumps(case).encode() + b"\n")
            self._parent.stdin.flush()
            until(lambda: self._started, "the program's start")
            return self._started.popleft()

    def close(self):
        """End the parent; what it has started is ended by whoever started it."""
        self._parent.stdin.close()
        self._parent.wait(PATIENCE)

    def _listen(self):
        for line in self._parent.stdout:
            message = json.loads(line)
            if "status" in message:
                self.ended[message["pid"]] = message["status"]
            else:
                self._started.append(message["pid"])


def serve_programs():
    """Be the parent: fork for every line, tell process numbers and how they ended."""
    import select

    def tell(**message):
        os.write(1, json.dumps(message).encode() + b"\n")

    children, rest_of_line = set(), b""
    # Imported and looked up once, here: no child waits for it.
    with suppress(Exception), CanDrives(dry_run=lambda line: None) as drives:
        motion.enable(drives, mode="pv", timeout=0.001)
    while True:
        if select.select([0], [], [], 0.005)[0]:
            data = os.read(0, 65536)
            if not data:
                break
            *lines, rest_of_line = (rest_of_line + data).split(b"\n")
            for line in lines:
                pid = os.fork()
                if pid == 0:
                    return json.loads(line)
                children.add(pid)
                tell(pid=pid)
        for pid in list(children):
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                children.remove(pid)
                tell(pid=pid, status=status)
    for pid in children:
        os.kill(pid, signal.SIGKILL)
    return None


@contextmanager
def no_interrupt_left():
    """Have an interrupt that comes late, from another thread, end here."""
    with suppress(KeyboardInterrupt):
        yield
        time.sleep(0.001)


def worst_of(outcomes: Sequence[tuple[object, list[str]]], most: int = 20) -> str:
    """Return the cases with problems as text, one a line; empty without any."""
    lines = [f"{case}: {'; '.join(found)}" for case, found in outcomes if found]
    more = f"\n... and {len(lines) - most} more" if len(lines) > most else ""
    return "\n".join(lines[:most]) + more


if __name__ == "__main__":
    if (given := serve_programs()) is not None:
        run_program(given)
