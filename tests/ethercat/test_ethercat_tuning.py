"""`drive-tune auto`, by design and by an agent, on EtherCAT: in lockstep by UDP, in real time by a virtual cable."""

from __future__ import annotations

import json
import os
import shutil
import subprocess

import numpy as np
import pytest
from rigs import TESTS
from rigs.closed_loop_rig import target_of
from rigs.ethercat_served import served
from rigs.namespaces import first_line, inside, needs_namespaces, spaces  # noqa: F401
from typer.testing import CliRunner

from drive_env.master.ethercat_drives import EtherCatDrives
from tuning.commands.cli import app
from tuning.search.trial_bench import leave_oscillations_to_trials
from tuning.stepper.commissioning import commission

pytestmark = pytest.mark.usefixtures("quick_designs")


def run(device, port, out, *more):
    """Return what a command printed as JSON, with its exit code."""
    bus = ["--device", device, "--interface", "ethercat-udp", "--channel", port, "--node", "0", "--lockstep"]
    done = CliRunner().invoke(app, ["auto", *more, *bus, "--travel", "-5:5", "--yes", "--out", str(out), "--json"])
    return done.exit_code, json.loads(done.stdout) if done.stdout.strip() else done.output


@pytest.mark.slow
def test_drive_tune_auto_tunes_a_tgz(tmp_path):
    """Both axes are accepted with their new gains; the noise may leave reservations about a position loop."""
    with served("tgz_d") as (port, drives):
        code, printed = run("tgz_d", port, tmp_path / "auto")
        found = np.stack([drives.read(key) for key in drives.device.gains.keys], axis=1)
    assert code == 0, printed
    axes = printed["axes"]
    assert all("position loop" in text for axis in axes for text in axis["reservations"]), axes
    assert all(axis["after"]["velocity_p"] > axis["before"]["velocity_p"] for axis in axes)
    for axis, gains in zip(axes, found.tolist(), strict=True):
        assert list(axis["after"].values()) == gains
        assert "D-Mode" not in axis["reason"], "an axis that goes on has both of its modes"


@pytest.mark.slow
def test_an_agent_tunes_a_tgz(tmp_path):
    with served("tgz_d") as (port, drives):
        code, printed = run("tgz_d", port, tmp_path / "agent", "--by", "agent")
    assert code == 0, printed
    # By the noise there may be reservations: in half of the runs margins are measured at too few lines.
    assert drives.num_axes == 2 and "'accepted': True" in str(printed) and "rejected" not in str(printed)


@pytest.mark.slow
def test_an_agent_for_servos_tunes_no_stepper(tmp_path):
    with served("tmcm3313") as (port, _):
        code, printed = run("tmcm3313", port, tmp_path / "agent", "--by", "agent")
    assert code == 2 and "tmcm3313 has no P of the velocity loop" in printed and "drive-tune auto --by tpe" in printed


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


@pytest.mark.slow
def test_the_path_of_commission_ends_with_the_certificate_of_one_axis_of_a_module(tmp_path):
    """The other axes have the objects that masters change alone saved, of those that the module has on EtherCAT."""
    with served("tmcm3313") as (port, drives):
        bus = ["--device", "tmcm3313", "--interface", "ethercat-udp", "--channel", port, "--node", "0", "--lockstep"]
        more = ["--axis", "0", "--travel", "-5:5", "--method", "35", "--yes", "--out", str(tmp_path / "x")]
        done = CliRunner().invoke(app, ["commission", *bus, *more])
        drives.advance(0.1)
        assert not drives.inside.records["stage_on"].any()
    assert done.exit_code == 0, done.output
    assert (tmp_path / "x" / "stepper-certificate.json").is_file()


# --- in real time -----------------------------------------------------------------------------------------------------
# Beside other programs nothing is in time; where this system lets them, these go first.
FIRST = ["chrt", "-f", "10"] if shutil.which("chrt") and hasattr(os, "geteuid") and os.geteuid() == 0 else []
LATE = ("SYNCs were more than a cycle late", "the program made no call for", "too busy")


def tuned_in_real_time(spaces, device, out, *more):  # noqa: F811
    """Tune as `tuned_once` does; once more where that was rejected or stopped, as it may be on a busy computer."""
    try:
        found = tuned_once(spaces, device, out, *more)
        if "'rejected'" not in str(found):
            return found
    except AssertionError as error:
        if not any(text in str(error) for text in LATE):
            raise
    return tuned_once(spaces, device, out.with_name("again"), *more)


def tuned_once(spaces, device, out, *more):  # noqa: F811
    """Tune a drive that is served in one namespace from the other; return exit code and what was printed as JSON."""
    pytest.importorskip("pysoem", reason="pysoem is not installed: pip install -e '.[ethercat]'")
    server = subprocess.Popen(
        FIRST + inside(spaces.slave, TESTS / "ethercat_tuned_drive.py", spaces.slave_interface, device),
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert first_line(server) == "1 slave\n"
        words = ["auto", "--device", device, "--interface", "ethercat", "--channel", spaces.master_interface]
        script = "from drive_env.programs import drive_tune; drive_tune()"
        done = subprocess.run(
            FIRST
            + inside(spaces.master, "-c", script, *words, "--position", 0, "--yes", "--out", out, "--json", *more),
            capture_output=True, text=True, timeout=600.0,
        )  # fmt: skip
    finally:
        server.terminate()
        server.wait(60.0)
        server.stdout.close()
    assert done.returncode in (0, 1) and done.stdout, done.stderr
    return json.loads(done.stdout)


def is_too_busy(axis):
    """Whether an axis was rejected on a computer that was too busy, as it then says."""
    return axis["verdict"] == "rejected" and any(text in str(axis) for text in LATE)


@pytest.mark.slow
@needs_namespaces
def test_drive_tune_auto_tunes_a_tgz_in_real_time(spaces, tmp_path):  # noqa: F811
    found = tuned_in_real_time(spaces, "tgz_d", tmp_path / "auto", "--travel", "-5:5")
    for axis in found["axes"]:
        assert is_too_busy(axis) or (axis["accepted"] and axis["after"] != axis["before"]), axis
        assert any("6062h) is in no process data" in note and "not recorded" in note for note in axis["notes"])


@pytest.mark.slow
@needs_namespaces
def test_drive_tune_auto_commissions_a_stepper_in_real_time(spaces, tmp_path):  # noqa: F811
    """Its image has room for three objects of each axis: position, demand, current; the statusword is asked for."""
    found = tuned_in_real_time(spaces, "tmcm3313", tmp_path / "auto", "--travel", "-20:20")
    assert len(found["axes"]) == 3
    for axis in found["axes"]:
        assert is_too_busy(axis) or axis["verdict"] != "rejected", axis


@pytest.mark.slow
@needs_namespaces
def test_an_agent_tunes_a_tgz_in_real_time(spaces, tmp_path):  # noqa: F811
    found = tuned_in_real_time(spaces, "tgz_d", tmp_path / "agent", "--by", "agent", "--travel", "-5:5")
    assert "'verdict':" in str(found) and "6062h) is in no process data" in str(found)
