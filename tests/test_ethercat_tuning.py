"""`drive-tune auto` and `drive-agent tune` over EtherCAT: drives that are served in lockstep, reached over UDP."""

from __future__ import annotations

import json
from contextlib import contextmanager

import numpy as np
import pytest
from test_tmcm3313_loops import target_of
from typer.testing import CliRunner

import agents.commands.cli
import tuning.commands.cli
from drive_env import EmulatedDrives
from drive_env.devices import find_device
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import UdpSocket
from drive_env.ethercat.world import EtherCatWorld
from drive_env.master.ethercat_drives import EtherCatDrives
from tuning.search.trial_bench import leave_oscillations_to_trials
from tuning.stepper.commissioning import commission


@contextmanager
def served(device):
    """Serve a drive, a machine on each axis; yields the UDP port and the emulated drives."""
    world = EtherCatWorld()
    drives = EmulatedDrives(device, "inertia", num_machines=find_device(device).num_axes, num_threads=1)
    world.add(EtherCatSlave(CoeNode(drives)), drives)
    with EtherCatServer(world, UdpSocket(0)) as server:
        yield str(server.way.port), drives
    world.close()


def run(app, command, device, port, out):
    """Return what a command printed as JSON, with its exit code."""
    bus = ["--device", device, "--interface", "ethercat-udp", "--channel", port, "--node", "0", "--lockstep"]
    done = CliRunner().invoke(app, [command, *bus, "--travel", "-5:5", "--yes", "--out", str(out), "--json"])
    return done.exit_code, json.loads(done.stdout) if done.stdout.strip() else done.output


@pytest.mark.slow
def test_drive_tune_auto_tunes_a_tgz(tmp_path):
    """Both axes are accepted with their new gains; in lockstep always the same."""
    with served("tgz_d") as (port, drives):
        _, printed = run(tuning.commands.cli.app, "auto", "tgz_d", port, tmp_path / "auto")
        found = np.stack([drives.read(key) for key in drives.device.gains.keys], axis=1)
    axes = printed["axes"]
    assert [axis["verdict"] for axis in axes] == ["accepted"] * 2, axes
    assert all(axis["after"]["velocity_p"] > axis["before"]["velocity_p"] for axis in axes)
    for axis, gains in zip(axes, found.tolist(), strict=True):
        assert list(axis["after"].values()) == gains
        assert "D-Mode" not in axis["reason"], "an axis that goes on has both of its modes"


@pytest.mark.slow
def test_drive_agent_tune_tunes_a_tgz(tmp_path):
    with served("tgz_d") as (port, drives):
        code, printed = run(agents.commands.cli.app, "tune", "tgz_d", port, tmp_path / "agent")
    assert code == 0, printed
    assert drives.num_axes == 2 and "'verdict': 'accepted'" in str(printed) and "rejected" not in str(printed)


@pytest.mark.slow
def test_an_agent_for_servos_tunes_no_stepper(tmp_path):
    with served("tmcm3313") as (port, _):
        code, printed = run(agents.commands.cli.app, "tune", "tmcm3313", port, tmp_path / "agent")
    assert code == 2 and "tmcm3313 has no P of the velocity loop" in printed and "drive-tune optimise" in printed


@pytest.mark.slow
def test_a_stepper_in_a_loop_is_commissioned(tmp_path):
    """Inside the envelope at 6,000 rpm; `drive-tune auto` sets it less, and trials of its loop pass that."""
    with (
        served("tmcm3313") as (port, _),
        EtherCatDrives("tmcm3313", interface="ethercat-udp", channel=port, pace="lockstep") as drives,
    ):
        leave_oscillations_to_trials(drives)
        result = commission(target_of(drives), tmp_path / "before.toml", keep=False)
    assert [axis.verdict == "rejected" for axis in result.axes] == [False] * drives.num_axes, result.axes
