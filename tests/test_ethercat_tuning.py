"""`drive-tune auto` and `drive-agent tune` over EtherCAT: drives that are served in lockstep, reached over UDP."""

from __future__ import annotations

import json
from contextlib import contextmanager

import pytest
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
@pytest.mark.parametrize("device", ["tgz_d", "tmcm3313"])
def test_drive_tune_auto(device, tmp_path):
    with served(device) as (port, drives):
        code, printed = run(tuning.commands.cli.app, "auto", device, port, tmp_path / "auto")
        print(code, str(printed)[:3000])
    assert code == 0


@pytest.mark.slow
@pytest.mark.parametrize("device", ["tgz_d", "tmcm3313"])
def test_drive_agent_tune(device, tmp_path):
    with served(device) as (port, drives):
        code, printed = run(agents.commands.cli.app, "tune", device, port, tmp_path / "agent")
        print(code, str(printed)[:3000])
    assert code == 0
