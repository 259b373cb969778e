"""The scope: its ring, decimation, triggers, pictures, figures and files."""

from __future__ import annotations

import io
import json
import struct
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import cia402
from drive_env.devices import find_device
from drive_env.dictionary.quantities import SHOWN
from drive_env.drives.trace import Trace
from drive_env.fieldbus.description import describe
from drive_env.studio.decimation import min_max, stride_of
from drive_env.studio.recorder import SampleRing, ScopeRecorder
from drive_env.studio.scope_export import as_csv, as_npz, as_png, in_words, measure_step
from drive_env.studio.scope_page import ScopePanel
from drive_env.studio.scope_trigger import EDGES, ScopeTrigger, first_fired
from drive_env.studio.scope_view import ScopeChannel, ScopeRecording, ScopeView, channel_of, with_channels, with_units
from drive_env.studio.workspace import Workspace, trigger_of

VELOCITY, STATUS = (cia402.VELOCITY_ACTUAL, 0), (cia402.STATUSWORD, 0)
KNOWN = find_device("tmcm1636").new_dictionary()
DEVICE = describe("tmcm1636", None)
CHANNEL = ScopeChannel(VELOCITY, 0, "Velocity actual value", "rpm", 0.5)


def trace(values, status=0x0237):
    """Samples of velocity and statusword of one axis, 1 ms apart."""
    rows = np.asarray(values, np.int64)[:, None]
    words = np.broadcast_to(np.asarray(status, np.int64).reshape(-1, 1), rows.shape)
    return Trace(np.arange(len(rows)) * 0.001, {VELOCITY: rows, STATUS: words}, KNOWN)


def recorder_of(*parts):
    made = ScopeRecorder(1, 0.001)
    made.objects = (VELOCITY, STATUS)
    for part in parts:
        made.keep(part, (VELOCITY, STATUS), made.now, made.now + 0.001 * len(part))
    return made


def picture(view):
    """Return a frame's header, and what its traces are as values."""
    data = view.frame()
    (length,) = struct.unpack("<I", data[:4])
    header = json.loads(data[4 : 4 + length])
    numbers = np.frombuffer(data[4 + length :], "<i2").astype(float)
    values, place = [], 0
    for one in header["traces"]:
        both = []
        for _ in range(2 if one["thick"] else 1):
            raw = numbers[place : place + one["count"]]
            both.append(one["low"] + (raw + one["offset"]) * one["step"])
            place += one["count"]
        values.append((both[0], both[-1]))
    return header, values


# --- ring ---------------------------------------------------------------------------------------------------------
def test_a_ring_keeps_the_newest_samples():
    ring = SampleRing((VELOCITY,), 1, capacity=5)
    for first in (0, 3, 6):
        ring.append(np.arange(first, first + 3.0), {VELOCITY: np.arange(first, first + 3)[:, None]})
    assert (ring.total, ring.oldest) == (9, 4)
    rows = ring.read(0, 100)
    assert rows.first == 4
    assert rows.t.tolist() == [4, 5, 6, 7, 8]
    assert rows.values[VELOCITY][:, 0].tolist() == [4, 5, 6, 7, 8]


def test_more_samples_than_a_ring_holds_at_once():
    ring = SampleRing((VELOCITY,), 1, capacity=4)
    ring.append(np.arange(10.0), {VELOCITY: np.arange(10)[:, None]})
    assert ring.read(0, 10).t.tolist() == [6, 7, 8, 9]


def test_other_objects_begin_a_ring_anew():
    made = recorder_of(trace([1, 2]))
    before = made.generation
    made.keep(trace([3]), (VELOCITY,), 0.002, 0.003)
    assert made.generation == before + 1
    assert made.ring.keys == (VELOCITY,)


# --- decimation ---------------------------------------------------------------------------------------------------
def test_no_spike_is_lost():
    values = np.zeros(10_000)
    values[7_777] = 5.0
    values[1_234] = -3.0
    found = min_max(values, stride_of(len(values), 300))
    assert len(found.low) <= 301
    assert (found.low.min(), found.high.max()) == (-3.0, 5.0)


def test_borders_of_columns_stay_while_samples_come():
    values = np.arange(1000.0)
    one, other = min_max(values[0:900], 10, 0), min_max(values[7:907], 10, 7)
    assert set(one.low[2:-2]) <= set(other.low)


def test_few_samples_stay_as_they_are():
    found = min_max(np.array([3.0, 1.0, 2.0]), 1)
    assert found.low.tolist() == found.high.tolist() == [3.0, 1.0, 2.0]
    assert len(min_max(np.empty(0), 4).starts) == 0


# --- triggers -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("kind", "values", "at"), [
    ("rising", [0, 5, 9, 10, 11], 3),
    ("rising", [20, 15, 12], None),  # it was above before
    ("rising", [20, 5, 15], 2),
    ("falling", [20, 15, 10, 5], 2),
    ("falling", [0, 5, 9], None),
])  # fmt: skip
def test_an_edge_passes_the_level(kind, values, at):
    assert first_fired(ScopeTrigger(kind, 0, VELOCITY, 10.0), np.array(values)) == at


@pytest.mark.parametrize(("kind", "words", "at"), [
    ("state", [0x0250, 0x0250, 0x0231, 0x0233], 2),
    ("state", [0x0237, 0x0637, 0x1637], None),  # bits that are none of the state
    ("state", [0x0240, 0x0260], None),  # bit 5 does not matter in switch on disabled
    ("fault", [0x0237, 0x0237, 0x021F, 0x0218], 2),
    ("fault", [0x0218, 0x0218], None),  # it was in fault before
])  # fmt: skip
def test_a_change_of_state_and_a_fault(kind, words, at):
    assert first_fired(ScopeTrigger(kind, 0), np.array(words)) == at


def test_a_trigger_that_there_is_not():
    with pytest.raises(ValueError, match="rising, falling"):
        ScopeTrigger("sideways", 0)


# --- pictures -----------------------------------------------------------------------------------------------------
def view_of(recorder, mode="roll", window=0.1, **trigger):
    view = ScopeView(recorder)
    view.channels, view.window, view.mode = (CHANNEL,), window, mode
    view.trigger = ScopeTrigger("rising", 0, VELOCITY, 50.0) if not trigger else ScopeTrigger(**trigger)
    view.run()
    return view


def test_a_rolling_picture_shows_the_newest_samples_in_their_unit():
    view = view_of(recorder_of(trace(np.arange(500))))
    header, values = picture(view)
    assert (header["from"], header["to"]) == (-0.1, 0.0)
    assert values[0][0][-1] == pytest.approx(0.5 * 499, abs=0.01)
    assert len(values[0][0]) == 100


def test_a_triggered_picture_begins_before_its_trigger():
    made = recorder_of(trace(np.zeros(200)))
    view = view_of(made, "normal")
    view.before = 0.2
    view.step()
    made.keep(trace(np.concatenate([np.zeros(40), np.full(30, 100)])), (VELOCITY, STATUS), 0.2, 0.27)
    view.step()
    assert view.status == "triggered" and view.kept is None  # its end is not there yet
    made.keep(trace(np.full(100, 100)), (VELOCITY, STATUS), 0.27, 0.37)
    view.step()
    kept = view.kept
    assert len(kept.t) == 100
    assert (kept.t[0], kept.t[20]) == pytest.approx((-0.02, 0.0))
    assert kept.of(CHANNEL)[19:21].tolist() == [0.0, 50.0]
    assert view.is_running


def test_single_halts_after_one_picture():
    made = recorder_of(trace(np.zeros(200)))
    view = view_of(made, "single")
    view.step()
    made.keep(trace(np.full(300, 100)), (VELOCITY, STATUS), 0.2, 0.5)
    view.step()
    assert view.kept is not None and view.status == "halted"
    view.run()
    assert view.kept is None and view.status == "waiting for the trigger"


def test_an_edge_between_two_pieces_is_seen():
    made = recorder_of(trace(np.zeros(200)))
    view = view_of(made, "single")
    view.step()
    made.keep(trace(np.full(200, 100)), (VELOCITY, STATUS), 0.2, 0.4)
    view.step()
    assert view.kept is not None


def test_auto_shows_what_there_is_where_no_trigger_comes():
    made = recorder_of(trace(np.zeros(3000)))
    view = view_of(made, "auto")
    made.keep(trace(np.full(1500, 7)), (VELOCITY, STATUS), 3.0, 4.5)
    header, _ = picture(view)
    assert header["to"] == 0.0 and not header["triggered"]


def test_halting_keeps_the_picture():
    made = recorder_of(trace(np.arange(200)))
    view = view_of(made)
    view.halt()
    made.keep(trace(np.zeros(200)), (VELOCITY, STATUS), 0.2, 0.4)
    _, values = picture(view)
    assert values[0][0].max() == pytest.approx(0.5 * 199, abs=0.01)


def test_a_reference_is_laid_under():
    made = recorder_of(trace(np.arange(200)))
    view = view_of(made)
    assert view.keep_as_reference()
    header, _ = picture(view)
    assert len(header["reference"]) == 1


def test_a_gap_breaks_the_line():
    made = ScopeRecorder(1, 0.001)
    made.keep(trace([1] * 40), (VELOCITY, STATUS), 0.0, 0.04)
    made.keep(trace([2] * 40), (VELOCITY, STATUS), 0.5, 0.54)
    view = view_of(made)
    header, _ = picture(view)
    assert header["traces"][0]["breaks"][0][0] == 40


def test_a_constant_is_no_division_by_zero():
    header, values = picture(view_of(recorder_of(trace(np.full(200, 42)))))
    assert values[0][0].tolist() == [21.0] * 100
    assert header["traces"][0]["high"] == 21.0


def test_nine_channels_are_refused():
    with pytest.raises(ValueError, match="9 channels are too many"):
        with_channels(ScopeView(recorder_of()), (CHANNEL,) * 9)


def test_a_channel_has_the_unit_that_people_read():
    found = channel_of(KNOWN.find(VELOCITY), 0, 65536.0, several=False)
    assert (found.unit, found.label) == ("rpm", "Velocity actual value [rpm]")
    assert 65536 * found.factor == pytest.approx(60.0)


def test_other_units_show_the_same_as_before():
    view = ScopeView(made := recorder_of(trace([0, 65536, 65536])))
    rpm = channel_of(KNOWN.find(VELOCITY), 0, 65536.0, several=False)
    view.channels, view.window = (rpm,), 0.003
    view.halt()
    view.keep_as_reference()
    before = view.shown().of(rpm)
    per_second = channel_of(KNOWN.find(VELOCITY), 0, 65536.0, several=False, units=SHOWN | {"speed": "deg/s"})
    with_units(view, (per_second,))
    assert per_second.label == "Velocity actual value [deg/s]" and made.now == 0.003
    for recording in (view.kept, view.reference):
        assert recording.of(per_second) == pytest.approx(6.0 * before)  # a rpm is 6 deg/s
    assert picture(view)[1][0][1].max() == pytest.approx(360.0, rel=1e-3)


# --- figures and files --------------------------------------------------------------------------------------------
def step_recording(overshoot=0.0):
    t = np.arange(-100, 900) * 0.001
    y = np.where(t < 0, 0.0, 100.0 * (1.0 - np.exp(-np.maximum(t, 0.0) / 0.02)))
    y = y + np.where((t > 0.06) & (t < 0.08), 100.0 * overshoot, 0.0)
    return ScopeRecording(t, ((CHANNEL, y),))


def test_figures_of_a_step():
    found = measure_step(step_recording(), CHANNEL, None, None)
    assert found.height == pytest.approx(100.0, rel=0.01)
    assert found.rise == pytest.approx(2.197 * 0.02, abs=0.002)  # of a lag of first order
    assert found.settling == pytest.approx(3.91 * 0.02, abs=0.004)
    assert found.overshoot == pytest.approx(0.0, abs=0.01)
    assert "rise (10 to 90 %)" in in_words(found, "rpm")


def test_figures_between_the_cursors():
    found = measure_step(step_recording(0.2), CHANNEL, -0.01, 0.5)
    assert found.overshoot == pytest.approx(0.15, abs=0.05)


def test_a_cursor_before_the_step_does_not_lengthen_it():
    rolling = step_recording()
    rolling = ScopeRecording(rolling.t - 2.0, rolling.values)  # no trigger: times up to now
    found = measure_step(rolling, CHANNEL, -2.08, -1.4)
    assert found.at == pytest.approx(-2.0, abs=0.003)
    assert found.settling == pytest.approx(3.91 * 0.02, abs=0.004)


def test_no_step_is_told():
    flat = ScopeRecording(np.arange(200) * 0.001, ((CHANNEL, np.zeros(200)),))
    with pytest.raises(ValueError, match="makes no step"):
        measure_step(flat, CHANNEL, None, None)


def test_files_hold_every_sample():
    recording = step_recording()
    rows = as_csv(recording).decode().splitlines()
    assert rows[0] == "t [s],Velocity actual value [rpm]"
    assert len(rows) == 1001
    with np.load(io.BytesIO(as_npz(recording))) as found:
        assert found["values"].shape == (1, 1000)
        assert (str(found["names"][0]), str(found["units"][0])) == ("Velocity actual value", "rpm")
        assert found["objects"].tolist() == [[0x606C, 0, 0]]
    assert as_png(recording, recording).startswith(b"\x89PNG")


# --- what is set ------------------------------------------------------------------------------------------------------


def test_a_workspace_is_found_again_from_its_file(tmp_path):
    """Of each axis its own; what was not set is as usual; a file is written by the first change."""
    file = tmp_path / "machine.toml"
    first = Workspace(DEVICE, file)
    assert first.of(0) == Workspace(DEVICE).of(0) and not file.exists()
    first.change(0, channels=((0x6041, 0), (0x2101, 0)), mode="single", level="-90 rpm")
    first.change(1, jog_speed="5 deg/s")
    first.change(0, window=0.5)
    again = Workspace(DEVICE, file)
    assert [again.of(axis) for axis in range(3)] == [first.of(axis) for axis in range(3)]
    assert (again.units["angle"], again.units["speed"], again.favourites) == ("rev", "rpm", ())
    again.show_in("angle", "deg")
    again.toggle_favourite(VELOCITY)
    again.toggle_favourite(STATUS)
    again.toggle_favourite(VELOCITY)
    third = Workspace(DEVICE, file)
    assert (third.units["angle"], third.units["speed"], third.favourites) == ("deg", "rpm", (STATUS,))
    with pytest.raises(ValueError, match="'inch' is not one of angle: rev, deg, rad;"):
        third.show_in("angle", "inch")
    assert again.of(0).channels == ((0x6041, 0), (0x2101, 0)) and again.of(0).window == 0.5
    assert again.of(0).jog_speed == again.of(2).jog_speed == "60 rpm"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("format = 1", "format = 2", "is not a workspace"),
        ("tmcm1636", "tgz_d", "is of tgz_d, and this is tmcm1636; give another file"),
        ('channels = ["6041:00"]', 'channels = ["606C:07"]', "has no object 606C:07"),
        ("favourites = []", 'favourites = ["606C:09"]', "has no object 606C:09"),
        ("favourites = []", "favourites = [7]", "mend the line"),
        ('speed = "rpm"', 'speed = "knots"', "units: speed = 'knots' is not one of"),
        ('speed = "rpm"', 'mass = "kg"', "units: mass = 'kg' is not one of"),
        ("6041:00", "velocity", "mend the line"),
        ('"single"', '"once"', "'once' is not one of roll, auto"),
        ("window = 2.0", "window = 3.0", "3.0 is not one of 0.1, 0.2"),
        ("before = 0.1", "before = 1.5", "before = 1.5 must be 0 to 0.9"),
        ("before = 0.1", "behind = 0.1", "missing, or are not known: before, behind"),
        ("before = 0.1", "before = [", "is not TOML"),
    ],
)
def test_a_file_that_is_no_workspace_is_refused(tmp_path, old, new, message):
    file = tmp_path / "machine.toml"
    Workspace(DEVICE, file).change(0, channels=((0x6041, 0),), mode="single")
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        Workspace(DEVICE, file)


@pytest.mark.parametrize("edge", EDGES)
def test_the_trigger_that_is_set(edge):
    settings = replace(Workspace(DEVICE).of(0), edge=edge)
    trigger = trigger_of(settings, 2, 700.0)
    has_level = edge in ("rising", "falling")
    assert (trigger.kind, trigger.axis) == (edge, 2)
    assert trigger.key == ((0x606C, 0) if has_level else (0x6041, 0))


def test_a_page_opens_though_the_file_has_what_the_scope_cannot_show(tmp_path):
    """A level that is no quantity, or an object that no process data carry: the page says so, and rolls."""
    told = []
    visitor = SimpleNamespace(axis=0, say=lambda text, kind: told.append(text))
    for settings, message in (
        ({"level": "fast"}, "the trigger is not set"),
        ({"source": (0x1018, 1)}, "1018:01 cannot be sampled"),
    ):
        workspace = Workspace(DEVICE, tmp_path / "machine.toml")
        workspace.change(0, mode="single", channels=((0x1018, 1), VELOCITY), **{"level": "30 rpm", **settings})
        session = SimpleNamespace(
            description=DEVICE, scales=[65536.0], num_axes=1, scopes={}, recorder=recorder_of(),
            workspace=Workspace(DEVICE, tmp_path / "machine.toml"),
        )  # fmt: skip
        ScopePanel(session, visitor)
        view = session.scopes[0]
        assert message in told[-1] and (view.mode, view.is_armed) == ("roll", False)
        assert [channel.key for channel in view.channels] == [VELOCITY]
