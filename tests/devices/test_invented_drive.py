"""A device that nothing in the repository knows: a folder of data, opened by its path, goes wherever a drive goes.

tests/invented_drive has two axes a node, three gains of other names, objects and units, a current loop that is fixed,
speeds in rpm, no cst, and fewer methods of homing.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rigs import TESTS
from rigs.life import Life
from rigs.world_bus import on_bus
from typer.testing import CliRunner

from agents.tuner.tune_target import gains_for, surrogate
from drive_env import EmulatedDrives, motion
from drive_env.devices import find_device
from drive_env.devices.gains import check_linear_model, loop_scales, rule_gains
from drive_env.dictionary.access import ObjectAccessError
from drive_env.dictionary.units import UNITS, Context
from drive_env.envs.gain_scheduling import GainScheduling
from drive_env.envs.gain_tuning import GainTuning
from drive_env.envs.tracking import Tracking
from drive_env.loops.linear_model import controllers
from drive_env.motors import find_motor
from tuning.auto.one_button import auto
from tuning.certificate.certificate import si_gains
from tuning.commands.cli import app
from tuning.compare.comparison import compare
from tuning.compare.suite import SuiteMachine
from tuning.identify.identification import identify
from tuning.outcome import Outcome
from tuning.response.frequency_response import measure
from tuning.rules.rules_by_name import propose
from tuning.runs import sweep
from tuning.runs.experiment import ExperimentError, SweptObject, load_experiment, resolve
from tuning.search.optimise import Settings, optimise
from tuning.target import emulated

FOLDER = TESTS / "invented_drive"
INVENTED = str(FOLDER)
NAMES = ("speed_gain", "speed_integrator", "position_gain")
NO_MODEL = (
    f"{INVENTED}: this drive has no linear model of its loops: its gains.toml has no P of the current loop, no I of "
    "the current loop; drive-tune sweep and auto --by tpe need none, and find gains by trials"
)
SPEED_GAIN, SPEED_INTEGRATOR = "3200h:01", "3200h:02"


def si(device, raw):
    """Return raw gains in the units of the drive record."""
    context = Context(65536.0, device.current_full_scale / 32768.0)
    units = [device.bindings[key].unit for key in device.gains.keys]
    return raw * np.array([float(UNITS[unit].factor(context)) for unit in units])


# --- its gains --------------------------------------------------------------------------------------------------------
def test_the_rule_says_the_same_of_it_as_of_a_drive_with_other_units():
    own, known, motor = find_device(INVENTED), find_device("tmcm1636"), find_motor("qbl4208")
    inertia = np.geomspace(1.0, 30.0, 7) * motor.inertia
    theirs = si(known, rule_gains(known, motor, inertia))[:, 2:]
    np.testing.assert_allclose(si(own, rule_gains(own, motor, inertia)), theirs, rtol=0.02)  # by whole numbers


def test_a_sweep_goes_over_its_objects():
    swept = (SweptObject(SPEED_GAIN, 20, 200, 3, "log"), SweptObject(SPEED_INTEGRATOR, 100, 800, 2, "log"))
    found = sweep.run(replace(load_experiment(), device=INVENTED, load="inertia", sweep=swept))
    assert len(found.order) == 6
    assert found.objects == (SPEED_GAIN, SPEED_INTEGRATOR)


def test_the_sweep_that_ships_covers_the_same_gains_in_its_units():
    found, known = load_experiment(device=INVENTED), load_experiment()
    assert [swept.object for swept in found.sweep] == ["speed_gain", "speed_integrator"]
    own, theirs = loop_scales(find_device(INVENTED)), loop_scales(find_device(known.device))[2:4]
    for swept, other, one, scale in zip(found.sweep, known.sweep, own, theirs, strict=False):
        ends = one.value([swept.low, swept.high])
        assert ends == pytest.approx(scale.value([other.low, other.high]), rel=0.05)
        assert (swept.count, swept.spacing) == (other.count, other.spacing)
    small = replace(found, sweep=tuple(replace(swept, count=2) for swept in found.sweep))
    assert sweep.run(small).objects == (SPEED_GAIN, SPEED_INTEGRATOR)
    assert load_experiment(device="tmcm1636_fw109").sweep == known.sweep  # which counts alike


@pytest.mark.parametrize("name", ["2042h:01", "3041h:01"])  # another drive's; its own current loop, which is fixed
def test_a_sweep_refuses_what_is_no_gain_of_it(name):
    with pytest.raises(ExperimentError):
        resolve(replace(load_experiment(), device=INVENTED, sweep=(SweptObject(name, 20, 200, 3, "log"),)))


def test_a_search_finds_gains_within_its_ranges():
    with emulated(INVENTED, "inertia", num_machines=2) as target:
        found = optimise(target, Settings(sampler="random", trials=6), shared=True, anew=True)
        assert found.gains.shape == found.rule.shape == (2, 3)
        assert np.isfinite(found.cost).all()
        np.testing.assert_array_equal(target.device.gains.read(target.drives), found.gains)
        with pytest.raises(ValueError, match="no gain is named 'velocity_p'; there are speed_gain"):
            optimise(target, Settings(gains=("velocity_p",)))


def test_the_command_writes_them_by_their_names(tmp_path):
    line = ["auto", "--by", "random", "--device", INVENTED, "--load", "inertia", "--trials", "2",
            "--machines", "2", "--out", str(tmp_path / "found")]  # fmt: skip
    done = CliRunner().invoke(app, line)
    assert done.exit_code == 0, done.output
    head = (tmp_path / "found" / "trials.csv").read_text(encoding="utf-8").splitlines()[0]
    assert head.startswith("search,trial,axis,speed_gain,speed_integrator,position_gain,")


SUITE = """
device = {device}

[[group]]
load = "inertia"
motor = "qbl4208"
supply = [24, 26]
[group.parameters]
"load.inertia" = [4.8e-06, 4.32e-05]
"""


@pytest.mark.slow
def test_tuners_are_ranked_on_it_under_the_names_of_its_gains(tmp_path):
    suite, out = tmp_path / "suite.toml", tmp_path / "out"
    suite.write_text(SUITE.format(device=json.dumps(INVENTED)), encoding="utf-8")
    line = ["rank", "--suite", suite, "-t", "factory", "-t", "baseline", "-t", "random", "-t", "simc", "--trials", "2",
            "--out", out]  # fmt: skip
    done = CliRunner().invoke(app, [str(word) for word in line])
    assert done.exit_code == 0, done.output
    rows = list(csv.DictReader((out / "machines.csv").open(encoding="utf-8")))
    preset = find_device(INVENTED).preset(find_motor("qbl4208"))
    factory = [preset[f"Controller.{name}"] for name in ("Speed gain", "Speed integrator", "Position gain")]
    for row in rows:
        gains = [int(row[name]) for name in NAMES]
        assert np.isfinite(float(row["robust_cost"]))
        if row["tuner"] == "factory":
            assert gains == factory
        if row["tuner"] == "baseline":
            assert float(row["relative"]) > 1.0  # nothing is better than what is searched on the machine itself
        assert (row["failed"] == "True") == (row["tuner"] == "simc")
    assert list(rows[0])[-4:] == [*NAMES, "note"]
    assert {row["note"] for row in rows if row["tuner"] == "simc"} == {f"ValueError: {NO_MODEL}"}


@pytest.mark.slow
def test_a_tuner_that_returns_the_gains_of_another_drive_has_failed():
    def of_another(target, rng):
        n = target.num_axes
        return Outcome(np.ones((n, 5), np.int64), np.zeros(n), *[np.zeros(n, np.int64)] * 3, ("",) * n)

    (machine,) = (SuiteMachine("one", INVENTED, "inertia", "qbl4208", {}, 24.0),)
    (row,) = compare([machine], {"of_another": of_another}).rows
    assert row.failed
    assert "integer gains of shape (1, 3), not int64 (1, 5)" in row.note


def test_an_agent_tunes_them_as_an_episode():
    env = GainTuning(2, device=INVENTED, load="inertia", trials=2, num_threads=1)
    assert env.config.gains == NAMES
    _, info = env.reset(seed=1)
    assert info["gains"].shape == (2, 1, 3)
    _, reward, *_, info = env.step(np.full((2, 3), 0.2, np.float32))
    assert np.isfinite(reward).all() and np.isfinite(info["trial_robust_cost"]).all()
    assert (info["trial_gains"] > 1).all()
    env.close()
    with pytest.raises(ValueError, match=r"speed_gain.*position_gain"):
        GainTuning(1, device=INVENTED, gains=("torque_p",))


@pytest.mark.slow
def test_a_trained_tuner_changes_them_by_the_parts_that_they_play():
    """It was trained on another drive, on gains over those of the baseline rule: names and units are nothing to it."""
    with emulated(INVENTED, "inertia", num_threads=1) as target:
        found = surrogate(target, np.random.default_rng(0)).gains
        rule = rule_gains(target.device, target.motor, 3.0 * target.motor.inertia)
    assert found.shape == (1, 3)
    assert np.all(found > rule / 30) and np.all(found < rule * 30)


def test_a_trained_tuner_names_the_gain_that_a_drive_lacks():
    device = find_device(INVENTED)
    fewer = device._replace(gains=replace(device.gains, rows=device.gains.rows[:2]))
    with pytest.raises(ValueError, match=r"no P of the position loop among its gains, which the agent changes; train"):
        gains_for({"gains": ["velocity_p", "position_p"]}, fewer)
    assert gains_for({"gains": ["position_p", "velocity_p"]}, device) == ("position_gain", "speed_gain")


def test_what_needs_a_linear_model_says_that_it_has_none(tmp_path):
    device, motor = find_device(INVENTED), find_motor("qbl4208")
    with pytest.raises(ValueError, match="this drive has no linear model of its loops"):
        check_linear_model(device)
    with emulated(INVENTED, "inertia") as target:
        for needs_it in (
            lambda: auto(target, tmp_path / "before.toml"),
            lambda: identify(target),
            lambda: measure(target),
            lambda: propose("simc", device, motor, None),
            lambda: controllers(device, (1, 1, 1)),
        ):
            with pytest.raises(ValueError, match=re.escape(NO_MODEL)):
                needs_it()
        assert not target.drives.read(0x6064).any()  # nothing has moved
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [("auto",), ("rules",), ("auto", "--by", "agent"), ("auto", "--by", "rule")])
def test_commands_that_need_a_linear_model_end_with_that_line_and_leave_nothing(tmp_path, command):
    out = [] if command == ("rules",) else ["--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*command, "--device", INVENTED, "--load", "inertia", *out])
    assert done.exit_code == 2, done.output
    assert done.stderr.strip().endswith(NO_MODEL)
    assert list(tmp_path.iterdir()) == []


def test_its_gains_are_certified_under_its_own_names():
    raw = find_device(INVENTED).preset(find_motor("qbl4208"))
    gains = [raw[f"Controller.{name}"] for name in ("Speed gain", "Speed integrator", "Position gain")]
    assert si_gains(find_device(INVENTED), 24.0, gains) == pytest.approx({
        "speed gain [A*s/rad]": 0.051,
        "speed integrator T_i [s]": 65536.0 / 5000.0 / 329.0,
        "position gain [1/s]": 31.467,
    })  # fmt: skip


def test_without_a_cascade_there_is_no_rule_and_every_method_says_so(tmp_path):
    folder, suite = tmp_path / "own", tmp_path / "suite.toml"
    shutil.copytree(FOLDER, folder)
    path = folder / "gains.toml"
    path.write_text(path.read_text(encoding="utf-8").replace('cascade = "pi"', ""), encoding="utf-8")
    suite.write_text(SUITE.format(device=json.dumps(str(folder))), encoding="utf-8")
    device = find_device(str(folder))
    assert si_gains(device, 24.0, (51, 329, 31467)) == {}  # integers are all that is known
    out = str(tmp_path / "out")
    for line, says in (
        (["auto", "--device", str(folder), "--load", "inertia", "--out", out], "its gains.toml names no cascade"),
        (
            ["auto", "--by", "tpe", "--device", str(folder), "--load", "inertia", "--out", out],
            "names no cascade of its loops",
        ),
        (["rank", "--suite", str(suite), "-t", "factory", "--out", out], "names no cascade of its loops"),
    ):
        done = CliRunner().invoke(app, line)
        assert done.exit_code == 2, done.output
        assert str(folder) in done.stderr and says in done.stderr and "drive-tune sweep" in done.stderr
        assert not Path(out).exists()


def test_two_gains_of_one_part_are_no_cascade():
    device = find_device(INVENTED)
    twice = (*device.gains.rows, device.gains.rows[0]._replace(name="speed_gain_2", key=(0x3200, 2)))
    with pytest.raises(ValueError, match=r"gains.toml: speed_gain_2 is a second P of the velocity loop"):
        rule_gains(device._replace(gains=replace(device.gains, rows=twice)), find_motor("qbl4208"), 1e-5)


# --- the rest of a drive's life ---------------------------------------------------------------------------------------
@pytest.mark.parametrize("load", ["inertia", "two_mass"])
def test_it_keeps_the_contract(load):
    assert Life(INVENTED, load, "qbl4208", 2).whole().size


def test_it_has_its_own_modes_and_methods_of_homing():
    with EmulatedDrives(INVENTED, "inertia", num_threads=1) as drives:
        assert drives.read(0x6502)[0] == 0x1A5  # without bit 9, cst
        for name, value in ((0x6060, 10), (0x6098, 21), ((0x3041, 1), 7)):
            with pytest.raises(ObjectAccessError):
                drives.write(name, value)
        assert drives.read((0x3041, 1))[0] == 4021  # the current loop is what it is
        assert not drives.device.gains.columns_of("current")


def moved(drives):
    """Return what a move of both axes shows."""
    objects = (0x6041, 0x6064, 0x606C, 0x6077)
    motion.enable(drives, mode="pp")
    motion.start_move(drives, [20_000, -30_000])
    trace = drives.record(objects, 0.3)
    motion.disable(drives)
    return np.stack([trace[name] for name in objects])


def test_on_a_bus_both_axes_of_a_node_show_the_same_integers():
    machine = {"load": "inertia", "num_machines": 2, "num_threads": 1, "seed": 4}
    with EmulatedDrives(INVENTED, **machine) as inside:
        expected = moved(inside)
    with on_bus(EmulatedDrives(INVENTED, **machine), device=INVENTED) as drives:
        assert drives.num_axes == 2
        found = moved(drives)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(("kind", "options"), [(Tracking, {"mode": "csv"}), (GainScheduling, {"gains": NAMES})])
def test_the_other_environments_run_on_it(kind, options):
    env = kind(2, device=INVENTED, load="inertia", num_threads=1, **options)
    env.reset(seed=0)
    for _ in range(3):
        observation, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert np.isfinite(observation).all()
    env.close()


# --- a folder that is none --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("device.toml", "undervoltage", "undervolts", r"device.toml lacks or does not know 'undervoltage'"),
        ("device.toml", "axes = 2", "axes = ", "device.toml is not a TOML file"),
        ("device.toml", "axes = 2", 'axes = 2\nvariant_of = "tmcm1636"', "give the path of this file as the device"),
        ("bindings.toml", '"1/1000"', '"1/100"', "bindings.toml: .* has no unit '1/100'"),
        ("bindings.toml", '"3200:3"', '"3200:9"', "gains.toml: 3200h:03 is not a gain"),
        ("roles.toml", "outputs =", "out_puts =", "roles.toml lacks or does not know 'OUT_PUTS'"),
        ("gains.toml", "highest", "most", "gains.toml lacks or does not know 'highest'"),
        ("device.toml", "invented.eds", "none.eds", "none.eds"),
    ],
)
def test_a_file_that_is_wrong_is_named_with_what_is_wrong(tmp_path, file, old, new, message):
    folder = tmp_path / "own"
    shutil.copytree(FOLDER, folder)
    path = folder / file
    path.write_text(path.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        find_device(str(folder))


def test_a_motor_without_a_preset_is_told_with_the_remedy():
    with pytest.raises(ValueError, match=r"no preset for a re_40; write .*re_40.toml .* one for: qbl4208"):
        find_device(INVENTED).preset(find_motor("re_40"))
