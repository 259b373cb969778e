"""Commissioning step by step, on emulated drives and over CAN: what is measured, and that a stop leaves nothing behind.

What a drive has is read by the node's own dictionary, or inside the emulator; no word of the path enters a verdict.
"""

from __future__ import annotations

import json
import re
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.known_machines import true_plant
from rigs.truth import settings_of
from typer.testing import CliRunner

from drive_env import EmulatedDrives, cia402, motion
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.canopen.frames import SDO_REQUEST
from drive_env.drives.raw_gains import write_gains
from drive_env.loops.linear_model import OPEN_LOOPS
from drive_env.loops.margins import margins
from tuning.commands.cli import app
from tuning.commissioning.bench import CommissioningPlan
from tuning.commissioning.path import CommissioningPath
from tuning.commissioning.steps import STEPS
from tuning.target import emulated, on_bus

TURN = 65536
CHEAP = ("motor", "wiring", "current", "limits", "homing")
SWITCHES = {"method": 17, "limits": {"current": "6 A", "lowest": "1 rev", "highest": "11 rev"}}  # of the belt


def quiet(what, share):
    """Hear nothing of how far a step is."""


@pytest.fixture
def fresh():
    """A belt with switches, and its drive as it comes from the factory."""
    with emulated(load="belt", factory_fresh=True, num_threads=1) as target:
        yield target


def is_off(drives):
    return (drives.read(cia402.STATUSWORD) & 0x4F == 0x40).all()


@contextmanager
def served(*, load="belt"):
    """A node as it comes from the factory, in lockstep: world, drives, channel, and the frames that masters send."""
    world, frames = World(lockstep=True), []
    drives = EmulatedDrives(load=load, commissioned=False, num_threads=1)
    world.add(drives, [1])
    world.listeners.append(lambda ended: frames.append(ended.frame) if ended.sender != ("node", 1) else None)
    world.power_on()
    hub = Hub()
    with Server(world, hub):
        yield world, drives, hub.channel, frames
    world.close()


def commission(channel, *more, **options):
    words = ["--interface", "slcan", "--channel", channel, "--lockstep", "--travel", "-8:8"] if channel else []
    result = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"}).invoke(app, ["commission", *words, *more], **options)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def without(*names):
    return [word for name in names for word in ("--skip", name)]


# --- a stop ---------------------------------------------------------------------------------------------------------
@pytest.mark.every(3)
@pytest.mark.parametrize("step", CHEAP)
def test_stopped_in_any_step_the_drive_is_as_it_was_found(fresh, tmp_path, step):
    """By Ctrl-C, as soon as the step says that it is under way, or once it is done."""
    before = settings_of(fresh.drives)

    def stop(what, share):
        raise KeyboardInterrupt

    with (
        pytest.raises(KeyboardInterrupt),
        CommissioningPath(fresh, CommissioningPlan(**SWITCHES), tmp_path / "x") as path,
    ):
        for name in CHEAP:
            assert path.run(name, stop if name == step else quiet).state == "done"
            if name == step:
                assert settings_of(fresh.drives) != before  # there was something to take back
                raise KeyboardInterrupt
    assert settings_of(fresh.drives) == before and is_off(fresh.drives)
    fresh.drives.advance(0.5)
    assert abs(float(fresh.drives.machine.rotor_speed[0])) < 1.0


def test_a_step_that_fails_takes_back_its_own_changes_alone_and_can_be_done_again(fresh, tmp_path):
    plan = CommissioningPlan(method=3)
    with CommissioningPath(fresh, plan, tmp_path / "x") as path:
        path.run("motor", quiet)
        before = settings_of(fresh.drives)
        failed = path.run("homing", quiet)
        assert (failed.state, path.next) == ("failed", "wiring")
        assert failed.lines == ("homing method 3: the drive has 17, 18, 19, 21, 35",)
        assert settings_of(fresh.drives) == before
        plan.method = 35
        assert path.run("homing", quiet).state == "done"
        assert fresh.drives.read(cia402.HOMING_METHOD)[0] == 35


def test_back_to_a_step_brings_back_what_was_before_it(fresh, tmp_path):
    with CommissioningPath(fresh, CommissioningPlan(**SWITCHES), tmp_path / "x") as path:
        found = {}
        for name in ("motor", "limits", "homing"):
            found[name] = settings_of(fresh.drives)
            assert path.run(name, quiet).state == "done"
        path.back_to("limits")
        assert settings_of(fresh.drives) == found["limits"]
        states = {name: one.state for name, one in path.states.items()}
        assert (states["motor"], states["limits"], states["homing"]) == ("done", "pending", "pending")


def test_a_drive_that_had_a_mode_has_it_again(tmp_path):
    with emulated(load="belt", num_threads=1) as target:
        target.drives.write(cia402.MODE, cia402.MODES["csv"])
        with CommissioningPath(target, CommissioningPlan(method=35), tmp_path / "x") as path:
            assert path.run("homing", quiet).state == "done"
            assert target.drives.read(cia402.MODE)[0] == cia402.MODES["hm"]
        assert target.drives.read(cia402.MODE)[0] == cia402.MODES["csv"]


def test_an_axis_that_is_enabled_is_let_alone(fresh, tmp_path):
    with emulated(load="inertia", num_threads=1) as target:
        motion.enable(target.drives, mode="pp")
        with (
            pytest.raises(RuntimeError, match="axis 0 is enabled"),
            CommissioningPath(target, CommissioningPlan(), tmp_path / "x"),
        ):
            pass
        assert not is_off(target.drives)


# --- what the steps do ------------------------------------------------------------------------------------------------
def test_the_motor_is_that_of_its_file(fresh, tmp_path):
    """Its own data sheet, as `drive-env motor` writes it; here with another number of pole pairs and lines."""
    own = fresh.motor._replace(name="own", n_p=7, encoder_counts=8000)
    target = replace(fresh, motor=own)
    with CommissioningPath(target, CommissioningPlan(), tmp_path / "x") as path:
        assert "changed for own" in path.run("motor", quiet).lines[0]
        assert fresh.drives.read(0x2056)[0] == 7 and fresh.drives.read((0x2080, 2))[0] == 8000


def test_a_reversed_encoder_is_set_right(fresh, tmp_path):
    drives = fresh.drives
    with CommissioningPath(fresh, CommissioningPlan(), tmp_path / "x") as path:
        path.run("motor", quiet)
        drives.write((0x2080, 1), 0)  # the motor needs 1
        found = path.run("wiring", quiet)
        assert found.state == "done"
        assert found.lines[0].startswith("encoder reversed: 2080h:01 is 1 now, and was 0")
        assert drives.read((0x2080, 1))[0] == 1


def test_another_motor_is_found_by_its_winding(fresh, tmp_path):
    target = replace(fresh, motor=fresh.motor._replace(R_s=5.0 * fresh.motor.R_s))
    with CommissioningPath(target, CommissioningPlan(), tmp_path / "x") as path:
        path.run("motor", quiet)
        found = path.run("current", quiet)
        assert found.state == "failed" and "this is another motor, or its winding" in found.lines[0]


def test_the_current_loop_follows_the_winding_that_was_measured(tmp_path):
    """A winding of 1.3 times the resistance and 0.9 of the inductance: I goes with R over L, P with L."""
    values = {"motor.R_s": 0.468, "motor.L_q": 0.00054, "motor.L_d": 0.00054}
    target = emulated(load="inertia", factory_fresh=True, num_threads=1, parameters=values)
    with target, CommissioningPath(target, CommissioningPlan(), tmp_path / "x") as path:
        path.run("motor", quiet)
        before = target.drives.read((0x2041, 1))[0], target.drives.read((0x2041, 2))[0]
        assert path.run("current", quiet).state == "done"
        after = target.drives.read((0x2041, 1))[0], target.drives.read((0x2041, 2))[0]
    assert after[0] / before[0] == pytest.approx(0.9, rel=0.06)
    assert after[1] / before[1] == pytest.approx(1.3 / 0.9, rel=0.12)


def test_homing_ends_at_its_edge_and_the_axis_goes_back_to_where_it_stood(fresh, tmp_path):
    drives, stood = fresh.drives, float(fresh.drives.machine.rotor_angle[0])
    with CommissioningPath(fresh, CommissioningPlan(**SWITCHES), tmp_path / "x") as path:
        path.run("motor", quiet)
        found = path.run("homing", quiet)
        assert found.state == "done", found.lines
        assert abs(float(drives.machine.rotor_angle[0]) - stood) < 0.05 * 2.0 * np.pi
        edge = -0.23 / 0.04  # turns: the left limit switch of the belt [m], over the pulley's way of a turn
        assert drives.read(cia402.POSITION_ACTUAL)[0] / TURN == pytest.approx(-edge, abs=0.05)
        assert drives.read((cia402.POSITION_LIMITS, 2))[0] == 11 * TURN
        here = path.bench.here()  # the travel that is left: 1 to 11 turns from home, and it stands at 5.75
        assert here.low[0] / (2.0 * np.pi) == pytest.approx(-4.75, abs=0.06)
        assert here.high[0] / (2.0 * np.pi) == pytest.approx(5.25, abs=0.06)
        assert is_off(drives)


def test_without_a_method_it_says_so_and_offers_those_of_the_drive(fresh, tmp_path):
    with CommissioningPath(fresh, CommissioningPlan(), tmp_path / "x") as path:
        path.run("motor", quiet)
        found = path.run("homing", quiet)
        assert found.state == "failed" and "17: left to the left limit switch" in found.lines[0]
        assert found.lines[0].startswith("no homing method is chosen (6098h is 0); those of the drive are 17: left")


@pytest.mark.parametrize(("limits", "step", "told"), [
    ({"jerk": "1"}, "limits", "there is no limit 'jerk': a tmcm1636 has current, "),
    ({"current": "20 A"}, "limits", "3 times the rated current of qbl4208 are 10.5 A"),
    ({"current": "3 V"}, "limits", "is not a quantity in 'V'"),
    ({"quick-stop": "0"}, "limits", "6085h"),
    ({"lowest": "2 rev", "highest": "3 rev"}, "homing", "axis 0 stands at "),
    ({"lowest": "3 rev", "highest": "-3 rev"}, "homing", "axis 0: the highest position -196608 is not above"),
    ({"lowest": "3 rev", "highest": "3 rev"}, "homing", "axis 0: the highest position 196608 is not above"),
])  # fmt: skip
def test_a_limit_that_cannot_be_fails_its_step_and_changes_nothing(fresh, tmp_path, limits, step, told):
    with CommissioningPath(fresh, CommissioningPlan(limits=limits), tmp_path / "x") as path:
        path.run("motor", quiet)
        before = settings_of(fresh.drives)
        failed = path.run(step, quiet)
        assert failed.state == "failed" and told in failed.lines[0]
        assert settings_of(fresh.drives) == before


def test_an_open_loop_stepper_has_no_loops_to_identify(tmp_path):
    target = emulated("tmcm6212", load="inertia", factory_fresh=True, num_threads=1)
    with target, CommissioningPath(target, CommissioningPlan(), tmp_path / "x") as path:
        left = [name for name, one in path.states.items() if one.state == "skipped"]
        assert left == ["wiring", "current", "identify", "verify"]
        assert path.run("motor", quiet).state == "done" and path.run("limits", quiet).state == "done"


@pytest.mark.every(2)
@pytest.mark.parametrize("gains", [(4021, 1573, 445, 329, 118), (4021, 1573, 600, 400, 250)])
def test_the_margins_that_it_prints_are_those_of_the_true_plant(tmp_path, gains):
    """Of two masses on a spring, by the linear model of what the machine truly is."""
    with (
        emulated(load="two_mass", num_threads=1) as target,
        CommissioningPath(target, CommissioningPlan(dynamics="stiff"), tmp_path / "x") as path,
    ):
        write_gains(target.drives, np.array([gains]))
        printed = path.run("verify", quiet).lines
        plant, f = true_plant(target.drives), np.geomspace(2.0, 0.49 * target.device.velocity_rate, 4000)
        for loop, line in zip(("velocity", "position"), printed, strict=True):
            true = margins(f, OPEN_LOOPS[loop](target.device, plant, gains, f))
            phase, gain, ms = re.fullmatch(rf"{loop} loop (\d+)°, (\d+) dB, Ms ([\d.]+)(?:: .*)?", line).groups()
            assert float(phase) == pytest.approx(true.phase_deg, abs=6.0), line
            assert float(gain) == pytest.approx(true.gain_db, abs=2.0), line
            assert float(ms) == pytest.approx(true.ms, rel=0.2), line


# --- the command ------------------------------------------------------------------------------------------------------
def test_a_dry_run_reads_and_lists_the_steps_and_their_objects():
    with served() as (world, _, channel, frames):
        found = commission(channel, "--dry-run", "--skip", "homing")
        assert found.exit_code == 0, found.output
        assert all(frame.can_id == SDO_REQUEST + 1 and frame.data[0] & 0xE0 in (0x40, 0x60) for frame in frames)
        assert world.time == 0.0
    lines = found.stdout.splitlines()
    assert [line for line in lines if line.startswith("5/10")] == ["5/10 Homing: left out: left out"]
    assert sum(line[0].isdigit() for line in lines) == len(STEPS)
    assert any(line.startswith("  written: 2041h:01, 2041h:02") for line in lines)


@pytest.mark.parametrize(("words", "told"), [
    (("--step", "dance"), "--step dance: the steps are motor, wiring, current, limits"),
    (("--limit", "current"), "--limit current must be NAME=VALUE, with one of current, speed"),
    (("--limit", "jerk=3"), "--limit jerk=3 must be NAME=VALUE"),
    (("--limit", "current=3 V"), "is not a quantity in 'V'"),
    (("--limit", "lowest=-3 rev", "--skip", "homing"), "--limit lowest is written by the step homing, which is"),
    (("--limit", "current=3 A", "--step", "homing"), "--limit current is written by the step limits, which is"),
    (("--method", "35", "--skip", "homing"), "--method is written by the step homing, which is left out"),
    (("--dynamics", "brisk"), "give soft, standard, stiff"),
])  # fmt: skip
def test_a_mistake_is_named_before_anything_is_done(words, told):
    found = commission("", *words)
    assert found.exit_code == 2 and told in found.stderr


def test_over_can_it_asks_before_the_motor_turns_and_restores_what_it_wrote(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with served() as (_, drives, channel, _):
        before = settings_of(drives)
        found = commission(channel)
        assert found.exit_code == 2 and "the motor turns. Is its way clear? There is no terminal" in found.stderr
        assert "Motor done: 19 of 20 objects changed" in found.stdout
        assert "the drives have their state from before, by a second reading" in found.stderr
        assert settings_of(drives) == before and is_off(drives)


def test_a_method_that_the_drive_does_not_have_is_refused_before_anything_moves(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with served() as (_, drives, channel, _):
        before = settings_of(drives)
        found = commission(channel, "--yes", "--method", "99")
        assert found.exit_code == 2 and "homing method 99: the drive has 17, 18, 19, 21, 35" in found.stderr
        assert found.stdout == "" and settings_of(drives) == before and not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_failed_step_over_can_leaves_the_drive_as_it_was_found(tmp_path, monkeypatch):
    """Also where positions were turned round under limits of travel (2080h:01), and the axis was homed."""
    monkeypatch.chdir(tmp_path)
    with served() as (_, drives, channel, _):
        before = settings_of(drives)
        limits = ("--limit", "lowest=2 rev", "--limit", "highest=3 rev", "--method", "35")
        found = commission(channel, "--yes", *without("wiring", "current"), *limits)
        assert found.exit_code == 1 and "Homing failed: axis 0 stands at " in found.stdout
        assert settings_of(drives) == before and is_off(drives)


def test_what_is_stored_survives_a_power_cycle_and_undo_takes_it_back(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with served() as (world, drives, channel, _):
        before = settings_of(drives)
        words = without("wiring", "current", "homing", "identify", "tune", "verify")
        found = commission(channel, "--yes", "--out", "x", "--limit", "current=6 A", *words)
        assert found.exit_code == 0 and "Store done: stored in the drive (1010h:01)" in found.stdout, found.output
        stored = settings_of(drives)
        world.power_on()
        assert settings_of(drives) == stored and stored[0x2003, 0] == 6000
        again = CliRunner().invoke(app, ["undo", "x/before.toml", "--yes"])
        assert again.exit_code == 0, again.output
        assert settings_of(drives) == before


@pytest.mark.slow
def test_on_a_terminal_a_step_is_done_left_out_or_gone_back_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    terminal = SimpleNamespace(stdin=SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr("tuning.commands.commission.sys", terminal)
    words = [*without("wiring", "current", "identify", "tune", "verify"), "--out", "x"]
    with served() as (_, drives, channel, _):
        before = settings_of(drives)
        # motor; limits: back to the motor; it again; limits; homing: asked for its method; store: quit
        found = commission(channel, *words, input="y\nb\ny\ny\ny\n35\nq\n")
        assert found.exit_code == 1, found.output
        assert found.stdout.count("Motor done") == 2 and "home by method 35" in found.stdout
        assert "from before" in found.stdout, found.output
        assert settings_of(drives) == before and is_off(drives)


def test_what_was_tuned_elsewhere_has_no_certificate(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = without("wiring", "current", "homing", "identify", "tune", "verify")
    found = commission("", *words, "--yes", "--json", "--out", "x")
    told = json.loads(found.stdout)
    assert found.exit_code == 0 and told["kept"]
    assert told["steps"]["certificate"] == {"state": "skipped", "lines": ["Tuning was left out"]}
    assert told["steps"]["store"]["lines"] == [
        "the drive is emulated, and keeps nothing over a power cycle: its parameters stay until it is switched off"
    ]


# --- the whole path ---------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_from_the_factory_to_the_certificate_over_can_and_back(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with served() as (_, drives, channel, _):
        before = settings_of(drives)
        words = ["--method", "17", *(f"--limit={name}={value}" for name, value in SWITCHES["limits"].items())]
        found = commission(channel, "--yes", "--out", "x", *words, "--dynamics", "soft")
        assert found.exit_code == 0, found.output
        told = json.loads((tmp_path / "x" / "certificate.json").read_text())["axes"][0]
        assert (told["accepted"], told["dynamics"]) == (True, "soft")
        stored = settings_of(drives)
        assert is_off(drives) and stored[0x6098, 0] == 17 and stored[0x2042, 1] > 0
        again = CliRunner().invoke(app, ["undo", "x/before.toml", "--yes"])
        assert again.exit_code == 0, again.output
        assert settings_of(drives) == before


@pytest.mark.slow
@pytest.mark.parametrize(("step", "share"), [("identify", 0.3), ("tune", 0.3), ("verify", 0.2)])
def test_stopped_in_a_step_that_takes_long_the_drive_over_can_is_as_it_was_found(tmp_path, step, share):
    with served() as (_, drives, channel, _):
        before = settings_of(drives)
        options = {"interface": "slcan", "channel": channel, "nodes": [1], "pace": "lockstep", "timeout": 5.0}

        def stop(what, done):
            if done >= share:
                raise KeyboardInterrupt

        with (
            pytest.raises(KeyboardInterrupt),
            on_bus(travel=(-40.0, 40.0), **options) as target,
            CommissioningPath(target, CommissioningPlan(), tmp_path / "x") as path,
        ):
            for name in ("motor", "wiring", "current", step):
                path.run(name, stop if name == step else quiet)
        assert settings_of(drives) == before and is_off(drives)


@pytest.mark.slow
def test_a_stepper_comes_to_its_certificate(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = commission("", "--device", "tmcm6212", "--load", "inertia", "--yes", "--out", "x", "--method", "35")
    assert found.exit_code == 0, found.output
    assert (tmp_path / "x" / "stepper-certificate.json").is_file()
