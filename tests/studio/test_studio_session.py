"""The session behind the studio: jobs, stops at once, what a page has set in motion, what is sampled."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from rigs.session_rig import Beats, opened, until
from rigs.small_eds import FOLDER
from rigs.world_bus import bus_of

from drive_env import CanDrives, EmulatedDrives, SafetyError, cia402, motion
from drive_env.cia402 import State
from drive_env.devices.new_device import new_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.dictionary.roles import Role
from drive_env.drives.limit_at_rest import SHARE
from drive_env.fieldbus.description import describe
from drive_env.fieldbus.errors import BusError
from drive_env.master.parameters import read_parameters
from drive_env.master.single_axes import SingleAxes
from drive_env.motors import find_motor
from drive_env.studio import dictionary_jobs, motion_jobs, presence
from drive_env.studio.errors import JobEndedError
from drive_env.studio.presence import Presence
from drive_env.studio.sentences import sentence
from drive_env.studio.session import Session

FIRST = np.array([True])


@pytest.fixture
def session():
    with opened("inertia") as made:
        yield made


def state_of(session):
    return cia402.state_of(int(session.do(lambda drives: drives.read(cia402.STATUSWORD)[0], "look").result(10)))


def speed_of(session):
    return abs(int(session.do(lambda drives: drives.read(cia402.VELOCITY_ACTUAL)[0], "look").result(10)))


def jogs(session, page="page", speed="300 rpm"):
    """Have a page hold a jog; return its number once the axis turns."""
    session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
    number = session.presence.begin(page, FIRST, held=True).number
    session.do(motion_jobs.turn(session, 0, speed, number), "jog").result(10)
    return number


# --- jobs ---------------------------------------------------------------------------------------------------------
def test_a_job_returns_what_its_function_returns(session):
    assert session.do(lambda drives: drives.num_axes, "count").result(10) == 1


def test_jobs_run_one_after_the_other(session):
    order = []
    futures = [session.do(lambda drives, k=k: order.append(k), "note") for k in range(5)]
    [future.result(10) for future in futures]
    assert order == list(range(5))


def test_an_error_reaches_whoever_asked_and_the_session_goes_on(session):
    with pytest.raises(ObjectAccessError):
        session.do(lambda drives: drives.read(0x5FFE), "read").result(10)
    assert session.do(lambda drives: drives.num_axes, "count").result(10) == 1


def test_time_of_an_emulated_machine_passes_as_fast_as_ours(session):
    before, begun = session.recorder.now, time.monotonic()
    time.sleep(0.5)
    passed, ours = session.recorder.now - before, time.monotonic() - begun
    assert 0.3 * ours < passed < ours + 0.1  # on a busy computer less: what is late is not made up for


def test_a_job_in_a_hurry_is_not_paced(session):
    begun = time.monotonic()
    session.do(lambda drives: drives.advance(5.0), "five seconds", paced=False).result(30)
    assert time.monotonic() - begun < 4.0


def test_after_the_end_a_job_says_that_the_studio_is_closed(session):
    session.close()
    with pytest.raises(RuntimeError, match="closed"):
        session.do(lambda drives: None, "late").result(10)


def test_drives_that_cannot_be_opened_are_told():
    def fails():
        raise ValueError("there is no such bus; plug it in")

    made = Session(fails, "nothing", describe("tmcm1636", None))
    made.start()
    until(lambda: made.state == "failed")
    assert made.failure == "there is no such bus; plug it in"
    with pytest.raises(RuntimeError, match="plug it in"):
        made.do(lambda drives: None, "late").result(10)


def test_a_job_that_its_page_has_given_up_is_not_begun_and_harms_nobody(session):
    begun = []
    first = session.do(lambda drives: drives.advance(0.3), "long")
    second = session.do(lambda drives: begun.append(1), "given up")
    third = session.do(lambda drives: drives.advance(60.0), "stopped before it begins")
    assert second.cancel() and third.cancel()
    first.result(10)
    session.stop_now("the test")
    assert session.do(lambda drives: drives.num_axes, "count").result(10) == 1
    assert begun == []


# --- what a job does is sampled -----------------------------------------------------------------------------------
def test_a_move_and_a_recording_of_a_job_are_seen_by_the_scope(session):
    with Beats(session):
        session.do(motion_jobs.enable(0, "pp"), "enable").result(10)
        before = session.recorder.ring.total
        session.do(motion_jobs.move(session, 0, "2 rev", "600 rpm", relative=True), "move").result(10)
        rows = session.recorder.ring.read(before, session.recorder.ring.total)
        assert np.ptp(rows.values[cia402.POSITION_ACTUAL, 0]) > 1.9 * 65536
        assert np.allclose(np.diff(rows.t), 0.001)


def test_a_recording_in_pieces_is_the_recording(session):
    """What a job records, and plays, is what it gets without a studio."""
    rows = np.repeat([0, 100_000, 0], [30, 70, 30])

    def job(drives):
        motion.enable(drives, mode="pv")
        return drives.record(["Velocity actual value"], 0.13, play={"Target velocity": rows})

    with EmulatedDrives(load="inertia", num_threads=1) as alone:
        alone.advance(session.recorder.now)
        with Beats(session):
            got = session.do(lambda drives: (drives.machine.reset(), job(drives))[1], "record").result(10)
        alone.machine.reset()
        wanted = job(alone)
    assert len(got) == len(wanted) == 130
    assert np.allclose(got.t, wanted.t)
    assert np.array_equal(got["Velocity actual value"], wanted["Velocity actual value"])


def test_other_objects_can_be_sampled(session):
    session.sample("page", [(0x6062, 0)])
    until(lambda: (0x6062, 0) in session.recorder.ring.keys)
    session.forget_samples("page")
    until(lambda: (0x6062, 0) not in session.recorder.ring.keys)


# --- stops --------------------------------------------------------------------------------------------------------
def test_quick_stop_does_not_wait_for_a_long_job(session):
    """The job computes and calls no drives: the command is given all the same."""
    with Beats(session):
        session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
        begun, goes_on = threading.Event(), threading.Event()

        def job(drives):
            drives.write(cia402.TARGET_VELOCITY, 300_000)
            drives.advance(0.2)
            begun.set()
            goes_on.wait(10)
            drives.advance(1.0)

        future = session.do(job, "long")
        begun.wait(10)
        session.stop_now("the test")
        drives = session._real  # the truth: no job could tell it now
        assert not cia402.matches(int(drives.read(cia402.STATUSWORD)[0]), cia402.OPERATION_ENABLED)
        goes_on.set()
        with pytest.raises(JobEndedError, match="stopped: the test"):
            future.result(10)
        until(lambda: speed_of(session) == 0)


def test_a_job_that_is_stopped_can_put_back_what_it_changed(session):
    def job(drives):
        before = int(drives.read("Profile velocity")[0])
        drives.write("Profile velocity", 1234)
        try:
            drives.advance(60.0)
        finally:
            drives.write("Profile velocity", before)

    before = int(session.do(lambda drives: drives.read("Profile velocity")[0], "read").result(10))
    future = session.do(job, "changes a value")
    until(lambda: session.job is not None and session.job.title == "changes a value")
    time.sleep(0.1)
    session.stop_now("the test")
    with pytest.raises(JobEndedError):
        future.result(10)
    assert int(session.do(lambda drives: drives.read("Profile velocity")[0], "read").result(10)) == before


def test_jobs_that_wait_are_not_begun_after_a_stop(session):
    first = session.do(lambda drives: drives.advance(60.0), "long")
    second = session.do(lambda drives: drives.num_axes, "waits")
    until(lambda: session.job is not None)
    session.stop_now("the test")
    for future in (first, second):
        with pytest.raises(JobEndedError):
            future.result(10)


# --- pages --------------------------------------------------------------------------------------------------------
def test_a_jog_lasts_as_long_as_its_page_holds_it(session):
    with Beats(session) as page:
        page.held = jogs(session)
        time.sleep(presence.HOLD + 0.1)
        assert speed_of(session) > 200_000
        session.presence.end(page.held)
        session.do(motion_jobs.end_turn(0), "release").result(10)
        until(lambda: speed_of(session) == 0)
        assert state_of(session) is State.OPERATION_ENABLED


def test_a_drive_of_vl_without_a_position_turns_and_is_stopped_as_the_others(tmp_path):
    inverter = new_device(FOLDER / "inverters" / "granit_fu3.eds", tmp_path / "granit", find_motor("qbl4208"))
    with opened("inertia", str(inverter.folder)) as session:

        def speed():
            return abs(int(session.do(lambda drives: drives.read(cia402.VL_VELOCITY_ACTUAL)[0], "look").result(10)))

        session.do(motion_jobs.enable(0, "vl"), "enable").result(10)
        with Beats(session) as page:
            page.held = session.presence.begin("page", FIRST, held=True).number
            session.do(motion_jobs.turn(session, 0, "300 rpm", page.held), "jog").result(10)
            until(lambda: speed() > 250)
            until(lambda: session.axes[0].motion[0].unit == "rpm" and session.axes[0].motion[0].value > 250)
            session.presence.end(page.held)
            session.do(motion_jobs.end_turn(0), "release").result(10)
            until(lambda: speed() < 5)
            assert state_of(session) is State.OPERATION_ENABLED
            page.held = session.presence.begin("page", FIRST, held=True).number
            session.do(motion_jobs.turn(session, 0, "-300 rpm", page.held), "jog").result(10)
            until(lambda: speed() > 250)
            session.do(motion_jobs.disable(0), "disable").result(10)
            assert speed() < 15, "braked: without its voltage it would coast"
            session.do(motion_jobs.enable(0, "vl"), "enable").result(10)
            page.held = session.presence.begin("page", FIRST, held=True).number
            session.do(motion_jobs.turn(session, 0, "300 rpm", page.held), "jog").result(10)
            until(lambda: speed() > 250)
        until(lambda: speed() < 15, presence.HOLD + 2.0)
        assert state_of(session) is not State.OPERATION_ENABLED
        assert any("silent" in event.text for event in session.events)


def test_a_page_that_is_silent_stops_its_jog(session):
    with Beats(session) as page:
        page.held = jogs(session)
        time.sleep(0.3)
        assert speed_of(session) > 200_000
    until(lambda: speed_of(session) == 0, presence.HOLD + 0.4)
    assert state_of(session) is not State.OPERATION_ENABLED
    assert any("silent" in event.text for event in session.events)


def test_a_page_that_holds_nothing_any_more_stops_its_jog(session):
    """Its release was lost; its beats tell it."""
    with Beats(session) as page:
        page.held = jogs(session)
        page.held = 0
        until(lambda: speed_of(session) == 0, presence.HOLD + 0.4)


def test_another_page_does_not_keep_a_jog_going(session):
    with Beats(session, "other"):
        jogs(session, "page")
        until(lambda: speed_of(session) == 0, presence.HOLD + 0.4)


def test_a_page_that_is_closed_stops_its_jog_at_once(session):
    with Beats(session, "other"), Beats(session) as page:
        page.held = jogs(session)
        session.presence.leave("page")
        time.sleep(0.2)
        assert speed_of(session) < 50_000


def test_a_target_lasts_as_long_as_its_page_is_there(session, monkeypatch):
    monkeypatch.setattr(presence, "ASLEEP", 0.2)
    with Beats(session, "other"):
        with Beats(session):
            session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
            session.presence.begin("page", FIRST, held=False)
            session.do(lambda drives: drives.write(cia402.TARGET_VELOCITY, 300_000), "turn").result(10)
            time.sleep(0.3)
            assert speed_of(session) > 200_000
        until(lambda: speed_of(session) == 0, 1.3)


# --- jobs belong to their page ------------------------------------------------------------------------------------
def moves_far(session):
    return motion_jobs.move(session, 0, "900 rev", "300 rpm", relative=True)


def homes(session):
    """To a switch that is 35 revolutions away."""

    def job(drives):
        drives.write(0x6098, 17)
        drives.write((0x6099, 1), 300_000)
        drives.write((0x6099, 2), 30_000)
        drives.write(0x609A, 3_000_000)
        motion_jobs.home(0, 0)(drives)

    return job


def plays_for_long(session):
    """As a step that is recorded, or a tuner's experiment."""

    def job(drives):
        drives.write(cia402.TARGET_VELOCITY, 0)
        motion.enable(drives, mode="csv")
        drives.record([cia402.VELOCITY_ACTUAL], 60.0, play={cia402.TARGET_VELOCITY: np.full(60_000, 300_000)})

    return job


def turns_and_waits(session):
    """Another package's page that knows nothing of all this."""

    def job(drives):
        motion.enable(drives, mode="pv")
        drives.write(cia402.TARGET_VELOCITY, 300_000)
        drives.advance(60.0)

    return job


JOBS = [(moves_far, "inertia"), (homes, "belt"), (plays_for_long, "inertia"), (turns_and_waits, "inertia")]


def truly(session):
    """Return the speed of the machine itself [rad/s]."""
    return abs(float(session.glimpse(lambda machine: machine.rotor_speed[0], 10.0)))


@pytest.mark.every(5)
@pytest.mark.parametrize("way", ["closed", "silent"])
@pytest.mark.parametrize(("made", "load"), JOBS)
def test_a_job_that_moves_ends_with_its_page_though_another_one_is_there(made, load, way):
    with opened(load) as session, Beats(session, "other"):
        with Beats(session):
            session.do(motion_jobs.enable(0, "pp"), "enable").result(10)
            future = session.do(made(session), "a job that moves", page="page")
            until(lambda: truly(session) > 15.0 or future.done())
            assert not future.done(), future.exception()
        if way == "closed":
            session.presence.leave("page")
        with pytest.raises(JobEndedError, match=f"stopped: its page was {way}"):
            future.result(10)
        until(lambda: truly(session) < 0.1, 3.0)
        assert state_of(session) is not State.OPERATION_ENABLED
        assert any(f"a job that moves: its page was {way}" in event.text for event in session.events)


def test_a_job_of_a_page_that_is_gone_moves_nothing(session):
    """It waited for another one, and its page was closed meanwhile."""
    with Beats(session, "other"):
        session.do(motion_jobs.enable(0, "pp"), "enable").result(10)
        session.presence.leave("page")
        first = session.do(lambda drives: drives.advance(0.3), "another page's", page="other")
        second = session.do(moves_far(session), "waits", page="page")
        first.result(10)
        with pytest.raises(JobEndedError, match="its page was closed"):
            second.result(10)
        assert truly(session) < 0.1


def test_a_page_that_is_closed_ends_no_job_that_only_reads_and_stops_no_jog_of_another(session):
    with Beats(session, "other") as other:
        other.held = jogs(session, "other")
        until(lambda: truly(session) > 20.0)
        reads = session.do(lambda drives: drives.advance(0.5) or drives.num_axes, "reads", page="closed already")
        assert reads.result(10) == 1
        assert truly(session) > 20.0


def test_a_page_that_is_closed_does_not_keep_its_axis_from_being_disabled(session):
    with Beats(session, "other"):
        session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
        session.do(motion_jobs.disable(0), "disable", page="closed already").result(10)
        assert state_of(session) is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize("error", [ValueError("not this"), TimeoutError("not reached")])
def test_a_job_that_fails_leaves_nothing_in_motion(session, error):
    """A move that was not there within 600 s had failed, and moved on."""

    def job(drives):
        motion.enable(drives, mode="pv")
        drives.write(cia402.TARGET_VELOCITY, 300_000)
        drives.advance(0.3)
        raise error

    with Beats(session):
        with pytest.raises(type(error)):
            session.do(job, "fails", page="page").result(10)
        until(lambda: truly(session) < 0.1, 3.0)


def test_a_job_that_fails_before_it_moves_stops_nothing(session):
    with Beats(session):
        session.do(motion_jobs.enable(0, "pp"), "enable").result(10)
        with pytest.raises(ValueError, match="parsecs"):
            session.do(motion_jobs.move(session, 0, "900 parsecs", "", relative=True), "move", page="page").result(10)
        assert state_of(session) is State.OPERATION_ENABLED


@pytest.mark.slow
def test_a_jog_whose_page_is_silent_ends_though_a_job_waits_in_a_call(session):
    """Nothing looks after the pages in the drives' thread meanwhile."""
    with Beats(session, "other"):
        jogs(session, "page")
        goes_on = threading.Event()
        hung = session.do(lambda drives: goes_on.wait(20), "hangs", page="other")
        drives = session._real  # the truth: no job could tell it now
        enabled = cia402.OPERATION_ENABLED
        until(lambda: not cia402.matches(int(drives.read(cia402.STATUSWORD)[0]), enabled), 5.0)
        assert not hung.done()
        goes_on.set()
        with pytest.raises(JobEndedError):
            session.do(lambda drives: drives.advance(1.0), "after").result(10)
            raise JobEndedError


def test_a_transition_that_enables_moves_to_no_target_of_before(session):
    with Beats(session):
        session.do(motion_jobs.select_mode(0, "pv"), "mode").result(10)
        session.do(lambda drives: drives.write(cia402.TARGET_VELOCITY, 300_000), "a target").result(10)
        for word in cia402.ENABLING:
            session.do(motion_jobs.command(0, word), "transition").result(10)
            time.sleep(0.05)
        time.sleep(0.3)
        assert state_of(session) is State.OPERATION_ENABLED
        assert speed_of(session) == 0


def test_a_release_that_overtakes_its_jog_wins(session):
    with Beats(session):
        session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
        number = session.presence.begin("page", FIRST, held=True).number
        session.presence.end(number)
        session.do(motion_jobs.turn(session, 0, "300 rpm", number), "jog").result(10)
        time.sleep(0.2)
        assert speed_of(session) == 0


def test_without_any_page_an_axis_is_stopped_and_disabled(session, monkeypatch):
    session.presence.beat("page")
    monkeypatch.setattr(presence, "ABANDONED", 0.4)
    with Beats(session):
        session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
        session.do(lambda drives: drives.write(cia402.TARGET_VELOCITY, 300_000), "turn").result(10)
        time.sleep(0.6)
        assert speed_of(session) > 200_000
    until(lambda: any("last page" in event.text for event in session.events))
    session.presence.beat("page")
    until(lambda: state_of(session) is State.SWITCH_ON_DISABLED)
    assert speed_of(session) == 0
    assert sum("last page" in event.text for event in session.events) == 1


def test_axes_that_could_not_be_stopped_are_not_told_as_stopped(session, monkeypatch):
    def silent(*_):
        raise BusError("node 1 does not answer")

    with Beats(session):
        session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
        monkeypatch.setattr("drive_env.studio.session._stop_live", silent)
    monkeypatch.setattr(presence, "ABANDONED", 0.2)
    until(lambda: any("node 1 does not answer" in event.text for event in session.events))
    assert not any("were stopped" in event.text for event in session.events)
    monkeypatch.undo()


def test_presence_counts_pages_and_their_motions():
    known = Presence()
    known.beat("a")
    known.beat("b")
    assert known.pages() == 2
    one = known.begin("a", FIRST, held=False)
    assert known.moves() and known.is_on(one.number)
    known.leave("a")
    assert known.pages() == 1
    assert [motion.why for motion in known.take_overdue()] == ["its page was closed"]
    assert not known.moves()


def test_values_are_shown_in_the_units_that_were_chosen(session):
    with Beats(session):
        session.do(lambda drives: drives.machine.place(0, np.pi), "turn").result(10)
        until(lambda: session.axes[0].motion and abs(session.axes[0].motion[0].value - 0.5) < 0.01)
        session.workspace.show_in("angle", "deg")
        until(lambda: session.axes[0].motion[0].unit == "deg")
        assert session.axes[0].motion[0].value == pytest.approx(180.0, abs=3.0)


# --- texts --------------------------------------------------------------------------------------------------------
def test_errors_are_sentences_for_people():
    error = RuntimeError("axis 0 is in fault while waiting for target reached; see emergencies(), then reset_fault()")
    assert sentence(error).endswith("see the faults on the page Axes, then reset them")


def test_a_mistake_of_the_program_says_so(caplog):
    assert "please report it" in sentence(KeyError("x"))
    assert caplog.records


@pytest.mark.parametrize(("speed", "direction", "text"), [
    ("60 rpm", 1, "60 rpm"), ("60 rpm", -1, "-60 rpm"), ("-60 rpm", -1, "60 rpm"), ("+1 rev/s", -1, "-1 rev/s"),
])  # fmt: skip
def test_a_jog_backwards_turns_the_speed_round(speed, direction, text):
    assert motion_jobs.turned_round(speed, direction) == text


def test_faults_have_cause_and_remedy(session):
    with Beats(session):
        session.do(motion_jobs.enable(0, "pv"), "enable").result(10)
        session.do(lambda drives: setattr(drives.machine, "supply", 3.0), "the supply sinks").result(10)
        until(lambda: session.axes[0].is_in_fault)
        until(lambda: session.axes[0].faults)
        fault = session.axes[0].faults[-1]
        assert fault.text.name == "undervoltage"
        assert len(fault.text.cause) > 10 and len(fault.text.remedy) > 10


def test_a_current_at_its_limit_at_rest_is_told(session):
    """An encoder that stands still: 7 A, "target reached", no fault."""

    def jam(drives):
        drives.write(0x6065, 0x7FFFFFFF)
        motion.enable(drives, mode="pp")
        drives.machine.fault("encoder_stuck")
        motion.start_move(drives, 65_536, relative=True)

    with Beats(session):
        session.do(jam, "jam", page="page").result(20)
        until(lambda: session.axes[0].is_at_limit, 20.0)
        limit = int(session.do(lambda drives: drives.read(Role.CURRENT_LIMIT)[0], "read").result(10))
        assert abs(float(session.axes[0].motion[-1].value)) > 0.95e-3 * limit
        assert session.axes[0].current_share >= SHARE
        assert any("its current is at its limit" in event.text for event in session.events)
        session.do(motion_jobs.disable(0), "disable").result(20)
        until(lambda: not session.axes[0].is_at_limit and session.axes[0].current_share < 0.2)


def test_a_bus_in_use_has_its_own_process_data_in_backups_and_takes_others():
    """What the studio maps and watches by is its own: a backup has none of it, and a restore leaves it able to see."""
    with EmulatedDrives(load="inertia", num_threads=1) as emulated, bus_of(emulated, (5,), stay=True) as bus:
        lent = {"bus": bus, "nodes": (5,), "pace": "lockstep"}
        known = describe("tmcm1636", None)
        with CanDrives(safety=False, **lent) as drives:
            own = read_parameters(drives)
            text = dictionary_jobs.backup(known, 0)(drives)
        with serving(Session(lambda: CanDrives(**lent), "a drive", known)) as made:
            assert made.stored[0] == own
            made.do(motion_jobs.enable(0, "pp"), "enable").result(20)
            mapped = known.dictionary.find((0x1A00, 1))
            with pytest.raises(SafetyError, match="while an axis is enabled; nothing was sent"):
                made.do(dictionary_jobs.write(mapped, own[0x1A00, 1], 0), "write").result(20)
            made.do(motion_jobs.disable(0), "disable").result(20)
            assert made.do(lambda drives: read_parameters(SingleAxes(drives, known)), "read").result(20) == own
            kind = known.dictionary.find((0x1801, 2))
            assert made.do(dictionary_jobs.write(kind, 254, 0), "write").result(20) == 254
            job = dictionary_jobs.restore(known, text.encode(), "b.toml", 0, unchecked=False, other_drive=False)
            assert [change.entry for change in made.do(job, "restore").result(20)] == [kind]
            assert made.do(dictionary_jobs.write(kind, 254, 0), "write").result(20) == 254
            made.do(motion_jobs.enable(0, "pp"), "enable").result(20)
            made.do(motion_jobs.move(made, 0, "1 rev", "600 rpm", relative=True), "move").result(20)
            seen = int(made.recorder.newest()[cia402.POSITION_ACTUAL, 0][0])
            assert seen == pytest.approx(65536, abs=1000)
            assert int(emulated.read(cia402.POSITION_ACTUAL)[0]) == pytest.approx(65536, abs=1000)
            assert not made.events
        with CanDrives(safety=False, **lent) as drives:
            assert read_parameters(drives) == own | {(0x1801, 2): 254}


def test_what_a_module_has_stored_is_that_of_all_its_axes():
    emulated = EmulatedDrives("tmcm6212", num_machines=6, load="inertia", num_threads=1)
    with emulated, bus_of(emulated, (5,), stay=True) as bus:
        open_drives = lambda: CanDrives("tmcm6212", bus=bus, nodes=(5,), pace="lockstep")  # noqa: E731
        with serving(Session(open_drives, "a module", describe("tmcm6212", None))) as made:
            own = made.stored[3][cia402.PROFILE_VELOCITY, 0]
            made.do(lambda drives: drives.write(cia402.PROFILE_VELOCITY, own + 7), "write").result(20)
            assert made.stored[3][cia402.PROFILE_VELOCITY, 0] == own
            made.do(dictionary_jobs.store(1), "store").result(20)
            assert {one[cia402.PROFILE_VELOCITY, 0] for one in made.stored.values()} == {own + 7}


@contextmanager
def serving(made):
    """A session of drives of a bus, with a page."""
    made.presence.beat("page")
    made.start()
    try:
        until(lambda: made.state != "opening", 120.0)
        with Beats(made):
            yield made
    finally:
        made.close()


def test_a_backup_is_restored_where_a_machine_has_fewer_axes_than_its_device():
    known = describe("tmcm6212", None)
    made = Session(lambda: EmulatedDrives("tmcm6212", load="inertia", num_threads=1), "a stepper", known)
    made.start()
    until(lambda: made.state != "opening", 120.0)
    try:
        text = made.do(dictionary_jobs.backup(known, 0), "backup").result(20)
        entry = known.dictionary.find(cia402.PROFILE_VELOCITY)
        before = int(made.do(lambda drives: drives.read(cia402.PROFILE_VELOCITY)[0], "read").result(20))
        assert made.do(dictionary_jobs.write(entry, before + 1, 0), "write").result(20) == before + 1
        job = dictionary_jobs.restore(known, text.encode(), "backup.toml", 0, unchecked=False, other_drive=False)
        assert [change.entry.label for change in made.do(job, "restore").result(20)] == [entry.label]
        changed = dictionary_jobs.restore(
            known, text.replace("format", "# \nformat", 1).replace(f"= {before} ", f"= {before + 5} ").encode(),
            "changed.toml", 0, unchecked=False, other_drive=False,
        )  # fmt: skip
        with pytest.raises(ValueError, match="was changed since it was written"):
            made.do(changed, "restore").result(20)
    finally:
        made.close()
