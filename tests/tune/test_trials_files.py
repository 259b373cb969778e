"""The files of a search: its picture, the table of its trials, and the settings that repeat it."""

from __future__ import annotations

import csv
import math
import struct
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import to_hex

from tuning.search.optimise import Settings, TrialRow
from tuning.search.trials_files import _lines, _scale, figures, load_options, save, titles, trials_figure

ALONE, OF_EACH = "best accepted so far", "best accepted so far, of each search"
KEPT, STOPPED, FRAGILE = "#0072b2", "#d55e00", "#cc79a7"
NAMES = ("cost", "speed", "robustness", "current")


def trial(number=0, cost=0.0, *, search=0, objectives=(0.0, 0.0, 0.0), aborted=False, fragile=False, cause=""):
    return TrialRow(search, number, np.full((1, 5), 100), cost, objectives, aborted, fragile, cause)


def picture(rows, device="tmcm1636", **settings):
    return trials_figure(SimpleNamespace(rows=rows, t_0=0.01), Settings(**settings), device)


# --- the picture ------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("searches", "label"), [(1, ALONE), (2, OF_EACH)])
def test_the_picture_says_whose_best_its_line_is(searches, label):
    """One line for each search, the first of which has the label; what was stopped is no best."""
    rows = [
        trial(number, math.log(3.0 - number), search=search, aborted=number == 2)
        for search in range(searches)
        for number in range(3)
    ]
    figure = picture(rows)
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.get_legend().get_texts()].count(label) == 1
    assert axes.get_legend().get_texts()[0].get_text() == label
    lines = axes.get_lines()
    np.testing.assert_allclose([line.get_ydata() for line in lines], [[3.0, 2.0, 2.0]] * searches)
    np.testing.assert_array_equal([line.get_xdata() for line in lines], [[0, 1, 2]] * searches)
    assert {(to_hex(line.get_color()), line.get_drawstyle()) for line in lines} == {("#000000", "steps-post")}
    assert {(line.get_linewidth(), line.get_alpha()) for line in lines} == {(1.2, 0.8)}
    assert axes.get_title().endswith(f"seed 0{', 2 searches' if searches > 1 else ''}; less is better")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("trial", "J by measured terms")
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")


def test_before_anything_was_accepted_there_is_no_best():
    rows = [trial(0, aborted=True), trial(1, fragile=True), trial(2, math.log(5.0)), trial(3, math.log(7.0))]
    (line,) = picture(rows).axes[0].get_lines()
    np.testing.assert_allclose(line.get_ydata(), [np.nan, np.nan, 5.0, 5.0])


def test_trials_of_several_searches_are_sorted_by_search():
    rows = [trial(0, math.log(2.0), search=3), trial(0, math.log(4.0), search=1)]
    lines = picture(rows).axes[0].get_lines()
    assert [line.get_ydata().tolist() for line in lines] == [[pytest.approx(4.0)], [pytest.approx(2.0)]]


def test_each_trial_is_drawn_once_as_what_became_of_it():
    """What was stopped and is fragile, too, counts as stopped."""
    rows = [
        trial(0, math.log(2.0)),
        trial(1, math.log(3.0), aborted=True),
        trial(2, math.log(4.0), fragile=True),
        trial(3, math.log(5.0), aborted=True, fragile=True),
        trial(4, math.log(6.0)),
    ]
    (axes,) = picture(rows).axes
    found = {}
    for points in axes.collections:
        assert points.get_sizes().tolist() == [18]
        where = np.rint(points.get_offsets()).astype(int).tolist()
        found[points.get_label()] = (to_hex(points.get_facecolor()[0]), where)
    assert found == {
        "trial": (KEPT, [[0, 2], [4, 6]]),
        "stopped: it oscillated or went into fault": (STOPPED, [[1, 3], [3, 5]]),
        "not kept: it did not stop oscillating after a disturbance": (FRAGILE, [[2, 4]]),
    }
    (axes,) = picture(rows[:1]).axes
    assert [points.get_label() for points in axes.collections] == ["trial"]


def test_several_objectives_are_drawn_against_each_other_with_the_front_of_the_accepted():
    """The first two: settling times, of t_0 = 10 ms, and the worst J over J; what was stopped is on no front."""
    pairs = [(1.0, 5.0), (2.0, 4.0), (2.0, 5.0), (0.5, 1.0), (0.5, 0.5)]
    rows = [
        trial(k, objectives=(math.log(speed), math.log(worst), 7.0), aborted=k == 3, fragile=k == 4)
        for k, (speed, worst) in enumerate(pairs)
    ]
    (axes,) = picture(rows, objectives=("speed", "robustness")).axes
    (front,) = axes.get_lines()
    np.testing.assert_allclose(front.get_xydata(), [[10.0, 5.0], [20.0, 4.0]])
    assert front.get_label() == "accepted, on the Pareto front"
    assert (front.get_marker(), front.get_markersize(), front.get_fillstyle()) == ("o", 9, "none")
    assert front.get_linestyle() == "None" and to_hex(front.get_color()) == "#000000"
    np.testing.assert_allclose(axes.collections[0].get_offsets(), [[10.0, 5.0], [20.0, 4.0], [20.0, 5.0]])
    assert axes.get_xlabel() == "settling time, the slower of move and reversal [ms]"
    assert axes.get_ylabel() == "J of the worst phase over that of the moves"
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")


def test_a_front_of_none_is_not_drawn():
    (axes,) = picture([trial(aborted=True)], objectives=("speed", "robustness")).axes
    assert (len(axes.get_lines()), len(axes.collections)) == (0, 1)


def test_a_third_objective_counts_for_the_front_and_is_not_drawn():
    rows = [trial(0, objectives=(0.0, 0.0, 2.0)), trial(1, objectives=(math.log(2.0), math.log(2.0), 1.0))]
    (axes,) = picture(rows, objectives=("speed", "robustness", "current")).axes
    np.testing.assert_allclose(axes.get_lines()[0].get_xydata(), [[10.0, 1.0], [20.0, 2.0]])
    assert axes.get_ylabel() == "J of the worst phase over that of the moves"


def test_ripple_is_no_factor_and_has_a_linear_scale():
    rows = [trial(0, objectives=(0.0, 0.0, 2.5))]
    (axes,) = picture(rows, objectives=("current", "robustness")).axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("linear", "log")
    np.testing.assert_allclose(axes.collections[0].get_offsets(), [[2.5, 1.0]])
    (axes,) = picture(rows, objectives=("robustness", "current")).axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "linear")
    (axes,) = picture(rows, objectives=("current",)).axes
    assert axes.get_ylabel() == "ripple of the current [% of rated]" and axes.get_yscale() == "linear"


def test_a_logarithmic_scale_has_plain_numbers_at_1_2_and_5():
    figure = picture([trial(0, math.log(1.0)), trial(1, math.log(100.0))])
    figure.draw_without_rendering()
    axis = figure.axes[0].yaxis
    low, high = axis.get_view_interval()
    shown = [tick.label1.get_text() for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    assert shown == ["1", "2", "5", "10", "20", "50", "100"]
    assert {tick.label1.get_text() for tick in axis.get_minor_ticks()} <= {""}
    _scale(None, None, "current")  # changes nothing


@pytest.mark.parametrize(
    ("settings", "title"),
    [
        ({}, "tpe, seed 0; less is better"),
        ({"sampler": "random", "safe": True, "seed": 7}, "random, safe, seed 7; less is better"),
    ],
)
def test_the_picture_says_how_it_was_searched(settings, title):
    (axes,) = picture([trial()], **settings).axes
    assert axes.get_title() == title
    assert axes.title.get_fontsize() == 10
    assert axes.get_legend().get_texts()[0].get_fontsize() == 8
    assert axes.get_axisbelow() is True
    assert axes.xaxis.get_gridlines()[0].get_visible()


@pytest.mark.parametrize(
    ("device", "gains", "cost", "current", "stopped"),
    [
        ("tmcm1636", None, "J by measured terms", "ripple of the current [% of rated]", "oscillated"),
        ("tmcm6212", None, "J by measured terms, without load step and ripple of the current",
         "RMS of the currents that are set [% of rated]", "lost steps"),
        ("tmcm3313", ("correction_velocity_p",), "J by measured terms", "ripple of the current [% of rated]",
         "oscillated"),
        ("tmcm3313", ("pid_p",), "J by measured terms, without load step and ripple of the current",
         "vibration of the encoder, as J counts a ripple of so much [%]", "oscillated"),
    ],
)  # fmt: skip
def test_the_picture_of_a_stepper_says_what_its_cost_is_of(device, gains, cost, current, stopped):
    rows = [trial(0, aborted=True)]
    (axes,) = picture(rows, device, gains=gains, objectives=("cost", "current")).axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == (cost, current)
    assert axes.collections[0].get_label() == f"stopped: it {stopped} or went into fault"


@pytest.mark.parametrize(
    ("device", "gains", "current"),
    [
        ("tmcm1636", None, "ripple [%]"),
        ("tmcm1636", ("velocity_p",), "ripple [%]"),
        ("tmcm6212", None, "current [%]"),
        ("tmcm6212", ("run_current",), "current [%]"),
        ("tmcm3313", None, "current [%]"),
        ("tmcm3313", ("correction_velocity_p", "correction_position_p"), "ripple [%]"),
        ("tmcm3313", ("pid_p", "pid_d"), "vibration [%]"),
    ],
)
def test_what_the_columns_of_a_device_are_called(device, gains, current):
    assert titles(device, gains) == {
        "cost": "J", "speed": "settles [ms]", "robustness": "worst J over J", "current": current,
    }  # fmt: skip


def test_figures_are_in_units_that_a_person_reads():
    """Cost and robustness are factors, the speed a time of t_0 = 5 ms; the ripple stays what it is."""
    row = trial(cost=math.log(3.0), objectives=(math.log(4.0), math.log(1.5), 0.7))
    assert figures(row, NAMES, 5e-3) == pytest.approx([3.0, 20.0, 1.5, 0.7])
    assert figures(row, ("current", "speed"), 5e-3) == pytest.approx([0.7, 20.0])


# --- what is written --------------------------------------------------------------------------------------------------
MACHINE = {"device": "tmcm1636", "motor": "qbl4208", "load": "belt", "supply": 24.0, "travel": (-1.0, 1.5),
           "machines": 4, "channel": None, "lockstep": True}  # fmt: skip
FOUND = SimpleNamespace(
    t_0=0.01,
    rows=[
        trial(0, math.log(2.0), objectives=(math.log(3.0), 0.0, 0.125)),
        TrialRow(1, 4, np.array([[1, 2, 3, 4, 5], [6, 7, 8, 9, 10]]), 0.0, (0.0, 0.0, 0.0), True, False, "stall", 0.25),
        trial(2, 0.0, fragile=True),
    ],
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("search")
    settings = Settings(sampler="random", trials=3, gains=("velocity_p", "position_p"), width=0.5, safe=True,
                        seed=2, journal=Path("kept.log"))  # fmt: skip
    save(FOUND, settings, folder, MACHINE, {"drive-env": "1.2"})
    return folder


def test_the_table_has_a_row_for_each_axis_of_each_trial(written):
    rows = list(csv.reader((written / "trials.csv").read_text(encoding="utf-8").splitlines()))
    assert rows == [
        ["search", "trial", "axis", "torque_p", "torque_i", "velocity_p", "velocity_i", "position_p", "J",
         "settles [ms]", "worst J over J", "ripple [%]", "stopped", "fragile", "cause", "slack"],
        ["0", "0", "0", *["100"] * 5, "2", "30", "1", "0.125", "False", "False", "", ""],
        ["1", "4", "0", "1", "2", "3", "4", "5", "1", "10", "1", "0", "True", "False", "stall", "0.25"],
        ["1", "4", "1", "6", "7", "8", "9", "10", "1", "10", "1", "0", "True", "False", "stall", "0.25"],
        ["0", "2", "0", *["100"] * 5, "1", "10", "1", "0", "False", "True", "", ""],
    ]  # fmt: skip


def test_the_settings_repeat_the_search(written):
    text = (written / "settings.toml").read_text(encoding="utf-8")
    assert text.startswith("# All settings of the search. To repeat it: drive-tune auto --config settings.toml\n")
    assert "\n# journal: kept.log\n" in text
    assert tomllib.loads(text) == {
        "sampler": "random", "trials": 3, "objectives": ["cost"], "gains": ["velocity_p", "position_p"],
        "width": 0.5, "safe": True, "seed": 2,
        "machine": {"device": "tmcm1636", "motor": "qbl4208", "load": "belt", "supply": 24.0, "travel": [-1.0, 1.5],
                    "machines": 4, "lockstep": True},
        "versions": {"drive-env": "1.2"},
    }  # fmt: skip
    assert load_options(written / "settings.toml") == {
        "by": "random", "trials": 3, "objectives": ["cost"], "gains": ["velocity_p", "position_p"],
        "width": 0.5, "safe": True, "seed": 2, "device": "tmcm1636", "motor": "qbl4208", "load": "belt",
        "supply": 24.0, "travel": [-1.0, 1.5], "machines": 4, "lockstep": True,
    }  # fmt: skip


def test_the_picture_has_960_by_540_pixels(written):
    head = (written / "trials.png").read_bytes()[:24]
    assert head[:4] == b"\x89PNG" and struct.unpack(">II", head[16:]) == (960, 540)


def test_without_a_journal_none_is_named_and_what_is_not_given_is_left_out(tmp_path):
    save(FOUND, Settings(), tmp_path, MACHINE, {})
    text = (tmp_path / "settings.toml").read_text(encoding="utf-8")
    assert "journal" not in text and "gains" not in text and "safe = false\n" in text
    assert _lines({"a": None, "b": 1, "c": "x", "d": ["y", 2], "e": False}) == [
        "b = 1", 'c = "x"', 'd = ["y", 2]', "e = false",
    ]  # fmt: skip


# --- what is read -----------------------------------------------------------------------------------------------------
def test_the_pace_is_read_and_left_out_since_lockstep_says_it(tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text('seed = 3\n[machine]\nload = "inertia"\npace = "bus"\n', encoding="utf-8")
    assert load_options(file) == {"seed": 3, "load": "inertia"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed = ", r"settings\.toml is not TOML: .*; give settings\.toml of drive-tune auto"),
        ("seed = 3\n", r"settings\.toml is not from a search; give settings\.toml of drive-tune auto"),
        ("luck = 3\n[machine]\n", r"settings\.toml: key 'luck' is unknown; there are sampler, trials, objectives"),
        ("[machine]\ncolour = 3\n", r"settings\.toml: machine: key 'colour' is unknown; there are device, motor"),
        (None, r"cannot read .*settings\.toml: No such file or directory; give settings\.toml of drive-tune auto"),
        (b"\xff", r"settings\.toml is not TOML: .*; give settings\.toml of drive-tune auto"),
    ],
)
def test_a_file_that_is_of_no_search_is_told_why(tmp_path, text, message):
    file = tmp_path / "settings.toml"
    if text is not None:
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError, match=message):
        load_options(file)


def test_a_machine_that_is_no_table_has_no_options(tmp_path):
    file = tmp_path / "settings.toml"
    file.write_text("machine = 3\n", encoding="utf-8")
    assert load_options(file) == {}
