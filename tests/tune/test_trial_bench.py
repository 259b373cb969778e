"""Trials on the bench in closed form: what a trial costs, its objectives, and those that a log has already."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.drives.limits import Limits
from drive_env.motors import find_motor
from drive_env.safety.errors import SafetyError
from drive_env.trials.gain_trial import Trial
from drive_env.trials.method import method_of
from drive_env.trials.score import Terms
from tuning.runs.shard_log import ShardLog, ShardLogError
from tuning.search import trial_bench as module
from tuning.search.trial_bench import (
    MOST_WAITING,
    TrialBench,
    Tried,
    first_gains,
    leave_oscillations_to_trials,
)
from tuning.search.trial_log import LoggedTrials

DEVICE, MOTOR = find_device("tmcm1636"), find_motor("qbl4208")
GAINS = np.array([[1000, 200, 800, 100, 50]] * 4)
T_0 = 0.004
MOST_STOPS = 3  # trials in a row that the envelope may end


class Drives:
    """Drives whose positions are what a test says; what is done to them is noted."""

    observers, bus = (), None

    def __init__(self):
        self.num_axes, self.position, self.log, self.told = 4, np.full(4, 100), [], []

    def read(self, name):
        return self.position.copy()

    def write(self, name, value, where=None):
        self.log.append((name, np.broadcast_to(value, 4).tolist(), None if where is None else where.tolist()))

    def advance(self, seconds):
        self.log.append(("advance", round(seconds, 6)))

    def emergencies(self):
        told, self.told = self.told, []
        return told


def trial(settling=2.0, noise=0.0, overshoot=0.0, aborted=(), phases=None):
    """A trial of four axes: terms of all phases, or `phases` of settling, and (phase, axis) that were stopped."""
    one = np.ones((3, 4))
    stopped = np.zeros((3, 4), bool)
    for phase, axis in aborted:
        stopped[phase, axis] = True
    settled = one * settling if phases is None else np.array(phases, float)[:, None] * np.ones(4)
    return Trial(Terms(settled, one, one * noise, one * overshoot, stopped), one, stopped, one, stopped.any(axis=0))


def bench_of(found=None, *, anew=False):
    """A bench over four axes of two machines whose trial is found, and what is done."""
    made = TrialBench.__new__(TrialBench)
    drives = Drives()
    made.target = SimpleNamespace(drives=drives, num_axes=4, axes_per_machine=2, device=DEVICE, motor=MOTOR)
    made.num_machines, made.aborts, made.moves = 2, np.zeros(4, np.int64), np.zeros(4, np.int64)
    made._anew, made.method, made.t_0 = anew, method_of(DEVICE, MOTOR), T_0
    made._where, made._direction, made._stops = np.ones(4, bool), np.ones(4, np.int64), 0
    made._fallback = SimpleNamespace(begin=lambda: None, calmed=np.zeros(4, bool))
    made._origin, made.rule, made.safe, made.incumbent = np.full(4, 100), GAINS.copy(), GAINS // 4, GAINS // 2
    made.move = SimpleNamespace(distance=np.array([1000, -1000, 0, 1000]), velocity=np.full(4, 10_000))
    done = made.done = SimpleNamespace(recovered=[], went=[])

    def run(gains, incumbent, move, origin, direction, axes):
        if isinstance(found, Exception):
            raise found
        if not anew:  # it ends where its move did
            drives.position = np.where(axes, origin + direction * move.distance, drives.position)
        return found

    made._trials = SimpleNamespace(
        run=run, recover=lambda where: done.recovered.append(where.tolist()),
        go=lambda target, where: done.went.append((target.tolist(), where.tolist())),
        leave=lambda: done.went.append("left"), returns=False,
    )  # fmt: skip
    return made


@pytest.fixture
def written(monkeypatch):
    """Gains as they are written: rows and where."""
    found = []

    def write(drives, gains, where=None):
        found.append((np.asarray(gains).tolist(), None if where is None else np.asarray(where).tolist()))

    monkeypatch.setattr(module, "write_gains", write)
    monkeypatch.setattr(module, "write_profile", lambda drives, move, where: None)
    monkeypatch.setattr("tuning.search.trial_log.write_gains", write)
    return found


# --- cost ---------------------------------------------------------------------------------------------------------
def test_the_cost_is_ln_j_by_what_was_measured_and_the_softness_of_the_gains():
    found = bench_of()._cost(GAINS, trial(settling=2.0))
    j = 2.0**0.4 * np.array([1.0, 1.0, 1.5**-0.4])
    np.testing.assert_allclose(found, math.log(0.5 * j[:2].mean() + 0.5 * j.max()))
    half = GAINS.copy()
    half[:, 2] //= 2  # half the velocity P gives way twice as far
    np.testing.assert_allclose(bench_of()._cost(half, trial()) - bench_of()._cost(GAINS, trial()), 0.4 * math.log(2.0))


def test_beyond_the_end_of_j_the_cost_grows_a_tenth_as_fast():
    """J ends at 30, and yet what is slower is told from what is slow."""
    for settling in (1e4, 1e5):
        plain = math.log(settling**0.4 * (0.5 + 0.5 * 1.0))
        expected = plain if plain < math.log(30.0) else math.log(30.0) + 0.1 * (plain - math.log(30.0))
        np.testing.assert_allclose(bench_of()._cost(GAINS, trial(settling=settling)), expected)
    assert bench_of()._cost(GAINS, trial(settling=1e4))[0] > math.log(30.0)


def test_a_phase_that_was_stopped_costs_30():
    found = bench_of()._cost(GAINS, trial(settling=1.0, aborted=[(2, 1), (0, 3), (1, 3), (2, 3)]))
    np.testing.assert_allclose(found[[1, 3]], [math.log(0.5 + 15.0), math.log(30.0)])


def test_objectives_are_speed_robustness_and_current():
    found = bench_of()._objectives(trial(noise=0.02, phases=[2.0, 4.0, 8.0], aborted=[(2, 1), (1, 3), (2, 3)]))
    j = np.array([2.0, 4.0, 8.0]) ** 0.4 * (1.0 + (2 / 3) ** 2) ** 0.2
    np.testing.assert_allclose(found[0], [math.log(4.0), math.log(j[2] / j[:2].mean()), 2.0])
    np.testing.assert_allclose(found[1], [math.log(4.0), math.log(30.0), 2.0])
    slowest = 1.0 + 0.09 / T_0  # of a move that was stopped: all of the window from the profile's end to the load step
    np.testing.assert_allclose(found[3], [math.log(slowest), math.log(30.0), 2.0])


# --- a trial ------------------------------------------------------------------------------------------------------
def test_a_machine_is_as_good_as_its_worst_axis_and_goes_the_other_way_next_time(written):
    bench = bench_of(trial(aborted=[(2, 1)]))
    tried = bench.run(GAINS)
    assert tried.aborted.tolist() == [True, False] and tried.fragile.tolist() == [False, False]
    assert tried.cost[0] > tried.cost[1] and tried.objectives.shape == (2, 3)
    assert bench.moves.tolist() == [3] * 4 and bench.aborts.tolist() == [0, 1, 0, 0]
    assert bench.origin.tolist() == [1100, -900, 100, 1100] and bench._direction.tolist() == [-1] * 4
    assert written == [((GAINS // 2).tolist(), [True] * 4)]  # the incumbent, until the next trial
    bench.run(GAINS)
    assert bench.origin.tolist() == [100] * 4 and bench._direction.tolist() == [1] * 4


def test_trials_that_end_where_they_began_begin_there_again(written):
    bench = bench_of(trial())
    bench._trials.returns = True
    bench.run(GAINS)
    assert bench.origin.tolist() == [100] * 4 and bench._direction.tolist() == [1] * 4


def test_machines_that_take_no_part_stay_where_they_are(written):
    bench = bench_of(trial(aborted=[(0, 0), (0, 2)]))
    bench.run(GAINS, np.array([False, True]))
    assert bench.moves.tolist() == [0, 0, 3, 3] and bench.aborts.tolist() == [0, 0, 1, 0]
    assert bench.origin.tolist() == [100, 100, 100, 1100] and bench._direction.tolist() == [1, 1, -1, -1]
    assert written[-1][1] == [False, False, True, True]


def test_what_shakes_on_with_the_incumbent_gets_safe_gains_and_is_fragile(written):
    bench = bench_of(trial())
    bench._fallback.calmed = np.array([False, False, True, False])
    assert bench.run(GAINS).fragile.tolist() == [False, True]
    assert written[0][0] == [(GAINS[0] // 2).tolist()] * 2 + [(GAINS[0] // 4).tolist(), (GAINS[0] // 2).tolist()]


def test_emulated_machines_begin_every_trial_anew(written, monkeypatch):
    bench, resets = bench_of(trial(), anew=True), []
    monkeypatch.setattr(module, "machine_of", lambda drives: SimpleNamespace(reset=lambda: resets.append(1)))
    bench.run(GAINS)
    bench.run(GAINS)
    assert len(resets) == 2 and bench.origin.tolist() == [100] * 4 and bench._direction.tolist() == [1] * 4


def test_after_three_stops_in_a_row_the_envelopes_word_counts(written):
    bench = bench_of(SafetyError("too far"))
    for k in range(MOST_STOPS):
        tried = bench.run(GAINS, np.array([True, False]))
        assert tried.aborted.tolist() == [True, False] and not tried.fragile.any()
        np.testing.assert_allclose(tried.cost, math.log(30.0))
        np.testing.assert_allclose(tried.objectives[0], [math.log(1.0 + 0.09 / T_0), math.log(30.0), 100.0])
        assert bench.moves.tolist() == bench.aborts.tolist() == [k + 1, k + 1, 0, 0]
    with pytest.raises(SafetyError, match="too far"):
        bench.run(GAINS, np.array([True, False]))
    bench._stops = MOST_STOPS
    bench._trials.run = lambda *arguments: trial()
    bench.run(GAINS)
    assert bench._stops == 0  # not in a row any more


def test_causes_stand_once_for_a_machine_and_those_of_before_are_forgotten(written):
    bench = bench_of(trial())
    message = lambda axis, code, name: SimpleNamespace(axis=axis, code=code, name=name)  # noqa: E731
    bench.target.drives.told = [message(0, 0x3220, "undervoltage")]
    run = bench._trials.run

    def tell(*arguments):
        bench.target.drives.told = [message(k, 0x8611, "following_error") for k in (2, 3)]
        return run(*arguments)

    bench._trials.run = tell
    assert bench.run(GAINS).causes.tolist() == ["", "following error (8611h)"]
    bench._trials.run = lambda *arguments: trial()
    assert bench.run(GAINS).causes.tolist() == ["", ""]


@pytest.mark.parametrize(("away", "brought"), [(200, False), (201, True), (-201, True)])
def test_an_axis_farther_than_a_fifth_of_its_move_is_brought_back_first(written, away, brought):
    bench = bench_of(trial())
    bench.target.drives.position = np.array([100, 100 + away, 100, 100])
    bench._return(np.ones(4, bool))
    axes = [False, True, False, False]
    assert bench.done.went == ([([100] * 4, axes)] if brought else [])
    assert bench.moves.tolist() == [0, int(brought), 0, 0]
    if brought:  # the way at the profile's speed, then a trial's time until it is back, and no longer than eight
        waited = [("advance", pytest.approx(0.021, abs=1.1e-3)), *[("advance", 0.25)] * MOST_WAITING]
        assert bench.target.drives.log == waited and MOST_WAITING == 8
        assert written == [((GAINS // 2).tolist(), axes)] and bench.done.recovered == [axes]
    bench.moves[:] = 0
    bench._return(np.array([True, False, True, True]))  # it takes no part
    assert bench.moves.tolist() == [0] * 4


def test_an_axis_that_is_back_is_not_waited_for_any_longer(written, monkeypatch):
    bench = bench_of(trial())
    drives = bench.target.drives
    drives.position = np.array([100, 400, 100, 100])

    def advance(seconds):
        drives.log.append(seconds)
        drives.position = np.array([100, 400 if len(drives.log) < 3 else 250, 100, 100])

    monkeypatch.setattr(drives, "advance", advance)
    bench._return(np.ones(4, bool))
    assert len(drives.log) == 3, "the ramp, and a trial's time twice"


def test_a_move_of_nothing_has_a_fifth_of_an_increment(written):
    bench = bench_of(trial())
    bench.target.drives.position = np.array([100, 100, 101, 100])
    bench._return(np.ones(4, bool))
    assert bench.moves.tolist() == [0, 0, 1, 0]


def test_drives_are_left_as_they_were_found_and_off_where_they_were_off(written):
    bench = bench_of(trial())
    bench._profile = {cia402.PROFILE_VELOCITY: np.array([1, 2, 3, 4])}
    bench._was_enabled = np.array([True, False, True, True])
    bench.leave(GAINS)
    assert written == [(GAINS.tolist(), None)]
    assert bench.target.drives.log == [
        (cia402.PROFILE_VELOCITY, [1, 2, 3, 4], None), (cia402.CONTROLWORD, [6] * 4, [False, True, False, False])
    ]  # fmt: skip
    assert bench.done.went == ["left"]
    bench.target.drives.log.clear()
    bench._was_enabled[:] = True
    bench.leave(GAINS)
    assert len(bench.target.drives.log) == 1  # an axis that was enabled stays so


# --- the moves of identification ----------------------------------------------------------------------------------
@pytest.mark.parametrize("swings", [0, 1, 2, 3])
def test_an_axis_that_oscillates_in_them_gets_softer_gains_three_times(swings, written, monkeypatch):
    bench = bench_of()
    bench._drives, bench._reach = bench.target.drives, np.full(4, 10.0)
    bench.target.current = 3.5
    made = []

    def watch(where, current, noise):
        assert where.all() and current.tolist() == [3.5] * 4
        made.append(SimpleNamespace(swung=np.array([False, len(made) < swings, False, False])))
        return made[-1]

    def identify(reach, where):
        bench.target.drives.position = bench.target.drives.position + 100  # it ends elsewhere when it is stopped
        return f"found by {reach[0]:.4f}"

    monkeypatch.setattr(module, "OscillationWatch", watch)
    monkeypatch.setattr(module, "ampere_per_count", lambda drives: 1e-3)
    monkeypatch.setattr(module, "trial_reach", lambda target, inertia, holding, reach: reach)
    monkeypatch.setattr(module, "ObservedDrives", lambda drives, watch: drives)
    bench.method = SimpleNamespace(
        measures_current=True, trials=lambda drives, axes: SimpleNamespace(identify=identify)
    )
    bench.target.drives.read = lambda name: (
        bench.target.drives.position.copy() if name == cia402.POSITION_ACTUAL else np.full(4, 1000)
    )
    if swings == 3:
        with pytest.raises(
            RuntimeError, match="axis 1 oscillates in the moves of identification, even with 1/16 of the"
        ):
            bench._moved(GAINS)
    else:
        # Every move that was stopped leaves less of the way: 100 of 1,000 increments of a turn.
        assert bench._moved(GAINS) == f"found by {10.0 - swings * 0.1 * 2.0 * np.pi:.4f}"
    assert bench.moves.tolist() == [2 * min(swings + 1, 3)] * 4
    for k, (gains, where) in enumerate(written, 1):
        assert where == [False, True, False, False]
        softer = np.array(gains)[1] / GAINS[1]
        np.testing.assert_allclose(softer[[2, 4]], 0.25**k, rtol=0.3)
        assert np.array(gains)[[0, 2, 3]].tolist() == GAINS[:3].tolist()
    assert len(written) == swings


# --- trials that a log has ----------------------------------------------------------------------------------------
@pytest.fixture
def searched(monkeypatch):
    """A bench that counts what it tries, its clock, and the gains that are left."""
    tried = []

    def run(gains, where):
        tried.append(gains.tolist())
        bench.moves += 3
        bench.aborts[0] += 1
        clock.seconds += 0.75
        k = float(len(tried))
        return Tried(
            np.array([k, 2.0]), np.full((2, 3), k), np.array([True, False]), np.zeros(2, bool), np.array(["", "x"])
        )

    bench = SimpleNamespace(run=run, moves=np.zeros(4, np.int64), aborts=np.zeros(4, np.int64), tried=tried,
                            target=SimpleNamespace(drives="drives"))  # fmt: skip
    clock = SimpleNamespace(seconds=10.0)
    monkeypatch.setattr("tuning.search.trial_log.read_gains", lambda target: GAINS + len(tried))
    return bench, clock


def test_what_was_tried_is_taken_from_the_log_to_the_same_numbers(searched, written, tmp_path):
    bench, clock = searched
    where = np.array([True, True])
    with ShardLog(tmp_path / "log", "trials") as log:
        first = [LoggedTrials(bench, clock, log).run(GAINS, where)]
    assert len(bench.tried) == 1 and not written
    bench.moves[:], bench.aborts[:], clock.seconds = 0, 0, 0.0
    with ShardLog(tmp_path / "log", "trials") as log:
        trials = LoggedTrials(bench, clock, log)
        again = trials.run(GAINS, where)
        assert len(bench.tried) == 1  # nothing was moved
        for one, other in zip(first[0], again, strict=True):
            np.testing.assert_array_equal(one, other)
        assert (bench.moves.tolist(), bench.aborts.tolist(), clock.seconds) == ([3] * 4, [1, 0, 0, 0], 10.75)
        assert written == [((GAINS + 1).tolist(), None)]
        assert trials.run(2 * GAINS, where).cost.tolist() == [2.0, 2.0] and len(bench.tried) == 2
        bench.moves[:] += 1  # its own, not the log's
    with ShardLog(tmp_path / "log", "trials") as log:
        trials = LoggedTrials(bench, clock, log)
        trials.run(GAINS, where)
        assert bench.moves.tolist() == [3] * 4
        trials.run(2 * GAINS, where)
        assert bench.moves.tolist() == [6] * 4 and clock.seconds == 11.5 and len(bench.tried) == 2


@pytest.mark.parametrize(("gains", "where"), [(GAINS + 1, [True, True]), (GAINS, [True, False])])
def test_a_log_of_another_search_is_refused(searched, written, tmp_path, gains, where):
    bench, clock = searched
    with ShardLog(tmp_path / "log", "trials") as log:
        LoggedTrials(bench, clock, log).run(GAINS, np.array([True, True]))
    with (
        ShardLog(tmp_path / "log", "trials") as log,
        pytest.raises(ShardLogError, match="trials of another search; remove"),
    ):
        LoggedTrials(bench, clock, log).run(gains, np.array(where))


# --- a bench is made, and identifies ------------------------------------------------------------------------------
class Standing(Drives):
    """Drives of two machines of two axes, of which the second axis is enabled, that have some gains and profile."""

    time_waits, safety, device = True, None, DEVICE

    def __init__(self, machine=None):
        super().__init__()
        self.machine = machine

    def read(self, name):
        known = {
            cia402.POSITION_ACTUAL: [10, 20, 30, 40], cia402.STATUSWORD: [0x0240, 0x0637, 0x0240, 0x0238],
            cia402.PROFILE_VELOCITY: [1, 2, 3, 4], cia402.PROFILE_ACCELERATION: [5] * 4,
            cia402.PROFILE_DECELERATION: [6] * 4,
        }  # fmt: skip
        return np.array(known.get(name, [65536] * 4))


def target_of(drives, **options):
    given = {
        "drives": drives, "num_axes": 4, "axes_per_machine": 2, "device": DEVICE, "motor": MOTOR,
        "low": np.array([-1.0, -2.0, -math.inf, -2.0]), "high": np.array([2.0, 1.0, math.inf, 2.0]),
        "supply": np.array([24.0, 24.0, 30.0, 30.0]), "current": 3.5,
    }  # fmt: skip
    return SimpleNamespace(**(given | options))


def test_a_bench_knows_the_way_the_state_and_the_profile_that_it_found():
    """The way is the longer one, with its sign; forwards where both are equal."""
    bench = TrialBench(target_of(Standing()))
    assert bench.num_machines == 2 and bench.moves.tolist() == bench.aborts.tolist() == [0] * 4
    assert bench.reach.tolist() == [2.0, -2.0, math.inf, 2.0]
    assert bench._was_enabled.tolist() == [False, True, False, False]
    assert {name: values.tolist() for name, values in bench._profile.items()} == {
        cia402.PROFILE_VELOCITY: [1, 2, 3, 4], cia402.PROFILE_ACCELERATION: [5] * 4,
        cia402.PROFILE_DECELERATION: [6] * 4,
    }  # fmt: skip
    assert bench.t_0 == method_of(DEVICE, MOTOR).t_0() and bench.highest.tolist() == DEVICE.gains.highest.tolist()
    assert (bench._stops, bench._direction.tolist(), bench._where.tolist()) == (0, [1] * 4, [True] * 4)
    assert bench.trials is bench._trials


@pytest.mark.parametrize(
    ("anew", "machine", "resets"), [(False, object(), False), (True, object(), True), (True, None, False)]
)
def test_only_emulated_machines_can_begin_anew(anew, machine, resets):
    assert TrialBench(target_of(Standing(machine)), anew=anew)._anew is resets
    assert TrialBench(target_of(Standing(machine)))._anew is False


@pytest.mark.parametrize(("anew", "measures"), [(False, True), (True, True), (False, False)])
def test_identification_ends_with_safe_gains_on_drives_that_stand(anew, measures, written, monkeypatch):
    """First gains before anything is enabled; a tenth of a second until what was before has died away."""
    drives, done = Standing(object()), []
    bench = TrialBench(target_of(drives), anew=anew)
    drives.log = done
    present, first, rule, safe = (np.full((4, 5), k) for k in range(4))
    monkeypatch.setattr(module, "machine_of", lambda drives: SimpleNamespace(reset=lambda: done.append("reset")))
    monkeypatch.setattr(module, "read_gains", lambda target: present)
    monkeypatch.setattr(
        module, "write_gains", lambda drives, gains, where=None: done.append(("gains", int(gains[0, 0]), where))
    )
    planned = []
    axes = SimpleNamespace(inertia="J", offset="weight")

    def plan(found, scaler, reach):
        planned.append((found, scaler.tolist(), reach.tolist()))
        return "move"

    def bearable(target, inertia, holding, reach):
        assert (inertia, holding) == ("J", "weight")
        return np.minimum(reach, 1.5)

    monkeypatch.setattr(module, "trial_reach", bearable)

    bench.method = SimpleNamespace(
        measures_current=measures, first=lambda supply: first + int(supply[2] == 30.0) - 1,
        keep=lambda gains, kept: gains + (100 if kept is present else 0), plan=plan,
        rule=lambda found, move, supply: rule if (found, move) == (axes, "move") else None,
        safe=lambda found, move, supply: safe if (found, move) == (axes, "move") else None,
    )  # fmt: skip
    bench._trials = SimpleNamespace(recover=lambda where: done.append(("recover", where.tolist())))

    def moved(gains):
        done.append(("moved", int(gains[0, 0])))
        return axes, np.array([7, 8, 9, 10])

    monkeypatch.setattr(bench, "_moved", moved)
    bench.identify()
    everywhere = ("recover", [True] * 4)
    assert done == [
        *(["reset"] if anew else []), ("gains", 101, None), everywhere, ("advance", 0.1), ("moved", 101), everywhere,
        ("gains", 103, None), ("advance", 0.25),
    ]  # fmt: skip
    reach = [1.5, -2.0, 1.5, 1.5] if measures else [2.0, -2.0, math.inf, 2.0]  # what the DC link bears
    assert planned == [(axes, [65536] * 4, reach)]
    assert (bench.identified, bench.move, bench.origin.tolist()) == (axes, "move", [7, 8, 9, 10])
    assert bench.began.tolist() == [7, 8, 9, 10] and bench.began is not bench._origin
    assert (bench.rule[0, 0], bench.safe[0, 0], bench.incumbent[0, 0]) == (102, 103, 103)
    assert bench.incumbent is not bench.safe
    assert (bench._fallback.calm is bench.safe) == measures


def test_an_axis_whose_drive_measures_no_current_moves_once_for_identification():
    bench = bench_of()
    bench._reach, bench.method = "reach", SimpleNamespace(measures_current=False)
    bench._trials.identify = lambda reach, where: (reach, where.tolist())
    assert bench._moved(GAINS) == ("reach", [True] * 4) and bench.moves.tolist() == [2] * 4


def test_the_envelope_leaves_oscillations_and_pauses_of_a_minute_to_trials():
    changed = []
    limits = Limits(position=(-5.0, 5.0))
    drives = SimpleNamespace(safety=SimpleNamespace(limits=limits, change=changed.append))
    leave_oscillations_to_trials(drives)
    assert changed == [Limits(position=(-5.0, 5.0), oscillation=False, stall=60.0)]
    leave_oscillations_to_trials(SimpleNamespace(safety=None))
    assert len(changed) == 1


def test_first_gains_are_the_methods():
    target = target_of(Standing())
    assert first_gains(target).tolist() == method_of(DEVICE, MOTOR).first(target.supply).tolist()
