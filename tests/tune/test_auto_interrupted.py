"""Ctrl-C while a drive is tuned: it gets its gains back, is off, and the command says so."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from rigs.known_machines import gains, standing_in
from rigs.served_drives import environment
from rigs.served_drives import served as served_process
from rigs.world_bus import served

from drive_env import CanDrives, motion
from drive_env.devices import find_device
from drive_env.motors import find_motor
from tuning.auto import one_button as auto_module
from tuning.auto.one_button import auto
from tuning.auto.proving import ProvingGround
from tuning.snapshot import Transaction
from tuning.target import Target, emulated

DISABLED = 0x4F, 0x40  # mask and value of 6041h: switch on disabled
PATIENCE = 300.0  # s until another process has come so far; it is never this long


def is_off(drives):
    mask, value = DISABLED
    return bool(np.all(drives.read(0x6041) & mask == value))


def while_it_moves(monkeypatch):
    """Press Ctrl-C in the middle of the first trial."""
    run = ProvingGround.run

    def interrupted(self, tried, where):
        self._begin(where)
        motion.select_mode(self.target.drives, "pp", where)
        signal.raise_signal(signal.SIGINT)
        return run(self, tried, where)

    monkeypatch.setattr(ProvingGround, "run", interrupted)


def on_bus(drives):
    motor, device, way = find_motor("qbl4208"), find_device("tmcm1636"), np.array([30.0])
    return Target(
        drives, device, motor, np.array([24.0]), -way, way, motor.rated_speed, motor.rated_current,
        bus={"channel": "here", "nodes": [1]},
    )  # fmt: skip


def known(target, where):
    """Return the identification of the default inertia."""
    with emulated(load="inertia", num_threads=1) as same:
        return standing_in(same)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_designs")
@pytest.mark.parametrize("how", ["in process", "calls", "hub"])
def test_the_gains_before_are_back_and_the_drive_is_off(monkeypatch, tmp_path, how):
    while_it_moves(monkeypatch)
    if how == "in process":
        with emulated(load="inertia", num_threads=1) as target:
            before = gains(target.drives)
            with pytest.raises(KeyboardInterrupt):
                auto(target, tmp_path / "before.toml", experiments=standing_in)
            np.testing.assert_array_equal(gains(target.drives), before)
            assert is_off(target.drives)
        return
    with served(how, load="inertia") as drives:
        before = gains(drives)
        with pytest.raises(KeyboardInterrupt):
            auto(on_bus(drives), tmp_path / "before.toml", experiments=known)
        np.testing.assert_array_equal(gains(drives), before)
        assert is_off(drives)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_designs")
def test_a_second_ctrl_c_waits_until_everything_is_back(monkeypatch, tmp_path):
    roll_back = Transaction.roll_back

    def pressed_again(self, where=None):
        signal.raise_signal(signal.SIGINT)
        roll_back(self, where)

    while_it_moves(monkeypatch)
    monkeypatch.setattr(Transaction, "roll_back", pressed_again)
    handler = signal.getsignal(signal.SIGINT)
    with emulated(load="inertia", num_threads=1) as target:
        before = gains(target.drives)
        with pytest.raises(KeyboardInterrupt):
            auto(target, tmp_path / "before.toml", experiments=standing_in)
        np.testing.assert_array_equal(gains(target.drives), before)
        assert is_off(target.drives)
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda how: how.name)
def test_a_real_signal_over_a_served_bus(tmp_path, how):
    """A drive served by one process, tuned by another; Ctrl-C, a service that is stopped, a terminal that is closed."""
    out = tmp_path / "run"
    with served_process("--load", "inertia", "--lockstep", cwd=tmp_path) as (_, channel):
        bus = {"interface": "slcan", "channel": channel, "nodes": (1,), "pace": "lockstep"}
        with CanDrives("tmcm1636", **bus) as drives:
            before = gains(drives)
        command = [
            sys.executable, "-c", "from drive_env.programs import drive_tune; drive_tune()", "auto", "--bus",
            "--interface", "slcan", "--channel", channel, "--travel", "-5:5", "--lockstep", "--yes", "--out", str(out),
        ]  # fmt: skip
        process = subprocess.Popen(
            command, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            end = time.monotonic() + PATIENCE
            # The file is there before anything is changed; from then on something is.
            while not (out / "before.toml").exists() and process.poll() is None and time.monotonic() < end:
                time.sleep(0.05)
            time.sleep(1.0)
            process.send_signal(how)
            _, said = process.communicate(timeout=PATIENCE)
        finally:
            if process.poll() is None:
                process.kill()
        assert process.returncode == 130, said
        assert "the drives have their state from before, by a second reading" in said
        with CanDrives("tmcm1636", **bus) as drives:
            np.testing.assert_array_equal(gains(drives), before)
            assert is_off(drives)


@pytest.mark.slow
def test_a_fault_before_the_gains_are_written_rejects_its_axis_alone(monkeypatch, tmp_path):
    """The drive is enabled, and its shutdown switch opens once all is verified: the other machine keeps its gains."""

    first_alone = np.array([True, False])

    def faulty(bench):
        drives = bench.target.drives
        motion.enable(drives, mode="csv", where=first_alone)
        drives.machine.fault("enable_lost", duration=0.02, where=first_alone)
        drives.advance(0.05)

    monkeypatch.setattr(auto_module, "tell_of_lateness", faulty)
    with emulated(load="inertia", num_machines=2, num_threads=1) as target:
        found = auto(target, tmp_path / "before.toml")
        left = gains(target.drives)
    first, second = found.axes
    assert first.reason.startswith("the drive went into fault while its gains were verified: shutdown switch (5441h)")
    assert left[0].tolist() == list(first.before)
    assert second.accepted and left[1].tolist() == list(second.after) != list(second.before)
