"""A device that shares the TMCM-1636's cascade, and nothing else of its gains: what rests on the linear model works.

It is the invented drive with a current loop that can be tuned and cst: five gains under other names, in another order,
at other objects, in other units and ranges.
"""

from __future__ import annotations

import json
import re
import shutil
from contextlib import closing

import numpy as np
import pytest
from rigs import TESTS
from rigs.chip_gains import Gains, bandwidths_from_gains
from rigs.known_machines import true_plant
from typer.testing import CliRunner

from agents.tuner.tune_target import surrogate
from drive_env import motion
from drive_env.devices import find_device
from drive_env.devices.gains import bandwidth_gains, check_linear_model, gains_in_si
from drive_env.loops.linear_model import OPEN_LOOPS, Plant
from drive_env.motors import find_motor
from tuning.auto.design import Judge, design
from tuning.auto.identified import unsafe_gains
from tuning.auto.loop_model import LoopModel, one_axis
from tuning.auto.one_button import auto
from tuning.auto.twin import Known, Twins, gain_bounds
from tuning.certificate.certificate import si_gains
from tuning.certificate.certificate_files import load_certificate
from tuning.commands.cli import app
from tuning.identify.winding import loop_gains
from tuning.identify.working_state import working_state
from tuning.rules.rules_by_name import RULES, propose
from tuning.target import emulated

INVENTED = TESTS / "invented_drive"
ROWS = (  # name, object, greatest integer, loop, part; units are those of bindings.toml
    ("position_gain", "3200:3", 10_000_000, "position", "P"),
    ("speed_gain", "3200:1", 2_000_000, "velocity", "P"),
    ("speed_integrator", "3200:2", 65535, "velocity", "I"),
    ("amplifier_integrator", "3041:2", 65535, "current", "I"),
    ("amplifier_gain", "3041:1", 65535, "current", "P"),
)
NAMES = tuple(row[0] for row in ROWS)
KNOWN, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
J = 3.0 * MOTOR.inertia
RIGID = Plant.from_data_sheet(KNOWN, MOTOR, 24.0, J)
ELASTIC = Plant.from_data_sheet(KNOWN, MOTOR, 24.0, J, anti_resonance=40.0, resonance=80.0)


def replaced(path, old, new):
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1, f"{path} has {old!r} {text.count(old)} times"
    path.write_text(text.replace(old, new), encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the path of the device's folder."""
    place = tmp_path_factory.mktemp("devices") / "invented_cascade"
    shutil.copytree(INVENTED, place)
    rows = [
        f'[[gain]]\nname = "{name}"\ntitle = "{name.replace("_", " ")}"\nobject = "{key}"\nhighest = {highest}\n'
        f'loop = "{loop}"\npart = "{part}"\n'
        for name, key, highest, loop, part in ROWS
    ]
    (place / "gains.toml").write_text("\n".join(['cascade = "pi"\n', *rows]), encoding="utf-8")
    # Thousandths of duty per ampere, and both gains of the current loop can be written.
    replaced(place / "bindings.toml", '"current_p", unit = "current P"', '"current_p", unit = "1/1000"')
    eds = place / "invented.eds"
    text = re.sub(r"(\[3041sub[12]\][^\[]*AccessType=)ro", r"\1rw", eds.read_text(encoding="utf-8"))
    eds.write_text(text.replace("DefaultValue=4021", "DefaultValue=157"), encoding="utf-8")
    device = place / "device.toml"
    replaced(device, '"6060:0" = [0, 1, 3, 6, 8, 9]', '"6060:0" = [0, 1, 3, 6, 8, 9, 10]')
    replaced(device, "axes = 2", "axes = 1")
    preset = place / "presets" / "qbl4208.toml"
    current = '"Torque Mode Settings.Torque_P" = 157\n"Torque Mode Settings.Torque_I" = 1573\n'
    replaced(preset, '"Controller.Speed gain"', f'{current}"Controller.Speed gain"')
    return str(place)


@pytest.fixture
def device(folder):
    """Return the device."""
    return find_device(folder)


def own(device, gains):
    """Return gains of the TMCM-1636 as the device counts them, by hand: the units are those of its bindings."""
    full_scale = KNOWN.current_full_scale
    si = gains_in_si(KNOWN, 24.0, gains)
    raw = {
        "position_gain": 1e3 * si.position_p,
        "speed_gain": 1e3 * si.velocity_p,
        "speed_integrator": gains[3],
        "amplifier_integrator": gains[1],
        "amplifier_gain": 1e3 * gains[0] / (256.0 * full_scale),
    }
    return [max(round(raw[name]), 1) for name in device.gains.names]


def near(found, wanted, device, share=0.03):
    """Whether integers are the wanted ones but for a share, and for rounding where they are small."""
    np.testing.assert_allclose(found, own(device, wanted), rtol=share, atol=1.0)


# --- what gains mean --------------------------------------------------------------------------------------------------
def test_it_has_a_linear_model_in_its_own_order(device):
    check_linear_model(device)
    assert device.gains.names == NAMES


def test_bandwidths_become_its_integers_and_back(device):
    wanted = {"current_hz": 900.0, "velocity_hz": 25.0, "position_hz": 6.0}
    found = bandwidth_gains(device, MOTOR, J, **wanted)
    near(found, bandwidth_gains(KNOWN, MOTOR, J, **wanted), device, 0.005)
    meaning = bandwidths_from_gains(device, MOTOR, J, found)
    assert meaning.current_hz == pytest.approx(900.0, rel=0.005)  # by whole numbers: one of 140
    assert meaning.velocity_hz == pytest.approx(25.0, rel=0.01)
    assert meaning.position_hz == pytest.approx(6.0, rel=1e-4)


def test_gains_in_si_have_its_names_in_its_order(device):
    raw = Gains(4021, 1573, 445, 329, 118)
    theirs, found = si_gains(KNOWN, 24.0, raw), si_gains(device, 24.0, own(device, raw))
    assert list(found) == [
        "position gain [1/s]", "speed gain [A*s/rad]", "speed integrator T_i [s]", "amplifier integrator T_i [s]",
        "amplifier gain [V/A]",
    ]  # fmt: skip
    assert list(theirs) == [
        "torque P [V/A]", "torque T_i [s]", "velocity P [A*s/rad]", "velocity T_i [s]", "position P [1/s]"
    ]  # fmt: skip
    values = np.array(list(theirs.values()))[[4, 2, 3, 1, 0]]
    np.testing.assert_allclose(list(found.values()), values, rtol=0.02)


@pytest.mark.parametrize("plant", [RIGID, ELASTIC])
def test_its_open_loops_are_those_of_the_same_gains_on_a_drive_with_other_units(device, plant):
    f, raw = np.geomspace(1.0, 2000.0, 80), Gains(4019, 1573, 448, 329, 120)  # which both can have, all but exactly
    for open_loop in OPEN_LOOPS.values():
        np.testing.assert_allclose(
            open_loop(device, plant, own(device, raw), f), open_loop(KNOWN, plant, raw, f), rtol=0.01
        )


def test_it_is_judged_safe_by_its_own_columns(device):
    raw = own(device, Gains(4021, 1573, 445, 329, 118))
    assert unsafe_gains(device, RIGID, raw) == ""
    for name in ("position_gain", "speed_gain", "amplifier_gain"):
        opened = [0 if own_name == name else value for own_name, value in zip(NAMES, raw, strict=True)]
        assert unsafe_gains(device, RIGID, opened) == "a P gain is 0, so that a loop is open"


# --- what finds gains -------------------------------------------------------------------------------------------------
@pytest.mark.every(2)
@pytest.mark.parametrize("rule", [*RULES])
def test_a_rule_proposes_the_same_gains_in_its_units(device, rule):
    found, known = propose(rule, device, MOTOR, ELASTIC), propose(rule, KNOWN, MOTOR, ELASTIC)
    # A whole number of the amplifier gain is 40 of the other drive's, and what follows is designed around it.
    near(found.gains, known.gains, device, 0.25 if rule == "margin_65" else 0.05)
    assert set(found.wanted) == set(NAMES)


def test_a_rule_ends_at_its_own_greatest_integer(device):
    heavy = propose("simc", device, MOTOR, Plant.from_data_sheet(device, MOTOR, 24.0, 1e5 * J))
    assert heavy.gains[NAMES.index("speed_gain")] == 2_000_000
    assert any(note.startswith("speed gain would have to be") and "above 2000000" in note for note in heavy.notes)


def test_the_loop_that_measures_a_winding_is_the_same_on_both(folder):
    found = []
    for name in (folder, "tmcm1636"):
        with emulated(name, "inertia", num_threads=1) as target, working_state(target) as working:
            P, integral = loop_gains(working)
            found.append((float(P[0]), integral))
    (own_p, own_i), (known_p, known_i) = found
    assert own_p == round(known_p * 1e3 / (256.0 * KNOWN.current_full_scale))
    assert own_i == known_i


@pytest.mark.slow
def test_a_design_on_twins_stays_within_its_ranges(device):
    assert gain_bounds(device)[0].tolist() == [1, 1, 20, 1, 1]  # a T_i of 0.65 s
    known = Known(RIGID, 10.0, 0.1, 1e-4)
    with closing(Twins(device, MOTOR, [known], np.array([65536.0]), 16)) as twins:
        judge = Judge(twins, [(LoopModel(device, MOTOR, [RIGID], one_axis(RIGID)), np.array([0]))], [None])
        found = design(judge, judge, [RIGID])
    assert found.cost[0, 0] < 10.0 and found.slack[0, 0] > 0.0
    assert (found.gains >= gain_bounds(device)[0]).all() and (found.gains <= device.gains.highest).all()


def test_the_agent_that_ships_tunes_it(folder):
    with emulated(folder, "inertia", num_threads=1) as target:
        rule = propose("relay", target.device, MOTOR, true_plant(target.drives)).gains
        found = surrogate(target, np.random.default_rng(0)).gains
        np.testing.assert_array_equal(target.device.gains.read(target.drives), found)
    assert found.shape == (1, 5)
    outer = slice(0, 3)  # it changes these alone, around what a rule says
    assert np.all(found[0, outer] > np.array(rule)[outer] / 30) and np.all(found[0, outer] < np.array(rule)[outer] * 30)


@pytest.mark.slow
def test_the_command_shows_what_rules_propose_at_its_objects(folder):
    line = ["rules", "simc", "--device", folder, "--load", "inertia"]
    done = CliRunner().invoke(app, line)
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    title = next(k for k, line in enumerate(lines) if line.startswith("inertia"))
    heads = lines[title + 1 : title + 3]
    assert heads[0].split()[:3] == ["3200h", "3200h", "3041h"]  # position and velocity have an object in common
    assert heads[1].split()[1:6] == ["P", "P", "I", "I", "P"]


# --- the whole --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_one_button_tunes_it_and_certifies_it_under_its_own_names(folder, tmp_path):
    out = tmp_path / "out"
    done = CliRunner().invoke(app, ["auto", "--device", folder, "--load", "inertia", "--json", "--out", str(out)])
    assert done.exit_code == 0, done.output
    (axis,) = json.loads(done.stdout)["axes"]
    assert tuple(axis["before"]) == tuple(axis["after"]) == NAMES
    assert axis["after"]["speed_gain"] > axis["before"]["speed_gain"] == 51
    certificate, unchanged = load_certificate(out / "certificate.json")
    assert unchanged
    written = certificate.axes[0]
    assert written.after == tuple(axis["after"].values())
    assert written.after_si["speed gain [A*s/rad]"] == pytest.approx(1e-3 * axis["after"]["speed_gain"])
    assert written.after_si["position gain [1/s]"] == pytest.approx(1e-3 * axis["after"]["position_gain"])
    assert "current in moves, 3003h [A]" in certificate.envelope
    report = (out / "report.html").read_text(encoding="utf-8")
    assert "amplifier integrator T_i [s]" in report and "3041h:02" in report and "2041h" not in report


@pytest.mark.slow
def test_what_one_button_leaves_is_better_than_what_was_there(folder, tmp_path):
    """By a move: the gains are in the drive, each at its own object."""
    errors = []
    with emulated(folder, "inertia") as target:
        for number in range(2):
            motion.enable(target.drives, mode="pp")
            motion.start_move(target.drives, 20_000 * (-1) ** number)
            trace = target.drives.record((0x6062, 0x6064), 0.25)
            errors.append(np.abs(trace[0x6062] - trace[0x6064]).max())
            motion.disable(target.drives)
            if number == 0:
                (axis,) = auto(target, tmp_path / "before.toml").axes
                assert axis.accepted, axis.reason
                assert target.device.gains.read(target.drives)[0].tolist() == list(axis.after)
    assert errors[1] < 0.75 * errors[0]


@pytest.mark.slow
def test_a_trained_tuner_tunes_it(folder, tmp_path):
    more = ["--device", folder, "--load", "inertia", "--trials", "4", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, ["auto", "--by", "agent", *more])
    assert done.exit_code == 0, done.output
    assert "position gain" in done.output and "velocity P " not in done.output.split("gains are to oscillation")[1]
    certificate, _ = load_certificate(tmp_path / "out" / "certificate.json")
    assert next(iter(certificate.axes[0].after_si)) == "position gain [1/s]"
