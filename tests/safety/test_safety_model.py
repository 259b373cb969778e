"""The safety model: what it finds of the code before, that our rules leave nothing, that drive and library are so."""

from __future__ import annotations

import contextlib
import functools
import random
import signal
import time
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import can
import pytest
from rigs.canopen_wire import Wire
from rigs.safety_model import drive as drive_model
from rigs.safety_model.drive import Drive
from rigs.safety_model.exploration import GIVEN_UP, LEFT, RUNS_ON, TAKEN_FOR_OFF, UNRAMPED, UNWATCHED, explore
from rigs.safety_model.program import WORDS
from rigs.safety_model.rules import NO_POWER, OURS, OWN_ID, SET_POINT, SHUTDOWN, TODAY, Assumptions
from rigs.safety_model.situation import At, beginnings
from rigs.safety_model.steps import steps

from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.nmt import SERVICES, Command, NmtState
from drive_env.cia402 import STATE_CODING, State
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.port import Port, open_bus

ENABLING = ("write 06h", "write 0Fh")
LATE = ("play", "RPDO held", "late frame", "foreign SYNC")


# --- what the model finds -----------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("finding", "wrong", "troubles"),
    [
        (("play", "INT"), RUNS_ON, 0),
        ((*ENABLING, "leave", "answer lost"), RUNS_ON, 1),
        ((*ENABLING, "leave", "request lost"), RUNS_ON, 2),
        ((*ENABLING, "write 8Fh", "leave"), RUNS_ON, 0),
        ((*ENABLING, "INT"), RUNS_ON, 0),
        (("found enabled", "command", "kill"), RUNS_ON, 0),
        (("lockstep", *ENABLING, "kill"), RUNS_ON, 0),
        ((*ENABLING, "80h", "kill"), RUNS_ON, 1),
        ((*ENABLING, "same id", "kill"), RUNS_ON, 1),
        ((*ENABLING, "TERM"), LEFT, 0),
        ((*ENABLING, "silence"), RUNS_ON, 1),
        # Found by the model alone:
        ((*ENABLING, "NMT start lost", "kill"), RUNS_ON, 1),
        ((*ENABLING, "heartbeat lost", "kill"), RUNS_ON, 1),
        ((*ENABLING, "81h", "kill"), RUNS_ON, 1),
        ((*ENABLING, "82h, 01h", "kill"), RUNS_ON, 1),
    ],
    ids=[
        "a play that enables, then Ctrl-C",
        "the answer to the enabling write is lost",
        "both stop words are lost",
        "8Fh is taken for off",
        "Ctrl-C again during the stop",
        "found enabled, never armed",
        "lockstep on a bus of real time",
        "another master's 80h, then death",
        "two programs with one heartbeat",
        "TERM of a plain script",
        "one of several axes falls silent",
        "NMT start is lost, then death",
        "the first heartbeat is lost, then death",
        "another master resets the node, the program enables again, then death",
        "another master resets the node's communication and starts it, then death",
    ],
)
def test_a_finding_is_a_counterexample_of_the_code_before(finding, wrong, troubles):
    found = explore(TODAY, Assumptions(troubles), finding, {wrong}).found
    assert wrong in found
    assert set(finding) - {"found enabled", "lockstep"} <= found[wrong].kinds, "all of it is needed"
    assert wrong not in explore(OURS, Assumptions(troubles), finding).found


def test_a_counterexample_can_be_read():
    found = explore(TODAY, Assumptions(1), (*ENABLING, "leave", "answer lost"), {RUNS_ON}).found
    assert str(found[RUNS_ON]).splitlines() == [
        "runs on: nothing monitors it, and no watchdog ends it",
        "   0. the axis is off",
        "   1. the program writes 6040h = 06h  [switch on disabled; pre-operational; no watchdog]",
        "   2. 6040h = 06h is sent by SDO  [ready to switch on; pre-operational; no watchdog]",
        "   3. the program writes 6040h = 0Fh  [ready to switch on; pre-operational; no watchdog]",
        "   4. the library sends NMT start; it writes 127 to 1016h; it sends 1 heartbeat  "
        "[ready to switch on; operational; watches 127]",
        "   5. 6040h = 0Fh is sent by SDO; it acts, and its answer is lost  "
        "[operation enabled; operational; watches 127]",
        "   6. the program ends and closes its drives  [operation enabled; operational; watches 127]",
        "   7. the library goes on to put 1016h back  [operation enabled; operational; watches 127]",
        "   8. the library writes 0 to 1016h  [operation enabled; operational; no watchdog]",
    ]


@pytest.mark.slow
def test_no_counterexample_is_left_with_any_one_trouble():
    result = explore(OURS, Assumptions(troubles=1))
    assert result.states > 10_000
    assert not result.found, "\n".join(map(str, result.found.values()))


@pytest.mark.slow
def test_no_counterexample_is_left_with_any_two_troubles():
    result = explore(OURS, Assumptions(troubles=2))
    assert result.states > 100_000
    assert not result.found, "\n".join(map(str, result.found.values()))


@pytest.mark.parametrize(
    ("weaker", "wrong", "kinds", "troubles"),
    [
        ({"live_from": "writes"}, TAKEN_FOR_OFF, ("play", "INT"), 0),
        ({"arms_for": OURS.arms_for - {SET_POINT}}, UNWATCHED, ("found enabled", "command"), 0),
        ({"arms_for": OURS.arms_for - {SHUTDOWN}}, RUNS_ON, (*LATE, "write 06h", "82h, 01h", "kill"), 2),
        ({"arms_in_lockstep": False}, RUNS_ON, ("lockstep", *ENABLING, "kill"), 0),
        ({"arms": "once"}, RUNS_ON, (*ENABLING, "play", "82h, 01h", "kill"), 1),
        ({"beats": 1}, RUNS_ON, ("found enabled", "command", "heartbeat lost", "kill"), 1),
        ({"operational": "sent"}, RUNS_ON, (*ENABLING, "NMT start lost", "kill"), 2),
        ({"watches": False}, RUNS_ON, (*ENABLING, "82h", "kill"), 1),
        ({"misses": "all"}, RUNS_ON, (*ENABLING, "silence"), 1),
        ({"own_id": False}, RUNS_ON, (*ENABLING, "same id", "kill"), 1),
        ({"stops_in": "program"}, GIVEN_UP, (*ENABLING, "INT"), 0),
        ({"handles": frozenset({"INT"})}, LEFT, (*ENABLING, "TERM"), 0),
        ({"ramps_first": False}, UNRAMPED, (*ENABLING, "INT"), 0),
        ({"gives_up": "always"}, RUNS_ON, (*ENABLING, "leave", "request lost"), 2),
        ({"gives_up": "one proven off"}, GIVEN_UP, (*ENABLING, "leave", "request lost"), 1),
        ({"beats_last": False}, RUNS_ON, ("play", "RPDO held", "silence", "pause", "leave", *LATE[2:]), 3),
        ({"proof": "read"}, RUNS_ON, ("play", "leave", "answer held", "request lost"), 3),
        ({"off": NO_POWER}, RUNS_ON, (*LATE, "leave"), 1),
        ({"proves_anew": False}, GIVEN_UP, ("write 0Fh", "INT", "foreign enable", "command", "leave"), 1),
        ({"checks": "calls"}, RUNS_ON, ("play", "INT", "82h, 01h", "kill"), 1),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_every_rule_is_needed(weaker, wrong, kinds, troubles):
    assert wrong in explore(replace(OURS, **weaker), Assumptions(troubles), kinds, {wrong}).found
    assert not explore(OURS, Assumptions(troubles), kinds).found


def test_what_no_master_can_prevent_is_a_death_within_moments_of_anothers_act():
    """A drive that another master takes out of operational obeys no watchdog: 20 ms until our next look are left."""
    kinds = (*ENABLING, "80h", "82h", "82h, 01h", "same id", "kill")
    found = explore(OURS, Assumptions(1, coincidences=True), kinds).found
    assert set(found) == {RUNS_ON}
    assert [kind for kind, _, _ in found[RUNS_ON].trace][-2:] == ["80h", "kill"]


# --- the drive of the model is the drive --------------------------------------------------------------------------
EVENTS = (
    *(("write", word) for word in WORDS),
    *(("rpdo", word) for word in (0x06, 0x0F)),
    ("sync", 0),
    *(("nmt", command) for command in Command),
    *(("consumer", node) for node in (0, OWN_ID)),
    ("heartbeat", OWN_ID),
    *(("tick", node) for node in (0, OWN_ID)),
    ("trip", 0),
)


def moved(drive, event):
    """Return the model's drive after an event."""
    kind, value = event
    if kind in ("write", "consumer") and not SERVICES[drive.nmt].sdo:
        return drive
    if kind == "tick":
        return drive_model.tick(drive, frozenset({value} if value else ()))
    act = {"write": drive_model.write_controlword, "consumer": drive_model.write_consumer, "rpdo": drive_model.latch,
           "nmt": drive_model.take_nmt, "heartbeat": drive_model.hear}  # fmt: skip
    return act[kind](drive, value) if kind in act else getattr(drive_model, kind)(drive)


def all_drives():
    """Return every state that a drive can be in."""
    seen, queue = {Drive()}, deque([Drive()])
    while queue:
        for event in EVENTS:
            after = moved(queue[0], event)
            if after not in seen:
                seen.add(after)
                queue.append(after)
        queue.popleft()
    return seen


class RealDrive:
    """The emulated node, told what the model's drive is told."""

    SILENCE, RAMP = 120, 90  # [ms]
    SPEED = 100_000

    def __init__(self, drives):
        drives.machine.reset()
        self.wire = Wire(drives)
        self._prepare()

    def _prepare(self):
        """Bring back what a reset has taken: what the tests need, and the model does not have."""
        assert self.wire.download(0x1400, 1, 0xC0000205, 4) == 0
        assert self.wire.download(0x1400, 2, 0, 1) == 0  # an RPDO waits for SYNC
        assert self.wire.download(0x1400, 1, 0x40000205, 4) == 0
        if self.wire.value(0x6060) != 3:
            assert self.wire.download(0x6060, 0, 3, 1) == 0

    def take(self, event):
        kind, value = event
        wire = self.wire
        if kind == "write":
            wire.receive(0x605, f"2B 40 60 00 {value:02X} 00 00 00")
        elif kind == "consumer":
            raw = (value << 16 | self.SILENCE if value else 0).to_bytes(4, "little")
            wire.receive(0x605, f"23 16 10 01 {raw.hex(' ')}")
        elif kind == "rpdo":
            wire.receive(0x205, f"{value:02X} 00")
        elif kind == "sync":
            wire.receive(0x080)
        elif kind == "nmt":
            wire.receive(0x000, f"{int(value):02X} 05")
            if value in (Command.RESET_NODE, Command.RESET_COMMUNICATION):
                self._prepare()
        elif kind == "heartbeat":
            wire.receive(0x700 + value, "05")
        elif kind == "tick":
            self._wait(self.RAMP, value)
            self._wait(self.SILENCE + self.RAMP, value)
        else:
            wire.node._axes[0].trip()
        if wire.node._axes[0].state == State.OPERATION_ENABLED:
            wire.node.dictionary.port(0x60FF, 0).write(self.SPEED)  # entering operation enabled forgets set-points
        wire.take()

    def _wait(self, cycles, beats):
        for _ in range(cycles // 10):
            if beats:
                self.wire.receive(0x700 + beats, "05")
            self.wire.wait(10)

    def __str__(self):
        """Return what can be seen from outside, and whether watching has begun."""
        node = self.wire.node
        watched = node._consumers
        # Of a fault that comes from the network 6041h tells a cycle later.
        state, consumer = State(node._axes[0].state), self.wire.value(0x1016, 1) >> 16
        return seen(state, node.state, consumer, bool(watched) and watched[0]._last is not None)

    @property
    def turns(self):
        return abs(self.wire.value(0x606C)) > self.SPEED // 2


def seen(state, nmt, consumer, heard):
    return f"{state.name}, {nmt.name}, 1016h: {consumer}, {'heard' if heard else 'not heard'}"


def follow(drives, event_of, steps):
    """Let the emulated node and the model take the same events; compare them after each."""
    real, drive, trace = RealDrive(drives), Drive(), []
    for _ in range(steps):
        event = event_of(drive)
        if event is None:
            return trace
        before, drive = drive, moved(drive, event)
        real.take(event)
        trace.append((before, event))
        expected = seen(drive.fsa, drive.nmt, drive.consumer, drive.heard)
        assert str(real) == expected, f"after {event} in {before}"
        # How long an axis coasts, and when it turns again after it was enabled within a tick, the model leaves open.
        if event[0] == "tick" and before.live and not before.ramps:
            assert real.turns == drive.turns, f"after {event} in {before}"
    return trace


@pytest.mark.slow
def test_the_emulated_node_and_the_model_agree_on_random_walks(drives):
    choose = random.Random(1)
    trace = follow(drives, lambda drive: choose.choice(EVENTS), 3000)
    assert {drive.fsa for drive, _ in trace} == set(State) - {State.NOT_READY_TO_SWITCH_ON}
    assert {drive.nmt for drive, _ in trace} == {NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL, NmtState.STOPPED}


class Tour:
    """Chooses events so that each event is taken in each state, or in each state of a kind."""

    def __init__(self, kind):
        self.kind = kind
        self.left = {(kind(drive), event) for drive in all_drives() for event in EVENTS}
        self.wanted = len(self.left)
        self._way = []

    def __call__(self, drive):
        if not self._way:
            self._way = self._find(drive)
        if not self._way:
            return None
        event = self._way.pop(0)
        self.left.discard((self.kind(drive), event))
        return event

    def _find(self, start):
        """Return the events to the nearest one that was not taken yet, and it."""
        ways, queue = {start: []}, deque([start])
        while queue:
            drive = queue.popleft()
            for event in EVENTS:
                if (self.kind(drive), event) in self.left:
                    return [*ways[drive], event]
                after = moved(drive, event)
                if after not in ways:
                    ways[after] = [*ways[drive], event]
                    queue.append(after)
        return []


def test_they_agree_on_every_event_in_every_state_of_the_two_automata(drives):
    tour = Tour(lambda drive: (drive.fsa, drive.ramps, drive.nmt, drive.heard))
    follow(drives, tour, 100_000)
    assert tour.wanted > 500
    assert not tour.left


@pytest.mark.slow
def test_they_agree_on_every_event_in_every_state(drives):
    tour = Tour(lambda drive: drive)
    follow(drives, tour, 1_000_000)
    assert tour.wanted > 9_000
    assert not tour.left


def test_the_words_are_one_of_each_kind():
    def what_it_does(word):
        off = Drive()
        return tuple(
            drive_model.write_controlword(off._replace(fsa=state, word=before), word)._replace(word=0)
            for state in State
            for before in (0x00, 0x80)
        )

    kinds = {what_it_does(word) for word in range(256)}
    assert {what_it_does(word) for word in WORDS} == kinds
    assert len(kinds) == len(WORDS)


# --- the library of the model is the library ----------------------------------------------------------------------
FOREIGN = {"80h": (0x80,), "81h": (0x81,), "82h": (0x82,), "82h, 01h": (0x82, 0x01)}
TROUBLES = {"silence", *FOREIGN}  # that come between two calls


class Call(NamedTuple):
    """What a program does, and what becomes of its first frame with a controlword."""

    kind: str
    trouble: str = ""


SCRIPTS = {
    "a session without trouble": "06h 0Fh leave",
    "the enabling write lost": "06h 0Fh:request-lost leave",
    "its answer lost": "06h 0Fh:answer-lost leave",
    "8Fh while enabled": "06h 0Fh 8Fh leave",
    "disabled by its program": "06h 0Fh 00h leave",
    "quick stop, then Ctrl-C": "06h 0Fh 02h INT",
    "ready only": "0Fh 06h leave",
    "played": "play leave",
    "killed": "06h 0Fh kill",
    "killed before it enabled": "06h kill",
    "found enabled": "found-enabled command kill",
    "80h of another master, then killed": "06h 0Fh 80h kill",
    "81h of another master, enabled again, killed": "06h 0Fh 81h 06h 0Fh kill",
    "82h of another master, then killed": "06h 0Fh 82h kill",
    "82h and 01h of another master, then killed": "06h 0Fh 82h,01h kill",
    "82h and 01h of another master, then closed": "06h 0Fh 82h,01h leave",
    "silent, then closed": "06h 0Fh silence leave",
    "silent, then killed": "06h 0Fh silence kill",
}


def parsed(text):
    calls = []
    for word in text.split():
        kind, _, trouble = word.partition(":")
        kind = kind.replace(",", ", ")
        known = f"write {kind}" if kind[:2] in ("00", "02", "06", "07", "0F", "8F") else kind.replace("-", " ")
        calls.append(Call(known, trouble.replace("-", " ")))
    return calls


class Seen(NamedTuple):
    """What can be seen of a drive, by its truth: state, NMT state, whether 1016h watches somebody."""

    fsa: State
    nmt: NmtState
    watches: bool


def possible(rules, calls):
    """Return what may be seen after each call by the model: a set of Seen for each."""
    found = calls[0].kind == "found enabled"
    calls = calls[found:]
    begins = [s for s in beginnings(rules, Assumptions(0)) if s.drive.live == found and not s.lockstep]
    after = [set() for _ in calls]
    # Ctrl-C leaves the `with` block; where the supervisor has begun to stop by then, leaving goes on with that.
    ended = "leave" if rules.stops_in == "supervisor" else "INT"
    kinds = [ended if call.kind == "INT" else call.kind for call in calls]
    known, queue = set(), deque((s, 0, "") for s in begins)
    while queue:
        at = queue.popleft()
        if at in known:
            continue
        known.add(at)
        s, k, pending = at
        if s.at in (At.CLOSED, At.DEAD):
            drive = s.drive
            for _ in range(3):
                drive = drive_model.tick(drive, frozenset())
            if k == len(calls):
                after[k - 1].add(Seen(drive.fsa, drive.nmt, drive.consumer != 0))
            continue
        if s.at is At.PROGRAM and k and not s.interfered:
            after[k - 1].add(Seen(s.drive.fsa, s.drive.nmt, s.drive.consumer != 0))
        sends = s.at in (At.SEND, At.ARMED) and s.rows
        asked = s._replace(troubles=int(bool(pending) or (k < len(calls) and calls[k].kind in TROUBLES)))
        for step in steps(asked, rules, Assumptions(0)):
            then = step.after._replace(troubles=0)
            if step.kind == "drive" or (step.kind == "library" and not (sends and pending)):
                queue.append((then, k, pending))
            elif step.kind == "INT" and rules.stops_in == "supervisor":
                queue.append((then, k, pending))  # on a busy machine the envelope may be blind for a while, and stop
            elif sends and step.kind == pending:
                queue.append((then, k, ""))
            elif s.at is At.PROGRAM and k < len(calls) and step.kind == kinds[k]:
                queue.append((then, k + 1, calls[k].trouble))
    return after


class LossyBus(can.BusABC):
    """A bus that loses the next frame of a kind, all to the program, or all: then the process is dead to the drive."""

    def __init__(self, bus):
        super().__init__(channel="lossy")
        self._bus = bus
        self.lose = ""
        self.dead = self.silent = False

    def send(self, msg, timeout=None):
        if self.dead or self._lost("request", msg, 0x601, 0x2B):
            return
        self._bus.send(msg, timeout)

    def _recv_internal(self, timeout):
        message = self._bus.recv(timeout)
        if message is not None and (self.dead or self.silent or self._lost("answer", message, 0x581, 0x60)):
            message = None
        return message, True

    def _lost(self, which, message, can_id, command):
        """Return whether a transfer's frame to or from 6040h is to be lost."""
        controlword = message.arbitration_id == can_id and message.data[:3] == bytes((command, 0x40, 0x60))
        if self.lose == f"{which} lost" and controlword:
            self.lose = ""
            return True
        return False

    def fileno(self):
        return self._bus.fileno()

    def shutdown(self):
        super().shutdown()
        self._bus.shutdown()


class Session:
    """A program on a served emulator, call by call, with the truth of the drive."""

    def __init__(self):
        self.world = World(lockstep=False)
        self.emulated = EmulatedDrives(load="inertia", num_threads=1)
        (self.node,) = self.world.add(self.emulated, [1])
        self.hub = Hub()
        self.server = Server(self.world, self.hub)

    def run(self, calls):
        """Return what is seen after each call."""
        with self.server:
            other = Port(open_bus(channel=self.hub.channel))
            self.emulated.write(0x6060, 3)
            if calls[0].kind == "found enabled":
                other.send(0x000, b"\x01\x01")
                for word in (6, 7, 15):
                    self.emulated.write(0x6040, word)
                calls = calls[1:]
            bus = LossyBus(open_bus(channel=self.hub.channel))
            drives = CanDrives(bus=bus, timeout=0.5, safety=Limits(silence=0.3, stall=None))
            try:
                for call in calls:
                    bus.lose = call.trouble
                    self._act(call.kind, drives, bus, other)
                    yield self._seen()
            finally:
                bus.dead = True
                drives.close()
                bus.shutdown()
                other.close()
        self.world.close()

    def _act(self, kind, drives, bus, other):
        with contextlib.suppress(BusError, SafetyError):
            if kind.startswith("write"):
                drives.write(0x6040, int(kind[6:8], 16))
            elif kind == "play":
                drives.record([0x6041], 0.02, play={0x6040: [6] * 10 + [15] * 10})
            elif kind == "command":
                drives.write(0x60FF, 300_000)
            booted = []
            other.subscribe(0x701, lambda data: booted.append(data) if data == b"\0" else None)
            for command in FOREIGN.get(kind, ()):
                if command == 0x01:  # a node that still boots is deaf
                    assert other.wait(lambda: booted, 10.0)
                other.send(0x000, bytes((command, 1)))
            bus.silent = bus.silent or kind == "silence"
            for _ in range(2 * (kind in TROUBLES)):  # the program is told, once
                with contextlib.suppress(BusError, SafetyError):
                    drives.read(0x6041)
        if kind == "leave":
            drives.close()
        elif kind == "INT":
            with contextlib.suppress(KeyboardInterrupt), drives:
                signal.raise_signal(signal.SIGINT)
        elif kind == "kill":
            bus.dead = True

    def _seen(self):
        word = int(self.emulated.read(0x6041)[0])
        (state,) = [state for state, (mask, value) in STATE_CODING.items() if word & mask == value]
        return Seen(state, self.node.state, self.node.dictionary.port(0x1016, 1).read() != 0)


LONG = {
    "killed before it enabled", "disabled by its program", "8Fh while enabled", "ready only",
    "81h of another master, enabled again, killed",
}  # fmt: skip
MARKS = {name: [pytest.mark.slow] for name in SCRIPTS if name.startswith("82h")}
MARKS |= {name: [pytest.mark.slow] for name in LONG}


ATTEMPTS = 4  # on a computer that is busy the envelope may not see the drive in time, and refuse or stop


def follow_script(text):
    """Run a script on a served drive and compare it with the model after each call."""
    calls = parsed(text)
    expected = possible(OURS, calls)
    unexpected = ""
    for _ in range(ATTEMPTS):
        unexpected = run_script(text, calls, expected)
        if not unexpected:
            return
    pytest.fail(unexpected)


def run_script(text, calls, expected):
    """Return what was seen and should not be, empty if all was as expected."""
    session = Session()
    with contextlib.closing(session.run(calls)) as seen_after:
        for k, allowed in enumerate(expected):
            found = next(seen_after)
            end = time.monotonic() + 10.0  # a drive may be on its ramp, or wait for a heartbeat
            while found not in allowed and time.monotonic() < end:
                time.sleep(0.02)
                found = session._seen()
            if found not in allowed:
                return f"after call {k} of {text}: {found}, and the model has {allowed}"
    return ""


@pytest.mark.every(4)
@pytest.mark.parametrize(
    "text", [pytest.param(text, id=name, marks=MARKS.get(name, ())) for name, text in SCRIPTS.items()]
)
def test_the_library_does_what_the_model_allows(text):
    follow_script(text)


DRAWN = 16


@functools.cache
def drawn_scripts():
    """Return scripts of the model: a program's calls, frames lost and another master between them, and its end."""
    rng, scripts = random.Random(1), []
    while len(scripts) < DRAWN:
        words = [f"{word}{rng.choice(('', '', ':request-lost', ':answer-lost'))}" for word in ("06h", "0Fh")]
        calls = rng.choice((words, ["06h", "0Fh"], ["0Fh"], ["play"]))
        more = ("00h", "02h", "06h", "07h", "0Fh", "8Fh", "0Fh:answer-lost", "02h:answer-lost", "command", "80h", "81h")
        calls = calls + rng.choices(more, k=rng.randrange(1, 4))
        text = " ".join([*calls, rng.choice(("leave", "leave", "INT", "kill"))])
        if text not in scripts and text not in SCRIPTS.values() and all(possible(OURS, parsed(text))):
            scripts.append(text)
    return scripts


@pytest.mark.slow
@pytest.mark.parametrize("number", range(DRAWN))
def test_the_library_does_what_the_model_allows_in_a_script_drawn_from_it(number):
    follow_script(drawn_scripts()[number])
