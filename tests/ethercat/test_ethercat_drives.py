"""`EtherCatDrives`: the interface of drives over EtherCAT, and what stops a drive when its master is gone."""

from __future__ import annotations

import inspect
import logging
import re
import struct
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.ethercat_segment import EmulatedSegment, linked
from typer.testing import CliRunner

from drive_env import EmulatedDrives, Limits, ObjectAccessError, SafetyError, cia402, motion
from drive_env.commands.cli import app
from drive_env.ethercat import datagrams, registers
from drive_env.ethercat.application import AlState, AlStatusCode
from drive_env.ethercat.controller import LOGICAL, WRITING
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.ways import UdpSocket
from drive_env.fieldbus import link
from drive_env.fieldbus.errors import BusError, NoAnswerError, OpenError, RefusedError
from drive_env.master.ethercat import frame_ways
from drive_env.master.ethercat.ethercat_link import EtherCatLink, OtherEtherCatMasters
from drive_env.master.ethercat.ethercat_master import EtherCatMaster
from drive_env.master.ethercat.frame_master import FrameMaster
from drive_env.master.ethercat.frame_ways import CallWay, UdpWay
from drive_env.master.ethercat.image_data import EtherCatProcessData, ImageRows, ImageSamples
from drive_env.master.ethercat.process_watchdog import ProcessWatchdog
from drive_env.master.ethercat.slave_objects import SlaveObjects
from drive_env.master.ethercat.soem_master import SoemMaster
from drive_env.master.ethercat_drives import EtherCatDrives
from drive_env.master.open_drives import default_nodes, open_drives
from drive_env.master.parameters import read_parameters

SAMPLED = [0x6041, 0x6064, 0x606C]
EACH = np.array([1, 2, 3])


@pytest.mark.parametrize(("protocol", "kinds"), [
    (link.Link, (EtherCatLink,)), (link.ObjectClient, (SlaveObjects,)), (link.ProcessData, (EtherCatProcessData,)),
    (link.Samples, (ImageSamples,)), (link.Outputs, (ImageRows,)), (link.MasterWatch, (ProcessWatchdog,)),
    (link.OtherMastersHeard, (OtherEtherCatMasters,)), (EtherCatMaster, (FrameMaster, SoemMaster)),
], ids=lambda one: getattr(one, "__name__", ""))  # fmt: skip
def test_it_is_a_link(protocol, kinds):
    asked = {name: one for name, one in vars(protocol).items() if inspect.isfunction(one) and name[0] != "_"}
    for kind in kinds:
        for name, one in asked.items():
            found = list(inspect.signature(getattr(kind, name)).parameters.values())
            wanted = list(inspect.signature(one).parameters.values())
            assert [p.name for p in found[: len(wanted)]] == [p.name for p in wanted], (kind, name)
            assert all(p.default is not p.empty for p in found[len(wanted) :]), (kind, name)


# --- parity -----------------------------------------------------------------------------------------------------------
def csp(drives):
    motion.enable(drives, mode="csp")
    start = drives.read(0x6064)
    targets = start + np.minimum(np.arange(250), 200)[:, None] * 4 * EACH
    yield drives.record(SAMPLED, 0.25, {0x607A: targets})
    yield drives.record(SAMPLED, 0.05)
    for k in range(5):  # a policy, cycle by cycle
        yield drives.record(SAMPLED, 0.001, {0x607A: [targets[-1] - 5 * k]})


def csv(drives):
    motion.enable(drives, mode="csv")
    yield drives.record(SAMPLED, 0.15, {0x60FF: np.arange(150)[:, None] * 20 * EACH})
    drives.write(0x60FF, 1000 * EACH)  # what an SDO writes is not undone by the next frame
    yield drives.record(SAMPLED, 0.1)


def pp(drives):
    motion.enable(drives, mode="pp")
    drives.write(0x6081, 40_000)
    drives.write(0x6083, 400_000)
    drives.write(0x6084, 400_000)
    motion.start_move(drives, 2000 * EACH)
    yield drives.record(SAMPLED, 0.5)  # the envelope would brake what still turns
    motion.disable(drives)
    yield drives.record(SAMPLED, 0.02)


SCRIPTS = {script.__name__: script for script in (csp, csv, pp)}


def as_integers(traces):
    return [np.stack([trace[index] for index in SAMPLED]) for trace in traces]


@pytest.mark.every(6)
@pytest.mark.parametrize("safety", [True, False], ids=["enveloped", "bare"])
@pytest.mark.parametrize("name", SCRIPTS)
def test_the_same_script_gives_the_same_integers(name, safety):
    with EmulatedDrives("tmcm3313", load="portal", num_threads=1) as inside:
        inside.advance(0.002)
        expected = as_integers(SCRIPTS[name](inside))
    with linked(safety) as (drives, _):
        found = as_integers(SCRIPTS[name](drives))
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_array_equal(one, other)
    assert all(np.ptp(expected[0][1], axis=0) > 100), "every axis moved"


def test_several_slaves_are_the_axes_in_their_order():
    with linked(nodes=(0, 1)) as (drives, segment):
        assert drives.num_axes == 6 and drives.nodes == (0, 1)
        motion.enable(drives, mode="csp")
        start, steps = drives.read(0x6064), np.arange(1, 7)
        trace = drives.record(SAMPLED, 0.15, {0x607A: start + np.minimum(np.arange(150), 100)[:, None] * 3 * steps})
        np.testing.assert_allclose(trace[0x6064][-1] - start, 300 * steps, atol=40)
        places = np.concatenate([one.read(0x6064) for one in segment.world.drives])
        np.testing.assert_array_equal(drives.read(0x6064), places)


# --- states, images, objects ------------------------------------------------------------------------------------------
def test_it_goes_to_op_when_a_motor_is_to_run_and_to_init_at_the_end():
    with linked() as (drives, segment):
        (slave,) = segment.slaves
        assert slave.state is AlState.PRE_OP
        drives.record(SAMPLED, 0.002)
        assert slave.state is AlState.OP
    assert slave.state is AlState.INIT
    assert slave.application.output_size == slave.application.input_size == 30, "its factory's images"


@pytest.mark.slow
def test_an_image_is_changed_while_no_axis_is_enabled_and_put_back():
    with linked(pace="real-time") as (drives, segment):
        own = read_parameters(drives)
        drives.record([0x6041, 0x6077], 0.003)
        assert read_parameters(drives) == own, "a backup has nothing of our image"
        assert [entry.index for entry in drives.sampled_entries()] == [0x6041, 0x6077, 0x6064]
        motion.enable(drives, mode="csp")
        refused = "cannot be changed while axis 0 is enabled; record or play it once before enabling"
        with pytest.raises(ObjectAccessError, match=refused):
            drives.record([0x6062], 0.002)
        with pytest.raises(ObjectAccessError, match=r"4 objects of 3 axes are more than the 9 .* fewer at a time"):
            drives.record([0x6062, 0x6064, 0x606C, 0x6077], 0.002)
        with pytest.raises(ObjectAccessError, match="cannot be recorded: it is no process data"):
            drives.record([0x6083], 0.002)
        assert (drives.read(0x6041) & 0x6F == 0x27).all(), "a refusal stops nobody"
    assert segment.slaves[0].application.input_size == 30


def test_in_lockstep_what_no_image_has_is_read_by_sdo_before_each_frame():
    """No time passes meanwhile: rows are those of a drive in process, whether an object is in the image or not."""
    objects = [0x6041, 0x6064, 0x606C, 0x6077, 0x6062, 0x6083]
    targets = np.minimum(np.arange(60), 40)[:, None] * np.array([4, 8, 12])

    def moved(drives):
        drives.record([0x6041, 0x6064, 0x6077], 0.003)
        motion.enable(drives, mode="csp")
        trace = drives.record(objects, 0.06, {0x607A: drives.read(0x6064) + targets})
        later = drives.record([0x6062, 0x6064], 0.005)
        motion.disable(drives)
        return np.stack([trace[index] for index in objects]), np.stack([later[index] for index in (0x6062, 0x6064)])

    with linked() as (drives, segment):
        found = moved(drives)
        assert segment.slaves[0].application.input_size == 24, "as it was chosen before the axes were enabled"
    with EmulatedDrives("tmcm3313", load="portal", num_threads=1) as inside:
        expected = moved(inside)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one[1:], other[1:])  # a statusword shows a controlword one row later


def test_a_refusal_names_the_object_and_the_position():
    with linked(safety=False) as (drives, _):
        with pytest.raises(
            RefusedError, match=r"position 0 refused the write of 4 to 6060h:00 .*abort code 0609 0030h"
        ):
            drives.write_raw(drives.description.dictionary.find(0x6060), 0, 4)
        assert drives.read(0x1008)[0].startswith("TMCM-3313")


def test_emergencies_come_by_the_mailbox():
    with linked(safety=False) as (drives, segment):
        motion.enable(drives, mode="csv")
        segment.slaves[0].application.watchdog_expired(segment.world.time)
        drives.advance(0.003)
        assert 0x8100 in {message.code for message in drives.emergencies()}


def test_a_reset_restarts_the_slave_and_a_restart_of_its_own_is_noticed():
    with linked() as (drives, segment):
        drives.record(SAMPLED, 0.002)
        drives.write(0x6081, 12345)
        drives.reset_node()
        assert drives.read(0x6081)[0] != 12345
        drives.record(SAMPLED, 0.002)
        heard = []
        drives.link.hear(lambda: None, heard.append)
        segment.slaves[0].power_on(segment.world.time)
        drives.must_start()
        drives.start()
        assert heard == [0] and segment.slaves[0].state is AlState.OP


@pytest.mark.every(7)
@pytest.mark.parametrize(("given", "says"), [
    ({"nodes": (1,)}, "there is no position 1: 1 slave answers; count from 0"),
    ({"nodes": (0, 0)}, "must be positions in the line, from 0, each once"),
    ({"nodes": (-1,)}, "must be positions in the line"),
    ({"pace": "fast"}, "pace is 'real-time' or 'lockstep'"),
    ({"bitrate": 1000}, "bitrate is for CAN; leave it out"),
    ({"colour": 1}, "EtherCatDrives takes no 'colour'"),
    ({"device": "tgz_d"}, "is not a tgz_d"),
])  # fmt: skip
def test_what_cannot_be_opened_is_told(given, says):
    with EmulatedSegment() as segment, pytest.raises((BusError, ValueError), match=says):
        EtherCatDrives(**{"device": "tmcm3313", "master": segment.master(), "pace": "lockstep"} | given)


def test_nobody_there_is_told():
    with pytest.raises(NoAnswerError, match="no slave answers on this process; check cable, power and channel"):
        EtherCatDrives(master=FrameMaster(CallWay(lambda frame: None)))
    with pytest.raises(OpenError, match="channel 'x' must be a UDP port"):
        EtherCatDrives(interface="ethercat-udp", channel="x")


# --- the watch over the master ----------------------------------------------------------------------------------------
def let_pass(segment, until, patience=60.0):
    end = time.monotonic() + patience
    while time.monotonic() < end:
        with segment.turn:
            if until():
                return
        time.sleep(0.002)
    raise AssertionError("it did not happen")


def turning(drives, segment):
    """Have all axes turn; return the speed of the first [pps]."""
    motion.enable(drives, mode="pv")
    drives.write(0x6083, 400_000)
    drives.write(0x6084, 400_000)
    drives.write(0x60FF, 20_000)
    drives.advance(0.3)
    with segment.turn:
        return abs(int(segment.drives.read(0x606C)[0]))


def test_a_cable_that_is_pulled_stops_the_axes_by_the_slaves_own_watchdog(caplog):
    with linked(Limits(silence=0.3), "real-time", timeout=0.3, load="inertia", num_machines=3) as (drives, segment):
        assert turning(drives, segment) > 10_000
        (slave,) = segment.slaves
        assert drives.link.watch.detection_time == pytest.approx(0.3)
        assert slave.controller.watchdog_time == pytest.approx(0.3)
        with caplog.at_level(logging.CRITICAL):
            segment.is_connected = False
            let_pass(segment, lambda: slave.state is AlState.SAFE_OP)
            assert slave.code is AlStatusCode.SM_WATCHDOG
            let_pass(segment, lambda: not cia402.is_live(segment.drives.read(0x6041)).any())
            assert abs(int(segment.drives.read(0x606C)[0])) < 100
            with pytest.raises((SafetyError, NoAnswerError)):
                drives.advance(1.0)
            segment.is_connected = True
    assert not cia402.is_live(segment.drives.read(0x6041)).any()


@pytest.mark.every(2)
@pytest.mark.parametrize(("register", "value"), [(0x0420, b"\0\0"), (0x0400, b"\xff\xff")])
def test_a_watchdog_that_another_master_switches_off_stops_the_axes_and_is_set_again(register, value):
    """With 0420h = 0 the motors ran on for ever after the program's death; with 0400h = FFFFh for 26 times as long."""
    with linked(Limits(silence=0.3), "real-time", load="inertia", num_machines=3) as (drives, segment):
        assert turning(drives, segment) > 10_000
        (slave,) = segment.slaves
        with pytest.raises(SafetyError, match=r"another master has changed the watchdog of position 0"):
            with segment.turn:
                assert slave.controller.write(register, value, 0)
            for _ in range(600):
                drives.advance(0.1)
        let_pass(segment, lambda: slave.controller.watchdog_time == pytest.approx(0.3))
        # Held at rest in quick stop active, an axis obeys no watchdog (manual, section 2.2): its stop ends first.
        let_pass(segment, lambda: (segment.drives.inside.records["stage_on"] == 0.0).all())
        segment.is_connected = False
        let_pass(segment, lambda: slave.state is AlState.SAFE_OP)
        segment.is_connected = True


def test_an_exception_in_the_program_stops_the_axes_before_op_is_left():
    with pytest.raises(KeyError), linked(pace="real-time", load="inertia", num_machines=3) as (drives, segment):
        assert turning(drives, segment) > 10_000
        raise KeyError
    assert segment.slaves[0].state is AlState.INIT
    assert not cia402.is_live(segment.drives.read(0x6041)).any()
    assert abs(int(segment.drives.read(0x606C)[0])) < 100
    assert segment.slaves[0].controller.watchdog_time == pytest.approx(0.1), "put back"


@pytest.mark.slow
def test_a_program_that_computes_is_no_dead_master():
    with linked(Limits(silence=0.4), pace="real-time") as (drives, segment):
        motion.enable(drives, mode="csp")
        time.sleep(0.9)  # the supervisor exchanges images meanwhile
        assert segment.slaves[0].state is AlState.OP
        assert (drives.read(0x6041) & 0x6F == 0x27).all()
        motion.disable(drives)


def test_time_that_does_not_wait_is_no_lockstep():
    with (
        EmulatedSegment(lockstep=False) as segment,
        EtherCatDrives(master=segment.master(), pace="lockstep") as drives,
        pytest.raises(SafetyError, match="time passes by itself on this bus"),
    ):
        motion.enable(drives, mode="csp")


def test_lost_and_damaged_frames_change_nothing_but_time():
    """Every fifth frame is lost, cut or changed in lockstep; transfers and samples come all the same."""
    count = 0

    def damage(frame):
        nonlocal count
        count += 1
        return frame if count % 5 else (None, frame[:40], frame[:17])[count // 5 % 3]

    with EmulatedSegment() as segment:
        segment.damage = damage
        with EtherCatDrives(master=segment.master(), pace="lockstep", safety=False) as drives:
            drives.write(0x6081, 4321)
            assert drives.read(0x6081).tolist() == [4321] * 3
            assert len(drives.record(SAMPLED, 0.05).t) == 50
            assert len(drives.read(0x1008)[0]) > 4
    assert count > 200


def test_the_row_of_a_lost_frame_is_taken_by_the_next_one():
    """Rows are as many as cycles; what stays out is said, and taken as soon as frames come back again."""
    with linked(safety=False) as (drives, segment):
        drives.record([0x6041], 0.005)  # Op
        images = drives.link.process
        rows = images.samples()
        found = []
        for is_connected in (True, False, False, True, True):
            segment.is_connected = is_connected
            drives.link.sync()
            found.append((rows.complete(), images.owed))
        assert found == [(1, 0), (1, 1), (1, 2), (4, 0), (5, 0)]
        assert images.settle(0.01), "nothing stays out"
        segment.is_connected = False
        drives.link.sync()
        assert not images.settle(0.01), "a row stays out"
        segment.is_connected = True
        assert images.settle(0.01) and rows.complete() == 6
        rows.close()


def test_a_datagram_that_is_announced_and_never_comes_is_not_waited_for(monkeypatch):
    """The kernel may say that there is one, and then drop it for its check sum (select(2), BUGS)."""
    way, found = UdpWay(29999), []
    monkeypatch.setattr(frame_ways, "select", SimpleNamespace(select=lambda *_: ([way], [], [])))
    taker = threading.Thread(target=lambda: found.append(way.receive(0.001)), daemon=True)
    taker.start()
    taker.join(10.0)
    assert found == [None]
    way.close()


def test_a_slave_that_is_not_where_this_program_took_it_is_told():
    with linked(safety=False) as (drives, segment):
        others = drives.link.other_masters()
        others.check()
        drives.record([0x6041], 0.005)  # Op
        others.check()
        drives.link.other_masters().check()
        segment.master().begin()  # another master, which takes all slaves
        with pytest.raises(BusError, match="is in Pre-Op, and this program took it to Op: another master uses"):
            others.check()


# --- programs ---------------------------------------------------------------------------------------------------------
def test_programs_choose_the_link_by_the_interface(monkeypatch):
    monkeypatch.delenv("DRIVE_ENV_INTERFACE", raising=False)
    assert default_nodes("socketcan") == default_nodes(None) == (1,) and default_nodes("ethercat-udp") == (0,)
    with pytest.raises(OpenError, match="must be a UDP port"):
        open_drives("tmcm3313", interface="ethercat-udp", channel="none")
    monkeypatch.setenv("DRIVE_ENV_INTERFACE", "ethercat-udp")
    with pytest.raises(OpenError, match="must be a UDP port"):
        open_drives("tmcm3313", channel="none")


@pytest.fixture
def over_udp():
    """Options of a command for slaves that are served over UDP in lockstep."""
    with EmulatedSegment() as segment:
        way = UdpSocket(0)
        with EtherCatServer(segment.world, way):
            yield ["--interface", "ethercat-udp", "--channel", str(way.port)]


def run(*words):
    done = CliRunner().invoke(app, list(map(str, words)))
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.every(9)
@pytest.mark.parametrize(("words", "says"), [
    (("scan", "--first", "3"), "--first is for CAN; all slaves of a segment are found"),
    (("scan", "--bitrate", "500000"), "--bitrate is for CAN"),
    (("frames", "log", "frames.asc"), "carries no CAN frames"),
    (("get", "6041", "--device", "tmcm3313", "--position", "4"), "there is no position 4: 1 slave answers"),
    (("get", "6041", "--device", "tmcm3313", "--axis", "9"), "a tmcm3313 has 3 axes"),
    (("set", "6041", "5", "--device", "tmcm3313"), "can only be read"),
    (("scope", "6083", "--duration", "0.01", "--device", "tmcm3313"), "cannot be recorded"),
    (("parameters", "backup", "drive.toml", "--device", "tgz_d"), "it is a tmcm3313"),
    (("monitor", "zz", "--device", "tmcm3313"), "no object is named"),
])  # fmt: skip
def test_wrong_options_are_told_in_a_line(over_udp, tmp_path, monkeypatch, words, says):
    monkeypatch.chdir(tmp_path)
    done = CliRunner(env={"COLUMNS": "300", "NO_COLOR": "1"}).invoke(app, [*words, *over_udp])
    assert isinstance(done.exception, SystemExit) and done.exit_code in (1, 2), done.output
    assert says in done.output


@pytest.mark.slow
def test_commands_over_udp(over_udp, tmp_path):
    said = run("scan", *over_udp)
    assert said.split()[:3] == ["position", "0", "tmcm3313"] and "vendor 286h" in said and "Init" in said
    device = ["--device", "tmcm3313", "--node", "0", *over_udp]
    run("set", "6081", "5000", *device)
    assert run("get", "6081", "--raw", *device).splitlines()[2].endswith("= 5000")
    file = tmp_path / "drive.toml"
    assert "of node 0" in run("parameters", "backup", file, *device)
    run("set", "6081", "6000", *device)
    run("parameters", "restore", file, "--yes", *device)
    assert run("get", "6081", "--raw", *device).splitlines()[0].endswith("= 5000")


def test_a_scan_reads_an_eeprom_that_a_master_has_left_to_the_device():
    """As SOEM does; it is left as it was."""
    with EmulatedSegment(number=2) as segment:
        for slave in segment.slaves:
            slave.controller.memory[registers.SII_ACCESS] = 1
        found = segment.master().look()
        assert [(one.vendor, one.product) for _, one in found] == [(0x286, 3313)] * 2
        assert [slave.controller.memory[registers.SII_ACCESS] for slave in segment.slaves] == [1, 1]


# --- what has no room in an image -------------------------------------------------------------------------------------
FOUR = [0x6064, 0x6062, 0x6077, 0x6041]  # of three axes 12, and the image takes 9


@pytest.mark.slow
def test_a_statusword_that_has_no_room_is_asked_for_meanwhile():
    with linked(pace="real-time", load="inertia", num_machines=3) as (drives, segment):
        assert drives.can_record(FOUR) and not drives.can_record([*FOUR, 0x606C])
        trace = drives.record(FOUR, 0.05)
        assert all(trace[name].shape == (50, 3) for name in FOUR)
        assert (trace[0x6041] & 0x6F == 0x40).all(), "switch on disabled"
        motion.enable(drives, mode="pp")
        enabled = drives.record(FOUR, 0.05)
        assert (enabled[0x6041] & 0x6F == 0x27).all()
        less = drives.record([0x6064, 0x6041], 0.02)  # the image cannot be changed now, and lacks one of them
        assert (less[0x6041] & 0x6F == 0x27).all()
        segment.drives.write(0x6040, 0, where=np.array([True, False, False]))
        off = drives.record(FOUR, 0.1)[0x6041] & 0x4F
        assert off[0].tolist()[1:] == [0x07, 0x07] and off[-1].tolist() == [0x40, 0x07, 0x07]
        with pytest.raises(ObjectAccessError, match=r"606Ch.* is not in the process image"):
            drives.record([0x6064, 0x606C], 0.01)


def is_mail(frame):
    """Whether a frame carries a message to a mailbox."""
    return any(len(one.data) == 256 for one in datagrams.read(frame, datagrams.ETHERNET))


def test_a_drive_that_is_silent_is_told_by_what_asks_for_its_statusword():
    with linked(safety=False, pace="real-time", timeout=0.05, load="inertia", num_machines=3) as (drives, segment):
        drives.record(FOUR, 0.01)
        segment.damage = lambda frame: None if is_mail(frame) else frame
        with pytest.raises(NoAnswerError, match="did not answer"):
            drives.record(FOUR, 0.2)


@pytest.mark.parametrize(("pace", "has"), [("lockstep", True), ("real-time", False)])
def test_a_tgz_sends_its_demand_in_lockstep_alone(pace, has):
    with (
        EmulatedSegment("tgz_d", lockstep=pace == "lockstep", load="gantry") as segment,
        EtherCatDrives("tgz_d", master=segment.master(), pace=pace, safety=False) as drives,
    ):
        assert drives.can_record([0x6064, 0x6077, 0x6041])
        assert drives.can_record([0x6062]) is has


def frames_of(segment):
    """Return the datagrams that were sent to a segment from now on."""
    sent = []
    segment.world.segment.listeners.append(
        lambda now, frame, is_back: None if is_back else sent.extend(datagrams.read(frame, datagrams.ETHERNET))
    )
    return sent


def writes_an_object(datagram):
    """Whether it carries the initiation of an SDO download to a mailbox."""
    if datagram.command != datagrams.DatagramCommand.FPWR or len(datagram.data) != 256:
        return False
    is_sdo = datagram.data[5] & 0x0F == 3 and datagram.data[7] >> 4 == 2
    return is_sdo and datagram.data[8] >> 5 in (0, 1)


def control_of(datagram):
    """The state that it asks for by AL control; 0: it asks for none."""
    _, register = struct.unpack("<HH", struct.pack("<I", datagram.address))
    return datagram.data[0] & 0x0F if register == 0x0120 and datagram.command in WRITING else 0


def test_a_dry_run_writes_no_object_sends_no_image_and_goes_to_pre_op_at_most(tmp_path):
    file = tmp_path / "drive.toml"
    with EmulatedSegment() as segment:
        way = UdpSocket(0)
        with EtherCatServer(segment.world, way):
            device = ["--device", "tmcm3313", "--interface", "ethercat-udp", "--channel", str(way.port)]
            run("set", "6081", "5000", "--yes", *device)
            run("parameters", "backup", file, *device)
            run("set", "6081", "6000", "--yes", *device)
            sent = frames_of(segment)
            run("set", "6081", "7000", "--dry-run", *device)
            run("parameters", "restore", file, "--dry-run", *device)
            run("jog", "30 rpm", "--for", "0.2", "--axis", "1", "--dry-run", *device)
            assert any(len(one.data) == 256 for one in sent), "it has read"
            assert not [one for one in sent if writes_an_object(one)]
            assert not [one for one in sent if one.command in LOGICAL]
            assert {control_of(one) for one in sent} <= {0, AlState.INIT, AlState.PRE_OP}
            sent.clear()
            run("set", "6081", "7000", "--yes", *device)
            assert [one for one in sent if writes_an_object(one)], "a run that is not dry is seen so"


@pytest.mark.slow
def test_programs_that_sample_and_move_in_real_time_over_udp(tmp_path):
    with EmulatedSegment(load="inertia", num_machines=3) as segment:
        segment.world.lockstep = False
        way = UdpSocket(0)
        with EtherCatServer(segment.world, way):
            device = ["--device", "tmcm3313", "--interface", "ethercat-udp", "--channel", way.port]
            run("scope", "6041", "6064", "--duration", "0.05", "--out", tmp_path / "trace", *device)
            assert len((tmp_path / "trace.csv").read_text(encoding="utf-8").splitlines()) == 51
            assert "6064h" in run("monitor", "6064", "--duration", "0.05", *device)
            before = float(segment.drives.machine.rotor_angle[1])
            said = run("jog", "30 rpm", "--for", "0.3", "--axis", "1", *device)
            moved = (float(segment.drives.machine.rotor_angle[1]) - before) / (2 * np.pi)
            assert float(re.search(r"\((\S+) rev\)", said)[1]) == pytest.approx(moved, abs=0.01) and moved > 0.1
            assert not cia402.is_live(segment.drives.read(0x6041)).any()
        segment.world.lockstep = True
