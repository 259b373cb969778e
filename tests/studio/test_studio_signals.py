"""Test signals of the studio: what rotor, current and automaton do inside the emulator, and what is refused."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
from rigs.fault_injection import served
from rigs.namespaces import needs_namespaces, spaces, within  # noqa: F401
from rigs.session_rig import Beats, opened, until
from rigs.studio_rig import Tab, choose, chromium, needs_chromium, studio

from drive_env import EmulatedDrives, cia402
from drive_env.ethercat.coe_node import CoeNode
from drive_env.ethercat.ethercat_server import EtherCatServer
from drive_env.ethercat.slave import EtherCatSlave
from drive_env.ethercat.ways import RawSocket
from drive_env.ethercat.world import EtherCatWorld
from drive_env.fieldbus.description import describe
from drive_env.firmware.common import fsa
from drive_env.studio import motion_jobs, motion_signals
from drive_env.studio.errors import JobEndedError
from drive_env.studio.motion_signals import SIGNALS, SignalSettings, course, play_signal, signals_of
from drive_env.studio.session import Session

RPM, REV = 2.0 * np.pi / 60.0, 2.0 * np.pi
CYCLE = 0.001  # s
QUICK = {"held": 0.1, "cycles": 2, "low": 2.0, "high": 10.0, "lasts": 1.0}
# Of the object that is played: what a height does to the machine, and between which values.
PEAKS = {
    cia402.TARGET_POSITION: ("5 deg", "theta_m", 0.8 * 5.0 / 360.0 * REV, 1.4 * 5.0 / 360.0 * REV),
    cia402.TARGET_VELOCITY: ("100 rpm", "omega_m", 95.0 * RPM, 130.0 * RPM),
    cia402.TARGET_TORQUE: ("0.5 A", "i_q", 0.45, 0.75),
    cia402.TORQUE_OFFSET: ("0.5 A", "i_q", 0.0, 0.3),  # which this drive does not add
}


@pytest.fixture(scope="module")
def session():
    with opened("inertia") as made, Beats(made):
        yield made


@pytest.fixture
def truth(session, monkeypatch):
    """What the machine itself was after every few milliseconds of a signal, by the names of the drive's record."""
    rows = {name: [] for name in ("theta_m", "omega_m", "i_q", "fsa", "mode_display")}
    session.do(motion_jobs.enable(0, "pp"), "enable").result(10)
    until(lambda: abs(inside(session, "omega_m")) < 0.1)
    watched = motion_signals._watched

    def look(drives, *rest):
        for name, values in rows.items():
            values.append(float(session._real.inside.records[name].flat[0]))
        return watched(drives, *rest)

    monkeypatch.setattr(motion_signals, "_watched", look)
    return rows


def inside(session, name):
    return float(session._real.inside.records[name].flat[0])


def play(session, name, axis=0, **settings):
    wanted = SignalSettings(name, **{"height": PEAKS[SIGNALS[name].target][0], **QUICK, **settings})
    return session.do(play_signal(session, axis, wanted), name, page="page", paced=False).result(60)


# --- what is played -----------------------------------------------------------------------------------------------
@pytest.mark.every(3)
@pytest.mark.parametrize("name", SIGNALS)
def test_a_signal_does_what_its_row_says_and_leaves_mode_state_and_rest_as_before(session, truth, name):
    _, quantity, low, high = PEAKS[SIGNALS[name].target]
    told = play(session, name, travel="3 rev")
    seen = np.array(truth[quantity])
    assert low <= np.abs(seen - seen[0]).max() <= high
    assert {round(mode) for mode in truth["mode_display"][:-5]} <= {cia402.MODES[SIGNALS[name].mode], cia402.PV}
    assert ("take the torque pulse of the free axis" in told) == (name == "load_step")
    assert inside(session, "mode_display") == cia402.PP and inside(session, "fsa") == fsa.ENABLED
    assert abs(inside(session, "omega_m")) < 0.2
    if SIGNALS[name].target == cia402.TARGET_POSITION:
        assert abs(inside(session, "theta_m") - seen[0]) < 0.01 * REV


@pytest.mark.parametrize("before", ["csp", "csv", "pv", "cst"])
def test_an_axis_is_in_its_own_mode_again(session, truth, before):
    session.do(motion_jobs.select_mode(0, before), "mode").result(10)
    play(session, "position_step")
    assert inside(session, "mode_display") == cia402.MODES[before] and inside(session, "fsa") == fsa.ENABLED


@pytest.mark.parametrize("shape", ["square", "sweep"])
def test_a_speed_and_what_a_current_makes_of_it_bring_an_axis_back(shape):
    velocity = course(SignalSettings(f"velocity_{shape}", "", **QUICK), CYCLE)
    current = course(SignalSettings(f"current_{shape}", "", **QUICK), CYCLE)
    way, swing = np.cumsum(velocity), np.cumsum(current)
    assert np.abs(velocity).max() == pytest.approx(1.0, abs=0.02)
    assert abs(way[-1]) < 0.3 * np.ptp(way) and abs(swing[-1]) < 0.3 * np.ptp(swing)
    assert swing.min() < -0.2 * swing.max()  # both ways: it does not drift off
    assert velocity[0] == velocity[-1] == current[0] == 0.0


@pytest.mark.slow
def test_a_drive_that_adds_the_torque_offset_is_disturbed_while_it_holds_its_position():
    with opened("inertia", "tgz_s", "am3033_e") as session, Beats(session):
        session.do(motion_jobs.enable(0, "pp"), "enable").result(10)
        session.do(lambda drives: drives.write(cia402.TORQUE_OFFSET, 7), "offset").result(10)
        before, ring = inside(session, "theta_m"), session.recorder.ring
        first = ring.total
        assert play(session, "load_step", height="1 A", held=0.2) == ""
        place = ring.read(first, ring.total).values[cia402.POSITION_ACTUAL, 0][:, 0]
        assert np.ptp(place) > 0.02 * 2**20  # pushed away,
        assert abs(inside(session, "theta_m") - before) < 0.02 * REV  # and held
        assert int(session.do(lambda drives: drives.read(cia402.TORQUE_OFFSET)[0], "read").result(10)) == 7


# --- what is refused ----------------------------------------------------------------------------------------------
LIMITED = {
    "a way beyond the travel": ("position_step", {"height": "2 rev"}, r"0 to 2 rev, and -1 to 1 rev are allowed"),
    "a speed for so long": ("velocity_step", {"held": 1.0}, r"0 to 1.67 rev, and -1 to 1 rev are allowed"),
    "a speed": ("velocity_square", {"speed": "50 rpm"}, r"100 rpm are more than the 50 rpm"),
    "a frequency": ("position_sweep", {"speed": "50 rpm", "height": "90 deg"}, r"rpm are more than the 50 rpm"),
    "a current": ("current_step", {"height": "20 A"}, r"20 A are more than the current limit, \d.* A"),
    "a torque offset": ("load_step", {"height": "-20 A"}, r"-20 A are more than the current limit"),
    "a push for too long": ("current_step", {"held": 1.5}, r"held for 1.5 s: .* 1 s at most"),
    "a slow sweep of current": ("current_sweep", {"low": 0.2, "lasts": 8.0}, r"at least 0.5 Hz"),
    "too high a frequency": ("velocity_sweep", {"high": 400.0}, r"250 Hz at most"),
    "too long": ("velocity_sweep", {"lasts": 60.0}, r"takes 60 s, and 10 s are the most"),
    "no height": ("velocity_step", {"height": "0 rpm"}, r"does nothing; give one, e.g. 100 rpm"),
    "no time": ("velocity_step", {"held": 0.0}, r"give more than 0 of both"),
    "no travel": ("velocity_step", {"travel": "0 rev"}, r"a travel of 0 rev lets nothing move"),
    "no speed": ("velocity_step", {"speed": "0 rpm"}, r"lets nothing move"),
    "another unit": ("velocity_step", {"height": "1 A"}, r"is not a quantity in 'A'"),
}


@pytest.mark.every(4)
@pytest.mark.parametrize(("name", "settings", "message"), LIMITED.values(), ids=LIMITED)
def test_what_would_leave_a_limit_is_refused_and_moves_nothing(session, truth, name, settings, message):
    before = inside(session, "theta_m")
    with pytest.raises(ValueError, match=message):
        play(session, name, **settings)
    assert truth["theta_m"] == [] and abs(inside(session, "theta_m") - before) < 0.01
    assert inside(session, "mode_display") == cia402.PP and inside(session, "fsa") == fsa.ENABLED


@pytest.mark.parametrize(("objects", "settings", "message"), [
    ({(0x607D, 2): lambda here: here + 1000, (0x607D, 1): lambda here: here - 90_000}, {}, "to 0.0153 rev are allowed"),
    ({(0x6065, 0): lambda _: 800}, {}, "following error window"),
], ids=["607Dh", "6065h"])  # fmt: skip
def test_limits_of_the_drive_count(session, truth, objects, settings, message):
    def change(drives):
        here = int(drives.read(cia402.POSITION_ACTUAL)[0])
        own = {key: drives.read(key) for key in objects}
        for key, value in objects.items():
            drives.write(key, value(here))
        return own

    own = session.do(change, "limits").result(10)
    try:
        with pytest.raises(ValueError, match=message):
            play(session, "position_step", height="10 deg", **settings)
    finally:
        session.do(lambda drives: [drives.write(*one) for one in own.items()], "limits").result(10)
    assert truth["theta_m"] == []


def test_an_axis_that_is_off_or_turns_plays_nothing(session):
    session.do(motion_jobs.disable(0), "disable").result(10)
    with pytest.raises(RuntimeError, match="enable it first"):
        play(session, "velocity_step")
    session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
    session.do(lambda drives: drives.write(cia402.TARGET_VELOCITY, 100_000), "turn").result(10)
    until(lambda: inside(session, "omega_m") > 5.0)
    with pytest.raises(RuntimeError, match="turns already; bring it to rest first"):
        play(session, "velocity_step")
    session.do(motion_jobs.end_turn(0), "rest").result(10)


def test_a_drive_that_tells_no_position_or_has_no_cyclic_mode_has_no_signal():
    assert signals_of(("vl",), lambda key: True) == {}
    assert signals_of(("csv", "cst"), lambda key: key[0] != cia402.POSITION_ACTUAL) == {}
    assert list(signals_of(("csv",), lambda key: True)) == ["velocity_step", "velocity_square", "velocity_sweep"]


# --- what stops one -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("settings", "message"), [
    ({"travel": "1 rev"}, "its stop would end .* and -1 to 1 rev are allowed"),
    ({"travel": "50 rev", "speed": "300 rpm"}, "rpm, and 300 rpm are allowed"),
])  # fmt: skip
def test_a_free_axis_that_a_current_would_take_away_is_stopped(session, truth, settings, message):
    with pytest.raises(RuntimeError, match=message):
        play(session, "current_step", height="2 A", held=1.0, **settings)
    until(lambda: abs(inside(session, "omega_m")) < 0.1 and inside(session, "fsa") != fsa.ENABLED)
    assert abs(inside(session, "theta_m") - truth["theta_m"][0]) < 1.5 * REV


@pytest.mark.every(2)
@pytest.mark.parametrize("name", ["velocity_sweep", "load_step"])
def test_a_page_that_is_gone_ends_its_signal(session, truth, name):
    settings = SignalSettings(name, PEAKS[SIGNALS[name].target][0], lasts=9.0, held=1.0)
    session.presence.beat("another")
    future = session.do(play_signal(session, 0, settings), name, page="another")
    until(lambda: len(truth["theta_m"]) > 30 or future.done())
    assert not future.done(), future.exception()
    session.presence.leave("another")
    with pytest.raises(JobEndedError, match="its page was closed"):
        future.result(10)
    until(lambda: abs(inside(session, "omega_m")) < 0.1)
    assert inside(session, "fsa") != fsa.ENABLED and inside(session, "torque_offset") == 0.0


# --- on a bus -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_on_a_bus_the_envelope_holds_an_axis_to_its_room_and_has_its_limits_back():
    from drive_env import CanDrives

    with EmulatedDrives(load="inertia", num_threads=1) as emulated, served(emulated) as (world, channel):
        made = Session(lambda: CanDrives(channel=channel), "a bus", describe("tmcm1636", None))
        made.presence.beat("page")
        made.start()
        until(lambda: made.state != "opening", 60.0)
        assert made.state == "open", made.failure
        try:
            with Beats(made):
                limits = made._real.safety.limits
                made.do(motion_jobs.enable(0, "pp"), "enable").result(10)
                first = world.truth.cycles
                assert play(made, "velocity_square") == ""
                assert 95.0 * RPM < np.abs(world.truth.omega(first)).max() < 130.0 * RPM
                assert world.truth.is_on().all() and int(made.do(
                    lambda drives: drives.read(cia402.MODE_DISPLAY)[0], "mode").result(10)) == cia402.PP  # fmt: skip
                first = world.truth.cycles
                with pytest.raises(Exception, match=r"position|outside|limit"):
                    play(made, "current_step", height="2 A", held=1.0)
                until(lambda: world.truth.stands().all())
                assert np.ptp(world.truth.theta(first)) < 2.2 * REV  # the room, and what a torque mode may be outside
                assert made._real.safety.limits == limits
        finally:
            made.close()


@contextmanager
def looked_at(drives, quantity):
    """Yield the values that a quantity of axis 0 truly has, every few milliseconds while the block runs."""
    seen, over = [], threading.Event()

    def look():
        while not over.wait(0.002):
            seen.append(float(drives.inside.records[quantity].flat[0]))

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield seen
    finally:
        over.set()
        watcher.join()


def has_ended(drives, seen, low):
    """Whether a signal has had its effect, and the axis is enabled in its mode of before."""
    is_back = drives.read(cia402.MODE_DISPLAY)[0] == cia402.PP and drives.read(cia402.STATUSWORD)[0] & 0x6F == 0x27
    return bool(seen) and is_back and np.abs(np.array(seen) - seen[0]).max() > low


@needs_namespaces
@needs_chromium
@pytest.mark.slow
def test_on_ethercat_the_page_plays_signals_beside_the_scope(spaces):  # noqa: F811
    """A drive at one end of a cable, studio and browser at the other: what the rotor does is what the row says."""
    pytest.importorskip("pysoem", reason="pysoem is not installed: pip install -e '.[ethercat]'")
    drives = EmulatedDrives("tgz_s", "inertia", "am3033_e", num_threads=1)
    drives.advance(0.002)  # compiled before time counts
    drives.machine.reset()
    world = EtherCatWorld()
    world.add(EtherCatSlave(CoeNode(drives)), drives)
    with within(spaces.slave):
        way = RawSocket(spaces.slave_interface)
    bus = ("--device", "tgz_s", "--interface", "ethercat", "--channel", spaces.master_interface, "--timeout", "20")
    with EtherCatServer(world, way), within(spaces.master), studio(*bus) as made, chromium() as driver:
        tab = Tab(driver, made).open("/scope")
        for name in ("position_step", "position_sweep", "velocity_square", "current_square"):
            height, quantity, low, high = PEAKS[SIGNALS[name].target]
            choose(tab, "signal", SIGNALS[name].title)
            tab.type("signal-height", height)
            tab.type("signal-travel", "30 rev")
            tab.press("enable")
            tab.await_state("Operation enabled", 60.0)
            with looked_at(drives, quantity) as seen:
                tab.press("play-signal")
                until(partial(has_ended, drives, seen, low), 60.0)
            assert low <= np.abs(np.array(seen) - seen[0]).max() <= high, (name, tab.told())
        titles = driver.execute_script("return document.body.innerText")
        assert SIGNALS["load_step"].title not in titles, "no image of this drive has 60B2h"
        assert tab.errors() == [] and "Traceback" not in made.output
    world.close()


def test_a_signal_of_one_axis_of_a_portal_leaves_the_others_where_they_hold():
    with opened("portal") as session, Beats(session):
        session.do(motion_jobs.enable((0, 1, 2), "pp"), "enable").result(20)
        for axis in range(3):
            before = session._real.machine.rotor_angle
            first = session.recorder.ring.total
            assert play(session, "position_step", axis=axis) == ""
            place = session.recorder.ring.read(first, session.recorder.ring.total).values[cia402.POSITION_ACTUAL, 0]
            moved = np.ptp(place, axis=0) / 65536.0 * 360.0
            assert moved[axis] > 2.0 and np.delete(moved, axis).max() < 0.5, moved
            assert np.abs(session._real.machine.rotor_angle - before).max() < 0.01 * REV
