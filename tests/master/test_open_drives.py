"""What the constructors of drives on CAN and EtherCAT make of their options, and which of them a program means."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from drive_env import Limits
from drive_env.ethercat.datagrams import PORT
from drive_env.fieldbus.errors import OpenError
from drive_env.master import can_drives, ethercat_drives, open_drives
from drive_env.master.bus_drives import BusDrives
from drive_env.master.can.bus_time import BIT_RATE
from drive_env.master.can_drives import CanDrives
from drive_env.master.ethercat import frame_master, frame_ways, soem_master
from drive_env.master.ethercat_drives import EtherCatDrives, check_positions, open_frames, open_master
from drive_env.master.pace import LockstepPace, RealTimePace


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    """No interface and no channel in the environment."""
    for name in ("DRIVE_ENV_INTERFACE", "DRIVE_ENV_CHANNEL"):
        monkeypatch.delenv(name, raising=False)
    return monkeypatch


@pytest.fixture
def made(monkeypatch):
    """What drives are made of, without a bus: `link`, `description`, `pace`, `safety`, with what parts were given."""
    made = SimpleNamespace()

    def init(self, link, description, pace, safety):
        made.link, made.description, made.pace, made.safety, self._closed = link, description, pace, safety, True

    def part(name):
        return lambda *given, **named: (name, *given, *named.items())

    monkeypatch.setattr(BusDrives, "__init__", init)
    for name in ("CanLink", "Port", "DryPort", "BusTime", "open_bus"):
        monkeypatch.setattr(can_drives, name, part(name))
    process = SimpleNamespace(phase=None)
    monkeypatch.setattr(ethercat_drives, "EtherCatLink", lambda *given: SimpleNamespace(given=given, process=process))
    made.opened = []
    monkeypatch.setattr(ethercat_drives, "open_master", lambda *given: made.opened.append(given) or "a master")
    made.process = process
    return made


# --- CAN --------------------------------------------------------------------------------------------------------------
def test_can_drives_by_default_are_guarded_and_paced_by_the_clock(made):
    drives = CanDrives(channel="c", token="t")
    kind, port, nodes, description, bus_time, _ = made.link
    assert (kind, nodes, description) == ("CanLink", (1,), made.description)
    assert port == drives.port == ("Port", ("open_bus", None, "c", ("token", "t")))
    assert bus_time == ("BusTime", float(BIT_RATE), 0.001)
    assert isinstance(made.pace, RealTimePace) and made.pace._cycle == 0.001
    assert made.safety is True and made.description.name == "tmcm1636"
    assert made.description.timeout is None and made.description.cycles_per_sync == 1


def test_a_longer_cycle_and_another_bit_rate(made):
    CanDrives(cycle=0.004, bitrate=500_000, timeout=0.25, timeouts={0x1010: 3.0}, nodes=(3, 4), safety=False)
    assert made.description.cycle == pytest.approx(0.004) and made.description.cycles_per_sync == 4
    assert made.pace._cycle == pytest.approx(0.004) and made.link[4] == ("BusTime", 500_000.0, pytest.approx(0.004))
    assert made.description.timeout == 0.25 and made.description.timeouts == {(0x1010, 0): 3.0}
    assert made.link[2] == (3, 4) and made.safety is False
    for options in ({"timeout": 0.0}, {"timeouts": {0x6041: -1.0}}):
        with pytest.raises(ValueError, match=r"a time-out of .* is impossible"):
            CanDrives(**options)
    with pytest.raises(ValueError, match="pace is 'real-time' or 'lockstep', not 'fast'"):
        CanDrives(pace="fast")
    with pytest.raises(ValueError, match=r"cycle=0.002 s is for real time"):
        CanDrives(pace="lockstep", cycle=0.002)


@pytest.mark.parametrize("options", [{"pace": "lockstep"}, {"dry_run": True}, {"dry_run": str.strip}], ids=str)
def test_where_time_waits_the_bus_takes_no_time(made, options):
    CanDrives(**options)
    assert isinstance(made.pace, LockstepPace) and made.link[4] == ("BusTime",)
    taker = options.get("dry_run")
    if taker is not None:
        assert made.link[1] == ("DryPort", print if taker is True else taker)


def test_a_bus_that_was_given_stays_open(made):
    CanDrives(bus="a bus")
    assert made.link[1] == ("Port", "a bus", ("owned", False))


# --- EtherCAT ---------------------------------------------------------------------------------------------------------
def test_ethercat_drives_by_default_are_guarded_and_paced_by_the_clock(made):
    EtherCatDrives(channel="eth1")
    assert made.opened == [("ethercat", "eth1", None)]
    assert made.link.given == ("a master", (0,), made.description, False, False)
    assert isinstance(made.pace, RealTimePace) and made.pace._phase is None
    assert made.safety is True and made.description.name == "tmcm3313" and made.description.timeout is None
    own = made.description.cycle
    made.process.phase = SimpleNamespace(wait="suits the clocks")
    EtherCatDrives(cycle=2 * own, sync0=True, nodes=(1, 0), timeout=0.25, timeouts={0x6041: 3.0}, safety=False)
    assert made.description.cycle == pytest.approx(2 * own) == made.pace._cycle
    assert made.description.cycles_per_sync == 2 and made.pace._phase == "suits the clocks"
    assert made.link.given[1:] == ((1, 0), made.description, False, True) and made.safety is False
    assert made.description.timeout == 0.25 and made.description.timeouts == {(0x6041, 0): 3.0}


def test_in_lockstep_a_frame_is_waited_for_as_long_as_an_answer(made):
    EtherCatDrives(pace="lockstep", timeout=7.0, interface="ethercat-udp")
    assert made.opened == [("ethercat-udp", None, 7.0)]
    assert isinstance(made.pace, LockstepPace) and made.link.given[3] is True
    EtherCatDrives(master="mine", safety=limits if (limits := Limits(velocity=5.0)) else None)
    assert len(made.opened) == 1 and made.link.given[0] == "mine" and made.safety is limits


@pytest.mark.parametrize(("nodes", "positions"), [
    ((0,), (0,)), ([2, 0], (2, 0)), ((), None), ((1, 1), None), ((-1,), None), ((0, -1), None),
])  # fmt: skip
def test_positions_in_the_line(nodes, positions):
    if positions is None:
        with pytest.raises(ValueError, match="must be positions in the line, from 0, each once"):
            check_positions(nodes)
    else:
        assert check_positions(iter(nodes)) == positions


@pytest.fixture
def ways(monkeypatch):
    """Masters and ways that open nothing."""
    monkeypatch.setattr(soem_master, "SoemMaster", lambda name: ("soem", name))
    monkeypatch.setattr(frame_master, "FrameMaster", lambda way, timeout: ("frames", way, timeout))
    monkeypatch.setattr(frame_ways, "RawWay", lambda name: ("raw", name))
    monkeypatch.setattr(frame_ways, "UdpWay", lambda port: ("udp", port))


UDP, RAW, FRAME = "ethercat-udp", "ethercat", frame_master.FRAME


@pytest.mark.parametrize(
    ("interface", "channel", "timeout", "found"),
    [
        (RAW, "eth1", None, ("soem", "eth1")),
        (UDP, None, None, ("frames", ("udp", PORT), FRAME)),
        (UDP, "1", 2.0, ("frames", ("udp", 1), 2.0)),
        (UDP, "65535", None, ("frames", ("udp", 65_535), FRAME)),
    ],
)
def test_a_master_on_a_network_interface_or_over_udp(ways, interface, channel, timeout, found):
    assert open_master(interface, channel, timeout) == found


@pytest.mark.parametrize(
    ("interface", "channel", "error", "said"),
    [
        (RAW, None, OpenError, "needs a channel, the network interface, e.g. eth1"),
        (RAW, "", OpenError, "needs a channel"),
        (UDP, "0", OpenError, "channel '0' must be a UDP port, 1 to 65535; without it ethercat-udp takes"),
        (UDP, "65536", OpenError, "must be a UDP port"),
        (UDP, "-1", OpenError, "must be a UDP port"),
        ("socketcan", "can0", ValueError, "interface is 'ethercat' or 'ethercat-udp' on EtherCAT, not 'socketcan'"),
    ],
)
def test_what_is_no_way_to_a_segment(ways, interface, channel, error, said):
    with pytest.raises(error, match=said):
        open_master(interface, channel)
    with pytest.raises(error, match=said):
        open_frames(interface, channel)


def test_interface_and_channel_may_be_in_the_environment(ways, environment):
    assert open_frames(RAW, "eth1") == ("frames", ("raw", "eth1"), FRAME)
    environment.setenv("DRIVE_ENV_CHANNEL", "77")
    environment.setenv("DRIVE_ENV_INTERFACE", UDP)
    assert open_frames(None, None) == ("frames", ("udp", 77), FRAME)
    assert open_master(UDP, "78") == ("frames", ("udp", 78), FRAME)
    environment.setenv("DRIVE_ENV_CHANNEL", "eth9")
    assert open_master(RAW, None) == ("soem", "eth9") and open_master(RAW, "eth1") == ("soem", "eth1")


# --- which of them ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("given", "variable", "ethercat"), [
    (RAW, None, True), (UDP, None, True), (None, UDP, True), ("socketcan", UDP, False), (None, None, False),
    (None, "socketcan", False), (RAW, "socketcan", True),
])  # fmt: skip
def test_the_link_that_options_mean(monkeypatch, environment, given, variable, ethercat):
    if variable is not None:
        environment.setenv("DRIVE_ENV_INTERFACE", variable)
    monkeypatch.setattr(ethercat_drives, "EtherCatDrives", lambda device, **options: ("EtherCAT", device, options))
    monkeypatch.setattr(can_drives, "CanDrives", lambda device, **options: ("CAN", device, options))
    nodes = (0,) if ethercat else (1,)
    assert open_drives.is_ethercat(given) is ethercat and open_drives.default_nodes(given) == nodes
    kind, device, options = open_drives.open_drives(interface=given, channel="c")
    assert (kind, device, options["nodes"]) == ("EtherCAT" if ethercat else "CAN", "tmcm1636", nodes)
    assert options["interface"] == (given or variable if ethercat else given) and options["channel"] == "c"
    assert open_drives.open_drives("tmcm3313", interface=given, nodes=(5,))[1:] == (
        "tmcm3313", {"interface": options["interface"], "nodes": (5,)}
    )  # fmt: skip
