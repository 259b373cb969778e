"""`drive-tune rules` and `drive-tune auto` as a user types them."""

from __future__ import annotations

import json

import pytest
from rigs.commands import drive_tune

from drive_env.devices.gains import RAW_MAX
from tuning.auto import settings as auto_settings
from tuning.auto.one_button import BUDGET
from tuning.certificate.certificate_files import is_unchanged, load_certificate
from tuning.snapshot import load_snapshot


@pytest.mark.slow
def test_rules_show_gains_margins_and_what_a_relay_measured():
    done = drive_tune("rules", "simc", "margin_45", "--load", "inertia", "--relay", "--json")
    assert done.exit_code == 0, done.output
    (axis,) = json.loads(done.stdout)
    assert axis["plant"]["inertia"] == pytest.approx(1.5e-5, rel=0.1)
    assert list(axis["proposals"]) == ["simc", "margin_45", "relay, measured"]
    for proposal in axis["proposals"].values():
        assert all(0 < gain <= RAW_MAX for gain in proposal["gains"].values())
        assert all(one["phase_deg"] > 40.0 for one in proposal["margins"].values())
        assert proposal["keeps"] is (proposal["slack"] >= 0.0)
    assert axis["proposals"]["margin_45"]["margins"]["velocity"]["phase_deg"] == pytest.approx(45.0, abs=1.5)
    assert axis["dynamics"] == "standard"


@pytest.mark.slow
def test_rules_say_which_of_them_keep_the_dynamics_asked_for():
    kept = {}
    for dynamics, loads in (("soft", "0.5/2"), ("40/7/2.2", "0.8/3")):
        done = drive_tune("rules", "margin_45", "margin_60", "--load", "inertia", "--dynamics", dynamics,
                          "--inertia-range", loads)  # fmt: skip
        assert done.exit_code == 0, done.output
        low, high = loads.split("/")
        assert f"kept: by {dynamics} dynamics, load inertia x {low} to x {high}" in done.stdout
        rows = [line.split() for line in done.stdout.splitlines() if line.startswith("margin_")]
        kept[dynamics] = {row[0]: row[-1] for row in rows}
        assert all(row[-3].count("/") == row[-2].count("/") == 2 for row in rows)  # of both loops
    assert kept == {
        "soft": {"margin_45": "no", "margin_60": "yes"},
        "40/7/2.2": {"margin_45": "yes", "margin_60": "yes"},
    }


@pytest.mark.slow
def test_a_relay_that_says_nothing_leaves_the_rules_and_its_reason():
    done = drive_tune("rules", "simc", "--load", "two_mass", "--relay", "--json")
    assert done.exit_code == 0, done.output
    (axis,) = json.loads(done.stdout)
    assert list(axis["proposals"]) == ["simc"]
    assert "it swings at its load's resonance" in axis["no_relay"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("rules", "ziegler"), "no rule is named 'ziegler'; there are modulus_optimum"),
        (("auto", "--by", "rule", "--rule", "nichols"), "no rule is named 'nichols'"),
        (("auto", "--by", "luck"), "no method is named 'luck'; there are design, agent, tpe"),
        (("auto", "--rule", "simc"), "--rule has no meaning with --by design; leave it out, or choose --by rule"),
        (("auto", "--by", "rule", "--agent", "x"), "--agent has no meaning with --by rule"),
        (
            ("rules", "--bus", "--travel", "-1:1"),
            "will turn. Is its way clear? There is no terminal to ask; confirm with --yes",
        ),
        (("rules", "--load", "brick"), "no load is named 'brick'"),
        (("rules", "--dynamics", "45/8"), "dynamics '45/8': give soft, standard, stiff"),
        (("rules", "--device", "tmcm3313", "--dynamics", "soft"), "this drive has no linear model of its loops"),
        (("auto", "--node", "1"), "--travel is missing"),
        (("identify", "-c", "can0", "--travel", "-1:1"), "will turn. Is its way clear? There is no terminal to ask"),
        (("response", "--lockstep"), "--travel is missing"),
        (("auto", "--axes", "linked"), "add --bus"),
        (("auto", "--inertia-range", "2/0.5"), "the least lies between 0.2 and 1, the greatest between 1 and 5"),
        (("auto", "--device", "tmcm3313", "--dynamics", "soft"), "no linear model of its loops; leave --dynamics out"),
        (("auto", "--device", "tmcm3313", "--inertia-range", "0.5/3"), "leave --inertia-range out"),
        (("auto", "--by", "tpe", "--device", "tmcm3313", "--inertia-range", "0.5/3"), "leave --inertia-range out"),
        (("rules", "--inertia-range", "1"), "give the least and the greatest load inertia"),
    ],
)
def test_a_users_mistake_ends_with_one_line_and_exit_code_2(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = drive_tune(*arguments)
    assert done.exit_code == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_auto_does_not_write_into_a_folder_with_something_in_it(tmp_path):
    (tmp_path / "mine").write_text("keep")
    done = drive_tune("auto", "--load", "inertia", "--out", tmp_path)
    assert done.exit_code == 2
    assert "is not empty" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.slow
def test_auto_leaves_the_way_back_a_certificate_and_a_report(quick_designs, tmp_path):
    out = tmp_path / "run"
    done = drive_tune("auto", "--load", "inertia", "--out", out, "--json")
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    (axis,) = said["axes"]
    assert axis["accepted"]
    assert axis["before"] != axis["after"]
    # The trial of the rule's gains has some time more than the ten seconds, and what shakes at rest.
    assert 0.0 < said["drive seconds"][0] < BUDGET
    assert sorted(path.name for path in out.iterdir()) == ["before.toml", "certificate.json", "report.html"]
    assert is_unchanged(out / "certificate.json")
    assert load_snapshot(out / "before.toml").axes[0][0x2042, 1] == axis["before"]["velocity_p"]


def test_auto_ends_with_1_and_says_why_where_it_changed_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(auto_settings, "LEAST_WAY", 1e9)
    done = drive_tune("auto", "--load", "belt", "--out", tmp_path / "run")
    assert done.exit_code == 1
    assert "axis 0 was not tuned: the travel is too short" in " ".join(done.stdout.split())


@pytest.mark.slow
def test_the_gains_of_a_rule_are_tried_and_certified(tmp_path):
    done = drive_tune("auto", "--by", "rule", "--rule", "margin_55", "--load", "inertia", "--out", tmp_path / "run")
    assert done.exit_code == 0, done.output
    assert load_snapshot(tmp_path / "run" / "before.toml").axes[0][0x2042, 1] == 445
    certificate, unchanged = load_certificate(tmp_path / "run" / "certificate.json")
    (axis,) = certificate.axes
    assert unchanged and certificate.tuner == "rule margin_55" and axis.accepted and axis.after != axis.before
