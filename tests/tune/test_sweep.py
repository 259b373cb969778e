"""The gain sweep: its grid, its experiment file, its metrics, and that every point is what it would be alone."""

import csv
import math
import os
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from rigs.tables import every_row

from drive_env import EmulatedDrives, motion
from drive_env.own_packages import ForeignPackageError, check_own
from drive_env.trials import response
from tuning.runs import metrics, plots, provenance, sweep
from tuning.runs.experiment import (
    DEFAULT,
    Excitation,
    Experiment,
    ExperimentError,
    MetricChoice,
    SweptObject,
    gain_objects,
    label,
    load_experiment,
    resolve,
)
from tuning.runs.metrics import METRICS, TRACKING, MoveRecording
from tuning.runs.sweep_files import save_sweep

P, I, TORQUE_P = "2042h:01", "2042h:02", "2041h:01"
SHORT = Excitation(
    velocity_time=0.01, load_torque=-0.05, load_time=0.06, duration=0.1, sampling_period=0.001,
    velocity_rpm=1000.0, acceleration_rpm_per_s=100_000.0,
)  # fmt: skip


def grid(*swept, **changes):
    return replace(load_experiment(), sweep=tuple(swept), excitation=SHORT, **changes)


def swept(name, low, high, count, spacing="log"):
    return SweptObject(name, low, high, count, spacing)


SMALL = (swept(P, 200, 3200, 3), swept(I, 100, 1600, 3))


@pytest.fixture(scope="module")
def small():
    return sweep.run(grid(*SMALL))


# --- the grid ---------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("low", "high", "count", "spacing", "values"), [
    (0, 100, 5, "lin", [0, 25, 50, 75, 100]),
    (1, 1000, 4, "log", [1, 10, 100, 1000]),
    (100, 3200, 6, "log", [100, 200, 400, 800, 1600, 3200]),
    (1, 4, 10, "lin", [1, 2, 3, 4]),  # equal after rounding: counted once
    (1, 3, 20, "log", [1, 2, 3]),
    (7, 7, 3, "log", [7]),
    (5, 5, 1, "lin", [5]),
    (0, 65535, 2, "lin", [0, 65535]),
])  # fmt: skip
def test_values_of_a_range(low, high, count, spacing, values):
    assert swept(P, low, high, count, spacing).values().tolist() == values


def test_log_values_keep_their_ratio_and_their_ends():
    values = swept(P, 60, 4000, 32).values()
    assert (values[0], values[-1], len(values)) == (60, 4000, 32)
    ratio = (4000 / 60) ** (1 / 31)
    assert np.abs(values - 60 * ratio ** np.arange(32)).max() <= 0.5


def test_points_are_every_combination_with_the_last_object_fastest():
    points = grid(swept(P, 1, 2, 2, "lin"), swept(I, 5, 7, 3, "lin")).points()
    assert points.tolist() == [[1, 5], [1, 6], [1, 7], [2, 5], [2, 6], [2, 7]]


def test_the_default_is_a_grid_of_1024_velocity_gain_pairs_on_the_two_mass_load():
    experiment = load_experiment()
    assert experiment.size() >= 1024
    assert [label(entry) for entry in resolve(experiment).entries] == [P, I]
    assert (experiment.device, experiment.motor, experiment.load) == ("tmcm1636", "qbl4208", "two_mass")


@pytest.mark.parametrize("name", ["2042h:01", "2042H:1", "0x2042:1", "2042:01", "velocity mode settings.p_parameter"])
def test_an_object_is_known_by_index_and_by_name(name):
    assert resolve(grid(swept(name, 100, 200, 2))).entries[0].label == "2042h:01 Velocity Mode Settings.P_Parameter"


def test_the_gains_that_can_be_swept_are_the_writable_ones_of_2041h_to_2043h():
    device = resolve(grid(*SMALL)).device
    assert [label(entry) for entry in gain_objects(device, device.new_dictionary())] == [
        "2041h:01", "2041h:02", "2042h:01", "2042h:02", "2043h:01",
    ]  # fmt: skip


# --- every point is the machine it would be alone -------------------------------------------------------------------
@pytest.mark.slow
def test_a_row_of_the_grid_equals_a_run_of_that_pair_alone_bit_for_bit(small):
    points = small.experiment.points()
    for k in range(len(points)):
        alone = sweep.run(grid(*(swept(o, int(v), int(v), 1) for o, v in zip((P, I), points[k], strict=True))))
        for name, column in small.columns.items():
            if name != "rank":
                np.testing.assert_array_equal(alone.columns[name][0], column[k], err_msg=f"{name} of {points[k]}")


def test_threads_and_batches_change_no_digit(monkeypatch):
    experiment = grid(
        swept(P, 400, 3200, 10), swept(I, 100, 1600, 9)
    )  # the best is in the first batch, not in the last
    whole = sweep.run(experiment, num_threads=1)
    threads = sweep.run(experiment, num_threads=2)
    monkeypatch.setattr(sweep, "MAX_SAMPLES", 1)  # 90 points then run as 64 and 26
    split = sweep.run(experiment)
    for other in (threads, split):
        for name, column in whole.columns.items():
            np.testing.assert_array_equal(other.columns[name], column, err_msg=name)
        np.testing.assert_array_equal(other.response.speed_rpm, whole.response.speed_rpm)


def test_a_point_is_as_good_as_the_worst_of_its_machines():
    # The reference: the same machines in a set of their own, with the score by numpy.
    experiment = grid(swept(P, 300, 2600, 4), machines=3, seed=5)
    result = sweep.run(experiment)
    for k, gain in enumerate(result.columns[P]):
        with EmulatedDrives("tmcm1636", "two_mass", "qbl4208", num_machines=3, seed=5, randomise=True) as drives:
            assert len(set(drives.machine.parameters["load.inertia"])) == 3
            motion.enable(drives, mode="pv")
            recording, fault = sweep._record(
                drives, experiment, resolve(experiment), np.array([[gain]] * 3), lambda _share: None
            )
        assert not fault.any()
        found = metrics.figures(recording)
        score = np.where(metrics.oscillates(found), np.inf, metrics.tracking(found, TRACKING.weights))
        assert result.score[k] == score.max()
    assert 0 < np.isfinite(result.score).sum() < 4


def test_the_map_tells_by_colour_why_a_point_has_no_score(small):
    failed = dict(small.columns)
    score = failed[small.score_column] = np.where(np.arange(9) < 5, np.inf, 1.0)
    for flag, points in (("diverged", [0]), ("fault", [0, 1]), ("oscillates", [1, 2, 3])):
        failed[flag] = np.isin(np.arange(9), points)
    figure = plots.heat_map(replace(small, columns=failed, order=np.argsort(score, kind="stable")))
    told = {text.get_text(): patch.get_facecolor() for text, patch in zip(
        figure.axes[0].get_legend().get_texts(), figure.axes[0].get_legend().legend_handles, strict=True
    ) if "points" in text.get_text()}  # fmt: skip
    assert list(told) == [
        "no tracking (1 points)", "oscillating (2 points)", "in fault (1 points)", "diverged (1 points)"
    ]  # fmt: skip
    cells = figure.axes[0].collections[0]
    cells.update_scalarmappable()
    shown = cells.to_rgba(cells.get_array()).reshape(3, 3, 4).swapaxes(0, 1).reshape(9, 4)
    expected = ["diverged", "in fault", "oscillating", "oscillating", "no tracking"]
    for k, name in enumerate(expected):
        assert tuple(shown[k]) == next(colour for text, colour in told.items() if text.startswith(name))


def test_equal_gains_at_different_places_of_the_grid_are_equal_and_other_seeds_are_not():
    # A position gain changes nothing in profile velocity mode, so that all its points are one and the same axis.
    result = sweep.run(grid(swept("2043h:01", 50, 500, 11)))
    assert result.without_effect() == ["2043h:01"]
    other = sweep.run(grid(swept("2043h:01", 50, 500, 2), seed=1))
    assert other.columns["iae [rpm*s]"][0] != result.columns["iae [rpm*s]"][0]


def test_an_object_that_acts_is_not_reported_as_without_effect(small):
    assert small.without_effect() == []
    assert sweep.run(grid(swept(P, 200, 300, 2), swept("2043h:01", 50, 500, 3))).without_effect() == ["2043h:01"]


@pytest.mark.slow
def test_a_run_repeats_from_its_settings_to_the_last_byte(tmp_path, small):
    save_sweep(small, tmp_path / "first")
    again = sweep.run(load_experiment(tmp_path / "first" / "settings.toml"))
    save_sweep(again, tmp_path / "second")
    for name in ("results.csv", "settings.toml"):
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes()


# --- what the table says ----------------------------------------------------------------------------------------------
def test_figures_are_those_of_the_trace_that_the_drive_gives():
    result = sweep.run(grid(swept(P, 800, 800, 1), swept(I, 900, 900, 1)))
    drives = EmulatedDrives(load="two_mass", motor="qbl4208", seed=0)
    motion.enable(drives, mode="pv")
    drives.write(0x6083, round(100_000 * 65536 / 60))
    drives.write((0x2042, 1), 800)
    drives.write((0x2042, 2), 900)
    before = drives.record([0x606C, 0x6077], 0.01)
    drives.write(0x60FF, round(1000 * 65536 / 60))
    step = drives.record([0x606C, 0x6077], 0.05)
    drives.machine.load_torque = -0.05
    load = drives.record([0x606C, 0x6077], 0.04)
    speed = np.concatenate([part[0x606C][:, 0] for part in (before, step, load)]) * 60 / 65536
    current = np.concatenate([part[0x6077][:, 0] for part in (before, step, load)]) * 1e-3
    t = np.arange(100) * 1e-3
    reference = np.clip(100_000 * (t - 0.01), 0, 1000)

    np.testing.assert_array_equal(result.response.speed_rpm[:, 0], speed)
    np.testing.assert_array_equal(result.response.current[:, 0], current)
    np.testing.assert_allclose(result.response.reference_rpm, reference, atol=1e-3)
    steps = response.step_metrics(t, speed, reference, t_step=0.01, t_end=0.06, initial=0.0)
    error = np.abs(reference - speed)
    expected = {
        "iae [rpm*s]": np.trapezoid(error[10:61], t[10:61]),
        "itae [rpm*s^2]": np.trapezoid((t[10:61] - 0.01) * error[10:61], t[10:61]),
        "rise [s]": steps.rise_time,
        "settling [s]": steps.settling_time,
        "overshoot [%]": 100 * (speed[10:61].max() / 1000 - 1),
        "dip [rpm]": np.abs(speed[60:] - speed[60]).max(),
        "recovery [s]": response.disturbance_metrics(t, speed, reference, t_load=0.06, band=0.2).recovery_time,
        "disturbance_iae [rpm*s]": np.trapezoid(error[60:], t[60:]),
        "peak_current [A]": np.abs(current[10:]).max(),
        "rms_current [A]": math.sqrt(np.mean(current[10:] ** 2)),
        "ripple [A]": math.sqrt(np.mean(np.diff(current[35:61]) ** 2)),
    }
    for name, value in expected.items():
        assert np.isfinite(value), name
        assert result.columns[name][0] == pytest.approx(value, rel=1e-4), name
    assert set(expected) | {"undershoot [%]"} == {f"{row.name} [{row.unit}]" for row in METRICS.values()}


def lag(time_constant, *, height=1500.0, ringing=0.0, rumble=0.0):
    """A first-order response with a load torque that changes nothing; ringing at 100 Hz in rpm, in A for rumble."""
    t = np.arange(400) * 1e-3
    since = np.clip(t - 0.02, 0, None)
    speed = height * -np.expm1(-since / time_constant) + ringing * np.sin(200 * np.pi * since)
    current = rumble * np.sin(200 * np.pi * since)
    reference = np.where(t >= 0.02, height, 0.0)
    return MoveRecording(t, reference, speed[:, None], current[:, None], np.array([7.0]), 0.02, 0.2)


def test_metrics_of_a_first_order_lag_against_closed_forms():
    T = 0.015
    found = metrics.figures(lag(T))
    figure = {name: METRICS[name].function(found)[0] for name in METRICS}
    assert figure["iae"] == pytest.approx(1500 * T, rel=2e-3)
    assert figure["itae"] == pytest.approx(1500 * T**2, rel=3e-3)
    assert figure["rise"] == pytest.approx(T * math.log(9), rel=2e-3)
    assert figure["settling"] == pytest.approx(T * math.log(50), rel=2e-3)
    assert figure["overshoot"] == figure["undershoot"] == figure["peak_current"] == figure["ripple"] == 0.0


def test_tracking_is_the_weighted_sum_that_its_docstring_gives():
    found = metrics.figures(lag(0.015, rumble=0.7))
    iae, disturbance, ripple = (METRICS[name].function(found)[0] for name in ("iae", "disturbance_iae", "ripple"))
    score = metrics.tracking(found, {"step": 2.0, "disturbance": 3.0, "ripple": 0.5})[0]
    assert score == pytest.approx(2.0 * iae / 1500 + 3.0 * disturbance / 1500 + 0.5 * ripple / 7.0, rel=1e-12)
    # 0.7 A at 100 Hz, sampled every millisecond: the change from sample to sample has 2 sin(pi f T) of its amplitude.
    assert ripple == pytest.approx(0.7 * 2 * math.sin(0.1 * math.pi) / math.sqrt(2), rel=0.02)


def test_a_step_downwards_has_the_figures_of_its_mirror_image():
    up, down = (metrics.figures(lag(0.015, height=height)) for height in (1500.0, -1500.0))
    for name, row in METRICS.items():
        np.testing.assert_allclose(row.function(down), row.function(up), err_msg=name)
    assert metrics.tracking(down, TRACKING.weights) == pytest.approx(metrics.tracking(up, TRACKING.weights))


@pytest.mark.parametrize(("ringing", "rumble", "oscillates"), [
    (0.0, 0.0, False),
    (300.0, 0.0, True),  # 20 % of the step, in the velocity
    (15.0, 0.0, False),  # 1 %: noise
    (0.0, 3.0, True),  # 43 % of the current limit, in the current alone
    (0.0, 0.5, False),
])  # fmt: skip
def test_ringing_is_seen_in_velocity_and_current(ringing, rumble, oscillates):
    assert metrics.oscillates(metrics.figures(lag(0.015, ringing=ringing, rumble=rumble))).tolist() == [oscillates]


# --- the ranking ------------------------------------------------------------------------------------------------------
def test_rank_follows_the_score_and_unstable_pairs_come_last(small):
    score, rank = small.score, small.columns["rank"]
    assert sorted(rank) == list(range(1, 10))
    assert (np.diff(score[small.order][np.isfinite(score[small.order])]) >= 0).all()
    unstable = small.columns[P] == 3200
    assert small.columns["oscillates"][unstable].all()
    assert np.isinf(score[unstable]).all()
    assert rank[unstable].min() > rank[~unstable].max()
    assert np.isfinite(score[~unstable]).all()


def test_the_best_rows_and_the_recording_are_those_of_the_least_score(small):
    rows = small.best(3)
    assert [row["rank"] for row in rows] == [1, 2, 3]
    assert rows[0][small.score_column] == small.score.min()
    alone = sweep.run(grid(*(swept(o, rows[0][o], rows[0][o], 1) for o in (P, I))))
    np.testing.assert_array_equal(small.response.speed_rpm, alone.response.speed_rpm)


def test_without_a_figure_a_pair_ranks_behind_those_that_have_it():
    # Sluggish gains never settle: nan, which is no oscillation and no zero.
    default = load_experiment()
    result = sweep.run(replace(default, sweep=(swept(P, 60, 1000, 2),), metric=MetricChoice("settling")))
    assert np.isfinite(result.columns["settling [s]"][1])
    assert np.isnan(result.columns["settling [s]"][0])
    assert not result.columns["oscillates"][0]
    assert result.score.tolist() == [np.inf, result.columns["settling [s]"][1]]
    assert result.columns["rank"].tolist() == [2, 1]


def test_a_pair_that_trips_the_drive_is_flagged_and_ranks_last():
    # With next to no gain the axis stays behind by more than 6065h of the preset, ten revolutions.
    fast = replace(SHORT, velocity_rpm=4000.0, load_torque=0.0, load_time=0.2, duration=0.4)
    result = sweep.run(replace(grid(swept(P, 1, 800, 2)), excitation=fast))
    assert result.columns["fault"].tolist() == [True, False]
    assert np.isinf(result.score[0])


def test_a_machine_that_leaves_physics_is_flagged_and_its_neighbours_are_not(recwarn):
    result = sweep.run(replace(grid(swept(P, 200, 800, 2)), excitation=replace(SHORT, load_torque=1e12)))
    assert result.columns["diverged"].all()
    assert np.isinf(result.score).all()
    assert not any("range of physics" in str(warning.message) for warning in recwarn)


def test_three_objects_span_a_grid_of_three(small):
    result = sweep.run(grid(swept(TORQUE_P, 2000, 4021, 2), *SMALL))
    assert result.objects == (TORQUE_P, P, I)
    assert len(result.order) == 18
    # The preset's 2041h:01 is 4021, so half of the grid is the grid of two objects.
    half = result.columns[TORQUE_P] == 4021
    np.testing.assert_array_equal(result.score[half], small.score)
    assert np.any(result.score[~half] != small.score)


# --- what is written --------------------------------------------------------------------------------------------------
def test_the_table_has_a_row_per_pair_with_gains_metrics_and_flags(tmp_path, small):
    save_sweep(small, tmp_path / "run")
    with (tmp_path / "run" / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9
    assert list(rows[0]) == [P, I, "rank", "score [s]", *(f"{row.name} [{row.unit}]" for row in METRICS.values()),
                             "diverged", "oscillates", "fault"]  # fmt: skip
    for name, column in small.columns.items():
        np.testing.assert_array_equal([float(row[name]) for row in rows], column.astype(float), err_msg=name)
    assert {row["score [s]"] for row in rows if row["oscillates"] == "1"} == {"inf"}


def test_settings_hold_the_experiment_and_the_versions(tmp_path, small):
    save_sweep(small, tmp_path / "run")
    text = (tmp_path / "run" / "settings.toml").read_text()
    assert set(tomllib.loads(text)["versions"]) == {
        "drive-env", "numpy", "numba", "llvmlite", "mujoco", "sources", "python", "processor",
    }  # fmt: skip
    read = load_experiment(tmp_path / "run" / "settings.toml")
    assert replace(read, versions={}) == small.experiment
    assert provenance.differences(read.versions) == []
    assert provenance.differences(dict(read.versions) | {"numpy": "0.9"})[0].startswith(
        "the run was made with numpy 0.9"
    )


def test_results_are_complete_or_absent(tmp_path):
    with pytest.raises(KeyboardInterrupt), provenance.new_folder(tmp_path / "run") as partial:
        (partial / "results.csv").write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_something_in_it_is_refused_and_an_empty_one_taken(tmp_path, small):
    (tmp_path / "empty").mkdir()
    save_sweep(small, tmp_path / "empty")
    before = (tmp_path / "empty" / "results.csv").read_bytes()
    with pytest.raises(FileExistsError, match="is not empty; choose another --out"):
        save_sweep(small, tmp_path / "empty")
    assert (tmp_path / "empty" / "results.csv").read_bytes() == before
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="is a file"):
        save_sweep(small, tmp_path / "file")
    with pytest.raises(NotADirectoryError, match="is a file, so that"):
        save_sweep(small, tmp_path / "file" / "run")


def test_a_place_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # permissions do not bind root
    with pytest.raises(PermissionError, match="cannot be written; choose another --out"):
        provenance.check_folder(tmp_path / "runs" / "run")


def test_run_folders_do_not_collide(tmp_path):
    first = provenance.run_folder("sweep", tmp_path)
    first.mkdir()
    second = provenance.run_folder("sweep", tmp_path)
    assert first.name.endswith("-sweep")
    assert second != first


@pytest.mark.parametrize("objects", [1, 2, 3])
def test_pictures_show_the_grid_with_its_names_units_and_best(objects):
    result = sweep.run(
        grid(*(swept(P, 200, 3200, 3), swept(I, 0, 900, 2, "lin"), swept(TORQUE_P, 2000, 4000, 2))[:objects])
    )
    figure = plots.heat_map(result)
    axes = figure.axes[0]
    assert axes.get_xlabel() == "2042h:01 Velocity Mode Settings.P_Parameter [raw]"
    assert axes.get_xscale() == "log"
    score_axis = axes.yaxis if objects == 1 else figure.axes[1].yaxis
    assert score_axis.get_label_text() == "tracking [ms], less is better"
    if objects > 1:
        assert axes.get_ylabel() == "2042h:02 Velocity Mode Settings.I_Parameter [raw]"
        assert axes.get_yscale() == "linear"
        cells = axes.collections[1].get_array()  # over those that say why a point has no score
        best = 1e3 * result.score.reshape(3, 2, -1).min(axis=2).T
        np.testing.assert_allclose(cells.filled(np.inf).reshape(best.shape), best)
    (star,) = [line for line in axes.lines if line.get_marker() == "*"]
    assert star.get_xdata()[0] == result.best(1)[0][P]
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    unusable = int(np.isinf(result.score).sum())
    assert texts == ["best", f"oscillating ({unusable} points)"]
    responses = plots.best_response(result).axes
    assert [a.get_ylabel() for a in responses] == ["velocity [rpm]", "current i_q [A]", "load\ntorque [N·m]"]
    assert responses[2].get_xlabel() == "time [ms]"


def test_pictures_of_a_grid_without_a_usable_pair(small):
    result = sweep.run(grid(swept(P, 4000, 5000, 2), swept(I, 100, 200, 2)))
    assert np.isinf(result.score).all()
    assert plots.heat_map(result).axes[0].get_legend().get_texts()[0].get_text().startswith("oscillating")
    assert "no usable point" in plots.best_response(result).get_suptitle()
    single = sweep.run(grid(swept(P, 4000, 5000, 2)))
    assert plots.heat_map(single).axes[0].get_yticks().size == 0


# --- mistakes ---------------------------------------------------------------------------------------------------------
TEXT = DEFAULT.read_text(encoding="utf-8")


@every_row(("old", "new", "message"), [
    ('device = "tmcm1636"', 'device = "abc"', "no device is named 'abc'; there are tgz_d, tgz_d_2026"),
    ('motor = "qbl4208"', 'motor = "abc"', "no motor is named 'abc'; there are am3033_e, am3041_e"),
    ('load = "two_mass"', 'load = "abc"', "no load is named 'abc'; there are arm, ball_screw, belt, cart_pendulum"),
    ('load = "two_mass"', "load = 3", "load = 3 is a whole number; it must be a text"),
    ("seed = 0", "seed = 1.5", "seed = 1.5 is a number with a fraction; it must be a whole number"),
    ("seed = 0", "seed = true", "seed = True is a truth value; it must be a whole number"),
    ("seed = 0", "seed = -1", "seed = -1 lies outside 0"),
    ("seed = 0", "sed = 0", "key 'sed' is unknown; there are device, motor, load, seed"),
    ("seed = 0", "", "key 'seed' is missing; add it"),
    ("[[sweep]]", "[sweep]", "is not valid TOML"),
    ("low = 60", "low = 60.0", "sweep 1: low = 60.0 is a number with a fraction; it must be a whole number"),
    ("low = 60", "low = 70000", r"sweep 1: low = 70000 lies outside the range 0\.\.\.65535 of 2042h:01"),
    ("low = 60", "low = -1", r"sweep 1: low = -1 lies outside the range 0\.\.\.65535"),
    ("low = 60", "low = 5000", "sweep 1: low = 5000 is above high = 4000; swap them"),
    ("low = 30", "low = 0", "sweep 2: low = 0 has no logarithm; use low = 1 or spacing = 'lin'"),
    ("low = 30", "low = 30\nstep = 2", "sweep 2: key 'step' is unknown; there are object, low, high, count, spacing"),
    ("high = 4000", "high = 65536", r"sweep 1: high = 65536 lies outside the range 0\.\.\.65535"),
    ("high = 4000\ncount = 32", "high = 4000\ncount = 0", "sweep 1: count = 0 is below 1; give the number of values"),
    ("high = 4000\ncount = 32", "high = 4000\ncount = 5000000",
     "sweep 1: count = 5000000 is above the limit of 4194304"),
    ("low = 60\nhigh = 4000\ncount = 32", "low = 1\nhigh = 65535\ncount = 65535\nspacing = 'lin'\n[[sweep]]\n"
     "object = '2041h:01'\nlow = 1\nhigh = 9\ncount = 9",
     r"the grid has 65535 x \d+ x 32 = \d+ points; the limit is 4194304: lower a count"),
    ('spacing = "log"         #', 'spacing = "exp"  #', "sweep 1: spacing = 'exp' is unknown; there are lin, log"),
    ("Velocity Mode Settings.I_Parameter", "2042h:01", "sweep 2: 2042h:01 Velocity .* is swept already; remove one"),
    ("Velocity Mode Settings.I_Parameter", "2042h:03", "is 2042h:03 .*, no writable gain; gains of tmcm1636 are 2041h"),
    ("Velocity Mode Settings.I_Parameter", "2003h:00", "no writable gain; gains of tmcm1636 are 2041h:01, 2041h:02"),
    ("Velocity Mode Settings.I_Parameter", "2042h:09", "sweep 2: object: object 2042h has no sub-index 9"),
    ("Velocity Mode Settings.I_Parameter", "2999h:01", "sweep 2: object: object 2999h does not exist"),
    ("Velocity Mode Settings.I_Parameter", "Velocity Mode Settings.I_Param", "no object is named .*; did you mean"),
    ("velocity_rpm = 1500.0", "velocity_rpm = 0.0", "a step needs a velocity other than 0"),
    ("velocity_rpm = 1500.0", 'velocity_rpm = "fast"', "velocity_rpm = 'fast' is a text; it must be a number"),
    ("velocity_rpm = 1500.0", "velocity_rpm = inf", "excitation: velocity_rpm = inf is not finite; give a number"),
    ("velocity_rpm = 1500.0", "velocity_rpm = 1e9", r"velocity is \d+ as 60FFh:00 Target velocity, outside"),
    ("velocity_rpm = 1500.0", "velocity_rpm = 1\nvelocity_pps = 1", "needs velocity_rpm or velocity_pps; it has both"),
    ("velocity_rpm = 1500.0", "", "excitation: needs velocity_rpm or velocity_pps; it has none"),
    ("acceleration_rpm_per_s = 100000.0", "acceleration_rpm_per_s = 1e9", r"acceleration is \d+ as 6083h:00 "),
    ("acceleration_rpm_per_s = 100000.0", "acceleration_rpm_per_s = 0", "and an acceleration above 0"),
    ("sampling_period = 0.001", "sampling_period = 0.0015", "= 0.0015 s is not a whole .*; use 0.002 s"),
    ("sampling_period = 0.001", "sampling_period = 0", "sampling_period = 0 s is not a whole number .* use 0.001 s"),
    ("sampling_period = 0.001", "sampling_period = 0.02", "leaves 9 samples after 0.02 s; at least 20 .*: use 0.42"),
    ("velocity_time = 0.02", "velocity_time = 0.0205", "velocity_time = 0.0205 s is not a whole number .* of 0.001 s"),
    ("load_time = 0.2 ", "load_time = 0.01 ", "load_time = 0.01 s and duration = 0.4 s must follow each other"),
    ("load_time = 0.2 ", "load_time = 0.03 ", "leaves 10 samples after 0.02 s; at least 20 are needed: use 0.04 s"),
    ("load_torque = -0.1", "load_torque = nan", "excitation: load_torque = nan is not finite"),
    ("duration = 0.4", "duration = 0.2", "duration = 0.2 s must follow each other"),
    ("duration = 0.4", "duration = 100", r"duration = 100 s lies outside 0\.\.\.60 s; change it"),
    ('name = "tracking"', 'name = "abc"', "metric: name = 'abc' is unknown; there are tracking, iae, itae"),
    ('name = "tracking"', 'name = "iae"', "metric: iae takes no weights; weights has step, disturbance, ripple"),
    ("step = 1.0, ", "", "tracking takes the weights step, disturbance, ripple; weights has disturbance, ripple"),
    ("step = 1.0, ", "step = -1.0, ", "metric: weight step = -1 is negative; give 0 or more"),
    ("{ step = 1.0, disturbance = 1.0, ripple = 0.2 }", "{ step = 0, disturbance = 0, ripple = 0 }", "weights are 0"),
    ("{ step = 1.0, disturbance = 1.0, ripple = 0.2 }", "3", "metric: weights is a whole number; it must be a table"),
    ("[excitation]", "[excitations]", "key 'excitations' is unknown"),
])  # fmt: skip
def test_a_mistake_in_the_experiment_is_one_line_with_its_remedy(tmp_path, old, new, message):
    assert old in TEXT
    path = tmp_path / "experiment.toml"
    path.write_text(TEXT.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ExperimentError, match=message) as caught:
        load_experiment(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("data", "message"), [
    ("sweep = []", "nothing is swept; add at least one table"),
    ("sweep = 3", "sweep is a whole number; write one table"),
    ("sweep = [3]", "sweep 1 is a whole number; it must be a table"),
])  # fmt: skip
def test_a_sweep_that_is_no_list_of_tables(tmp_path, data, message):
    start, end = TEXT.index("[[sweep]]"), TEXT.index("[excitation]")
    (tmp_path / "experiment.toml").write_text(TEXT[:start] + data + "\n" + TEXT[end:], encoding="utf-8")
    with pytest.raises(ExperimentError, match=message):
        load_experiment(tmp_path / "experiment.toml")


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ExperimentError, match=r"cannot read .*none\.toml: No such file"):
        load_experiment(tmp_path / "none.toml")
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ExperimentError, match="binary: it is not UTF-8 text"):
        load_experiment(tmp_path / "binary")


def test_an_experiment_made_in_python_is_checked_when_it_runs():
    with pytest.raises(ExperimentError, match="low = 9 is above high = 3"):
        sweep.run(grid(swept(P, 9, 3, 2)))


def test_overrides_replace_what_the_file_says():
    experiment = load_experiment(motor="ec_i_40", load="inertia", seed=7, device=None)
    assert (experiment.device, experiment.motor, experiment.load, experiment.seed) == (
        "tmcm1636",
        "ec_i_40",
        "inertia",
        7,
    )


def test_heights_in_pps_and_rpm_mean_the_same():
    in_rpm = resolve(grid(*SMALL))
    pps = replace(SHORT, velocity_rpm=None, velocity_pps=float(round(1000 / 60 * 65536)), acceleration_rpm_per_s=None,
                  acceleration_pps2=float(round(100_000 / 60 * 65536)))  # fmt: skip
    in_pps = resolve(replace(grid(*SMALL), excitation=pps))
    assert (in_pps.velocity, in_pps.acceleration) == (in_rpm.velocity, in_rpm.acceleration)
    assert in_rpm.velocity == 1_092_267


def test_a_written_experiment_reads_back_equal(tmp_path):
    experiment = Experiment(
        "tmcm1636", "ec_i_40", "inertia", 2**40, (swept("0x2041:2", 0, 65535, 7, "lin"),),
        replace(SHORT, load_torque=1e-5 / 3, velocity_rpm=None, velocity_pps=-123456.0), MetricChoice("dip"),
    )  # fmt: skip
    (tmp_path / "e.toml").write_text(experiment.to_toml({}))
    assert load_experiment(tmp_path / "e.toml") == experiment


# --- packages ---------------------------------------------------------------------------------------------------------
def test_our_own_packages_pass_and_a_foreign_one_is_named(tmp_path):
    check_own("drive_env", "mechanics", "tuning", "agents")
    with pytest.raises(ForeignPackageError, match=r"foreign package 'json' at .*json before drive-env's own at"):
        check_own("json")
    with pytest.raises(ForeignPackageError, match="package 'not_there' of drive-env is not installed"):
        check_own("not_there")
    with pytest.raises(ForeignPackageError, match="mechanics"):
        check_own("mechanics", root=tmp_path)
