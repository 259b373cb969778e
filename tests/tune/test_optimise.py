"""Optimisation by trials: what a trial costs, that a safe search is safe, and that it works on a bus as well."""

from __future__ import annotations

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
from rigs.chip_gains import Gains
from rigs.world_bus import served
from typer.testing import CliRunner

from drive_env import EmulatedDrives, cia402
from drive_env.bus.hub import Hub
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.drives.observed import ObservedDrives
from drive_env.drives.raw_gains import read_gains, write_gains
from drive_env.motors import find_motor
from drive_env.trials.gain_trial import Trials, measured_cost, softness
from drive_env.trials.method import Cascade
from tuning.commands.cli import app
from tuning.compare.suite import load_suite, open_group
from tuning.drive_audit import KINDS, DriveAudit
from tuning.search import optimise as optimise_module
from tuning.search import trial_bench
from tuning.search.optimise import SAFE_STEP, Settings, optimise
from tuning.search.trial_bench import OBJECTIVES, TrialBench, first_gains
from tuning.search.trials_files import load_options
from tuning.target import Target, emulated

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

WILD = np.array([4021, 1573, 30_000, 3000, 30_000])
FEW = Settings(sampler="tpe", trials=8)


@pytest.fixture
def rigid():
    """Four rigid machines of one to eighteen rotors."""
    with open_group([m for m in load_suite() if m.load == "inertia" and m.motor == "qbl4208"]) as target:
        yield target


def trial_seconds(trials: int) -> float:
    """Return how long identification and so many trials take [s], without what recovery takes."""
    return (2 + 3 * trials) * 0.25  # moves of identification and of a trial, each of a quarter of a second


def searched(settings, load="inertia", lanes=4, **options):
    with emulated(load=load, num_machines=lanes) as target:
        return optimise(target, settings, shared=True, anew=True, **options)


# --- a trial ------------------------------------------------------------------------------------------------------
def test_a_trial_costs_what_the_environments_trials_cost(rigid):
    bench = TrialBench(rigid, anew=True)
    bench.identify()
    tried = bench.run(bench.rule)
    # The same by hand.
    drives = rigid.drives
    trials = Trials(drives, rigid.motor, 1, bench.t_0)
    drives.machine.reset()
    everywhere = np.ones(4, bool)
    trials.recover(everywhere)
    by_hand = trials.run(bench.rule, bench.safe, bench.move, bench._origin, np.ones(4, int), everywhere)
    assert not by_hand.aborted.any()
    expected = measured_cost(
        by_hand.costs(softness(rigid.device.gains, bench.rule) / softness(rigid.device.gains, bench.rule))
    )
    assert np.all(expected < 30.0)
    np.testing.assert_allclose(np.exp(tried.cost), expected, rtol=1e-12)
    np.testing.assert_allclose(tried.objectives[:, 0], np.log(by_hand.terms.settling[:2].max(axis=0)))
    np.testing.assert_allclose(tried.objectives[:, 2], 100.0 * by_hand.terms.noise[:2].mean(axis=0))


def test_a_slower_axis_costs_more_even_where_j_has_come_to_its_end(rigid):
    bench = TrialBench(rigid, anew=True)
    bench.identify()
    slow, slower = bench.safe.copy(), bench.safe.copy()
    slow[:, 2:] //= 2
    slower[:, 2:] //= 4
    costs = [bench.run(gains).cost for gains in (slow, slower)]
    assert np.all(costs[0] > math.log(30.0))
    assert np.all(costs[1] > costs[0])


def fails_in_its_second_trial(monkeypatch, drives):
    """Take the enabling input from the first machine of emulated drives in whatever is tried second."""
    run, seen = Trials.run, []

    def failing(self, *arguments):
        seen.append(None)
        if len(seen) == 2:
            drives.machine.fault("enable_lost", duration=0.02, where=np.arange(drives.num_axes) == 0)
        return run(self, *arguments)

    monkeypatch.setattr(Trials, "run", failing)


def test_a_trial_that_a_fault_ends_names_the_emergency(rigid, monkeypatch):
    bench = TrialBench(rigid)
    bench.identify()
    fails_in_its_second_trial(monkeypatch, rigid.drives)
    told = [bench.run(bench.rule) for _ in range(3)]
    assert [one.causes.tolist() for one in told] == [[""] * 4, ["shutdown switch (5441h)", "", "", ""], [""] * 4]
    assert [one.aborted.tolist() for one in told] == [[False] * 4, [True, False, False, False], [False] * 4]


@pytest.mark.parametrize("gains", [np.zeros(5, int), WILD], ids=["factory fresh", "wild"])
def test_whatever_gains_the_drives_had_they_are_identified_and_tried(rigid, gains):
    write_gains(rigid.drives, np.tile(gains, (4, 1)))
    bench = TrialBench(rigid)
    bench.identify()
    true = rigid.drives.machine.parameters
    share = true["motor.psi_m"] / rigid.motor.psi_m
    np.testing.assert_allclose(
        bench.identified.inertia, (true["load.inertia"] + true["motor.inertia"]) / share, rtol=0.1
    )
    assert not bench.run(bench.safe).aborted.any()


def test_an_axis_that_oscillates_while_it_is_identified_is_off_within_50_ms_and_moves_again_more_softly(
    rigid, monkeypatch
):
    """Three axes have the commissioning gains, which suit them; the last has far too high ones."""
    gains = first_gains(rigid)
    gains[3, 2:4] *= 60
    monkeypatch.setattr(Cascade, "first", lambda method, supply: gains.copy())
    currents = []
    record = type(rigid.drives).record

    def listening(drives, objects, *rest, **more):
        trace = record(drives, objects, *rest, **more)
        if 0x6077 in objects or (0x6077, 0) in objects:
            currents.append(trace[0x6077][:, 3])
        return trace

    monkeypatch.setattr(type(rigid.drives), "record", listening)
    bench = TrialBench(rigid)
    bench.identify()
    shaking = np.abs(np.diff(np.concatenate(currents))) > 0.5 * rigid.current * 1e3
    assert 5 <= shaking.sum() <= 50
    truth = rigid.drives.machine.parameters["load.inertia"] + rigid.drives.machine.parameters["motor.inertia"]
    np.testing.assert_allclose(bench.identified.inertia, truth, rtol=0.2)
    assert bench.moves.min() > 2


def test_an_axis_that_oscillates_with_any_gains_is_told(rigid, monkeypatch):
    monkeypatch.setattr(trial_bench, "SOFTER", 1)
    monkeypatch.setattr(Cascade, "first", lambda method, supply: np.tile(np.array(WILD), (4, 1)))
    with pytest.raises(RuntimeError, match="axis 0 oscillates in the moves of identification, even with 1/"):
        TrialBench(rigid).identify()


def test_what_oscillates_is_stopped_and_has_the_last_good_gains_again(rigid):
    bench = TrialBench(rigid)
    bench.identify()
    bench.incumbent = bench.rule.copy()
    gains = bench.rule.copy()
    gains[1] = WILD
    tried = bench.run(gains)
    assert tried.aborted.tolist() == [False, True, False, False]
    assert bench.aborts.tolist() == [0, 1, 0, 0]
    np.testing.assert_array_equal(read_gains(rigid.drives)[1], bench.rule[1])
    assert np.all(cia402.matches(rigid.drives.read(0x6041), cia402.OPERATION_ENABLED))


class Chart:
    """Drives that are drawn millisecond by millisecond: the current of each axis [A], and the gains in force."""

    def __init__(self, drives):
        self._drives = drives
        self.current, self.gains = [], []

    def __getattr__(self, name):
        return getattr(self._drives, name)

    def advance(self, duration):
        if duration > 0.0:
            self.record([0x6077], duration)

    def record(self, objects, duration, *rest, **options):
        gains = np.stack([self._drives.read(name) for name in GAIN_OBJECTS], axis=-1)
        trace = self._drives.record([*objects, *({0x6077} - set(objects))], duration, *rest, **options)
        self.current.extend(trace[0x6077] * 1e-3)
        self.gains.extend([gains] * len(trace))
        return trace

    def stopped_after(self, axis, rated_current):
        """Return for how long an axis oscillated each time until it had other gains [ms], and which those were."""
        change = np.diff(np.array(self.current)[:, axis], append=self.current[-1][axis])
        gains = np.array(self.gains)[:, axis]
        found, t = [], 0
        while t < len(change) - 25:
            if math.sqrt(np.mean(change[t : t + 25] ** 2)) > 0.4 * rated_current:
                end = t
                while end < len(gains) and np.array_equal(gains[end], gains[t]):
                    end += 1
                found.append((end - t, gains[min(end, len(gains) - 1)].tolist()))
                t = end + 25  # until it has died away
            t += 1
        return found


def test_what_oscillates_has_the_last_good_gains_within_50_ms_of_drive_time(rigid):
    chart = Chart(rigid.drives)
    bench = TrialBench(replace(rigid, drives=chart))
    bench.identify()
    bench.run(bench.rule)
    bench.incumbent = bench.rule.copy()  # as a search does with what was good
    chart.current.clear(), chart.gains.clear()
    gains = np.where(np.array([[True], [True], [False], [True]]), WILD, bench.rule)
    tried = bench.run(gains)
    assert tried.aborted.tolist() == [True, True, False, True]
    for axis, aborted in enumerate(tried.aborted):
        stops = chart.stopped_after(axis, rigid.motor.rated_current)
        assert bool(stops) == aborted
        for milliseconds, after in stops:
            assert milliseconds <= 50
            assert after == bench.rule[axis].tolist()


def test_what_shakes_on_with_the_last_good_gains_is_calmed_and_said():
    machines = [m for m in load_suite() if m.load == "inertia" and m.motor == "qbl4208"][:2]
    with open_group(machines) as target:
        bench = TrialBench(target)
        bench.identify()
        bench.incumbent[1] = WILD
        gains = np.stack([bench.rule[0], WILD])
        tried = bench.run(gains)
        assert tried.fragile.tolist() == [False, True]
        trace = target.drives.record([0x6077], 0.05)
        change = np.diff(trace[0x6077], axis=0) * 1e-3
        assert np.all(np.sqrt(np.mean(change**2, axis=0)) < 0.4 * target.motor.rated_current)


# --- a search -----------------------------------------------------------------------------------------------------
@pytest.mark.every(4)
@pytest.mark.parametrize("sampler", ["random", "grid", "tpe", "cmaes"])
def test_a_search_ends_with_the_best_of_its_trials_on_the_drives(rigid, sampler):
    found = optimise(rigid, Settings(sampler=sampler, trials=9, seed=2))
    np.testing.assert_array_equal(read_gains(rigid.drives), found.gains)
    for machine in range(4):
        rows = [row for row in found.rows if row.search == machine]
        assert len(rows) == 9
        np.testing.assert_array_equal(rows[0].gains[0], found.rule[machine])  # the rule is the first that is tried
        kept = [row for row in rows if not row.aborted]
        best = next(row for row in kept if np.array_equal(row.gains[0], found.gains[machine]))
        assert found.cost[machine] == best.cost <= rows[0].cost
    assert np.all(found.moves >= 2 + 3 * 9)
    assert found.aborts.tolist() == [sum(row.aborted for row in found.rows if row.search == k) for k in range(4)]
    assert found.drive_seconds >= trial_seconds(9)


def test_a_search_leaves_the_drives_as_they_were_but_for_the_gains(rigid):
    kept = (0x6081, 0x6083, 0x6084, 0x2003)
    before = [rigid.drives.read(name) for name in kept]
    optimise(rigid, replace(FEW, trials=3))
    np.testing.assert_array_equal([rigid.drives.read(name) for name in kept], before)
    assert not np.any(cia402.matches(rigid.drives.read(0x6041), cia402.OPERATION_ENABLED))


def test_a_search_follows_from_its_seed():
    first, again, other = (searched(replace(FEW, seed=seed)) for seed in (1, 1, 2))
    gains = [np.stack([row.gains for row in found.rows]) for found in (first, again, other)]
    np.testing.assert_array_equal(gains[0], gains[1])
    assert [row.cost for row in first.rows] == [row.cost for row in again.rows]
    assert not np.array_equal(gains[0], gains[2])


def test_a_machine_of_several_is_searched_as_it_is_alone():
    machines = [m for m in load_suite() if m.load == "inertia" and m.motor == "qbl4208"][:2]
    with open_group(machines) as both:
        together = optimise(both, replace(FEW, trials=4))
    with open_group(machines[:1]) as one:
        alone = optimise(one, replace(FEW, trials=4))
    mine = [row for row in together.rows if row.search == 0]
    for row, own in zip(mine, alone.rows, strict=True):
        np.testing.assert_array_equal(row.gains, own.gains)


def test_other_gains_than_those_named_are_the_rules(rigid):
    found = optimise(rigid, replace(FEW, gains=("torque_p",), trials=4, width=0.5))
    tried = np.stack([row.gains[0] for row in found.rows if row.search == 0])
    np.testing.assert_array_equal(tried[:, 1:], np.tile(found.rule[0, 1:], (4, 1)))
    ratio = np.log(tried[:, 0] / found.rule[0, 0])
    assert len(set(tried[:, 0].tolist())) > 1 and np.all(np.abs(ratio) < 0.5 + 1e-3)


def test_a_journal_is_gone_on_from(tmp_path):
    whole = searched(replace(FEW, journal=tmp_path / "whole.log"))
    half = replace(FEW, journal=tmp_path / "half.log")
    searched(replace(half, trials=4))
    resumed = searched(half)
    assert len(resumed.rows) == len(whole.rows) == 8
    for row, expected in zip(resumed.rows, whole.rows, strict=True):
        np.testing.assert_array_equal(row.gains, expected.gains)
        assert row.cost == expected.cost
    np.testing.assert_array_equal(resumed.gains, whole.gains)


# --- several objectives -------------------------------------------------------------------------------------------
def test_robustness_is_worst_of_what_was_stopped():
    found = searched(replace(FEW, trials=16), "two_mass")
    stopped = [row for row in found.rows if row.aborted]
    assert stopped, "some of these gains oscillate"
    k = OBJECTIVES.index("robustness")
    assert {row.objectives[k] for row in stopped} == {math.log(30.0)}
    assert all(0.0 <= row.objectives[k] < math.log(30.0) for row in found.rows if not row.aborted)


# --- machines of several axes -------------------------------------------------------------------------------------
@pytest.mark.parametrize("load", ["gantry", "robot"])
def test_the_axes_of_a_machine_are_searched_as_one(load):
    machines = [m for m in load_suite() if m.load == load][:1]
    with open_group(machines) as target:
        found = optimise(target, replace(FEW, trials=5, safe=True))
        np.testing.assert_array_equal(read_gains(target.drives), found.gains)
    axes = len(found.rule)
    assert axes == {"gantry": 2, "robot": 6}[load]
    assert [row.gains.shape for row in found.rows] == [(axes, 5)] * len(found.rows)
    for row in found.rows:  # each axis has its rule's gains times what all of them have
        factors = row.gains[:, 2:] / found.rule[:, 2:]
        np.testing.assert_allclose(factors, np.broadcast_to(factors.mean(axis=0), factors.shape), rtol=0.02)
    (best,) = [row for row in found.rows if np.array_equal(row.gains, found.gains)][:1]
    assert not best.aborted
    assert found.cost[0] == min(row.cost for row in found.rows if not row.aborted)


def test_a_grid_of_a_machine_of_several_axes_is_a_grid():
    with open_group([m for m in load_suite() if m.load == "gantry"][:1]) as target:
        found = optimise(target, Settings(sampler="grid", trials=9))
    assert len({row.gains.tobytes() for row in found.rows}) == 9  # the rule and 2 levels of 3 gains


# --- the safe search ----------------------------------------------------------------------------------------------
def logs(row, rule):
    return np.log(row.gains[0, 2:] / rule[2:])


@pytest.fixture(scope="module")
def safely():
    """A safe search on elastic machines, which the rule itself makes oscillate, and what an audit saw of it."""
    machines = [m for m in load_suite() if m.load == "two_mass" and m.motor == "qbl4208"]
    with open_group(machines) as target:
        audit = DriveAudit(target)
        found = optimise(
            replace(target, drives=ObservedDrives(target.drives, audit)),
            Settings(sampler="tpe", trials=20, safe=True, seed=3),
        )
    return found, audit


@pytest.mark.slow
def test_a_safe_search_begins_with_gains_that_are_proved(safely):
    found, _ = safely
    first = [row for row in found.rows if row.number == 0]
    assert len(first) == 6 and not any(row.aborted for row in first)
    assert all(np.all(logs(row, found.rule[row.search]) < -0.5) for row in first)


def test_a_safe_search_goes_on_from_what_was_proved_in_small_steps(safely):
    found, _ = safely
    for search in range(6):
        rows = [row for row in found.rows if row.search == search]
        for k, row in enumerate(rows[1:], 1):
            proved = [logs(other, found.rule[search]) for other in rows[:k] if not other.aborted]
            way = min(np.abs(logs(row, found.rule[search]) - point).max() for point in proved)
            assert way < SAFE_STEP + 0.02  # gains are integers


def test_a_safe_search_keeps_off_what_oscillated(safely):
    found, _ = safely
    stopped = 0
    for search in range(6):
        rows = [row for row in found.rows if row.search == search]
        for k, row in enumerate(rows):
            beyond = [
                other for other in rows[:k] if other.aborted and np.all(row.gains[0, 2:] > 1.02 * other.gains[0, 2:])
            ]
            assert not beyond
            stopped += row.aborted
    assert stopped, "a search that is never stopped shows nothing here"


def test_a_safe_search_ends_with_gains_that_were_never_stopped_and_are_better(safely):
    found, _ = safely
    for search in range(6):
        rows = [row for row in found.rows if row.search == search]
        (kept,) = [row for row in rows if np.array_equal(row.gains[0], found.gains[search])][:1]
        assert not kept.aborted
        assert kept.cost < rows[0].cost


@pytest.mark.slow
def test_a_safe_search_shakes_the_axes_less_than_a_bold_one(safely):
    found, audit = safely
    machines = [m for m in load_suite() if m.load == "two_mass" and m.motor == "qbl4208"]
    with open_group(machines) as target:
        bold = optimise(target, Settings(sampler="tpe", trials=20, seed=3))
    assert found.aborts.sum() < 0.7 * bold.aborts.sum()
    assert audit.violations[KINDS.index("tripped")].sum() == 0


def test_a_short_travel_is_kept():
    machines = [m for m in load_suite() if m.load == "belt" and m.travel < 1.0]
    with open_group(machines) as target:
        audit = DriveAudit(target)
        optimise(replace(target, drives=ObservedDrives(target.drives, audit)), Settings(trials=8, safe=True))
    assert audit.violations[KINDS.index("left its travel")].sum() == 0


# --- on a bus -----------------------------------------------------------------------------------------------------
def free_axis(drives):
    """Return one axis of a bus that may turn freely, as a target."""
    motor, free = find_motor("qbl4208"), np.array([math.inf])
    supply = np.array([motor.voltage])
    return Target(drives, drives.device, motor, supply, -free, free, motor.rated_speed, motor.rated_current)


@pytest.mark.slow
def test_a_search_runs_on_one_axis_of_a_bus_inside_the_envelope():
    from tuning.search.trial_bench import leave_oscillations_to_trials

    with served("calls", load="inertia") as drives:
        leave_oscillations_to_trials(drives)
        target = free_axis(drives)
        found = optimise(target, Settings(trials=5, safe=True))
        np.testing.assert_array_equal(read_gains(target.drives), found.gains)
    costs = [row.cost for row in found.rows]
    assert len(costs) == 5 and min(costs) == found.cost[0] < costs[0]


def test_a_stop_by_the_envelope_is_an_abort():
    with served("calls", load="inertia") as drives:  # with its own watch for oscillations
        target = free_axis(drives)
        bench = TrialBench(target)
        bench.identify()
        bench.incumbent = bench.rule.copy()
        tried = bench.run(WILD[None])
        assert tried.aborted.tolist() == [True] and tried.cost[0] == math.log(30.0)
        np.testing.assert_array_equal(read_gains(target.drives), bench.rule)
        assert not bench.run(bench.rule).aborted.any()


# --- the command --------------------------------------------------------------------------------------------------
def drive_tune(*arguments):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.stderr.strip()  # of the progress bar an empty line is left


@pytest.fixture
def node(tmp_path, monkeypatch):
    """An emulated drive on a hub, and the arguments that search on it."""
    monkeypatch.chdir(tmp_path)
    world = World(lockstep=True)
    machine = EmulatedDrives(load="inertia", num_threads=1)
    machine.advance(0.001)  # compiles: a node that does would not answer in time
    world.add(machine, [1])
    hub = Hub()
    bus = ("--bus", "--interface", "slcan", "--channel", hub.channel, "--lockstep")
    with Server(world, hub):
        yield machine, ("auto", "--by", "random", *bus, "--travel", "-5:5", "--yes", "--trials", 4, "--out", "obus")
    world.close()


@pytest.mark.slow
def test_the_emergency_that_ended_a_trial_is_printed_and_in_the_table(node, tmp_path, monkeypatch):
    machine, arguments = node
    fails_in_its_second_trial(monkeypatch, machine)
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    assert done.stdout.count("was stopped: the drive reported") == 1
    assert "trial 1 was stopped: the drive reported shutdown switch (5441h)" in done.stdout
    with (tmp_path / "obus" / "trials.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["cause"] for row in rows] == ["", "shutdown switch (5441h)", "", ""]
    assert rows[1]["stopped"] == "True"


def is_interrupted(monkeypatch):
    """Press Ctrl-C while the drives have gains that are tried."""

    def pressed(target, settings, progress):
        write_gains(target.drives, WILD[None])
        raise KeyboardInterrupt

    monkeypatch.setattr(optimise_module, "optimise", pressed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "says"),
    [
        pytest.param(
            (),
            "the trials made so far are lost: on a bus they are kept only with --journal FILE",
            marks=pytest.mark.slow,
        ),
        (
            ("--journal", "kept.log"),
            "the trials made are in kept.log: the same command, with a new --out, continues from there",
        ),
    ],
)
def test_ctrl_c_on_a_bus_says_what_the_drives_have_and_what_is_kept(node, monkeypatch, more, says):
    machine, arguments = node
    before = [int(machine.read(key)[0]) for key in GAIN_OBJECTS]
    is_interrupted(monkeypatch)
    code, error = drive_tune(*arguments, *more)
    assert code == 130
    assert error.splitlines() == [
        "drive-tune: the drives have their state from before, by a second reading; drive-tune undo obus/before.toml "
        "restores it",
        f"drive-tune: interrupted; {says}",
    ]
    assert [int(machine.read(key)[0]) for key in GAIN_OBJECTS] == before


def test_the_way_back_of_an_earlier_search_is_not_replaced(node, tmp_path):
    """It is the only one, if that search was killed."""
    _, arguments = node
    (tmp_path / "obus").mkdir()
    (tmp_path / "obus" / "before.toml").write_text("the only copy", encoding="utf-8")
    _, error = drive_tune(*arguments)
    assert "the folder obus is not empty; choose another --out" in error
    assert (tmp_path / "obus" / "before.toml").read_text(encoding="utf-8") == "the only copy"


@pytest.mark.slow
def test_what_there_is_not_is_not_resumed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    search = ("auto", "--by", "random", "--load", "inertia", "--trials", 2, "--machines", 1, "--out", "run")
    assert drive_tune(*search, "--resume") == (
        2, "drive-tune: there is no search to resume: run.unfinished does not exist; correct --out, or leave --resume "
        "out to begin a new one",
    )  # fmt: skip
    assert not list(tmp_path.iterdir())
    code, error = drive_tune(*search)
    assert code == 0, error
    assert drive_tune(*search, "--resume") == (
        2, "drive-tune: the search in run is finished, and its results are there: nothing is left to resume",
    )  # fmt: skip


def test_what_an_emulated_search_keeps_in_its_journal_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def pressed(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr("tuning.search.searches.run", pressed)
    search = ("auto", "--by", "tpe", "--load", "inertia", "--out", "run")
    assert drive_tune(*search) == (130, "drive-tune: interrupted; nothing was written")
    assert drive_tune(*search, "--journal", "kept.log") == (
        130, "drive-tune: interrupted; the trials made are in kept.log: the same command, with a new --out, continues "
        "from there",
    )  # fmt: skip


# --- mistakes -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("gains", "message"),
    [
        (("velocity_d",), r"no gain is named 'velocity_d'; there are torque_p"),
        (("velocity_p", "velocity_p"), r"give different ones of gain"),
        ((), r"give different ones of gain: .*, not none"),
    ],
)
def test_gains_that_the_drive_does_not_have_are_refused_before_anything_moves(rigid, gains, message):
    gains_before = rigid.device.gains.read(rigid.drives)
    with pytest.raises(ValueError, match=message):
        optimise(rigid, Settings(gains=gains))
    np.testing.assert_array_equal(rigid.device.gains.read(rigid.drives), gains_before)


def test_the_first_gains_are_those_of_the_commissioning_preset(rigid):
    rigid = replace(rigid, supply=np.full(4, rigid.motor.voltage))
    preset = [rigid.drives.read(name)[0] for name in GAIN_OBJECTS]
    np.testing.assert_array_equal(first_gains(rigid), np.tile(preset, (4, 1)))
    assert len(preset) == len(Gains._fields)


def test_settings_of_versions_before_0_2_are_read(tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text('sampler = "tpe"\n[machine]\nload = "inertia"\nlanes = 3\n', encoding="utf-8")
    assert load_options(file) == {"by": "tpe", "load": "inertia", "machines": 3}
