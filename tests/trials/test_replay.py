"""Replay: an emulated machine plays the real one; what is told of the difference, and what the fit finds, is known."""

from types import SimpleNamespace

import numpy as np
import pytest
from rigs.recorded_moves import (
    CURRENT,
    DEMAND,
    POSITION,
    SPEED,
    TARGET,
    TORQUE,
    TRUTH,
    TURN,
    VELOCITY,
    a_move,
    machines,
    recorded,
    written,
)

from drive_env import motion
from drive_env.randomisation.random_machines import Distributions, Law
from drive_env.trials import replay as module
from drive_env.trials.replay import Log, _candidates, command_of, compare, fit, read_log, replay


@pytest.fixture(scope="module")
def log():
    return recorded([DEMAND, POSITION, VELOCITY, CURRENT], "csp", {TARGET: a_move()})


# --- how far ----------------------------------------------------------------------------------------------------------
def test_the_same_machine_differs_by_its_noise_alone(log):
    report = compare(log, replay(machines(parameters=TRUTH), log))
    assert set(report) == {POSITION, VELOCITY, CURRENT}
    for name, limit in ((POSITION, 2e-4), (VELOCITY, 3e-3), (CURRENT, 1e-2)):
        assert report[name].nrmse[0] < limit
        assert report[name].shift[0] == pytest.approx(0.0, abs=3e-4)


def test_another_machine_differs_most_in_what_moves_it(log):
    report = compare(log, replay(machines(), log))
    assert report[CURRENT].nrmse[0] > 0.1
    assert report[CURRENT].nrmse[0] > 3.0 * report[POSITION].nrmse[0]


def test_nrmse_is_the_rms_over_the_range_of_the_log():
    t = np.arange(100) * 1e-3
    want = Log(t, {POSITION: np.arange(100)[:, None] * 10})
    report = compare(want, {POSITION: np.arange(100)[:, None] * 10 + 99}, 1)[POSITION]
    assert report.nrmse[0] == pytest.approx(0.1)


@pytest.mark.parametrize("late", [-7, 0, 4])
def test_a_response_that_is_late_is_told_by_how_much(late):
    t = np.arange(300) * 1e-3
    wave = [1000.0 * np.sin(40.0 * (t - shift)) for shift in (0.0, late * 1e-3)]
    raw = [np.rint(values).astype(np.int64)[:, None] for values in wave]
    report = compare(Log(t, {VELOCITY: raw[0]}), {VELOCITY: raw[1]})[VELOCITY]
    assert report.shift[0] == pytest.approx(late * 1e-3, abs=1e-4)
    assert report.shifted[0] < 1e-3
    assert report.nrmse[0] == pytest.approx(0.0, abs=1e-9) if late == 0 else report.nrmse[0] > 0.05


def test_a_shift_counts_in_the_time_between_two_samples():
    """Of samples 4 ms apart a row is 4 ms."""
    t = np.arange(100) * 4e-3
    want, have = (np.rint(1000.0 * np.sin(20.0 * (t - late))).astype(int)[:, None] for late in (0.0, 8e-3))
    assert compare(Log(t, {VELOCITY: want}), {VELOCITY: have})[VELOCITY].shift[0] == pytest.approx(8e-3, abs=4e-4)


def test_every_machine_is_told_of_apart_and_of_axes_the_worst(log):
    drives = machines(3)
    drives.machine.set_all({name: np.array([1e-5, value, 1e-4]) for name, value in TRUTH.items() if "inertia" in name})
    drives.machine.set("load.coulomb", TRUTH["load.coulomb"])
    found = compare(log, replay(drives, log), 3)[CURRENT].nrmse
    assert found.argmin() == 1
    two = Log(np.arange(50) * 1e-3, {POSITION: np.tile(np.arange(50)[:, None], (1, 2))})
    off = two.objects[POSITION] + np.array([0, 7])
    assert compare(two, {POSITION: off})[POSITION].nrmse[0] == pytest.approx(7 / 49)


@pytest.mark.parametrize(
    ("mode", "target", "rows"),
    [
        ("csp", TARGET, a_move()),
        ("csv", SPEED, np.rint(500_000 * np.sin(np.arange(400) * 0.03)).astype(int)),
        ("cst", TORQUE, np.rint(400 * np.sin(np.arange(400) * 0.05)).astype(int)),
    ],
)
def test_what_was_played_in_a_cyclic_mode_is_played_again(mode, target, rows):
    told = recorded([target, POSITION, VELOCITY, CURRENT], mode, {target: rows})
    assert command_of(told)[0] == target
    report = compare(told, replay(machines(parameters=TRUTH), told))
    # A current alone leaves what friction and noise do to the speed where it is.
    assert report[VELOCITY].nrmse[0] < (0.05 if mode == "cst" else 0.02)


def test_the_settings_of_the_real_drive_count(log):
    stiff = {(0x2043, 1): 250, (0x2042, 1): 900}
    real = machines(seed=77, parameters=TRUTH)
    for name, value in stiff.items():
        real.write(name, value)
    motion.enable(real, "csp")
    trace = real.record([TARGET, POSITION], 0.4, play={TARGET: a_move()})
    told = Log(trace.t, {name: trace[name] for name in (TARGET, POSITION)})
    drives = machines(parameters=TRUTH)
    without, settled = (compare(told, replay(drives, told, s))[POSITION].nrmse[0] for s in (None, stiff))
    assert settled < 1e-3
    assert without > 0.02


def test_a_log_that_begins_elsewhere_and_skips_cycles_is_played_from_there(log):
    every = {name: values[::2] + (123_456 if name in (DEMAND, POSITION) else 0) for name, values in log.objects.items()}
    thin = Log(log.t[::2], every)
    found = replay(machines(parameters=TRUTH), thin)
    assert found[POSITION][0, 0] == pytest.approx(123_456, abs=20)
    assert compare(thin, found)[POSITION].nrmse[0] < 5e-3


# --- the fit ----------------------------------------------------------------------------------------------------------
def test_the_fit_finds_the_machine(log):
    drives = machines(64)
    before = drives.machine.parameters
    found = fit(drives, log, "two_mass", ["load.inertia", "load.coulomb"])
    assert found.distance[0] < 0.1 * found.nominal
    for name, value in TRUTH.items():
        assert found.accepted[name].min() < value < found.accepted[name].max(), name
        assert found.accepted[name][0] == pytest.approx(value, rel=0.15)
        assert found.narrowed[name] < 0.5
    assert np.all(np.diff(found.distance) >= 0.0)
    assert found.distance[-1] <= 1.2 * found.distance[0]
    # The drives are as they were.
    assert all(np.array_equal(values, before[name]) for name, values in drives.machine.parameters.items())


@pytest.mark.slow
def test_the_fitted_set_draws_machines_like_the_real_one(log, tmp_path):
    found = fit(machines(32), log, "two_mass", list(TRUTH), rounds=5)
    path = tmp_path / "fitted.toml"
    path.write_text(found.to_toml(), encoding="utf-8")
    laws = Distributions.load(path)
    assert laws.laws == found.distributions.laws
    assert laws.laws["motor.R_s"] == Distributions.load("two_mass").laws["motor.R_s"]
    defaults = {name: float(values[0]) for name, values in machines().machine.parameters.items()}
    draws = [laws.draw(np.random.default_rng(k), defaults) for k in range(50)]
    for name in TRUTH:
        values = [draw[name] for draw in draws]
        assert min(values) >= found.accepted[name].min()
        assert max(values) <= found.accepted[name].max()


@pytest.mark.slow
def test_a_parameter_that_the_log_does_not_show_keeps_its_law(log):
    found = fit(machines(64), log, "two_mass", ["load.inertia", "motor.thermal_resistance"], slack=1.5)
    assert found.narrowed["motor.thermal_resistance"] > 0.5
    text = found.to_toml()
    if found.narrowed["motor.thermal_resistance"] >= 0.8:
        prior = Distributions.load("two_mass").laws["motor.thermal_resistance"]
        assert found.distributions.laws["motor.thermal_resistance"] == prior
        assert "motor.thermal_resistance: " in text
        assert "does not determine it" in text


def test_the_same_seed_finds_the_same(log):
    first, second = (fit(machines(16), log, "two_mass", ["load.inertia"], rounds=2, seed=3) for _ in range(2))
    assert np.array_equal(first.distance, second.distance)


# --- the file ---------------------------------------------------------------------------------------------------------


def test_what_scope_writes_is_read_back(log, tmp_path):
    written(tmp_path / "scope.csv", log)
    again = read_log(tmp_path / "scope.csv")
    assert again.t == pytest.approx(log.t)
    assert set(again.objects) == set(log.objects)
    assert all(np.array_equal(again.objects[name], values) for name, values in log.objects.items())


def test_several_axes_are_read_back(tmp_path):
    log = Log(np.arange(20) * 2e-3 - 0.01, {POSITION: np.arange(40).reshape(20, 2), VELOCITY: np.ones((20, 2), int)})
    written(tmp_path / "two.csv", log, ("node 1", "node 2 axis 1"))
    again = read_log(tmp_path / "two.csv")
    assert (again.num_axes, again.every) == (2, 2)
    assert np.array_equal(again.objects[POSITION], log.objects[POSITION])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "first line must begin with 't"),
        ("time,6064h:00 P\n", "first line must begin with 't"),
        ("t [s],position\n", r"column 'position' names no object; it must begin as '6064h:00 '"),
        ("t [s],6064h:00 P\n" + "".join(f"{k}e-3,{k}.5\n" for k in range(12)), "needs a time and 1 whole numbers"),
        ("t [s],6064h:00 P\n0,1\n", "at least 10 lines of 2 values"),
        ("t [s],6064h:00 P\n" + "".join(f"{k * k}e-3,1\n" for k in range(12)), "must increase by the same"),
        ("t [s],6064h:00 P (node 1),6064h:00 P (node 2),606Ch:00 V (node 1)\n"
         + "".join(f"{k}e-3,1,1,1\n" for k in range(12)), "for the same axes"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_log_is_told_why(tmp_path, text, message):
    path = tmp_path / "log.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        read_log(path)


def test_logs_that_cannot_be_replayed_are_refused(log):
    with pytest.raises(ValueError, match=r"has no command .* record one of 6062h, 607Ah, 60FFh, 6071h"):
        command_of(Log(log.t, {POSITION: log.objects[POSITION]}))
    jump = np.where(np.arange(len(log.t)) < 50, 0, 5 * TURN)[:, None]
    with pytest.raises(ValueError, match="no command that changes step by step"):
        command_of(Log(log.t, {TARGET: jump, POSITION: log.objects[POSITION]}))
    with pytest.raises(ValueError, match="begins in the middle of a move"):
        command_of(Log(log.t[100:], {name: values[100:] for name, values in log.objects.items()}))
    with pytest.raises(ValueError, match="of 1 axes, a machine of load 'gantry' has 2"):
        replay(machines(load="gantry"), log)
    with pytest.raises(ValueError, match=r"'load.weight' cannot be fitted; did you mean .*; there are motor.R_s"):
        fit(machines(16), log, "two_mass", ["load.weight"])
    with pytest.raises(ValueError, match="at least 16 machines and one parameter, not 4 and 1"):
        fit(machines(4), log, "two_mass", ["load.inertia"])
    with pytest.raises(ValueError, match=r"there is no log nowhere\.csv"):
        read_log("nowhere.csv")


def rounds_of_a_fit(monkeypatch, count=200, **options):
    """What a fit tries where the distance is known: how far a machine's share of chance is from the middle."""
    tried = []

    def candidates(*arguments):
        tried.append(found := _candidates(*arguments))
        return found

    monkeypatch.setattr(module, "_candidates", candidates)
    monkeypatch.setattr(module, "_give", lambda drives, values: np.ones(drives.num_machines, bool))
    monkeypatch.setattr(
        module, "_distances", lambda drives, log, settings: np.abs(tried[-1][:, 0] - 0.5) if tried else np.ones(count)
    )
    drives = SimpleNamespace(
        num_machines=count,
        machine=SimpleNamespace(
            parameters={"load.inertia": np.full(count, 2e-5)}, set_all=lambda values: None, reset=lambda: None
        ),
    )
    fit(drives, None, "two_mass", ["load.inertia"], **options)
    return tried


def test_a_fit_draws_its_next_round_around_the_best_tenth(monkeypatch):
    """Of shares spread evenly from 0 to 1 those within 0.05 of the middle, spread by twice their own covariance."""
    tried = rounds_of_a_fit(monkeypatch)
    assert len(tried) == 4
    first, second = np.sort(tried[0][:, 0]), tried[1][:, 0]
    assert np.abs(first - (np.arange(200) + 0.5) / 200).max() <= 0.5 / 200
    assert second.mean() == pytest.approx(0.5, abs=0.02)
    assert second.std() == pytest.approx(np.sqrt(3.0) * 0.1 / np.sqrt(12.0), rel=0.2)


def test_a_fit_never_draws_around_fewer_than_four(monkeypatch):
    second = rounds_of_a_fit(monkeypatch, accept=1e-9, rounds=2)[1][:, 0]
    assert second.std() == pytest.approx(np.sqrt(3.0) * 4 / 200 / np.sqrt(12.0), rel=0.5)


def test_a_share_beyond_the_ends_of_its_law_is_reflected_there():
    """A parameter at its limit stays reachable, and none is drawn that the law does not have."""
    steps = np.array([-0.2, 1.3, 2.4, 0.25, 1.0])
    rng = SimpleNamespace(
        choice=lambda best, count: np.zeros(count, int),
        multivariate_normal=lambda mean, spread, count: steps[:count, None],
    )
    tried = np.linspace(0.0, 1.0, 8)[:, None]  # the first is 0
    found = _candidates(rng, tried, np.arange(8.0), len(steps), 1, 0.1)
    np.testing.assert_allclose(found[:, 0], [0.2, 0.7, 0.4, 0.25, 1.0])


# --- parts of it --------------------------------------------------------------------------------------------------
def rows_of(times, values=None):
    values = range(len(times)) if values is None else values
    return "t [s],6064h:00 P\n" + "".join(f"{t!r},{v}\n" for t, v in zip(times, values, strict=True))


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([k * 1e-3 for k in range(10)], None),
        ([k * 1e-3 for k in range(9)], "at least 10 lines of 2 values each"),
        ([1e7 - 0.009 + k * 1e-3 for k in range(9)] + [1e7], None),
        ([k * 1e-3 for k in range(10)] + [2e7], r"line 12 has the time 2e\+07 s; times must lie within 1e\+07 s of 0"),
        ([-2e7] + [k * 1e-3 for k in range(10)], r"line 2 has the time -2e\+07 s"),
        ([k * 1e-3 for k in range(10)] + [float("nan")] * 2, "line 12 has the time nan s"),
        ([k * 3e-3 for k in range(10)], None),
        ([k * 1.5e-3 for k in range(10)], "must increase by the same whole number of milliseconds"),
        ([k * 0.4e-3 for k in range(10)], "must increase by the same whole number"),
        ([-k * 1e-3 for k in range(10)], "must increase by the same whole number"),
        ([k * 1e-3 + (0.0004 if k == 5 else 0.0) for k in range(10)], "must increase by the same"),
        ([k * 1e-3 + (0.0002 if k == 5 else 0.0) for k in range(10)], None),  # the clock of a bus
    ],
)
def test_times_go_on_by_whole_milliseconds(tmp_path, times, message):
    path = tmp_path / "log.csv"
    path.write_text(rows_of(times), encoding="utf-8")
    if message is None:
        assert read_log(path).t.tolist() == pytest.approx(times)
        return
    with pytest.raises(ValueError, match=message):
        read_log(path)


@pytest.mark.parametrize("line", ["0.010,1,2", "0.010", "", "0.010,99999999999999999999"])
def test_a_line_of_another_length_or_a_number_that_no_drive_has_is_told(tmp_path, line):
    path = tmp_path / "log.csv"
    path.write_text(rows_of([k * 1e-3 for k in range(10)]) + line + "\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"every line needs a time and 1 whole numbers|at least 10 lines"):
        read_log(path)


@pytest.mark.parametrize(("step", "every"), [(0.001, 1), (0.002, 2), (0.0004, 1), (0.02, 20)])
def test_how_many_cycles_lie_between_two_samples(step, every):
    assert Log(np.arange(10) * step, {POSITION: np.zeros((10, 1), int)}).every == every


def a_log(**objects):
    names = {"demand": DEMAND, "target": TARGET, "speed": SPEED, "torque": TORQUE, "velocity": VELOCITY}
    found = {names[name]: np.asarray(values)[:, None] for name, values in objects.items()}
    return Log(np.arange(len(next(iter(found.values())))) * 1e-3, found)


PATH, JUMP = np.arange(20), np.where(np.arange(20) < 10, 0, 19)


@pytest.mark.parametrize(
    ("objects", "expected"),
    [
        ({"target": PATH, "demand": PATH, "speed": PATH}, (DEMAND, "csp", TARGET)),
        ({"speed": JUMP, "target": PATH, "torque": PATH}, (TARGET, "csp", TARGET)),
        ({"target": JUMP, "speed": JUMP, "torque": PATH}, (SPEED, "csv", SPEED)),  # the target of a profile
        ({"target": JUMP, "torque": JUMP}, (TORQUE, "cst", TORQUE)),
        ({"target": 0 * PATH + 7, "speed": PATH}, (TARGET, "csp", TARGET)),  # it stays: nothing jumps
        ({"target": np.array([0, 4, 8] * 5), "speed": PATH}, (SPEED, "csv", SPEED)),
        ({"target": np.array([0, 3, 6, 9, 10]), "speed": PATH[:5]}, (TARGET, "csp", TARGET)),
        ({"target": np.array([0, 5, 10]), "speed": PATH[:3]}, (SPEED, "csv", SPEED)),  # half of it at once
    ],
)
def test_which_object_of_a_log_is_the_command(objects, expected):
    assert command_of(a_log(**objects)) == expected


@pytest.mark.parametrize(("first", "begins"), [(0, True), (10, True), (-10, True), (11, False), (-11, False)])
def test_a_tenth_of_the_speeds_range_is_rest(first, begins):
    velocity = np.clip(np.arange(20) * 10, 0, 100) if first >= 0 else -np.clip(np.arange(20) * 10, 0, 100)
    velocity[:2] = first, 0
    log = a_log(torque=PATH, velocity=velocity)
    if begins:
        assert command_of(log)[1] == "cst"
        return
    with pytest.raises(ValueError, match="begins in the middle of a move"):
        command_of(log)


def test_positions_between_samples_lie_on_a_line_and_stay_after_the_last():
    rows = module._between(np.array([[0, 100], [10, 90], [11, 90]]), 4)
    assert rows.tolist() == [
        [0, 100], [2, 98], [5, 95], [8, 92], [10, 90], [10, 90], [10, 90], [11, 90], *[[11, 90]] * 4
    ]  # fmt: skip


@pytest.mark.parametrize(("rows", "period"), [(12, 0.001), (300, 0.001), (40, 0.05)])
def test_a_shift_is_looked_for_within_20_ms_and_a_quarter_of_the_log(rows, period):
    """A response that is later than that is told with the longest one."""
    wave = np.arange(rows, dtype=float)[:, None]
    reach = min(max(1, int(0.02 / period + 1e-9)), rows // 4)
    shift, rest = module._best_shift(wave, (wave - 3 * reach)[:, None, :], np.ones(1), period)
    assert shift == pytest.approx(reach * period) and rest == pytest.approx(2.0 * reach)
    shift, rest = module._best_shift(wave, (wave + 0.3)[:, None, :], np.ones(1), period)
    assert shift == pytest.approx(-0.3 * period) and rest == pytest.approx(0.0, abs=1e-9)


def test_what_cannot_be_is_no_candidate():
    """All machines are set at once; where one cannot have it, each by itself."""
    tried = []

    def set_all(values, where=None):
        tried.append(where)
        if where is None or np.any(values["load.inertia"][where] > 2.5):
            raise ValueError("too much")

    drives = SimpleNamespace(num_machines=4, machine=SimpleNamespace(set_all=set_all))
    assert module._give(drives, {"load.inertia": np.array([1.0, 3.0, 2.0, 4.0])}).tolist() == [True, False, True, False]
    assert len(tried) == 5
    drives.machine.set_all = lambda values, where=None: None
    assert module._give(drives, {}).tolist() == [True] * 4


@pytest.mark.parametrize("best", [0.0, 0.5])
def test_what_was_accepted_is_the_range_of_its_middle_nine_tenths(best):
    laws = Distributions({"a": Law("uniform", True, 0.5, 1.5), "b": Law("loguniform", False, 1.0, 100.0)})
    shares = np.stack([np.linspace(0.0, 1.0, 101), np.linspace(0.4, 0.6, 101)], axis=1)
    found = module._result(laws, ["a", "b"], {"a": 2.0, "b": 7.0}, shares, best + np.linspace(0.0, 1.0, 101), 9.0)
    assert found.narrowed == {"a": pytest.approx(1.0), "b": pytest.approx(0.2)}
    assert (found.is_seen("a"), found.is_seen("b")) == (False, True)
    assert found.distributions.laws["a"] == laws.laws["a"]
    law = found.distributions.laws["b"]
    assert (law.law, law.relative) == ("loguniform", False)
    assert (law.low, law.high) == (pytest.approx(100**0.41), pytest.approx(100**0.59))
    np.testing.assert_allclose(found.accepted["a"], 2.0 * np.linspace(0.5, 1.5, 101))
    text = found.to_toml()
    assert "# a: 100 % of the range given: the log does not determine it" in text
    assert "# b: 20 % of the range given\n" in text
    assert f"nominal machine 9.0000, best {best:.4f}, worst accepted {best + 1:.4f} of 101." in text


def test_a_range_relative_to_the_machines_own_stays_so():
    laws = Distributions({"a": Law("uniform", True, 0.5, 1.5)})
    shares = np.linspace(0.2, 0.4, 101)[:, None]
    law = module._result(laws, ["a"], {"a": 2.0}, shares, np.ones(101), 1.0).distributions.laws["a"]
    assert (law.law, law.relative) == ("uniform", True)
    assert (law.low, law.high) == (pytest.approx(0.71), pytest.approx(0.89))


@pytest.mark.parametrize("narrowed", [0.8, 0.79])
def test_from_four_fifths_of_its_range_on_a_parameter_is_not_determined(narrowed):
    laws = Distributions({"a": Law("uniform", False, 0.0, 1.0)})
    found = module.LogFit(laws, {}, np.ones(1), 1.0, {"a": narrowed})
    assert found.is_seen("a") == (narrowed < 0.8)


# --- what is played, on drives that a test plays ----------------------------------------------------------------------
class Player:
    """Two machines of two axes that stand at 1,000 and 2,000, and answer with what they are told twice over."""

    num_machines, num_axes, load = 2, 4, SimpleNamespace(name="gantry")

    def __init__(self):
        self.log = []
        self.machine = SimpleNamespace(reset=lambda: self.log.append("reset"))

    def read(self, name):
        assert name == POSITION
        return np.array([1000, 2000, 1000, 2000])

    def write(self, name, value):
        self.log.append((name, np.asarray(value).tolist()))

    def record(self, names, seconds, *, play, period):
        ((target, rows),) = play.items()
        self.log.append((list(names), round(seconds, 6), target, round(period, 6)))
        self.rows = rows
        return dict.fromkeys(names, 2 * rows)


def logged(every=1, **objects):
    names = {"demand": DEMAND, "target": TARGET, "speed": SPEED, "torque": TORQUE, "velocity": VELOCITY,
             "position": POSITION, "current": CURRENT}  # fmt: skip
    return Log(np.arange(12) * every * 1e-3, {names[name]: np.asarray(values) for name, values in objects.items()})


@pytest.fixture
def player(monkeypatch):
    drives = Player()
    monkeypatch.setattr(module.motion, "enable", lambda drives, mode: drives.log.append(mode))
    return drives


STEPS = np.arange(12)[:, None] * [10, -20] + [5000, 7000]
REST = np.zeros((12, 2), int)


@pytest.mark.parametrize("command", ["demand", "target"])
def test_positions_are_played_from_where_the_machines_stand_and_told_where_the_log_was(player, command):
    """What a drive demanded in a cycle it was told a cycle earlier; what it was told is played as it is."""
    log = logged(position=STEPS + 3, velocity=REST, current=REST, **{command: STEPS})
    found = replay(player, log, {"2043h:01": 7})
    own = STEPS - [4000, 5000]
    played = np.concatenate([own[1:], own[-1:]]) if command == "demand" else own
    assert player.log == [
        "reset", ("2043h:01", 7), (TARGET, [1000, 2000, 1000, 2000]), "csp",
        ([POSITION, VELOCITY, CURRENT], 0.012, TARGET, 0.001),
    ]  # fmt: skip
    np.testing.assert_array_equal(player.rows, np.tile(played, (1, 2)))
    np.testing.assert_array_equal(found[POSITION], np.tile(2 * played + [4000, 5000], (1, 2)))
    np.testing.assert_array_equal(found[VELOCITY], np.tile(2 * played, (1, 2)))
    assert list(found) == [POSITION, VELOCITY, CURRENT]


def test_positions_of_every_third_cycle_are_played_on_a_line_between_them(player):
    log = logged(3, target=STEPS, position=STEPS)
    replay(player, log)
    assert player.rows.shape == (36, 4) and player.log[-1] == ([POSITION], 0.036, TARGET, 0.003)
    np.testing.assert_array_equal(player.rows[:7, 0], [1000, 1003, 1007, 1010, 1013, 1017, 1020])
    np.testing.assert_array_equal(player.rows[-4:, 1], [1787, 1780, 1780, 1780])


@pytest.mark.parametrize(("command", "mode", "name"), [("speed", "csv", SPEED), ("torque", "cst", TORQUE)])
def test_speeds_and_currents_are_played_as_they_were_and_stay_until_the_next(player, command, mode, name):
    log = logged(2, velocity=REST, position=STEPS, **{command: STEPS})
    found = replay(player, log)
    assert player.log == ["reset", mode, ([POSITION, VELOCITY], 0.024, name, 0.002)]
    np.testing.assert_array_equal(player.rows, np.tile(np.repeat(STEPS, 2, axis=0), (1, 2)))
    np.testing.assert_array_equal(found[POSITION], 2 * player.rows)


def test_a_log_of_other_axes_is_refused_before_anything_is_reset(player):
    with pytest.raises(ValueError, match="the log is of 1 axes, a machine of load 'gantry' has 2"):
        replay(player, logged(torque=STEPS[:, :1]))
    assert player.log == []


# --- the columns of a file --------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("title", "key"),
    [
        ("6064h:00 Position actual value [inc] (node 1)", (0x6064, 0)),
        ("60Ffh:0A Something", (0x60FF, 0x0A)),
        ("2041h:03 Actual Current [mA]", (0x2041, 3)),
        ("6064h:00 P (node 2 axis 1)", (0x6064, 0)),
        ("6064h Position", None),
        ("x6064h:00 P", None),
        ("6064h:00", None),
        ("6064h:00 P (a", None),
    ],
)
def test_a_column_is_known_by_its_object(tmp_path, title, key):
    path = tmp_path / "log.csv"
    lines = [f"t [s],{title}", *(f"{k}e-3,{k * 7}" for k in range(10))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if key is None:
        with pytest.raises(ValueError, match="names no object; it must begin as '6064h:00 '"):
            read_log(path)
        return
    log = read_log(path)
    assert list(log.objects) == [key] and log.objects[key][:, 0].tolist() == [7 * k for k in range(10)]
    assert log.num_axes == 1 and log.objects[key].dtype == np.int64


def test_columns_of_one_object_are_its_axes_wherever_they_stand(tmp_path):
    path = tmp_path / "log.csv"
    head = "t [s],6064h:00 P (node 1),606Ch:00 V (node 1),6064h:00 P (node 2),606Ch:00 V (node 2)"
    path.write_text("\n".join([head, *(f"{k}e-3,{k},{-k},{k + 50},{-k - 50}" for k in range(10))]), encoding="utf-8")
    log = read_log(path)
    assert log.objects[POSITION][4].tolist() == [4, 54] and log.objects[VELOCITY][4].tolist() == [-4, -54]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe", r"log\.csv is not a text file; give the CSV that drive-env scope writes"),
        (b"t [s],6064h:00 P\n0,\"" + b"1" * 200_000, r"log\.csv is not CSV: .*; give the one that drive-env scope"),
        (b"\n", r"the first line must begin with 't \[s\]', as drive-env scope writes it"),
        (b"t [s]\n" + b"0\n" * 12, r"the first line must begin with 't \[s\]'"),
        (b"t [s],6064h:00 P\n" + b"0.1\n" * 12, "every line needs a time and 1 whole numbers|at least 10 lines of 2 v"),
        (b"t [s],6064h:00 P,606Ch:00 V\n" + b"0,1\n" * 12, r"needs a time and 2 whole numbers: line 2 has 2"),
        (b"t [s],6064h:00 P,606Ch:00 V\n" + b"0,1,x\n" * 12, r"every line needs a time and 2 whole numbers: invalid"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_read_is_told_why(tmp_path, content, message):
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        read_log(path)


# --- the course of a fit ----------------------------------------------------------------------------------------------
def fitted(monkeypatch, *, distances, possible=None, count=16, **options):
    """Fit two parameters where the distances of each round, and which machines there can be, are known."""
    rounds, log = iter(distances), []
    monkeypatch.setattr(module, "_distances", lambda drives, log, settings: np.asarray(next(rounds), float))

    def give(drives, values):
        log.append({name: value.copy() for name, value in values.items()})
        return np.ones(count, bool) if possible is None else np.asarray(possible)

    monkeypatch.setattr(module, "_give", give)
    machine = SimpleNamespace(
        parameters={"load.inertia": np.full(count, 2e-5), "motor.R_s": np.full(count, 0.5), "other": np.ones(count)},
        set_all=lambda values: log.append({name: value.tolist() for name, value in values.items()}),
        reset=lambda: log.append("reset"),
    )
    drives = SimpleNamespace(num_machines=count, machine=machine)
    found = fit(drives, None, "two_mass", ["load.inertia", "motor.R_s"], **options)
    return found, log


def test_machines_are_accepted_within_a_fifth_of_the_best_of_all_rounds(monkeypatch):
    base = np.full(16, 9.0)
    base[3] = 5.0  # the nominal machine's own noise differs: the least counts
    first, second = np.full(16, 7.0), np.full(16, 7.0)
    first[[2, 5]], second[[1, 4]] = (1.0, 1.2), (1.1, 1.201)
    found, log = fitted(monkeypatch, distances=[base, first, second], rounds=2)
    assert found.nominal == 5.0 and found.distance.tolist() == [1.0, 1.1, 1.2]
    assert found.accepted["load.inertia"].tolist() == [log[0]["load.inertia"][2], log[1]["load.inertia"][1],
                                                       log[0]["load.inertia"][5]]  # fmt: skip
    assert log[2:] == [{"load.inertia": [2e-5] * 16, "motor.R_s": [0.5] * 16}, "reset"]
    wider, _ = fitted(monkeypatch, distances=[base, first, second], rounds=2, slack=1.25)
    assert len(wider.distance) == 4


def test_what_cannot_be_is_infinitely_far(monkeypatch):
    distances = np.arange(16.0) + 1.0
    found, _ = fitted(
        monkeypatch, distances=[distances, distances], possible=[False, *[True] * 15], rounds=1, slack=1.0
    )
    assert found.distance.tolist() == [2.0]


def test_machines_are_as_they_were_after_a_fit_that_fails(monkeypatch):
    drawn = []

    def failing(drives, log, settings):
        raise OSError("no")

    monkeypatch.setattr(module, "_distances", failing)
    machine = SimpleNamespace(
        parameters={"load.inertia": np.full(16, 2e-5)}, set_all=drawn.append, reset=lambda: drawn.append("reset")
    )
    with pytest.raises(OSError, match="no"):
        fit(SimpleNamespace(num_machines=16, machine=machine), None, "two_mass", ["load.inertia"])
    assert [list(drawn[0]), drawn[1]] == [["load.inertia"], "reset"]


@pytest.mark.parametrize(("count", "parameters"), [(15, ["load.inertia"]), (16, [])])
def test_a_fit_needs_sixteen_machines_and_a_parameter(count, parameters):
    machine = SimpleNamespace(parameters={"load.inertia": np.ones(count)})
    with pytest.raises(ValueError, match=f"at least 16 machines and one parameter, not {count} and {len(parameters)}"):
        fit(SimpleNamespace(num_machines=count, machine=machine), None, "two_mass", parameters)


def test_what_is_drawn_from_a_range_can_be_fitted():
    laws = Distributions({
        "a": Law("uniform", True, 0.5, 1.5), "b": Law("choice", False, 0.0, 1.0),
        "c": Law("loguniform", False, 1.0, 2.0),
        "supply.voltage": Law("uniform", True, 0.9, 1.1),
    })  # fmt: skip
    names = module.fittable(laws)
    assert "a" in names and "c" in names and "b" not in names
    assert ("supply.voltage" in names) == ("supply.voltage" not in module.BESIDE)


@pytest.mark.parametrize(
    ("accept", "count", "width", "best"), [(0.1, 100, 1, 10), (0.25, 100, 1, 25), (0.01, 100, 1, 4), (0.01, 100, 3, 6)]
)
def test_the_next_round_is_drawn_around_the_best_share(accept, count, width, best):
    chosen = []

    class Chance:
        def choice(self, indices, size):
            chosen.append((sorted(indices.tolist()), size))
            return np.zeros(size, int)

        def multivariate_normal(self, mean, spread, size):
            chosen.append((mean.tolist(), spread))
            return np.zeros((size, width))

    tried = np.random.default_rng(0).random((3 * count, width))  # three rounds
    _candidates(Chance(), tried, np.arange(3 * count)[::-1].astype(float), count, width, accept)
    assert chosen[0] == (list(range(3 * count - best, 3 * count)), count) and chosen[1][0] == [0.0] * width
    expected = 2.0 * np.atleast_2d(np.cov(tried[-best:], rowvar=False)) + 1e-10 * np.eye(width)
    np.testing.assert_allclose(chosen[1][1], expected, rtol=1e-12)
