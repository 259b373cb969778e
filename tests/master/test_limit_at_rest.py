"""An axis that stands with its current at its limit is told: its drive sees nothing wrong."""

from __future__ import annotations

import json
import time
import uuid

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from drive_env import EmulatedDrives, cia402, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.commands.cli import app
from drive_env.dictionary.roles import Role
from drive_env.drives.currents import ampere_per_count, read_current_limit
from drive_env.drives.limit_at_rest import HELD, LimitAtRest

LOOK = 0.05  # s
READ = (cia402.STATUSWORD, cia402.TORQUE_ACTUAL, cia402.VELOCITY_ACTUAL, Role.CURRENT_LIMIT)


def told(drives, watch, seconds):
    """Let time pass, and return after how long [s] each axis was told, nan where it was not."""
    when = np.full(drives.num_axes, np.nan)
    for k in range(round(seconds / LOOK)):
        drives.advance(LOOK)
        when = np.fmin(when, np.where(watch.look(k * LOOK, *map(drives.read, READ)), k * LOOK, np.nan))
    return when


def set_off(drives, counts=20_000):
    motion.enable(drives, mode="pp", timeout=20.0)
    motion.start_move(drives, counts, timeout=20.0)


@pytest.mark.parametrize("device", ["tmcm1636", "tgz_d"])
def test_an_encoder_that_is_stuck_is_told_though_the_drive_reports_no_fault(device):
    """On a TMCM-1636 it is 7.0 A of 7.0 A for ever, with a statusword of 0237h."""
    with EmulatedDrives(device, load="inertia", num_threads=1) as drives:
        drives.machine.fault("encoder_stuck")
        set_off(drives, round(0.3 * drives.read(Role.POSITION_SCALE)[0]))
        when = told(drives, LimitAtRest(drives), 2.0)
        status, current = map(drives.read, READ[:2])
        share = LimitAtRest(drives).share(current // 2, drives.read(Role.CURRENT_LIMIT))
        assert share == pytest.approx(0.5, abs=0.02)
        current, limit = current * ampere_per_count(drives), read_current_limit(drives)
        assert cia402.matches(status, cia402.OPERATION_ENABLED).all()
        assert not cia402.matches(status, cia402.FAULT_BIT).any()
        assert current / limit == pytest.approx(1.0, abs=0.02)
        assert (when >= HELD).all()
        assert (when <= 1.5).all()
        # Switched off, it pushes no longer.
        watch = LimitAtRest(drives)
        motion.disable(drives)
        assert np.isnan(told(drives, watch, 1.0)).all()


def test_axes_that_move_or_hold_are_not_told():
    """A move of 20 revolutions with all the current there is, and a weight that is held: no word of either."""
    with EmulatedDrives(load="vertical_screw", num_threads=1) as drives:
        drives.write(Role.CURRENT_LIMIT, 3000)
        for ramp in (cia402.PROFILE_ACCELERATION, cia402.PROFILE_DECELERATION):
            drives.write(ramp, 2**31 - 1)
        watch = LimitAtRest(drives)
        set_off(drives, 20 * 65536)
        seen = np.abs(drives.record([cia402.TORQUE_ACTUAL], 0.05)[cia402.TORQUE_ACTUAL]).max()
        assert seen >= 2850, "it takes all of its current to set off"
        assert np.isnan(told(drives, watch, 2.0)).all()


def test_steppers_have_no_such_limit():
    with EmulatedDrives("tmcm6212", load="inertia", num_threads=1) as drives:
        watch = LimitAtRest(drives)
        assert not watch.is_known
        assert not watch.look(0.0, [0x237], [9], [0], [1]).any()
        assert np.isnan(watch.share([9], [1])).all()


class Served:
    """Drives in a world in real time, which lets their time pass; its server has them between two calls."""

    def __init__(self, drives, guard):
        self.num_axes, self._drives, self._guard = drives.num_axes, drives, guard

    def read(self, *args, **options):
        with self._guard:
            return self._drives.read(*args, **options)

    def write(self, *args, **options):
        with self._guard:
            self._drives.write(*args, **options)

    def advance(self, duration):
        time.sleep(duration)


@pytest.mark.slow
def test_monitor_tells_it(monkeypatch):
    drives = EmulatedDrives(load="inertia", num_threads=1)
    world = World(lockstep=False)
    world.add(drives, [1])
    channel = str(uuid.uuid4())
    for name, value in {"INTERFACE": "virtual", "CHANNEL": channel, "TIMEOUT": "20"}.items():
        monkeypatch.setenv(f"DRIVE_ENV_{name}", value)
    with Server(world, CanPort(can.Bus(interface="virtual", channel=channel))) as server:
        patience = time.monotonic() + 60.0
        while not server.is_serving and time.monotonic() < patience:  # a power cycle would repair the encoder
            time.sleep(LOOK)
        with server.guard:
            drives.machine.fault("encoder_stuck")
        served = Served(drives, server.guard)
        set_off(served)
        while served.read(cia402.TORQUE_ACTUAL)[0] < 6800 and time.monotonic() < patience:
            time.sleep(LOOK)
        for options in (["--json"], []):
            result = CliRunner().invoke(app, ["monitor", "6077", "--period", "0.1", "--duration", "3", *options])
            assert result.exit_code == 0, result.output
            if options:
                rows = [json.loads(line) for line in result.stdout.splitlines()]
                assert not rows[0]["current at its limit at rest"][0]
                assert rows[-1]["current at its limit at rest"] == [True], rows
                assert rows[-1]["6077:00"][0] > 6800
                assert not any(row["emergencies"] for row in rows)
            else:
                assert "its current is at its limit, and it stands" in " ".join(result.stdout.split())
    world.close()
