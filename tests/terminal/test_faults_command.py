"""`drive-env faults` names what the emulator's machine really has, and never a cause that it has not."""

from __future__ import annotations

import json
import uuid
from contextlib import contextmanager

import can
import numpy as np
import pytest
from typer.testing import CliRunner

import drive_env.commands.cli
from drive_env import EmulatedDrives, cia402, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import device_names, find_device
from drive_env.drives.fault_texts import fault_text
from drive_env.drives.reported_faults import read_faults
from drive_env.fieldbus.description import describe
from drive_env.firmware.common.protection import CUT, STOP

DONE, REFUSED = 0, 1


@contextmanager
def on_a_bus(drives):
    """The command, on a bus with a node of these drives, whose time stands still."""
    world = World(lockstep=True)
    world.add(drives, [1])
    channel = str(uuid.uuid4())
    named = ["--interface", "virtual", "--channel", channel, "--timeout", "20", "--device", drives.device.name]
    try:
        with Server(world, CanPort(can.Bus(interface="virtual", channel=channel))):
            yield lambda *words: CliRunner().invoke(drive_env.commands.cli.app, ["faults", *named, *words]), world
    finally:
        world.close()


def found(run, *words):
    result = run("--json", *words)
    return result.exit_code, json.loads(result.stdout)


def jam(drives):
    """A following error of axis 0, whose cause a machine has."""
    drives.write(cia402.FOLLOWING_WINDOW, 10)
    motion.enable(drives, mode="csp")
    drives.write(cia402.TARGET_POSITION, 60_000)
    drives.advance(0.1)


@pytest.mark.every(3)
@pytest.mark.parametrize(("spoil", "name"), [
    (lambda drives: jam(drives), "following error"),
    (lambda drives: setattr(drives.machine, "supply", 0.0), "undervoltage"),
    (lambda drives: setattr(drives.machine, "enable_input", False), "shutdown switch"),
])  # fmt: skip
def test_a_drive_without_603f_and_1003_is_understood_by_its_flags(spoil, name):
    drives = EmulatedDrives(load="inertia", num_threads=1)
    with on_a_bus(drives) as (run, _):
        assert run().exit_code == DONE
        motion.enable(drives, mode="pv")
        spoil(drives)
        drives.advance(5.0)  # a link empties slowly
        assert drives.read(0x6041)[0] & 0x08
        code, (row,) = found(run)
        assert code == REFUSED and row["fault"] and row["node"] == 1
        assert [cause["name"] for cause in row["causes"]] == [name]
        text = run().stdout
        assert f"  {name}\n    why: {row['causes'][0]['cause']}\n    do: {row['causes'][0]['remedy']}\n" in text


def test_of_several_axes_the_one_in_fault_is_named():
    drives = EmulatedDrives("tgz_d", "inertia", num_machines=2, num_threads=1)
    with on_a_bus(drives) as (run, world):
        motion.enable(drives, mode="pv")
        drives.machine.error_bits = np.array([0, 1 << 27])  # motor_parameter: 6320h, whose code is of others, too
        for _ in range(50):  # its node notes it in 1003h
            world.cycle()
        code, rows = found(run)
        assert code == REFUSED and [row["fault"] for row in rows] == [False, True]
        for row in (rows[1], found(run)[1][1]):
            assert [cause["name"] for cause in row["causes"]] == ["motor parameter"]
        assert row["source"].startswith("1003h = ")
        assert found(run, "--axis", "0")[0] == DONE
        assert run("--axis", "2").exit_code == 2


def test_each_axis_is_told_its_own_cause_by_1003h_whichever_is_newer():
    drives = EmulatedDrives("tgz_d", "inertia", num_machines=2, num_threads=1)
    with on_a_bus(drives) as (run, world):
        motion.enable(drives, mode="pv")
        for bits in ([1 << 15, 0], [1 << 15, 1 << 27]):  # axis 0: angle error; later axis 1: motor parameter
            drives.machine.error_bits = np.array(bits)
            for _ in range(50):
                world.cycle()
        found(run)  # hears what is still on its way
        rows = found(run)[1]
        assert all(row["source"].startswith("1003h = ") for row in rows), rows
        first, second = ([cause["name"] for cause in row["causes"]] for row in rows)
        assert first != second == ["motor parameter"], rows


class ByItsEds:
    """A drive of which nothing but an EDS is known: statusword, 603Fh, 1003h as CiA 301 has them."""

    num_axes = 1

    def __init__(self, **objects):
        self.objects = {cia402.STATUSWORD: 0x0218, 0x1001: 0x21} | {int(k[1:], 16): v for k, v in objects.items()}

    def read(self, name):
        return np.array([self.objects[name]])

    def emergencies(self):
        return []


class Known:
    """What its EDS says."""

    device = None
    num_axes = 1
    emergency_names = describe(None, describe("tmcm1636", None).dictionary.path).emergency_names

    def __init__(self, drives):
        self.has = drives.objects.__contains__

    def role(self, role):
        return None


def test_an_unknown_drive_is_understood_by_603f():
    drives = ByItsEds(x603F=0x8130)
    (report,) = read_faults(drives, Known(drives))
    assert report.source == "603Fh = 8130h" and [cause.name for cause in report.causes] == ["heartbeat lost"]
    assert report.causes[0] == fault_text("heartbeat_lost")


def test_an_unknown_drive_that_reports_nothing_has_no_invented_cause():
    drives = ByItsEds()
    (report,) = read_faults(drives, Known(drives))
    assert report.is_fault and report.causes == () and report.source == ""


@pytest.mark.parametrize("name", device_names())
def test_each_cause_of_each_device_has_a_text(name):
    device = find_device(name)
    for cause in device.firmware.causes:
        if cause.reaction in (CUT, STOP):
            assert "manual lists its code" not in fault_text(cause.name).cause, cause.name
