"""Nodes that have left operational are started, and no motor runs by it; judged by the truth inside the emulator."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.ethercat_segment import linked
from rigs.fault_injection import ON, served, until
from rigs.session_rig import Beats
from rigs.studio_rig import Tab, chromium, needs_chromium, studio
from rigs.world_bus import WorldBus

from drive_env import CanDrives, EmulatedDrives, SafetyError, motion
from drive_env.bus.bus_faults import BusFaults
from drive_env.bus.world import World
from drive_env.canopen.frames import Frame
from drive_env.canopen.nmt import NmtState
from drive_env.cia402 import State
from drive_env.drives.chosen_axes import ChosenAxes
from drive_env.ethercat.application import AlState
from drive_env.faults.schedule import parse_order
from drive_env.fieldbus.description import describe
from drive_env.fieldbus.errors import BusError
from drive_env.studio import motion_jobs
from drive_env.studio.session import Session

FIRST, SECOND = np.array([True, False]), np.array([False, True])
TURNS, STILL = 5.0, 0.5  # rad/s: an axis at 90 rpm, and one at rest


@pytest.fixture(scope="module")
def two():
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as drives:
        yield drives


@pytest.fixture
def bench(two):
    """A session on two nodes that are served in real time; yields it, the world, and what injects a fault."""
    with served(two, (1, 2)) as (world, channel):
        faults = BusFaults(world)
        drives = lambda: CanDrives(channel=channel, nodes=[1, 2], timeout=0.5)  # noqa: E731
        session = Session(drives, "two nodes", describe("tmcm1636", None))
        session.presence.beat("page")
        session.start()
        until(lambda: session.state != "opening")
        assert session.state == "open", session.failure
        try:
            with Beats(session):
                yield session, world, faults
        finally:
            session.close()


def do(session, job):
    return session.do(job, "a job", page="page").result(10)


def states(world):
    return [node.state for node in world.nodes.values()]


@pytest.mark.slow
def test_a_node_that_missed_heartbeats_is_started_from_the_page_and_turns_again(bench):
    session, world, faults = bench
    do(session, motion_jobs.enable((0, 1), "pp"))
    do(session, motion_jobs.disable((0, 1)))
    faults.add(parse_order("bus_loss share=1 duration=1"))
    until(lambda: all(axis.is_silent for axis in session.axes), "the silence of both nodes")
    assert all(axis.state is None for axis in session.axes), "what was seen before is not shown as if it were"
    until(lambda: not faults.listing(), "the end of the loss")
    first = world.truth.cycles
    do(session, motion_jobs.start_node(0))
    until(lambda: states(world)[0] is NmtState.OPERATIONAL)
    assert states(world)[1] is NmtState.STOPPED, "it was not chosen"
    until(lambda: [axis.is_silent for axis in session.axes] == [False, True], "the silence of the other one alone")
    do(session, motion_jobs.start_node(1))
    until(lambda: all(axis.state is State.SWITCH_ON_DISABLED for axis in session.axes))
    assert np.abs(world.truth.omega(first)).max() < STILL and not np.isin(world.truth.fsa(first), ON).any()
    do(session, motion_jobs.enable((0, 1), "pv"))
    do(session, lambda drives: motion.turn(drives, 100_000, None))
    until(lambda: (world.truth.omega()[-1] > TURNS).all(), "both axes' motion")


@needs_chromium
@pytest.mark.slow
def test_the_page_offers_the_start_of_a_node_that_was_stopped(two):
    with served(two, (1, 2)) as (world, channel):
        faults, nodes = BusFaults(world), ("--node", "1", "--node", "2")
        with studio("--channel", channel, *nodes, "--timeout", "0.5") as made, chromium() as driver:
            tab = Tab(driver, made).open("/axes")
            tab.await_state("Switch on disabled")
            assert not tab.named("silent").is_displayed()
            faults.add(parse_order("second_master node=1 command=2 duration=0.05"))
            until(lambda: tab.named("silent").is_displayed(), "the silence")
            tab.await_state("unknown")
            tab.press("start-node")
            tab.await_state("Switch on disabled")
            until(lambda: not tab.named("silent").is_displayed(), "its end")
        assert not np.isin(world.truth.fsa(), ON).any()


@pytest.fixture
def on_can(two):
    """Yield drives in lockstep, a second master's NMT command to a node, and what tells the nodes' states."""
    two.machine.reset()
    world = World(lockstep=True)
    world.add(two, [1, 2])
    bus = WorldBus(world)
    with CanDrives(bus=bus, nodes=[1, 2], pace="lockstep", timeout=0.2) as drives:
        yield drives, lambda command, node: world.receive(Frame(0x000, bytes((command, node)))), lambda: states(world)
    world.close()


def test_a_node_is_not_started_under_a_live_axis(on_can):
    """A second master has taken it to pre-operational, where a drive runs on with its last command."""
    drives, command, now = on_can
    motion.enable(drives, mode="pv", where=FIRST)
    command(0x80, 1)
    with pytest.raises(SafetyError, match=r"axis 0 is live \(6041h = [0-9A-F]{4}h\).*quick-stop or disable it"):
        drives.start_node()
    assert now() == [NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL]
    assert [int(word) & 0x6F for word in drives.read(0x6041)] == [0x27, 0x40], "neither axis was commanded"
    drives.write(0x6040, 0x06, where=FIRST)  # which leaves it ready to switch on, where a word may lead it on
    drives.start_node(FIRST)
    assert now() == [NmtState.OPERATIONAL] * 2
    assert (drives.read(0x6041) & 0x6F == 0x40).all()


def test_an_axis_of_another_node_turns_on_meanwhile(on_can, two):
    drives, command, now = on_can
    motion.enable(drives, mode="pv", where=SECOND)
    motion.turn(drives, 100_000, SECOND)
    drives.advance(0.2)
    command(0x02, 1)
    drives.start_node(FIRST)
    assert now() == [NmtState.OPERATIONAL] * 2
    for _ in range(10):
        drives.advance(0.01)
        still, turns = np.abs(two.machine.rotor_speed)
        assert still < STILL and turns > TURNS
    assert [int(word) & 0x6F for word in two.read(0x6041)] == [0x40, 0x27]


def test_a_node_with_an_axis_that_was_not_proved_off_is_not_started(on_can):
    drives, command, now = on_can
    command(0x02, 1)
    command(0x02, 2)
    drives.safety._axes.lost.add(0)
    with pytest.raises(SafetyError, match="axis 0 could not be confirmed to be off"):
        drives.start_node()
    drives.safety._axes.lost.clear()
    assert now() == [NmtState.STOPPED] * 2
    ChosenAxes(drives, [1]).start_node()
    assert now() == [NmtState.STOPPED, NmtState.OPERATIONAL]


@pytest.mark.parametrize("state", [AlState.SAFE_OP, AlState.PRE_OP], ids=lambda one: one.name)
def test_an_image_with_a_controlword_of_before_enables_nothing(state):
    """On EtherCAT the last image goes on: 0Fh in it would lead on an axis that another tool has switched on."""
    with linked(safety=False, nodes=(0, 1)) as (drives, segment):
        words = np.repeat([0x06, 0x07, 0x0F], 4)
        drives.write(0x6060, 9)
        drives.record([0x6041, 0x6064], 0.012, {0x6040: words, 0x60FF: np.full(12, 8000)})
        drives.advance(0.05)
        stopped, other = segment.world.drives
        assert (np.abs(other.machine.rotor_speed) > STILL).all()
        drives.link._master._to(0, state)
        for word in (0x00, 0x06, 0x07):
            stopped.write(0x6040, word)
        stopped.machine.reset()
        drives.start_node(np.arange(6) < 2)
        assert [slave.state for slave in segment.slaves] == [AlState.OP] * 2
        drives.advance(0.05)
        assert (stopped.read(0x6041) & 0x6F == 0x40).all() and (np.abs(stopped.machine.rotor_speed) < STILL).all()
        assert (other.read(0x6041) & 0x6F == 0x27).all() and (np.abs(other.machine.rotor_speed) > STILL).all()
        with pytest.raises(SafetyError, match="axis 3 is live"):
            drives.start_node(np.arange(6) == 4)
        drives.link.process._ready.clear()
        with pytest.raises(BusError, match="position 1 has no images either"):
            drives.start_node(np.arange(6) == 0)
