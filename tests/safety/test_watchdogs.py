"""What the drives do by themselves when the program dies: how soon they must, and whose watchdogs are given up."""

from __future__ import annotations

import logging
import math
import signal
from types import SimpleNamespace

import numpy as np
import pytest

from drive_env import Limits, SafetyError, cia402
from drive_env.drives.limits import NO_LIMIT
from drive_env.fieldbus.errors import BusError
from drive_env.fieldbus.link import NoWatchdogError
from drive_env.safety import signals
from drive_env.safety.axes import Axes
from drive_env.safety.bounds import POSITION_HIGH
from drive_env.safety.watchdogs import Watchdogs

OFF, READY, ENABLED = 0x0240, 0x0231, 0x0637  # statuswords: switch on disabled, ready to switch on, operation enabled
TURN = 65536.0


class Node:
    """What a node answers, and what is done to it."""

    def __init__(self, *status, is_set=True, is_lent=False, may_turn=True):
        self.status, self.is_set, self.is_lent, self.may_turn = list(status), is_set, is_lent, may_turn
        self.words, self.given_back, self.is_restored = [], False, False

    def read(self):
        status = self.status.pop(0) if len(self.status) > 1 else self.status[0]
        if status is None:
            raise BusError("no answer")
        return status


def watchdogs_of(*nodes, limits=None, bounds=None, has=(), is_counted=True, detection_time=None, starts=True):
    """The watchdogs of nodes of one axis each."""
    log = []

    def start():
        log.append("start")
        for node in nodes if starts else ():
            node.status = [status for status in node.status if status is not None] or [None]

    watch = SimpleNamespace(
        is_set=lambda k: nodes[k].is_set,
        is_in_force=lambda k: nodes[k].is_set,
        restore=lambda k: setattr(nodes[k], "is_restored", True),
        cease=lambda: log.append("cease"),
        end=lambda: log.append("end"),
        begin=lambda silence: log.append(silence),
        detection_time=detection_time,
    )
    drives = SimpleNamespace(
        nodes=tuple(range(1, len(nodes) + 1)), time_waits=False, num_axes=len(nodes),
        link=SimpleNamespace(watch=watch, wording=SimpleNamespace(sign_of_life="heartbeats")),
        description=SimpleNamespace(
            num_axes=1, has=lambda key: key in has, dictionary=SimpleNamespace(find=lambda key: key)
        ),
        read_raw=lambda entry, axis: nodes[axis].read(),
        write_raw=lambda entry, axis, word: nodes[axis].words.append(word),
        must_start=lambda: None, start=start,
    )  # fmt: skip
    axes = SimpleNamespace(
        may_turn=np.array([node.may_turn for node in nodes]), lost=set(), is_counted=is_counted, is_armed=True,
        of_nodes=lambda ks: np.isin(np.arange(len(nodes)), ks), off=[],
    )  # fmt: skip
    axes.take_for_off = lambda mask: axes.off.extend(np.flatnonzero(mask).tolist())
    lending = SimpleNamespace(
        has_lent=lambda own: any(nodes[axis].is_lent for axis in own),
        give_back=lambda own: [setattr(nodes[axis], "given_back", True) for axis in own],
    )
    in_force = SimpleNamespace(user=limits or Limits(), bounds=lambda: bounds)
    made = Watchdogs(drives, axes, in_force, lending)
    return made, axes, log


def untouched():
    return Node(OFF, is_set=False, may_turn=False)


# --- whose watchdogs are given up ---------------------------------------------------------------------------------
def test_every_node_is_given_back_what_it_had_whatever_the_one_before_it_needs():
    nodes = [untouched(), Node(OFF), Node(ENABLED), Node(OFF), untouched()]
    watchdogs, axes, log = watchdogs_of(*nodes)
    watchdogs.give_up()
    assert [node.is_restored for node in nodes] == [False, True, False, True, False]
    assert [node.given_back for node in nodes] == [False, True, False, True, False]
    assert (axes.lost, axes.off, log) == ({2}, [1, 3], ["cease"])


@pytest.mark.parametrize(
    "why", [{"is_set": True}, {"is_lent": True}, {"may_turn": True}], ids=["watchdog", "a limit", "may turn"]
)
def test_a_node_that_has_anything_of_ours_is_looked_at(why):
    node = Node(OFF, **{"is_set": False, "may_turn": False} | why)
    watchdogs_of(node)[0].give_up()
    assert node.given_back and node.is_restored


@pytest.mark.parametrize(
    ("statuses", "is_off", "words"),
    [
        ([OFF], True, 0),
        ([READY, OFF], True, 1),  # taken there first
        ([OFF, READY, OFF], True, 1),  # twice in a row, not twice
        ([OFF, ENABLED], False, 0),  # the first answer was an old one
        ([ENABLED], False, 0),
        ([READY, OFF, READY, OFF, READY, OFF], False, 3),  # five looks, and no two in a row
        ([READY, READY, READY, OFF, OFF], True, 3),  # the last two of five
        ([READY], False, 5),
        ([None, OFF], True, 0),  # woken: a node that has missed its master is stopped and answers nothing
        ([OFF, None, OFF], True, 0),
    ],
)
def test_off_is_what_two_answers_in_a_row_show(statuses, is_off, words):
    node = Node(*statuses)
    watchdogs, axes, _ = watchdogs_of(node)
    watchdogs.give_up()
    assert node.words == [cia402.DISABLE_VOLTAGE] * words
    assert node.is_restored == is_off
    assert axes.lost == (set() if is_off else {0})


@pytest.mark.parametrize(("is_set", "told"), [(True, "its watchdog stays on and it gets no more heartbeats"),
                                              (False, "it has no watchdog")])  # fmt: skip
def test_who_answers_nothing_is_woken_once_and_keeps_its_watchdog(is_set, told, caplog):
    node = Node(None, is_set=is_set)
    watchdogs, axes, log = watchdogs_of(node, starts=False)
    watchdogs.give_up()
    assert log == ["start", "cease"]
    assert axes.lost == {0} and not node.given_back and not node.is_restored
    assert told in caplog.text


# --- how soon the drives must act ---------------------------------------------------------------------------------
def bounds_of(travel, speed, braking, given=True):
    """Limits of one axis; speeds in inc/s, the braking in inc/s^2 and 0 where it is not known."""
    low, high = (-NO_LIMIT, NO_LIMIT) if travel is None else (0, round(travel))
    return SimpleNamespace(
        low=np.array([low]), high=np.array([high]), given=np.array([given]), velocity=np.array([round(speed)]),
        speed=np.array([float(speed)]), braking=np.array([float(braking)]),
    )  # fmt: skip


def silence_of(bounds, **options):
    """After which silence the drive acts."""
    watchdogs, _, log = watchdogs_of(Node(OFF), bounds=bounds, detection_time=0.0, **options)
    watchdogs.set()
    return log[0]


@pytest.mark.parametrize("is_counted", [True, False])
@pytest.mark.parametrize(
    ("travel", "speed", "braking", "silence"),
    [
        (10 * TURN, 10 * TURN, 0.0, 0.25),  # a quarter of the travel: 2.5 turns at 10 turns/s
        (10 * TURN, 10 * TURN, 100 * TURN, 0.20),  # of which the ramp takes 10^2 / 200 = 0.5 turns
        (100 * TURN, 10 * TURN, 100 * TURN, 0.5),  # never longer than the user says
        (10 * TURN, 50 * TURN, 0.0, 0.06),  # nor shorter than a computer can keep
        (None, 50 * TURN, 0.0, 0.5),  # no end to run into
    ],
)
def test_a_dead_master_uses_up_a_quarter_of_the_travel(travel, speed, braking, silence, is_counted):
    assert silence_of(bounds_of(travel, speed, braking), is_counted=is_counted) == pytest.approx(silence)


def test_a_shorter_silence_of_the_users_is_kept_however_short():
    assert silence_of(bounds_of(10 * TURN, 50 * TURN, 0.0), limits=Limits(silence=0.03)) == 0.03


@pytest.mark.parametrize("options", [{"has": {POSITION_HIGH}}, {"given": False}], ids=["607Dh", "no limit given"])
def test_a_drive_that_holds_its_travel_itself_or_has_none_needs_no_sooner_watchdog(options):
    given = options.pop("given", True)
    bounds = bounds_of(10 * TURN, 50 * TURN, 0.0, given)
    assert silence_of(bounds, **options) == 0.5
    assert bounds.velocity[0] == bounds.speed[0] == 50 * TURN


@pytest.mark.parametrize("is_counted", [True, False])
@pytest.mark.parametrize("braking", [0.0, 100 * TURN])
def test_where_the_shortest_silence_is_too_long_the_speed_is_lowered(braking, is_counted, caplog):
    """Until v * 0.06 s + v^2 / 2a is a quarter of the travel."""
    travel, speed = 10 * TURN, 60 * TURN
    bounds = bounds_of(travel, speed, braking)
    with caplog.at_level(logging.WARNING):
        assert silence_of(bounds, is_counted=is_counted) == pytest.approx(0.06)
    lowered, kept = (bounds.velocity, bounds.speed) if is_counted else (bounds.speed, bounds.velocity)
    v, way = float(lowered[0]), 0.25 * travel
    assert kept[0] == speed
    assert v * 0.06 + (v**2 / (2.0 * braking) if braking else 0.0) == pytest.approx(way, rel=1e-4)
    assert f"no more than {math.floor(v)} increments a second are allowed" in caplog.text


def test_a_drive_that_would_act_too_late_is_not_moved():
    """Watchdogs count milliseconds: one more than asked for is the same."""
    for late, fails in ((0.5009, False), (0.5011, True)):
        watchdogs, _, _ = watchdogs_of(Node(OFF), bounds=bounds_of(None, TURN, 0.0), detection_time=late)
        if fails:
            with pytest.raises(SafetyError, match=rf"dead after {late:g} s, and 0\.5 s are allowed"):
                watchdogs.set()
        else:
            watchdogs.set()


def test_one_node_whose_watchdog_is_off_has_the_axes_armed_anew():
    bounds = bounds_of(None, TURN, 0.0)
    for is_set in ([True, True], [True, False], [False, True]):
        watchdogs, axes, _ = watchdogs_of(*(Node(OFF, is_set=s) for s in is_set), bounds=bounds, detection_time=0.0)
        watchdogs.set()
        watchdogs.check()
        assert axes.is_armed == all(is_set)


def test_without_a_silence_no_watchdog_is_set(caplog):
    watchdogs, axes, log = watchdogs_of(Node(OFF, is_set=False), limits=Limits(silence=None))
    watchdogs.set()
    watchdogs.check()
    assert log == ["end"] and axes.is_armed
    assert "no drive stops by itself when this process dies" in caplog.text


def test_a_drive_that_cannot_watch_is_not_moved():
    watchdogs, _, _ = watchdogs_of(Node(OFF), bounds=bounds_of(None, TURN, 0.0), detection_time=0.0)

    def begin(silence):
        raise NoWatchdogError("node 1 has no 1016h")

    watchdogs._watch.begin = begin
    with pytest.raises(SafetyError, match=r"^node 1 has no 1016h$"):
        watchdogs.set()
    watchdogs._watch.is_in_force = lambda k: pytest.fail("none was set")
    watchdogs.check()


def test_watchdogs_that_were_given_up_are_not_asked_for():
    watchdogs, axes, log = watchdogs_of(Node(OFF, is_set=False), bounds=bounds_of(None, TURN, 0.0), detection_time=0.0)
    watchdogs.set()
    watchdogs.end()
    watchdogs.check()
    assert axes.is_armed and log == [0.5, "end"]


@pytest.mark.parametrize(("passes", "told"), [
    (True, r"time passes by itself on this bus.*open them with pace='real-time'"),
    (None, r"this drive has no producer heartbeat \(1017h\).*open it with pace='real-time'"), (False, None),
])  # fmt: skip
def test_in_lockstep_it_is_proved_once_that_time_waits_and_no_watchdog_is_set(passes, told):
    watchdogs, _, log = watchdogs_of(Node(OFF))
    looked = []
    watchdogs._drives.time_waits = True
    watchdogs._drives.link.time_passes = lambda: (looked.append(1), passes)[1]
    for _ in range(2):
        if told is None:
            watchdogs.set()
        else:
            with pytest.raises(SafetyError, match=told):
                watchdogs.set()
    assert len(looked) == (1 if told is None else 2) and log == []


def test_what_a_watchdog_depends_on_is_not_written():
    watchdogs, _, _ = watchdogs_of(Node(OFF))
    watchdogs._watch.holds = lambda key: key == (0x1016, 1)
    watchdogs.check_not_held(SimpleNamespace(index=0x1016, sub=2, label="1016h:02"))
    with pytest.raises(SafetyError, match="1016h:01 belongs to the watchdog by which the drive notices"):
        watchdogs.check_not_held(SimpleNamespace(index=0x1016, sub=1, label="1016h:01"))


def test_a_last_sign_of_life_that_does_not_go_out_is_told(caplog):
    watchdogs, _, _ = watchdogs_of(Node(OFF))

    def cease():
        raise BusError("the bus is gone")

    watchdogs._watch.cease = cease
    watchdogs.cease()
    assert "the bus is gone" in caplog.text


def test_one_axis_of_a_node_that_is_live_keeps_the_watchdog_of_all_of_them():
    nodes = [Node(OFF) for _ in range(6)]
    nodes[4].status = [ENABLED]
    watchdogs, axes, log = watchdogs_of(*nodes)
    watchdogs._drives.nodes, watchdogs._drives.description.num_axes = (1, 2), 3
    axes.of_nodes = lambda ks: np.isin(np.arange(6) // 3, ks)
    watchdogs.give_up()
    assert [node.given_back for node in nodes] == [True] * 3 + [False] * 3
    assert axes.lost == {3, 4, 5} and axes.off == [0, 1, 2] and log == ["cease"]


@pytest.mark.parametrize("turning", [0, 1])
def test_a_node_with_an_axis_that_may_turn_is_looked_at(turning):
    nodes = [Node(OFF, is_set=False, may_turn=k == turning) for k in range(4)]
    watchdogs, axes, _ = watchdogs_of(*nodes)
    watchdogs._drives.nodes, watchdogs._drives.description.num_axes = (1, 2), 2
    axes.of_nodes = lambda ks: np.isin(np.arange(4) // 2, ks)
    watchdogs.give_up()
    assert [node.given_back for node in nodes] == [True, True, False, False]


# --- axes of nodes ------------------------------------------------------------------------------------------------
def test_axes_of_nodes_are_counted_through_and_taken_for_off_by_themselves():
    drives = SimpleNamespace(
        num_axes=6, time_waits=True, description=SimpleNamespace(num_axes=2, has=lambda key: False, dictionary=None)
    )
    axes = Axes(drives)
    assert np.flatnonzero(axes.of_nodes([0, 2])).tolist() == [0, 1, 4, 5]
    assert not axes.of_nodes([]).any()
    axes.assume(axes.everywhere)
    axes.take_for_off(axes.of_nodes([1]))
    for known in (axes.live, axes.assumed, axes.in_flight, axes.may_turn):
        assert np.flatnonzero(known).tolist() == [0, 1, 4, 5]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_that_is_ignored_stays_so_and_the_others_are_guarded(name):
    """The program was started to outlive its terminal, or Ctrl-C of it."""
    numbers = {one: getattr(signal, one) for one in signals.NAMES if hasattr(signal, one)}
    before = {number: signal.getsignal(number) for number in numbers.values()}
    one = SimpleNamespace()
    try:
        for number in numbers.values():
            signal.signal(number, signal.SIG_DFL)
        signal.signal(numbers[name], signal.SIG_IGN)
        signals.guard(one)
        found = {other: signal.getsignal(number) for other, number in numbers.items()}
        assert {other for other, handler in found.items() if handler is signals._handle} == numbers.keys() - {name}
        signals.release(one)
        assert signal.getsignal(numbers[name]) is signal.SIG_IGN
        assert all(signal.getsignal(n) is signal.SIG_DFL for other, n in numbers.items() if other != name)
    finally:
        signals.release(one)
        for number, handler in before.items():
            signal.signal(number, handler)
