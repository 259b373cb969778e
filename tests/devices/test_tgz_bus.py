"""A TGZ-D behind a CAN bus: moves, equal integers, and what happens while its D-Mode does not fit.

With another D-Mode the drive takes nothing from its master (TGZ manual, section on 6060h). What an axis does then that
was enabled, the manual does not say: ours stops by itself, and another one may run on, which `ignores` has it do. The
verdict on every stop is the emulator's inside alone (tests/rigs/fault_injection.py).
"""

from __future__ import annotations

import os
import random
import signal
import struct
from contextlib import contextmanager, suppress

import canopen
import numpy as np
import pytest
from rigs.canopen_wire import Wire
from rigs.fault_injection import (
    ANSWER,
    DEAD_MASTER,
    EXPECTED,
    KINDS,
    SILENCE,
    FaultyBus,
    ObservedWorld,
    Truth,
    WorldBus,
    eds_read_once,
    no_interrupt_left,
    no_longer_than,
    problems,
    rest,
    run_lockstep,
    run_with,
    sample,
    served,
    until,
    worst_of,
)
from rigs.world_bus import assert_equal, on_bus

from drive_env import CanDrives, EmulatedDrives, SafetyError, cia402, motion
from drive_env.canopen.frames import Frame
from drive_env.commands.options import default_samples
from drive_env.commands.scope import DEFAULT
from drive_env.devices import find_device
from drive_env.dictionary.roles import Role
from drive_env.drives.limits import Limits
from drive_env.firmware.record import set_lanes
from drive_env.master.can.port import open_bus

STRIDE = int(os.environ.get("FAULT_STRIDE", "1"))
RPM = 1000  # velocity units, as a drive is commissioned
SPEED = 90 * RPM
RAD_PER_S = SPEED / RPM * 2.0 * np.pi / 60.0
D_MODE, PV_D_MODE, PP_D_MODE, WRONG = 0x2303, 6, 7, 0
TURN = 2**20  # increments
RADIANS = 2.0 * np.pi / TURN
LIMITS = Limits(position=(-3 * TURN, 3 * TURN), silence=SILENCE)
WATCHED = [0x6041, 0x6062, 0x6064, 0x606C, 0x6077]


@pytest.fixture(scope="module")
def inside():
    with eds_read_once(), EmulatedDrives("tgz_d", "inertia", num_machines=2, num_threads=1) as drives:
        drives.inside.connect_axes(0, 2)  # as on the node, which all these tests put them on
        yield drives


@pytest.fixture(autouse=True)
def no_test_hangs(request):
    with no_longer_than(1800.0 if request.node.get_closest_marker("slow") else 90.0):
        yield


@contextmanager
def lockstep(inside, safety=True):
    inside.machine.reset()
    with on_bus(inside, stay=True, timeout=ANSWER, safety=safety) as drives:
        yield drives


def turn(drives):
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", SPEED)
    drives.advance(0.1)


def stops(inside):
    """Another master's D-Mode; the drive sees to it in its next period."""
    inside.write(D_MODE, WRONG)


def ignores(inside):
    """The same on a drive that goes on as before: the automaton is told of no change."""
    inside.write(D_MODE, WRONG)
    set_lanes(inside.inside.records, "disconnected", np.ones(2, int))


def ignores_by_mode(inside):
    """Another master's mode of operation instead of its D-Mode, and the drive goes on as before."""
    inside.write(cia402.MODE, cia402.MODES["pp"])
    set_lanes(inside.inside.records, "disconnected", np.ones(2, int))


GATES = {gate.__name__: gate for gate in (stops, ignores, ignores_by_mode)}


# --- moves ----------------------------------------------------------------------------------------------------------
def watch(drives, seconds, play=None):
    trace = drives.record(WATCHED, seconds, play=play)
    return np.stack([trace[name] for name in WATCHED])


def pp(drives):
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", [600 * RPM, 300 * RPM])
    motion.start_move(drives, [TURN // 4, -TURN // 8])
    yield watch(drives, 0.1)
    motion.start_move(drives, [-TURN // 16, TURN // 8], relative=True)
    yield watch(drives, 0.4)
    motion.disable(drives)
    yield watch(drives, 0.02)


def pv(drives):
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", [SPEED, -2 * SPEED])
    yield watch(drives, 0.1)
    drives.write("Target velocity", [-SPEED, SPEED])
    yield watch(drives, 0.1)
    motion.quick_stop(drives)
    yield watch(drives, 0.1)


def csp(drives):
    motion.enable(drives, mode="csp")
    way = TURN // 16 * (1 - np.cos(np.linspace(0, 2 * np.pi, 150)))[:, None] * np.array([1, -2])
    yield watch(drives, 0.15, {0x607A: np.rint(way).astype(int)})
    yield watch(drives, 0.03)


@pytest.mark.every(6)
@pytest.mark.parametrize("safety", [True, False])
@pytest.mark.parametrize("script", [pp, pv, csp])
def test_the_same_script_gives_the_same_integers_over_the_bus(inside, script, safety):
    inside.machine.reset()
    expected = list(script(inside))
    with lockstep(inside, safety) as drives:
        found = list(script(drives))
    assert_equal(expected, found)
    moved = np.concatenate(expected, axis=1)[WATCHED.index(0x6064)]
    assert (np.ptp(moved, axis=0) > TURN // 100).all(), "every axis moves"


def test_what_a_scope_shows_by_default_can_be_recorded(inside):
    """60FFh is not among it: no TPDO carries it."""
    with lockstep(inside) as drives:
        names = default_samples(drives.description.dictionary, DEFAULT)
        assert names == ["6062", "6064", "606C", "6077"]
        assert len(drives.record([int(name, 16) for name in names], 0.003).t) == 3


def test_modes_are_changed_over_the_bus_while_the_axes_are_enabled(inside):
    with lockstep(inside) as drives:
        for mode in ("pv", "pp", "csp", "csv", "pv"):
            motion.enable(drives, mode=mode)
            drives.advance(0.08)
            assert cia402.matches(drives.read(0x6041), cia402.OPERATION_ENABLED).all(), mode
            assert (drives.read(0x6061) == cia402.MODES[mode]).all()


def test_an_axis_that_turns_is_enabled_again_when_its_d_mode_follows_late(inside, monkeypatch):
    """Where time passes between the two frames of a change the drive stops the axis, and no other master is blamed."""
    with lockstep(inside) as drives:
        turn(drives)
        write = drives.write

        def slow_write(name, *args, **options):
            write(name, *args, **options)
            if name == cia402.MODE:
                drives.advance(0.01)

        monkeypatch.setattr(drives, "write", slow_write)
        motion.enable(drives, mode="pp")
        assert cia402.matches(drives.read(0x6041), cia402.OPERATION_ENABLED).all()
        drives.advance(0.3)
        before = drives.read(0x6064)
        motion.move_to(drives, [16_000, -16_000], relative=True)
        assert np.abs(drives.read(0x6064) - before - [16_000, -16_000]).max() <= 6400


# --- a D-Mode that does not fit ------------------------------------------------------------------------------------
def ended(inside, session, limits=LIMITS):
    """Run a session in lockstep; check by the truth that it ends at rest and disabled, and return what ended it."""
    with no_interrupt_left():
        truth, _, error = run_lockstep(inside, session, limits=limits)
    assert problems(truth) == []
    assert (np.abs(truth.omega()).max(axis=0) > 0.5 * RAD_PER_S).all(), "it did turn"
    return error


@pytest.mark.every(3)
@pytest.mark.parametrize("gate", GATES)
def test_the_program_is_told_that_an_axis_takes_no_commands_any_more(inside, gate):
    def session(drives):
        turn(drives)
        GATES[gate](inside)
        drives.advance(1.0)

    error = ended(inside, session)
    assert isinstance(error, SafetyError)
    assert "axis 0 has ceased to take commands" in str(error)


def test_one_axis_alone_is_named_and_all_are_stopped(inside):
    def session(drives):
        turn(drives)
        inside.write(D_MODE, [PV_D_MODE, WRONG])
        drives.advance(1.0)

    error = ended(inside, session)
    assert isinstance(error, SafetyError)
    assert "axis 1 has ceased to take commands" in str(error)


def test_an_axis_at_rest_that_is_switched_off_so_is_told_of_as_well(inside):
    def session(drives):
        motion.enable(drives, mode="pv")
        drives.advance(0.1)
        inside.write(D_MODE, WRONG)
        with pytest.raises(SafetyError, match="axis 0 has ceased to take commands"):
            drives.advance(0.1)

    assert run_lockstep(inside, session, limits=LIMITS)[2] is None


def close(drives):
    drives.close()


def interrupt(drives):
    signal.raise_signal(signal.SIGINT)


def fail(drives):
    raise RuntimeError("a mistake of the program")


def disable(drives):
    motion.disable(drives)
    status = drives.read(0x6041)
    assert (status & 0x4F == 0x40).all(), "it says disabled, and is not"


def quick_stop(drives):
    motion.quick_stop(drives)
    drives.advance(0.3)


def reset_fault(drives):
    motion.reset_fault(drives)


def disable_voltage(drives):
    drives.write(0x6040, 0)


ENDS = {end.__name__: end for end in (close, interrupt, fail, disable, quick_stop, reset_fault, disable_voltage)}


@pytest.mark.every(24)
@pytest.mark.parametrize("gate", GATES)
@pytest.mark.parametrize("end", ENDS)
def test_every_end_finds_an_axis_that_takes_no_commands(inside, end, gate):
    """At once, in the middle of the drive's own stop, or while it runs on."""

    def session(drives):
        turn(drives)
        GATES[gate](inside)
        with suppress(SafetyError):
            ENDS[end](drives)

    ended(inside, session)


@pytest.mark.parametrize("gate", GATES)
@pytest.mark.parametrize("end", [disable, quick_stop])
def test_motion_is_heard_without_an_envelope(inside, end, gate):
    def session(drives):
        turn(drives)
        GATES[gate](inside)
        end(drives)

    assert ended(inside, session, limits=False) is None


def test_disable_does_not_claim_what_the_drive_ignored(inside, monkeypatch):
    """Somebody writes the D-Mode again and again: the axis runs on, and nobody is told that it is off."""
    with lockstep(inside, safety=False) as drives:
        turn(drives)
        passes = drives.advance

        def advance(seconds):
            ignores(inside)
            passes(seconds)

        monkeypatch.setattr(drives, "advance", advance)
        drives.advance(0.01)
        with pytest.raises(TimeoutError, match=r"did not reach switch on disabled .* takes no commands \(bit 9 is 0\)"):
            motion.disable(drives, timeout=0.05)
        assert (drives.read(0x6041) & 0x6F == 0x27).all()


def test_a_drive_that_is_disconnected_is_enabled_once_motion_has_set_its_d_mode(inside):
    with lockstep(inside) as drives:
        inside.write(D_MODE, WRONG)
        inside.write(cia402.MODE, cia402.MODES["pp"])
        drives.advance(0.01)
        drives.write(0x6040, 0x06)
        drives.advance(0.01)
        assert not (drives.read(0x6041) & (0x200 | 0x21)).any(), "it has taken a command"
        motion.enable(drives)
        assert (drives.read(Role.MODE_GATE) == PP_D_MODE).all()
        assert (drives.read(0x6041) & 0x26F == 0x227).all()


def sdo(index, value, size, sub=0):
    """Return the request of a write to node 1."""
    data = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, sub) + value.to_bytes(size, "little")
    return Frame(0x601, data.ljust(8, b"\0"))


@pytest.mark.every(3)
@pytest.mark.parametrize(("index", "value", "size"), [(D_MODE, WRONG, 4), (cia402.MODE, 1, 1), (0x2403, 1, 4)])
def test_frames_of_another_master_stop_the_axes_and_the_program_is_told(inside, index, value, size):
    inside.machine.reset()
    world = ObservedWorld(inside, lockstep=True)
    bus = WorldBus(world)
    with (
        pytest.raises(SafetyError, match="has ceased to take commands"),
        CanDrives("tgz_d", bus=bus, pace="lockstep", timeout=ANSWER) as drives,
    ):
        turn(drives)
        assert (np.abs(world.truth.omega()[-1]) > 0.5 * RAD_PER_S).all()
        with world.lock:
            world.receive(sdo(index, value, size), "another master")
        drives.advance(1.0)
    bus.shutdown()
    assert problems(world.truth) == []


# --- a master that dies ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("gate", GATES)
def test_heartbeats_that_stay_away_stop_an_axis_that_takes_no_commands(inside, gate):
    inside.machine.reset()
    wire, heartbeat = Wire(inside), (0x77F, "05")
    wire.start()
    assert wire.download(0x1029, 1, 2, 1) == 0  # to stopped, which ends operation
    assert wire.download(0x1016, 1, 127 << 16 | 100, 4) == 0  # node 127, 100 ms
    wire.receive(*heartbeat)
    for index, value, size in ((D_MODE, PV_D_MODE, 4), (cia402.MODE, 3, 1), (0x60FF, SPEED, 4)):
        for further in (0, 0x100 if index == D_MODE else 0x800):
            wire.take()
            assert wire.download(index + further, 0, value, size) == 0
    for word in (0x06, 0x07, 0x0F):
        for index in (0x6040, 0x6840):
            wire.take()
            assert wire.download(index, 0, word, 2) == 0
        wire.wait(5)
    for _ in range(10):
        wire.receive(*heartbeat)
        wire.wait(20)
    truth = Truth(inside)
    assert (np.abs(truth.omega()[-1]) > 0.5 * RAD_PER_S).all()
    GATES[gate](inside)
    for _ in range(400):
        wire.wait(1)
        truth.sample()
    assert problems(truth) == []
    if gate == "ignores":  # in another mode an axis may have come to rest before
        assert np.abs(truth.omega()[60]).max() > 0.5 * RAD_PER_S
    if gate != "stops":  # which had stopped before
        assert (inside.read(0x6041) & 0x4F == 0x08).all()


@pytest.mark.slow
@pytest.mark.parametrize("gate", ["stops", "ignores"])
def test_a_program_that_dies_in_real_time_leaves_no_axis_running(inside, gate):
    """The master may stop before, if the computer is too busy for it to see the drives."""
    with served(inside) as (world, channel):
        bus = FaultyBus(open_bus(channel=channel))
        cycle = world.cycle

        def cut():
            bus.cut()
            GATES[gate](inside)
            world.cycle = cycle
            cycle()

        def script():
            with CanDrives("tgz_d", bus=bus, safety=LIMITS, timeout=1.0) as drives:
                turn(drives)
                assert drives.bus.read_raw(drives.description.dictionary.find((0x1029, 1)), 0) == 2, (
                    "a dead master must stop the axes, not make them pre-operational"
                )
                world.cycle = cut
                drives.advance(1.0)

        with suppress(*EXPECTED), no_interrupt_left():
            script()
        rest(world)
        bus.shutdown()
        assert problems(world.truth, reaction=DEAD_MASTER) == []


@pytest.mark.slow
def test_python_canopen_moves_it_in_pp_and_is_ignored_with_another_d_mode(inside):
    with served(inside) as (world, channel):
        network = canopen.Network()
        network.connect(interface="slcan", channel=channel, sleep_after_open=0)
        try:
            node = canopen.RemoteNode(1, str(find_device("tgz_d").eds))
            network.add_node(node)
            node.sdo.RESPONSE_TIMEOUT = 30.0
            node.nmt.state = "OPERATIONAL"
            for index, value in ((0x6060, 1), (D_MODE, PP_D_MODE), (0x6081, 300 * RPM), (0x607A, TURN // 4)):
                node.sdo[index].raw = value
            for word, state in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
                node.sdo[0x6040].raw = word
                until(lambda state=state: node.sdo[0x6041].raw & 0x26F == 0x200 | state, hex(state))
            node.sdo[0x6040].raw = 0x1F
            until(lambda: node.sdo[0x6041].raw & 0x1000, "the acknowledge")
            node.sdo[0x6040].raw = 0x0F
            until(lambda: node.sdo[0x6041].raw & 0x1400 == 0x0400, "target reached")
            assert abs(node.sdo[0x6064].raw - TURN // 4) <= 6400
            assert abs(world.truth.theta()[-1, 0] / RADIANS - TURN / 4) <= 6400
            node.sdo[D_MODE].raw = WRONG
            until(lambda: node.sdo[0x6041].raw & 0x24F == 0x40, "the drive's own stop")
            node.sdo[0x6040].raw = 0x06
            begun = world.cycles
            until(lambda: world.cycles >= begun + 20, "20 ms")
            assert node.sdo[0x6041].raw & 0x26F == 0x40
            node.sdo[D_MODE].raw = PP_D_MODE
            until(lambda: node.sdo[0x6041].raw & 0x200, "bit 9")
        finally:
            network.disconnect()


# --- frames that are lost ---------------------------------------------------------------------------------------------
def pp_move(drives):
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 600 * RPM)
    motion.start_move(drives, TURN // 16)
    drives.advance(0.02)
    motion.start_move(drives, -TURN // 32, relative=True)
    drives.advance(0.01)
    motion.quick_stop(drives)
    drives.advance(0.1)


def pv_run(drives):
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 600 * RPM)
    drives.advance(0.03)
    motion.quick_stop(drives)
    drives.advance(0.1)


def sessions(inside):
    def taken_over(drives):
        """The D-Mode goes while the axis turns, and the axis runs on."""
        motion.enable(drives, mode="pv")
        drives.write("Target velocity", 300 * RPM)
        drives.advance(0.03)
        ignores(inside)
        drives.advance(0.05)

    return {"pp_move": pp_move, "pv_run": pv_run, "taken_over": taken_over}


@pytest.mark.every(10)
@pytest.mark.parametrize("kind", KINDS)
def test_a_fault_at_a_frame_leaves_no_axis_running(inside, kind):
    session = sessions(inside)["taken_over"]
    _, frames, _ = run_lockstep(inside, session, limits=LIMITS)
    chosen = sample(random.Random(kind), frames, 2)
    assert worst_of([(f"{kind} {k}", run_with(inside, session, kind, k, LIMITS)) for k in chosen]) == ""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pp_move", "pv_run", "taken_over"])
def test_a_fault_at_many_frames_leaves_no_axis_running(inside, name):
    session = sessions(inside)[name]
    truth, frames, _ = run_lockstep(inside, session, limits=LIMITS)
    assert problems(truth) == []
    outcomes = []
    for k, kind in enumerate(KINDS):
        chosen = range(7 * k, frames, 40 * STRIDE)
        outcomes += [(f"{kind} {frame}", run_with(inside, session, kind, frame, LIMITS)) for frame in chosen]
    assert worst_of(outcomes) == ""
