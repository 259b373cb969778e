"""Several axes commanded together: what their rotors and automata do inside the emulator."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.session_rig import Beats, opened, until

from drive_env import cia402
from drive_env.firmware.common import fsa
from drive_env.studio import motion_jobs
from drive_env.studio.errors import JobEndedError
from drive_env.studio.motion_jobs import masks_of

GROUP = [0, 1]
ALL = [0, 1, 2]
JOG = 300.0 * 2.0 * np.pi / 60.0  # rad/s


@pytest.fixture
def session():
    with opened("inertia", num_machines=3) as made, Beats(made, "other"):
        made.presence.beat("other")
        made.do(motion_jobs.enable(ALL, "pv"), "enable").result(10)
        yield made


def speeds(session):
    return np.abs(np.ravel(session.glimpse(lambda machine: machine.rotor_speed, 10.0)))


def enabled(session):
    return session._real.inside.records["fsa"].ravel()[:3] == fsa.ENABLED


def begin(session, axes, page, speed="300 rpm"):
    """Have a page hold the jog of axes; return its number once they turn."""
    number = session.presence.begin(page, masks_of(3, axes), held=True).number
    session.do(motion_jobs.turn(session, axes, speed, number), "jog").result(10)
    return number


@pytest.mark.every(3)
@pytest.mark.parametrize("axes", [[1], GROUP, ALL])
def test_axes_are_enabled_and_disabled_together_and_the_others_are_let_alone(session, axes):
    session.do(motion_jobs.disable(ALL), "disable").result(10)
    assert not enabled(session).any()
    session.do(motion_jobs.enable(axes, "pp"), "enable").result(10)
    assert enabled(session).tolist() == masks_of(3, axes).tolist()
    session.do(motion_jobs.enable(ALL, "pp"), "enable").result(10)
    session.do(motion_jobs.disable(axes), "disable").result(10)
    assert enabled(session).tolist() == (~masks_of(3, axes)).tolist()


def test_a_group_turns_together_as_long_as_its_page_holds_it(session):
    with Beats(session) as page:
        page.held = begin(session, GROUP, "page")
        until(lambda: (speeds(session)[:2] > 0.9 * JOG).all())
        assert speeds(session)[2] < 0.1
        assert np.ptp(speeds(session)[:2]) < 0.05 * JOG
        lasting = session.presence.end(page.held)
        session.do(motion_jobs.end_turn(np.flatnonzero(lasting.axes).tolist()), "release").result(10)
        until(lambda: (speeds(session) < 0.1).all())
        assert enabled(session).all()


@pytest.mark.every(3)
@pytest.mark.parametrize("way", ["silent", "closed", "fault"])
def test_all_axes_of_a_group_stop_where_one_is_lost_or_its_page_is(session, way):
    with Beats(session) as page:
        page.held = begin(session, GROUP, "page")
        until(lambda: (speeds(session)[:2] > 0.9 * JOG).all())
        if way == "closed":
            session.presence.leave("page")
        elif way == "fault":
            sinks = lambda drives: setattr(drives.machine, "supply", [24.0, 3.0, 24.0])  # noqa: E731
            session.do(sinks, "the supply sinks").result(10)
        if way != "silent":
            until(lambda: speeds(session)[0] < 0.1, 2.0)
    until(lambda: speeds(session)[0] < 0.1, 2.0)
    assert enabled(session).tolist() == [False, False, True]
    told = "axis 1 is not enabled any more, and none goes on without it" if way == "fault" else way
    assert any(told in event.text for event in session.events)


def test_none_turns_where_one_cannot(session):
    session.do(motion_jobs.disable([1]), "disable").result(10)
    with Beats(session) as page:
        with pytest.raises(RuntimeError, match="axis 1 is not enabled and cannot move"):
            page.held = begin(session, GROUP, "page")
        assert (speeds(session) < 0.1).all()
        assert enabled(session).tolist() == [True, False, True]


def test_no_group_turns_nothing(session):
    with pytest.raises(ValueError, match="no axis is in the group; choose some"):
        begin(session, [], "page")


def test_a_group_is_stopped_at_once_with_the_job_that_moves_it_and_the_others_go_on(session):
    """A jog of axis 2 goes on; a move of axis 0, a job that would last minutes, ends."""
    with Beats(session) as page:
        page.held = begin(session, [2], "page")
        move = session.do(motion_jobs.move(session, 0, "900 rev", "300 rpm", relative=True), "move", page="other")
        until(lambda: speeds(session)[0] > 0.9 * JOG or move.done())
        assert not move.done(), move.exception()
        session.presence.stop(masks_of(3, GROUP), "the group of a page, axes 0, 1")
        with pytest.raises(JobEndedError, match="the group of a page"):
            move.result(10)
        until(lambda: speeds(session)[0] < 0.1)
        assert enabled(session).tolist() == [False, False, True]
        assert speeds(session)[2] > 0.9 * JOG


def test_a_stopped_group_stands_though_nothing_moved_it(session):
    session.presence.stop(masks_of(3, [1]), "the group of a page, axis 1")
    until(lambda: enabled(session).tolist() == [True, False, True])
    assert int(session.do(lambda drives: drives.read(cia402.STATUSWORD)[1], "look").result(10)) & 0x4F != 0x08
