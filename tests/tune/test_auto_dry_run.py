"""`drive-tune auto --dry-run`: everything is looked at, nothing is written, and what a run writes was told before."""

from __future__ import annotations

import json
from contextlib import contextmanager

import numpy as np
import pytest
from rigs.auto_stages import run_agent
from rigs.ethercat_segment import EmulatedSegment
from typer.testing import CliRunner

from agents.policies.policy import load_policy
from agents.shipped import shipped
from drive_env import EmulatedDrives, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.frames import NMT, SDO_REQUEST, Frame
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.ways import UdpSocket
from drive_env.master.can.sdo import SdoClient
from tuning.commands.cli import app
from tuning.rehearsal import NO, rehearse
from tuning.target import on_bus

TURN = 65536
UPLOADS = (0x40, 0x60)  # upper three bits of an SDO request that reads: initiate, segment
STOP = 0x02  # NMT command
AFTER_A_TRIP = {(0x605A, 0)}
WIRED_OTHERWISE = {(0x2080, 1), (0x2070, 1), (0x2070, 2)}  # what is set right only where the cable is another
IN_REAL_TIME = {(0x1016, 1), (0x1029, 1)}  # in lockstep nobody watches over a master


@contextmanager
def served(load="two_mass", prepare=lambda drives: None):
    """A node in lockstep; gives world, drives, channel, and the frames that its masters send."""
    world, frames = World(lockstep=True), []
    drives = EmulatedDrives(load=load, num_threads=1)
    world.add(drives, [1])
    world.listeners.append(lambda ended: frames.append(ended.frame) if ended.sender != ("node", 1) else None)
    world.power_on()
    prepare(drives)
    hub = Hub()
    with Server(world, hub):
        yield world, drives, hub.channel, frames
    world.close()


def dictionary_of(world):
    """Every object of the node that can be read, as bytes on the bus would show it."""
    node, found = world.nodes[1], {}
    for entry in node.dictionary.entries:
        try:
            found[entry.index, entry.sub] = node.dictionary.port(entry.index, entry.sub).read()
        except ObjectAccessError:
            continue
    assert len(found) > 150
    return found


def dry_run(channel, *more):
    bus = ["--interface", "slcan", "--channel", channel, "--lockstep"]
    arguments = ["auto", *bus, "--travel", "-2:2", "--dry-run", *more]
    result = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, arguments)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


@pytest.mark.every(4)
@pytest.mark.parametrize("by", ["design", "agent", "rule", "tpe"])
def test_the_drive_is_read_and_nothing_else(by):
    with served() as (world, _, channel, frames):
        before, state = dictionary_of(world), world.nodes[1].state
        found = dry_run(channel, "--by", by)
        assert (found.exit_code, found.stderr) == (0, "")
        assert dictionary_of(world) == before and world.nodes[1].state is state and world.time == 0.0
        assert len(frames) > 100
        assert all(frame.can_id == SDO_REQUEST + 1 and frame.data[0] & 0xE0 in UPLOADS for frame in frames)
    for line in ("ok    identity: node 1 is a tmcm1636: TMCM-1636", "ok    state: switch on disabled",
                 "ok    interface: SDO answers in", "would carry 6064h", "ok    heartbeat: the drive can monitor",
                 "pole pairs 4", "24 V entered", "6064h from -131072 to 131072, now 0",
                 "a quick stop for a position beyond", "now torque P 4021",
                 "It would move axis 0 between -12.6 and 12.6 rad from where it is",
                 "Nothing was written."):  # fmt: skip
        assert line in found.stdout, line


def test_for_programs_as_json():
    with served() as (_, _, channel, _):
        found = json.loads(dry_run(channel, "--json", "--no-store").stdout)
    assert found["would run"] is True
    gains = next(row for row in found["writes"] if row["key"] == [0x2042, 1])
    assert gains["present"] == [445] and gains["stays"] and gains["values"] == "1...32767"
    assert [0x1010, 1] not in [row["key"] for row in found["writes"]]


@pytest.mark.slow
def test_a_run_writes_nothing_that_was_not_told(tmp_path, monkeypatch):
    written = set()
    write = SdoClient.write

    def watch(self, index, sub, *rest):
        written.add((index, sub))
        write(self, index, sub, *rest)

    monkeypatch.setattr(SdoClient, "write", watch)
    policy = load_policy(shipped("gain_tuning"))
    policy.bundle.configuration["trials"] = 1
    ways = (-2.0 * np.pi, 2.0 * np.pi)
    with (
        served() as (_, _, channel, _),
        on_bus(interface="slcan", channel=channel, pace="lockstep", travel=ways) as target,
    ):
        told = {row.key for row in rehearse(target).writes}
        assert not written
        run_agent(target, policy, tmp_path / "before.toml", name="gain_tuning")
    assert written <= told
    mapping = {key for key in told if 0x1600 <= key[0] < 0x1B00}  # entries that this run's PDOs do not have
    assert told - written - mapping - AFTER_A_TRIP - WIRED_OTHERWISE == IN_REAL_TIME


def enable(drives):
    motion.enable(drives, mode="pv")


def turn(drives):
    enable(drives)
    drives.write(0x60FF, 5 * TURN)
    drives.advance(0.5)
    drives.write(0x6040, 0)  # and it coasts


@pytest.mark.every(6)
@pytest.mark.parametrize(
    ("prepare", "line"),
    [
        (lambda d: d.write(0x2056, 7), "no    motor: 2056h:00 (pole pairs) is 7, and 4 is needed for qbl4208"),
        (lambda d: d.write((0x2080, 2), 8192), "2080h:02 (encoder counts) is 8192, and 4096 is needed"),
        (lambda d: d.write(0x2055, 1), "2055h:00 (commutation by the encoder) is 1, and 3 is needed"),
        (lambda d: d.write(0x2050, 0), "no    motor: the drive is not commissioned for a motor"),
        (lambda d: d.write(0x2003, 0), "no    limits: "),
        (lambda d: (d.write((0x2006, 2), 200), d.write((0x2006, 1), 1)), "the brake chopper acts from 20 V"),
        (lambda d: d.write((0x607D, 2), TURN), "no    travel: -12.6 to 12.6 rad from here"),
        (enable, "no    state: operation enabled (statusword"),
        (turn, "no    standstill: the axis turns at"),
    ],
)
def test_what_a_run_would_not_begin_for(prepare, line):
    with served(prepare=prepare) as (world, _, channel, frames):
        before = dictionary_of(world)
        found = dry_run(channel)
        assert dictionary_of(world) == before
        assert all(frame.data[0] & 0xE0 in UPLOADS for frame in frames)
    assert found.exit_code == 1 and line in found.stdout
    assert found.stderr.startswith("drive-tune: a run would not start")


@pytest.mark.slow
@pytest.mark.parametrize("patient_masters", [None], ids=["as patient as a user's"])
def test_a_node_that_is_stopped_stays_so(patient_masters):
    with served() as (world, _, channel, frames):
        world.nodes[1].receive(Frame(NMT, bytes((STOP, 1))), world.time)
        state = world.nodes[1].state
        found = dry_run(channel)
        assert world.nodes[1].state is state
        assert {frame.can_id for frame in frames} == {SDO_REQUEST + 1}
    assert (
        found.exit_code == 1
        and "if it is in the NMT state stopped, a run without --dry-run takes it to pre-operational" in found.stderr
    )


def test_an_emulated_drive_is_rehearsed_as_well(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["auto", "--by", "agent", "--dry-run", "--trials", "3"])
    assert (
        found.exit_code == 0 and "1 + 3 trials of gains that the agent proposes (3 moves of 250 ms each" in found.stdout
    )
    assert NO + " " not in [line.strip()[:3] for line in found.stdout.splitlines()]
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("by", [[], ["--by", "tpe"]])
def test_what_a_stepper_would_write_cannot_be_told_and_no_other_run_is_named_in_its_place(by):
    found = CliRunner().invoke(app, ["auto", *by, "--device", "tmcm6212", "--load", "inertia", "--dry-run"])
    assert found.exit_code == 2 and "cannot be listed before; leave --dry-run out" in " ".join(found.stderr.split())


@pytest.mark.slow
def test_the_files_that_a_search_would_write_are_those_that_it_writes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    search = ["auto", "--by", "tpe", "--load", "inertia", "--trials", "2", "--out", "found", "--json"]
    told = json.loads(CliRunner().invoke(app, [*search, "--dry-run"]).stdout)["files"]
    CliRunner().invoke(app, search)
    assert sorted(told) == sorted(f"found/{one.name}" for one in (tmp_path / "found").iterdir())


@pytest.mark.parametrize(("pace", "of_demand"), [("lockstep", "6062h, 6077h"), ("real-time", "is computed from")])
def test_a_drive_of_two_axes_on_ethercat_is_rehearsed(pace, of_demand):
    with EmulatedSegment("tgz_d", load="inertia", num_machines=2) as segment:
        segment.world.lockstep = pace == "lockstep"
        way = UdpSocket(0)
        with EtherCatServer(segment.world, way):
            bus = ["--interface", "ethercat-udp", "--channel", str(way.port), "--device", "tgz_d"]
            more = ["--lockstep"] if pace == "lockstep" else []
            found = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(
                app, ["auto", *bus, *more, "--travel", "-2:2", "--dry-run"]
            )
        segment.world.lockstep = True
    assert found.exception is None or isinstance(found.exception, SystemExit), found.exception
    assert of_demand in found.output
    for part in ("position 0 axis 1: standstill", "1C13h:01", "0420h would be set to"):
        assert part in found.output, part
    assert "PDO" not in found.output and "Nothing was written." in found.output


def test_a_node_of_two_axes_on_can_is_rehearsed():
    world = World(lockstep=True)
    world.add(EmulatedDrives("tgz_d", "inertia", num_machines=2, num_threads=1), [1])
    world.power_on()
    hub = Hub()
    with Server(world, hub):
        found = dry_run(hub.channel, "--device", "tgz_d")
    world.close()
    assert "node 1 axis 1: standstill: the axis is at rest" in found.output
