"""`drive-tune auto --by agent`: a trained tuner on a drive, as a user meets it."""

from __future__ import annotations

import json
import threading
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.auto_stages import run_agent
from typer.testing import CliRunner

from agents.policies import guard
from agents.policies.guard import PolicyStoppedError
from agents.policies.policy import PolicyError, load_policy
from agents.shipped import shipped
from agents.tuner.open_tuner import open_tuner
from agents.tuner.tune_target import surrogate, tune_target
from drive_env.cia402 import OPERATION_ENABLED
from drive_env.devices import find_device
from drive_env.drives.observed import ObservedDrives
from drive_env.trials.gain_trial import Trials
from tuning.certificate.certificate_files import load_certificate
from tuning.commands.cli import app
from tuning.drive_audit import KINDS, DriveAudit
from tuning.snapshot import load_snapshot
from tuning.target import emulated

pytestmark = pytest.mark.usefixtures("quick_designs")  # a run corrects what it tried as auto does

GAIN_OBJECTS = find_device("tmcm1636").gains.keys


def command(*arguments):
    result = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1", "DRIVE_ENV_CHANNEL": ""}).invoke(
        app, ["auto", "--by", "agent", *map(str, arguments)]
    )
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def gains(target):
    return np.stack([target.drives.read(name) for name in GAIN_OBJECTS], axis=-1)


def is_enabled(target):
    mask, value = OPERATION_ENABLED
    return target.drives.read(0x6041) & mask == value


class Broken:
    """A tuner that is one for so many trials."""

    def __init__(self, good):
        self._good = good
        self._policy = load_policy(shipped("gain_tuning"))
        self.bundle = self._policy.bundle

    def reset(self, mask=None):
        self._policy.reset(mask)

    def act(self, observation):
        self._good -= 1
        return self._policy.act(observation) if self._good >= 0 else np.full(3, np.nan)


@pytest.mark.slow
def test_it_tunes_an_emulated_drive_and_certifies_it(tmp_path):
    code, out, error = command("--trials", 5, "--out", tmp_path / "run")
    assert (code, error.strip()) == (0, "")
    lines = out.splitlines()
    table = lines[lines.index("trial  velocity P  velocity I  position P        J") + 1 :][:6]
    assert [row.split()[0] for row in table] == ["rule", "1", "2", "3", "4", "5"]
    certificate, unchanged = load_certificate(tmp_path / "run" / "certificate.json")
    assert unchanged
    (axis,) = certificate.axes
    assert certificate.tuner == "agent gain_tuning"
    assert axis.accepted and axis.after != axis.before
    tried = [tuple(map(int, row.split()[1:4])) for row in table]
    # What breaks the dynamics is designed again from what was measured, and that is said.
    assert tuple(axis.after[2:]) in tried or any("designed again" in note for note in axis.notes)
    assert axis.identified["inertia"].low < axis.identified["inertia"].value < axis.identified["inertia"].high
    assert axis.frequency_responses[0].margins["phase margin [deg]"] > 10.0
    moves = axis.steps[:2]  # the same move, with the gains before and the new ones; then a load step
    assert [step.tuned for step in moves] == [False, True]
    for step in moves:
        assert step.actual[-1] == pytest.approx(step.reference[-1], rel=0.1) and step.reference[-1] > 0.0
    before, after = (step.figures["largest following error [rad]"] for step in moves)
    assert after < before  # the commissioned gains are slow
    assert any(line.startswith("axis 0: accepted") for line in lines)
    assert "axis 0: the agent chooses " in out
    before = load_snapshot(tmp_path / "run" / "before.toml")
    assert tuple(before.axes[0][key] for key in GAIN_OBJECTS) == axis.before
    assert (tmp_path / "run" / "report.html").is_file()


@pytest.mark.slow
def test_a_channel_of_the_environment_alone_moves_no_motor(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", "socket://127.0.0.1:1")
    result = CliRunner().invoke(
        app, ["auto", "--by", "agent", "--trials", "1", "--load", "inertia", "--out", str(tmp_path / "run")]
    )
    assert result.exit_code == 0 and "stored in the drive" not in result.stdout


def test_a_real_motor_turns_only_if_its_way_is_said_to_be_clear(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    known = SimpleNamespace(
        device=SimpleNamespace(name="tmcm1636"), motor=SimpleNamespace(name="qbl4208"), axes_per_machine=1
    )
    monkeypatch.setattr("tuning.commands.options.open_target", lambda _: nullcontext(known))
    code, _, error = command("--interface", "virtual", "--channel", "none", "--node", 3, "--travel", "-1:1")
    assert code == 2
    question = "drive-tune: The motor of node 3 will turn. Is its way clear?"
    assert error == f"{question} There is no terminal to ask; confirm with --yes\n"
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_it_tunes_both_axes_of_an_amplifier_on_mains():
    """The TGZ, whose registers, units and machines it has never seen; each axis turns a load of its own.

    It acts there as on any drive. Its card does not hold for it (test_kept_margins.py), so its cost is not judged.
    """
    with emulated("tgz_d", "inertia", num_machines=2) as target:
        tuned = tune_target(target, load_policy(shipped("gain_tuning")), trials=3)
        assert all(trial.gains.shape == (2, target.device.gains.count) for trial in tuned.trials)
        for axis in range(2):
            answer = tuned.trials[tuned.answers[axis]]
            assert not answer.aborted[axis]
            assert answer.gains[axis].tolist() == tuned.gains[axis].tolist()
        written = np.stack([target.drives.read(name) for name in target.device.gains.keys], axis=-1)
        np.testing.assert_array_equal(written, tuned.gains)
        assert not is_enabled(target).any()


@pytest.mark.slow
def test_json_for_programs(tmp_path):
    code, out, _ = command("--trials", 1, "--load", "inertia", "--json", "--out", tmp_path / "run")
    found = json.loads(out)
    assert code == 0
    assert 0.0 < found["axes"][0]["J"] < 10.0 and "the agent chooses" in str(found["axes"][0]["notes"])


@pytest.mark.parametrize(("arguments", "message"), [
    (["--agent", "nobody"], "no agent named 'nobody' ships; there are arm_path, gain_tuning"),
    (["--agent", "nothing.npz"], "there is no file nothing.npz"),
    (["--agent", "gantry_beam"], "acts in ServoDrive/GantryBeam-v1; a tuner acts in ServoDrive/GainTuning-v0"),
    (["--channel", "can0", "--travel", "-1:1", "--yes"], "channel 'can0' needs an interface"),
    (["--node", "1", "--travel", "-1:1", "--yes"], "no CAN channel is given"),
    (["--interface", "virtual", "--channel", "none"], "--travel is missing: give how far the motor may turn"),
    (["--trials", "0"], "--trials 0 must be 1 or more"),
    (["--load", "nothing"], "no load is named 'nothing'"),
    (["--dynamics", "lively"], "dynamics 'lively': give soft, standard, stiff"),
])  # fmt: skip
def test_a_mistake_ends_with_code_2_and_one_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, _, error = command(*arguments)
    assert (code, len(error.splitlines())) == (2, 1), error
    assert message in error
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_a_policy_that_gives_no_number_leaves_the_drive_as_it_was_and_disabled(tmp_path):
    with emulated("tmcm1636", "two_mass", "qbl4208") as target:
        before = gains(target)
        with pytest.raises(PolicyError, match="not a number"):
            run_agent(target, Broken(1), tmp_path / "before.toml", name="broken")
        assert np.array_equal(gains(target), before)
        assert not is_enabled(target).any()


@pytest.mark.slow
def test_a_tuner_that_never_returns_ends_the_run_and_leaves_the_drive_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "PATIENT", replace(guard.PATIENT, stall=1.0))

    class Hanging(Broken):
        def act(self, observation):
            self._good -= 1
            if self._good < -1:  # it was asked once before anything moved
                threading.Event().wait(600.0)
            return self._policy.act(observation)

    with emulated("tmcm1636", "inertia", "qbl4208") as target:
        before = gains(target)
        with pytest.raises(
            PolicyStoppedError, match="no answer for 1000 ms: it is too slow, or does not return at all"
        ):
            run_agent(target, Hanging(1), tmp_path / "before.toml", name="hanging")
        assert np.array_equal(gains(target), before) and not is_enabled(target).any()


class Contrary:
    """A tuner that lowers all gains, and answers those of its first look."""

    def __init__(self):
        self.bundle = load_policy(shipped("gain_tuning")).bundle
        self.step = self.bundle.settings["step"]

    def reset(self, mask=None):
        pass

    def act(self, observation):
        return np.full((len(observation), 3), -0.2 / self.step)

    def answer(self, observation):
        return -observation[:, 7:10] / self.step  # ln of the incumbent's gains over the rule's


def test_the_answer_is_the_tuners_own_where_it_makes_one():
    with emulated("tmcm1636", "inertia", "qbl4208") as target:
        found = tune_target(target, Contrary(), trials=1)
        assert np.array_equal(gains(target), found.gains)
    assert np.array_equal(found.gains, found.trials[0].gains)
    assert not np.array_equal(found.gains, found.trials[1].gains)


class Reckless(Contrary):
    """A tuner that raises all gains tenfold, which no axis bears, and would stay with that."""

    def act(self, observation):
        return np.full((len(observation), 3), 2.3 / self.step)

    def answer(self, observation):
        return self.act(observation)


def settings(target):
    """Return what tuning has no business to change."""
    names = [0x6065, 0x6081, 0x6083, 0x6084, 0x6085, 0x2003, 0x2050, 0x2055, 0x2056, (0x60C2, 1)]
    return np.stack([target.drives.read(name) for name in names], axis=1)


def test_gains_that_were_stopped_are_no_answer():
    """However sure a tuner is of them: the best trial that was not stopped is kept, and that is said."""
    with emulated("tmcm1636", "inertia", "qbl4208") as target:
        done = tune_target(target, Reckless(), trials=3)
        assert all(trial.aborted.all() for trial in done.trials[1:]) and not done.trials[0].aborted.any()
        assert (done.answers.tolist(), done.overruled.tolist()) == ([0], [True])
        assert np.array_equal(gains(target), done.trials[0].gains)


def unstable(*_):
    """Loops of an axis of which no gains keep anything."""
    device = find_device("tmcm1636")
    return [(SimpleNamespace(device=device, slack=lambda dynamics, sets: np.full(len(sets), -1.0)), np.array([0]))]


@pytest.mark.slow
def test_a_proposal_that_breaks_the_margins_is_not_tried_and_that_is_said(tmp_path):
    """Margins are computed from the identified plant: a tuner that raises all gains tenfold moves none with them."""
    with emulated("tmcm1636", "inertia", "qbl4208") as target:
        agent = Reckless()
        agent.bundle.configuration["trials"] = 2
        done = run_agent(target, agent, tmp_path / "before.toml", name="reckless", doubts=("of another kind",))
        (axis,) = done.result.axes
        rule, *others = done.trials
        assert rule.kept.all() and not rule.lowered.any()
        for trial in others:
            assert trial.lowered.all() and trial.kept.all() and not trial.aborted.any()
        assert any("2 of the agent's 2 proposals broke standard dynamics" in note for note in axis.notes)
        assert axis.accepted and "of another kind" in axis.reservations
        assert tuple(axis.after) == tuple(gains(target)[0])


@pytest.mark.every(2)
@pytest.mark.parametrize(("models", "reason"), [
    (lambda *_: [], "every trial was stopped, the baseline rule's too"),
    (unstable, "none of the trials keeps standard dynamics by the identified plant"),
])  # fmt: skip
def test_where_no_trial_can_be_the_answer_the_drive_has_what_it_had(tmp_path, monkeypatch, models, reason):
    monkeypatch.setattr("agents.tuner.kept_margins.loop_models", models)
    monkeypatch.setattr(
        "drive_env.trials.method.rule_gains", lambda *_, **__: np.array([[4021, 1573, 32767, 9, 32767]])
    )
    with emulated("tmcm1636", "inertia", "qbl4208") as target:
        before, set_before = gains(target), settings(target)
        done = run_agent(target, Reckless(), tmp_path / "before.toml", name="reckless")
        assert done.result.axes[0].reason == reason
        assert not done.result.kept and not done.result.axes[0].accepted
        assert np.array_equal(gains(target), before) and np.array_equal(settings(target), set_before)
        assert not is_enabled(target).any()


def test_outside_its_card_it_says_so_before_anything_moves(tmp_path):
    """Outside its card a run prints a sentence on stderr and adds a reservation; inside, neither."""
    code, out, error = command("--load", "winder", "--dry-run", "--dynamics", "soft", "--out", tmp_path / "run")
    assert code == 0 and "Nothing was written." in out
    assert error.startswith("drive-tune: the agent was not trained on this load: winder, and its card holds for ")


def test_the_dynamics_asked_for_are_the_agents_and_the_verifications(tmp_path, monkeypatch):
    asked = {}

    def proven(*_, **options):
        asked.update(options)
        raise RuntimeError("as far as this test goes")

    monkeypatch.setattr("tuning.auto.one_button.auto", proven)
    policy = open_tuner("gain_tuning", "tmcm1636", None, "50/10/1.8")
    assert policy.bundle.configuration["dynamics"] == "50/10/1.8"
    _, _, error = command("--load", "inertia", "--dynamics", "50/10/1.8", "--out", tmp_path / "run")
    assert "as far as this test goes" in error
    assert asked["dynamics"].name == "50/10/1.8"


def test_what_shakes_on_with_the_incumbent_is_calmed(monkeypatch):
    """A trial that is stopped goes on with the incumbent's gains, and those may be near to the edge, too."""
    run, wild = Trials.run, np.array([4021, 1573, 30_000, 3000, 30_000])
    monkeypatch.setattr(
        Trials, "run", lambda self, gains, incumbent, *rest: run(self, gains, wild + 0 * incumbent, *rest)
    )
    with emulated("tmcm1636", "inertia", "qbl4208") as target:
        audit = DriveAudit(target)
        done = tune_target(replace(target, drives=ObservedDrives(target.drives, audit)), Reckless(), trials=2)
    assert [bool(trial.aborted) for trial in done.trials] == [False, True, True]
    assert audit.violations[KINDS.index("oscillated")].tolist() == [0]  # never for 100 ms


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_a_trial_that_a_fault_ends_names_the_emergency(tmp_path, monkeypatch, number):
    """The rule's trial as well as one of the agent's."""
    run, seen = Trials.run, []
    with emulated("tmcm1636", "inertia", "qbl4208") as target:

        def failing(self, *arguments):
            seen.append(None)
            if len(seen) == number + 1:
                target.drives.machine.fault("enable_lost", duration=0.02)
            return run(self, *arguments)

        with monkeypatch.context() as during:
            during.setattr(Trials, "run", failing)
            done = run_agent(target, Reckless(), tmp_path / "before.toml", name="reckless")
    assert [trial.faults[0] for trial in done.trials[:2]] == [("shutdown_switch",) * (k == number) for k in range(2)]

    def shown(policy, doubts, show, say):
        for trial in done.trials[:2]:
            show(trial)
        raise RuntimeError("as far as this test goes")

    monkeypatch.setattr("agents.tuner.tuning_run.finder", shown)
    _, out, _ = command("--load", "inertia", "--out", tmp_path / "run")
    rows = [line for line in out.splitlines() if "it oscillated or went into fault" in line]
    (named,) = (row for row in rows if "; the drive reported shutdown switch" in row)
    assert named.split()[0] == ("1" if number else "rule")


def test_a_wrong_wiring_ends_the_run_before_any_trial_with_the_reason(tmp_path):
    reversed_ = (0x2080, 1)
    with emulated("tmcm1636", "inertia", "qbl4208") as target:
        target.drives.write(reversed_, 1 - target.drives.read(reversed_))
        target.drives.write((0x2080, 3), 2)  # its halls align the encoder once: it is not set right under way
        before = gains(target)
        done = run_agent(target, Contrary(), tmp_path / "before.toml", name="contrary")
        assert done.trials == [] and "encoder counts in the wrong direction" in done.result.axes[0].reason
        assert np.array_equal(gains(target), before) and not is_enabled(target).any()


@pytest.mark.slow
def test_gains_are_all_that_a_run_changes(tmp_path):
    with emulated("tmcm1636", "two_mass", "qbl4208", num_machines=2) as target:
        before = settings(target)
        done = run_agent(target, load_policy(shipped("gain_tuning")), tmp_path / "before.toml", name="gain_tuning")
        assert done.result.accepted.all()
        assert np.array_equal(settings(target), before) and not is_enabled(target).any()
        assert [tuple(row) for row in gains(target)] == [tuple(axis.after) for axis in done.result.axes]


def test_it_starts_from_any_gains():
    """Factory-fresh drives have none; others have what somebody left in them."""
    with emulated("tmcm1636", "two_mass", "qbl4208", num_machines=2) as target:
        for name in GAIN_OBJECTS:
            target.drives.write(name, [0, 32767])
        found = tune_target(target, load_policy(shipped("gain_tuning")), trials=3)
        assert np.array_equal(gains(target), found.gains)
        assert not is_enabled(target).any()
        first, best = found.trials[0].measured, np.min([trial.measured for trial in found.trials], axis=0)
    assert np.all(best <= first)
    assert np.all(best < 5.0)


@pytest.mark.slow
def test_as_a_tuner_of_the_comparison_it_tells_its_costs():
    with emulated("tmcm1636", "inertia", "qbl4208", num_machines=2) as target:
        outcome = surrogate(target, np.random.default_rng(0))
    assert outcome.gains.shape == (2, 5)
    assert np.all(outcome.moves == 2 + 3 * 11)
    assert np.all((outcome.drive_seconds > 8.0) & (outcome.drive_seconds < 20.0))
