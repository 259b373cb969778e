"""The page Tune: gains that are changed and taken back, steps, responses, auto stopped and to its certificate."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.session_rig import until

pytest.importorskip("nicegui", reason="the extra `studio` is not installed")

from drive_env import EmulatedDrives, cia402
from drive_env.devices import find_device
from drive_env.drives.raw_gains import read_gains
from drive_env.fieldbus.description import describe
from drive_env.loops.dynamics import find_dynamics
from drive_env.studio import motion_jobs
from drive_env.studio.errors import JobEndedError
from drive_env.studio.session import Session
from tuning.auto.proving import Shown
from tuning.auto.stages import AxisResult, Result
from tuning.response.measured_loop import Loops
from tuning.snapshot import load_snapshot, take_of
from tuning.studio import gain_card, response_card, response_charts, step_card, tune_jobs
from tuning.studio.stiffness_slider import StiffnessSlider
from tuning.studio.tune_desk import LAST, StepRecording, TuneDesk, TunerSession
from tuning.target import of_machines

STANDARD = find_dynamics("standard")
KNOWN = find_device("tmcm1636").gains
VELOCITY_P = KNOWN.names.index("velocity_p")


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """A session on a two-mass machine, and its desk; runs are left in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    made = Session(lambda: EmulatedDrives(load="two_mass", num_threads=1), "a machine", describe("tmcm1636", None))
    made.presence.beat("page")
    made.start()
    until(lambda: made.state != "opening", 120.0)
    assert made.state == "open", made.failure
    yield TuneDesk(made)
    made.close()


def do(desk, job, **options):
    """Have a job done, by a page that is there meanwhile."""
    future = desk.session.do(job, "a job", page="page", **options)
    end = time.monotonic() + 300.0
    while not future.done() and time.monotonic() < end:
        desk.session.presence.beat("page")
        time.sleep(0.02)
    return future.result(0)


def gains_of(desk):
    return tuple(map(int, do(desk, lambda drives: read_gains(drives)[0])))


def all_parameters(desk):
    """The parameters of the drives, without their commands."""
    return do(desk, lambda drives: take_of(drives, {}).axes)


# --- gains --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("highest", [1, 255, 32767])
def test_a_slider_has_a_place_for_each_gain(highest):
    assert gain_card.place_of(0, highest) == 0
    assert gain_card.value_at(0, highest) == 0
    assert gain_card.value_at(gain_card.STOPS, highest) == highest
    for place in range(1, gain_card.STOPS + 1):
        value = gain_card.value_at(place, highest)
        assert 1 <= value <= highest
        if value > 100:  # where a place is less than an integer, several places have the same one
            assert abs(gain_card.place_of(value, highest) - place) <= 1


def test_a_gain_is_shown_in_si():
    device = find_device("tmcm1636")
    texts = gain_card.si_texts(device, 24.0, (4021, 1573, 445, 329, 118))
    assert [text.split()[-1] for text in texts] == ["V/A", "s", "A*s/rad", "s", "1/s"]
    assert texts[4] == "31.47 1/s"
    assert gain_card.si_texts(device, 24.0, (4021, 0, 445, 329, 118))[1] == "off"


def test_a_gain_is_changed_and_taken_back(desk):
    before = gains_of(desk)
    do(desk, tune_jobs.set_gains(desk, 0, {VELOCITY_P: 700}, "velocity P to 700"))
    assert gains_of(desk)[VELOCITY_P] == 700
    do(desk, tune_jobs.set_gains(desk, 0, {VELOCITY_P: 800, 0: 5000}, "two at once"))
    assert desk.last_change(0).what == "two at once"
    assert do(desk, tune_jobs.undo(desk, 0)) == "two at once"
    assert gains_of(desk) == (*before[:VELOCITY_P], 700, *before[VELOCITY_P + 1 :])
    do(desk, tune_jobs.undo(desk, 0))
    assert gains_of(desk) == before
    with pytest.raises(ValueError, match="no change to take back"):
        do(desk, tune_jobs.undo(desk, 0))


@pytest.mark.parametrize("value", [-1, 32768])
def test_a_gain_out_of_its_range_is_refused_before_anything_is_written(desk, value):
    before = gains_of(desk)
    with pytest.raises(ValueError, match="must be 0 to 32767"):
        do(desk, tune_jobs.set_gains(desk, 0, {0: 5000, VELOCITY_P: value}, "wrong"))
    assert gains_of(desk) == before
    assert not desk.changes


def test_the_state_before_is_in_a_file_and_comes_back(desk):
    before = all_parameters(desk)
    do(desk, motion_jobs.enable(0, "pv"))
    do(desk, lambda drives: drives.write(cia402.TARGET_VELOCITY, 300_000))
    do(desk, tune_jobs.set_gains(desk, 0, {VELOCITY_P: 700}, "velocity P"))
    do(desk, lambda drives: drives.write("Profile acceleration", 123_456))
    assert load_snapshot(desk.before_file) == desk.before
    assert do(desk, tune_jobs.restore_before(desk)) >= 2
    assert all_parameters(desk) == before
    stand_still(desk)


def stand_still(desk):
    """Check that the axis is off and at rest, as the emulator has it."""
    speed, live = do(desk, lambda drives: (
        abs(float(drives.machine.rotor_speed[0])), cia402.is_live(int(drives.read(cia402.STATUSWORD)[0])),
    ))  # fmt: skip
    assert not live
    assert speed < 0.5  # rad/s


# --- steps --------------------------------------------------------------------------------------------------------
def test_a_velocity_step_is_recorded_and_the_axis_is_off_and_back(desk):
    start = int(do(desk, lambda drives: drives.read(cia402.POSITION_ACTUAL))[0])
    step = do(desk, tune_jobs.record_velocity_step(desk, 0, 300.0, 0.1), paced=False)
    assert (step.unit, step.gains) == ("rpm", gains_of(desk))
    assert step.demand.max() == pytest.approx(300.0, rel=0.01)
    assert np.median(step.actual[(step.t > 0.05) & (step.t < 0.1)]) == pytest.approx(300.0, rel=0.05)
    assert step.t[np.argmax(step.demand > 0)] == pytest.approx(0.0, abs=2e-3)
    assert "rise" in step.figures and "ms" in step.figures
    assert np.abs(step.current).max() > 0.1
    end = int(do(desk, lambda drives: drives.read(cia402.POSITION_ACTUAL))[0])
    assert abs(end - start) < 0.1 * 65536  # of the half turn that it made each way
    stand_still(desk)


def test_a_move_is_recorded_and_goes_back(desk):
    step = do(desk, tune_jobs.record_move(desk, 0, 0.5), paced=False)
    assert step.kind == "position"
    assert step.actual[-1] == pytest.approx(step.demand[-1], rel=0.01)
    assert step.demand[-1] in (pytest.approx(0.5, rel=0.01), pytest.approx(180.0, rel=0.01))
    assert abs(int(do(desk, lambda drives: drives.read(cia402.POSITION_ACTUAL))[0])) < 700
    stand_still(desk)


def test_an_axis_that_was_enabled_stays_so_in_its_mode(desk):
    do(desk, motion_jobs.enable(0, "pp"))
    do(desk, tune_jobs.record_velocity_step(desk, 0, 200.0, 0.05), paced=False)
    mode, status = do(desk, lambda drives: (drives.read(cia402.MODE)[0], drives.read(cia402.STATUSWORD)[0]))
    assert mode == cia402.MODES["pp"]
    assert cia402.matches(int(status), cia402.OPERATION_ENABLED)


def test_a_step_beyond_the_travel_is_refused_before_anything_moves(desk):
    desk.entries.travel = "-0.1:0.2"
    with pytest.raises(ValueError, match=r"takes 0.5 turns, and there are 0.2"):
        do(desk, tune_jobs.record_velocity_step(desk, 0, 300.0, 0.1))
    stand_still(desk)


def recording(number, kind="velocity"):
    row = np.linspace(0.0, 1.0, 50)
    return StepRecording(0, kind, (number,), "rpm", row, row, row, row, "figures", at=float(number))


def test_the_last_step_with_the_gains_before_stays_as_the_reference(desk):
    desk.steps.extend(replace(recording(k), gains=(1 if k < 2 else 2,)) for k in range(12))
    shown = desk.last_steps(0, "velocity")
    assert [step.at for step in shown] == [11, 1, 10, 9, 8, 7]
    assert step_card.reference_of(shown).at == 1
    lines = {one["name"]: one["lineStyle"] for one in step_card.step_chart(shown)["series"]}
    assert [lines[step.name]["opacity"] for step in shown] == [1.0, 1.0, 0.45, 0.45, 0.45, 0.45]
    assert [lines[step.name]["type"] for step in shown[:2]] == ["solid", [8, 4]]


@pytest.mark.parametrize("reason", ["", "its loops are too near to instability"])
def test_moves_that_auto_measured_are_among_the_steps(desk, tmp_path, reason):
    """A move of half a turn; where its gains were rejected, those before are the newest."""
    t = np.arange(300) * 1e-3
    demand = np.minimum(t / 0.1, 1.0)[:, None] * np.pi
    shown = Shown(
        t, demand, 0.99 * demand, np.ones((300, 1)), np.array([True]), ("",), *np.zeros((4, 1))
    )  # fmt: skip
    axis = AxisResult((1, 2, 3, 4, 5), (1, 2, 3, 4, 5) if reason else (6, 7, 8, 9, 10), reason)
    none = np.zeros(1)
    result = Result((axis,), none, none, none, none, shown, shown, None, {}, STANDARD, tmp_path, False)
    do(desk, tune_jobs.run_tuner(desk, TunerSession("auto", tmp_path), lambda *_: result), paced=False)
    steps = desk.last_steps(0, "position")
    assert [step.gains for step in steps] == ([axis.before, ()] if reason else [axis.after, axis.before])
    assert ("rejected gains" in steps[1].name) == bool(reason)
    assert {step.source for step in steps} == {"auto"}
    assert (steps[0].unit, float(steps[0].demand[-1])) in (("rev", pytest.approx(0.5)), ("°", pytest.approx(180.0)))
    assert steps[0].actual[-1] == pytest.approx(0.99 * steps[0].demand[-1])


def test_the_last_five_lie_under_the_newest(desk):
    desk.steps.extend(recording(k) for k in range(9))
    desk.steps.append(recording(99, "position"))
    shown = desk.last_steps(0, "velocity")
    assert [step.gains[0] for step in shown] == [8, 7, 6, 5, 4, 3]
    chart = step_card.step_chart(shown)
    series = [one for one in chart["series"] if one["yAxisIndex"] == 0]
    assert len(series) == 1 + LAST + 1  # the demand, and all of them
    assert len({str(one["lineStyle"]["type"]) + one["lineStyle"]["color"] for one in series}) == len(series)


# --- responses ----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_margins_follow_the_gains_after_a_response_and_the_slider_writes_nothing(desk):
    now = gains_of(desk)
    assert StiffnessSlider(panel_of(desk), None).designed.startswith("No response of the velocity loop yet")
    measured = do(desk, tune_jobs.measure_response(desk, 0, "velocity"), paced=False)
    faster = list(now)
    faster[VELOCITY_P] = round(1.5 * now[VELOCITY_P])
    sets = response_charts.loops_of(measured, 0, {"": faster, ", before": now})
    titles, rows = response_card.margin_rows(sets, STANDARD)
    assert titles == [
        "", "velocity loop, before", "velocity loop", "position loop, before", "position loop", "asked for",
    ]  # fmt: skip
    by_title = {title: values for title, *values in rows}
    assert by_title["Crossover"][0] == f"{measured.margins(0).crossover_hz:.1f} Hz"
    assert [float(text.split()[0]) for text in by_title["Crossover"][:2]] == [
        pytest.approx(18.7, abs=1.5), pytest.approx(29.0, abs=3.0),
    ]  # fmt: skip
    assert by_title["Phase margin"][-1] == "≥ 45.0°"
    assert len(response_charts.bode(sets)["yAxis"]) == len(response_charts.step(measured, 0, {"": now})["yAxis"]) == 2
    designed = StiffnessSlider(panel_of(desk), None).designed
    assert (np.diff([designed.at(place, now)[VELOCITY_P] for place in (0.0, 0.5, 1.0)]) > 0).all()
    stand_still(desk)
    assert gains_of(desk) == now
    assert not desk.changes


def panel_of(desk):
    return SimpleNamespace(desk=desk, axis=0)


def test_ends_of_one_part_have_no_gains_by_one_response(monkeypatch):
    target = SimpleNamespace(linked=True)
    assert "run auto" in tune_jobs._soft_to_stiff(None, target, None, 0)


def test_what_dynamics_forbid_has_a_cross(monkeypatch):
    """A loop 1 / (s (1 + s T)) whose crossover has 38 degrees of phase margin."""
    f = np.geomspace(1.0, 400.0, 2000)
    L = 100.0 / (2j * np.pi * f * (1.0 + 2j * np.pi * f / 70.0))
    sets = {"": Loops(f, L, 0.1 * L, np.ones(len(f), bool))}
    cells = {title: values for title, *values in response_card.margin_rows(sets, STANDARD)[1]}
    assert [text.startswith("✕") for text in cells["Phase margin"]] == [True, False, False]
    assert not any("✕" in text for text in cells["Crossover"])
    series = response_charts.nichols(sets, STANDARD)["series"]
    forbidden = np.array([point for one in series[:2] for point in one["data"]])
    assert (forbidden.min(axis=0), forbidden.max(axis=0)) == (
        pytest.approx([-225.0, -8.0], abs=0.1), pytest.approx([-135.0, 8.0], abs=0.1),
    )  # fmt: skip


def test_margins_that_were_not_measured_say_so():
    assert response_card.margin_text(float("nan"), 1, "°") == "not measured"
    assert response_card.margin_text(float("inf"), 1, "dB") == "infinite"
    assert response_card.margin_text(44.21, 1, "°") == "44.2°"


# --- where an emulated axis may go ---------------------------------------------------------------------------------
def test_the_ends_of_a_load_are_places():
    with EmulatedDrives(load="ball_screw", num_threads=1) as drives:
        there = of_machines(drives, drives)
        width = there.high - there.low
        drives.write("Modes of operation", cia402.MODES["pp"])
        from drive_env import motion

        motion.enable(drives, mode="pp")
        motion.move_to(drives, 5 * 65536)
        here = of_machines(drives, drives)
        assert here.high == pytest.approx(there.high - 10.0 * np.pi, abs=0.2)
        assert here.high - here.low == pytest.approx(width)


# --- tuners -------------------------------------------------------------------------------------------------------
def started(desk, folder, title="auto"):
    run = TunerSession(title, folder)
    return run, desk.session.do(tune_jobs.run_tuner(desk, run, tune_jobs.auto(False)), title, page="page", paced=False)


def wait(desk, condition, patience=300.0):
    end = time.monotonic() + patience
    while not condition():
        desk.session.presence.beat("page")
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.every(2)
@pytest.mark.parametrize(
    "when", ["identifying", pytest.param("designing gains on digital twins", marks=pytest.mark.slow)]
)
def test_auto_is_stopped_and_everything_is_as_before(desk, tmp_path, when):
    before = all_parameters(desk)
    run, future = started(desk, tmp_path / "auto")
    wait(desk, lambda: when in run.lines)
    time.sleep(0.3)
    begun = time.monotonic()
    desk.session.stop_now("a page")
    wait(desk, future.done, 30.0)
    assert time.monotonic() - begun < 10.0
    with pytest.raises(JobEndedError, match="stopped: a page"):
        future.result(0)
    assert run.is_over and "the gains from before are back" in run.failure
    assert all_parameters(desk) == before
    stand_still(desk)
    assert not (tmp_path / "auto" / "report.html").exists()


def test_auto_is_asked_for_the_dynamics_of_the_page(monkeypatch, tmp_path):
    asked = {}
    monkeypatch.setattr("tuning.auto_to_files.auto_to_files", lambda *_, **options: asked.update(options))
    target = SimpleNamespace(device=find_device("tmcm1636"))
    tune_jobs.auto(True, "soft")(target, TunerSession("auto", tmp_path), lambda what, share: None)
    assert asked == {"keep": True, "dynamics": "soft"}


@pytest.mark.slow
def test_auto_comes_to_its_certificate_and_is_undone(desk, tmp_path):
    before = gains_of(desk)
    run, future = started(desk, tmp_path / "auto")
    wait(desk, future.done)
    future.result(0)
    (verdict,) = run.verdicts
    assert verdict.verdict in ("accepted", "accepted with reservations")
    assert verdict.before == before
    assert gains_of(desk) == verdict.after != before
    assert [step.gains for step in desk.last_steps(0, "position")] == [verdict.after, before]
    designed = StiffnessSlider(panel_of(desk), None).designed  # without a press of Measure
    assert (np.diff([designed.at(place, before)[VELOCITY_P] for place in (0.0, 0.5, 1.0)]) > 0).all()
    assert {one.name for one in run.folder.iterdir()} == {"before.toml", "certificate.json", "report.html"}
    assert run.share == 1.0
    do(desk, tune_jobs.measure_response(desk, 0, "velocity"), paced=False)
    anew = StiffnessSlider(panel_of(desk), None).designed
    assert anew.gains[:, VELOCITY_P] == pytest.approx(designed.gains[:, VELOCITY_P], rel=0.1)
    do(desk, tune_jobs.undo(desk, 0))
    assert gains_of(desk) == before


@pytest.mark.slow
def test_a_stop_while_the_slider_is_designed_leaves_the_outcome_of_auto(desk, tmp_path, monkeypatch):
    measured = do(desk, tune_jobs.measure_response(desk, 0, "velocity"), paced=False)
    monkeypatch.setattr(tune_jobs, "_keep_measured", lambda *_: [0])
    monkeypatch.setattr(tune_jobs, "verdicts", lambda _: ("accepted",))
    desk.soft_to_stiff.clear()
    run = TunerSession("auto", tmp_path)
    future = desk.session.do(tune_jobs.run_tuner(desk, run, lambda *_: None), "auto", page="page", paced=False)
    wait(desk, lambda: 0 in desk.soft_to_stiff)
    assert run.is_over and run.verdicts
    desk.session.stop_now("a page")
    wait(desk, future.done, 10.0)
    with pytest.raises(JobEndedError):
        future.result(0)
    assert run.verdicts and not run.failure and not desk.soft_to_stiff
    assert desk.responses["velocity", 0] is measured


@pytest.mark.slow
def test_an_agent_tunes_trial_by_trial(desk, tmp_path):
    from agents.studio.agent_part import columns_of, work_of
    from agents.tuner.open_tuner import open_tuner

    policy = open_tuner("gain_tuning", "tmcm1636", 2)
    run = TunerSession("agent", tmp_path / "agent", columns=columns_of("tmcm1636"))
    job = tune_jobs.run_tuner(desk, run, work_of(policy, "gain_tuning", False))
    future = desk.session.do(job, "agent", page="page", paced=False)
    wait(desk, future.done)
    future.result(0)
    assert [row[0] for row in run.trials] == ["rule", "1", "2"]
    assert all(len(row) == len(run.columns) for row in run.trials)
    assert (run.folder / "report.html").exists()
    assert run.verdicts[0].verdict in ("accepted", "accepted with reservations", "rejected")


@pytest.mark.slow
def test_rules_are_side_by_side_once_an_axis_is_identified(desk):
    from tuning.rules.rules_by_name import RULES
    from tuning.studio.rules_card import identified_rows

    before = gains_of(desk)
    do(desk, tune_jobs.identify_axes(desk), paced=False)
    assert list(desk.rules[0].rows) == list(RULES)
    rows = {title: (value, why) for title, value, why in identified_rows(desk.identified[0])}
    assert rows["total inertia"][0].endswith("kg*m^2")
    assert all(why for _, why in rows.values())
    assert gains_of(desk) == before
    gains = desk.rules[0].rows["simc"].gains
    do(desk, tune_jobs.set_gains(desk, 0, dict(enumerate(gains)), "simc"))
    assert gains_of(desk) == gains


# --- drives of a bus ----------------------------------------------------------------------------------------------
@pytest.fixture
def bus_desk(tmp_path, monkeypatch):
    """A desk on a node that is served, whose time waits for SYNCs; and the emulated drives behind it."""
    from drive_env.bus.hub import Hub
    from drive_env.bus.server import Server
    from drive_env.bus.world import World
    from drive_env.master.open_drives import open_drives

    monkeypatch.chdir(tmp_path)
    with EmulatedDrives(load="inertia", num_threads=1) as emulated:
        emulated.advance(0.001)  # compiled before anybody waits for an answer
        world, hub = World(), Hub()
        world.add(emulated, [1])
        address = {"interface": "slcan", "channel": hub.channel, "nodes": [1], "pace": "lockstep"}
        with Server(world, hub):
            made = Session(
                lambda: open_drives("tmcm1636", **address, timeout=30.0), "a node", describe("tmcm1636", None), address
            )
            made.presence.beat("page")
            made.start()
            until(lambda: made.state != "opening", 60.0)
            assert made.state == "open", made.failure
            yield TuneDesk(made), emulated
            made.close()
        world.close()


def test_without_its_travel_nothing_moves_on_a_bus(bus_desk):
    desk, emulated = bus_desk
    with pytest.raises(ValueError, match="the travel is missing"):
        do(desk, tune_jobs.record_velocity_step(desk, 0, 300.0, 0.1))
    assert float(emulated.machine.rotor_speed[0]) == 0.0


def test_a_step_on_a_bus_and_the_envelope_afterwards(bus_desk):
    desk, emulated = bus_desk
    desk.entries.travel = "-2:2"
    limits = do(desk, lambda drives: drives.safety.limits)
    before = tuple(map(int, read_gains(emulated)[0]))
    do(desk, tune_jobs.set_gains(desk, 0, {VELOCITY_P: 700}, "velocity P"))
    assert read_gains(emulated)[0, VELOCITY_P] == 700
    step = do(desk, tune_jobs.record_velocity_step(desk, 0, 300.0, 0.1), paced=False)
    assert np.median(step.actual[(step.t > 0.05) & (step.t < 0.1)]) == pytest.approx(300.0, rel=0.05)
    assert do(desk, lambda drives: drives.safety.limits) == limits
    assert desk.before.bus["channel"] == desk.session.address["channel"]
    do(desk, tune_jobs.undo(desk, 0))
    assert tuple(map(int, read_gains(emulated)[0])) == before


@pytest.mark.slow
def test_auto_on_a_bus_comes_to_its_certificate_and_the_way_back_is_a_file(bus_desk, tmp_path):
    desk, emulated = bus_desk
    desk.entries.travel = "free"
    before = tuple(map(int, read_gains(emulated)[0]))
    run, future = started(desk, tmp_path / "auto")
    wait(desk, future.done)
    future.result(0)
    (verdict,) = run.verdicts
    assert verdict.verdict in ("accepted", "accepted with reservations"), verdict.reason
    assert tuple(map(int, read_gains(emulated)[0])) == verdict.after != before
    assert load_snapshot(tmp_path / "auto" / "before.toml").bus["nodes"] == [1]
    do(desk, tune_jobs.restore_before(desk))
    assert tuple(map(int, read_gains(emulated)[0])) == before
    assert float(emulated.machine.rotor_speed[0]) == pytest.approx(0.0, abs=0.5)


def test_auto_on_a_bus_is_stopped_and_the_gains_are_back(bus_desk, tmp_path):
    desk, emulated = bus_desk
    desk.entries.travel = "free"
    before = tuple(map(int, read_gains(emulated)[0]))
    run, future = started(desk, tmp_path / "auto")
    wait(desk, lambda: abs(float(emulated.machine.rotor_speed[0])) > 5.0)
    desk.session.stop_now("a page")
    wait(desk, future.done, 30.0)
    assert run.is_over and "the gains from before are back" in run.failure
    assert tuple(map(int, read_gains(emulated)[0])) == before
    wait(desk, lambda: abs(float(emulated.machine.rotor_speed[0])) < 0.5, 5.0)
    assert not cia402.is_live(int(emulated.read(cia402.STATUSWORD)[0]))
