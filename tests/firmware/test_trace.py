"""What `record` returns: printed, in units, as a table and a picture; and quantities that are written as text."""

from __future__ import annotations

import csv
import math
import sys

import numpy as np
import pytest

from drive_env import EmulatedDrives
from drive_env.dictionary.quantities import parse

POSITION, SPEED, CURRENT, STATUS = "Position actual value", "Velocity actual value", "Torque actual value", "Statusword"


@pytest.fixture(scope="module")
def drives():
    with EmulatedDrives(load="gantry") as drives:
        yield drives


@pytest.fixture(scope="module")
def trace(drives):
    return drives.record([POSITION, SPEED, CURRENT, STATUS], 0.01, period=0.002)


@pytest.mark.parametrize(("name", "unit", "per_count"), [
    (SPEED, "pps", 1.0),
    (SPEED, "rad/s", 2.0 * math.pi / 65536),
    (SPEED, "rpm", 60.0 / 65536),
    (POSITION, "deg", 360.0 / 65536),
    (CURRENT, "A", 1e-3),
])  # fmt: skip
def test_a_unit_is_asked_for_beside_the_name(drives, trace, name, unit, per_count):
    key = (trace._dictionary.find(name).index, 0)
    trace._values[key] = np.arange(10).reshape(5, 2) - 3
    np.testing.assert_allclose(trace[name, unit], (np.arange(10).reshape(5, 2) - 3) * per_count, rtol=1e-12)
    assert trace[name].dtype == np.int64
    np.testing.assert_array_equal(trace[key[0], unit], trace[name, unit])


@pytest.mark.parametrize(("name", "unit", "message"), [
    (SPEED, "A", r"606Ch:00 Velocity actual value is not a quantity in 'A'; it takes pps, rev/s, rpm, rad/s, deg/s"),
    (STATUS, "rpm", r"6041h:00 Statusword has no unit that rpm could be turned into; give its integer"),
])  # fmt: skip
def test_a_unit_that_does_not_fit_is_refused(trace, name, unit, message):
    with pytest.raises(ValueError, match=message):
        trace[name, unit]


def test_what_was_not_recorded_is_named_with_and_without_a_unit(trace):
    for key in ("Target velocity", ("Target velocity", "rpm")):
        with pytest.raises(KeyError, match=r"60FFh:00 Target velocity was not recorded; there are 6064h:00"):
            trace[key]


def test_a_trace_prints_what_it_holds(drives):
    printed = repr(drives.record([CURRENT, STATUS], 0.01, period=0.002)).splitlines()
    assert printed[0] == "5 samples from 0 to 0.008 s, 2 axes"
    assert printed[1].startswith("  6077h:00 Torque actual value: ") and printed[1].endswith(" mA")
    assert printed[2].startswith("  6041h:00 Statusword: ")


def test_a_table_has_time_and_every_axis_with_its_unit(trace, tmp_path):
    with trace.to_csv(tmp_path / "trace.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert rows[0][:3] == ["t [s]", "6064h:00 Position actual value [inc] (axis 0)",
                           "6064h:00 Position actual value [inc] (axis 1)"]  # fmt: skip
    assert [row[0] for row in rows[1:]] == ["0", "0.002", "0.004", "0.006", "0.008"]
    assert [[int(cell) for cell in row[7:]] for row in rows[1:]] == trace[STATUS].tolist()


def test_a_picture_has_a_panel_for_each_object_in_units_that_people_read(trace, tmp_path):
    figure = trace.plot()
    assert [panel.get_ylabel() for panel in figure.axes] == ["rev", "rpm", "A", ""]
    assert all(len(panel.lines) == 2 for panel in figure.axes)
    np.testing.assert_allclose(figure.axes[1].lines[1].get_ydata(), trace[SPEED, "rpm"][:, 1])
    figure.savefig(tmp_path / "trace.png")


def test_a_frame_needs_pandas_and_says_so(trace, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="to_frame needs pandas, which is not installed: pip install pandas"):
        trace.to_frame()


def test_a_frame_has_the_columns_of_the_table(trace):
    pytest.importorskip("pandas")
    frame = trace.to_frame()
    assert frame.index.name == "t [s]" and len(frame.columns) == 8
    np.testing.assert_array_equal(frame.to_numpy()[:, -2:], trace[STATUS])


@pytest.mark.parametrize("text", ["500 rpm", "10 rev/s", "70000 pps", "1e3deg/s"])
def test_a_quantity_is_written_as_the_command_line_takes_it(drives, text):
    drives.write("Profile velocity", text)
    expected = parse(text, drives.inside.objects.entries.find("Profile velocity"), 65536.0)
    assert drives.read("Profile velocity").tolist() == [expected] * 2


def test_a_quantity_of_another_kind_changes_nothing(drives):
    before = drives.read("Profile velocity")
    with pytest.raises(ValueError, match=r"6081h:00 Profile velocity is not a quantity in 'A'"):
        drives.write("Profile velocity", "5 A")
    assert drives.read("Profile velocity").tolist() == before.tolist()


def test_a_quantity_goes_to_the_axes_of_the_mask(drives):
    drives.write("Profile velocity", 100)
    drives.write("Profile velocity", "1 rev/s", np.array([False, True]))
    assert drives.read("Profile velocity").tolist() == [100, 65536]


def test_a_trace_keeps_the_scale_that_it_was_recorded_with(drives):
    then = drives.record([SPEED], 0.002)
    then._values[0x606C, 0] = np.full((2, 2), 65536)
    drives.write("Position Scaler", 4096)
    try:
        np.testing.assert_allclose(then[SPEED, "rpm"], 60.0)
        now = drives.record([SPEED], 0.002)
        now._values[0x606C, 0] = np.full((2, 2), 4096)
        np.testing.assert_allclose(now[SPEED, "rpm"], 60.0)
    finally:
        drives.write("Position Scaler", 65536)
