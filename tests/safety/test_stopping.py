"""A stop by grades, row by row: an axis as it may behave, and what its stop makes of it."""

from __future__ import annotations

import math
from itertools import pairwise
from types import SimpleNamespace

import pytest
from rigs.tables import every_row

from drive_env.safety.stopping import ANSWER, LONGEST_FOLLOWING, AxisStop, Phase, Sample, Stop

ENABLED, STOPPING, OFF = 0x0637, 0x0617, 0x0650  # statuswords (CiA 402)
QUICK_STOP, DISABLE_VOLTAGE = 0x02, 0x00  # controlwords
SPEED, RAMP, REST = 600_000.0, 6_000_000.0, 10_000.0  # inc/s, inc/s^2, inc/s: the ramp takes 0.1 s
PERIOD = 0.005  # s between two samples


class Axis:
    """An axis that obeys controlwords, though it brakes as it likes.

    Args:
        speed: Speed [inc/s] over the time since its quick stop began [s].
        obeys: Takes the quick stop.
        seen_until: Shows nothing new afterwards [s].
    """

    def __init__(self, speed, *, obeys=True, seen_until=math.inf):
        self.speed, self.obeys, self.seen_until = speed, obeys, seen_until
        self.status, self.begun, self.last = ENABLED, None, None
        self.sense = 1.0  # of its movement

    def sample(self, now):
        if self.last is None or now <= self.seen_until:
            moving = SPEED if self.begun is None else self.speed(now - self.begun)
            self.last = Sample(now, self.status, self.sense * moving)
        return self.last

    def take(self, word, now):
        if word == QUICK_STOP and self.obeys and self.status == ENABLED:
            self.status, self.begun = STOPPING, now
        if word == DISABLE_VOLTAGE:
            self.status = OFF


def stop(axis, *, ramp=RAMP, holds=False, longest=4.0):
    """Stop an axis; return its stop, and when the voltage went [s], None if it never did."""
    one, cut = AxisStop(0.0, SPEED, ramp, REST, holds), None
    for step in range(round(longest / PERIOD)):
        now = step * PERIOD
        word = one.step(now, axis.sample(now))
        if word is not None:
            axis.take(word, now)
        if word == DISABLE_VOLTAGE and cut is None:
            cut = now
        if one.is_over:
            break
    return one, cut


def down(rate, to=0.0):
    """Slow down at a rate [inc/s^2] to a speed."""
    return lambda t: max(SPEED - rate * t, to)


def swing(share, lasting):
    """Slow down as the ramp says, past rest, and come back from a share of the speed after a time [s]."""

    def speed(t):
        passed = t - SPEED / RAMP
        if passed < 0.0:
            return SPEED - RAMP * t
        return -share * SPEED * math.sin(math.pi * passed / lasting) if passed < lasting else 0.0

    return speed


@every_row(
    ("speed", "ramp", "why", "earliest", "latest"),
    [
        # It slows down well enough: the voltage goes at rest, without a reason to tell.
        (down(RAMP), RAMP, "", 0.1, 0.15),
        (down(0.6 * RAMP), RAMP, "", 0.16, 0.2),  # more than half of the ramp
        (down(0.2 * RAMP), RAMP, "", 0.4, 0.6),  # less, but it will stand within a second
        (down(0.2 * RAMP), 0.0, "", 0.4, 0.6),  # of a ramp that is not known
        # At its limit of current it goes on as before, until the ramp has come down to the speed that it has.
        (
            lambda t: SPEED * (1.0 + 2.0 * t) if t < 0.04 else max(1.08 * SPEED - RAMP * (t - 0.04), 0.0),
            RAMP,
            "",
            0.14,
            0.2,
        ),
        # It does not.
        (down(0.0), RAMP, "it does not slow down by its ramp", 0.04, 0.1),
        (down(0.0), 0.0, "it does not slow down by its ramp", 0.04, 0.1),
        (down(-RAMP), RAMP, "it does not slow down by its ramp", 0.04, 0.1),
        (down(0.05 * RAMP), RAMP, "it does not slow down by its ramp", 0.04, 0.1),  # two seconds and more
        (down(RAMP, to=0.1 * SPEED), RAMP, "it does not slow down by its ramp", 0.24, 0.28),
        # Slower and slower, always fast enough to stand within a second, and never at rest.
        (lambda t: 0.1 * SPEED + 0.9 * SPEED * math.exp(-t), RAMP / 20.0, "it is still turning after 2 s", 2.0, 2.05),
        # As slowly as a ramp says that would take minutes.
        (down(RAMP / 10_000.0), RAMP / 10_000.0, "it does not slow down by its ramp", 0.04, 0.1),
        # Past rest and back.
        (swing(0.12, 0.2), RAMP, "", 0.3, 0.4),
        (swing(-0.4, 0.2), RAMP, "it does not slow down by its ramp", 0.1, 0.25),  # on again, not back
        (swing(0.4, 0.2), RAMP, "it does not slow down by its ramp", 0.1, 0.22),
        (down(RAMP, to=-0.1 * SPEED), RAMP, "it does not slow down by its ramp", 0.22, 0.28),  # it stays there
        # As late as half of the ramp has it, back by no more than 15 % (and the speed of rest) for 0.1 s, or by more.
        (down(0.55 * RAMP, to=-0.19 * SPEED), RAMP, "it does not slow down by its ramp", 0.29, 0.33),
        (down(0.55 * RAMP, to=-0.21 * SPEED), RAMP, "it does not slow down by its ramp", 0.2, 0.27),
    ],
)
@every_row("sense", [1.0, -1.0])
def test_an_axis_keeps_its_voltage_while_it_slows_down(speed, ramp, why, earliest, latest, sense):
    axis = Axis(speed)
    axis.sense = sense
    one, cut = stop(axis, ramp=ramp)
    assert one.why == why
    assert one.phase is Phase.OFF
    assert earliest <= cut <= latest


def test_an_axis_that_does_not_obey_the_quick_stop_loses_its_voltage_after_100_ms():
    one, cut = stop(Axis(down(0.0), obeys=False))
    assert one.why == "it does not obey the quick stop"
    assert 0.1 < cut <= 0.1 + 2 * PERIOD


def test_an_axis_that_is_not_seen_loses_its_voltage_after_400_ms():
    one, cut = stop(Axis(down(RAMP), seen_until=0.05))
    assert one.why.startswith("its position was not received for 0.4 s")
    assert 0.45 < cut <= 0.45 + 3 * PERIOD


def test_an_axis_that_is_held_keeps_its_voltage_at_rest_until_it_is_released():
    axis = Axis(down(RAMP))
    one, cut = stop(axis, holds=True)
    assert (one.phase, cut, axis.status) == (Phase.REST, None, STOPPING)
    assert one.rests_for(5.0) > 4.0
    one.release()
    assert one.step(5.0, axis.sample(5.0)) == DISABLE_VOLTAGE


def test_an_axis_that_is_held_and_breaks_loose_loses_its_voltage():
    axis = Axis(down(RAMP))
    one, _ = stop(axis, holds=True)
    assert one.step(1.0, Sample(1.0, STOPPING, 9.0 * REST)) is None
    assert one.step(1.1, Sample(1.1, STOPPING, -11.0 * REST)) == DISABLE_VOLTAGE
    assert one.why == "it moves though it is held"


def test_voltage_off_is_repeated_and_given_up_after_600_ms():
    one, sent = AxisStop(0.0, SPEED, RAMP, REST, holds=False), []
    for step in range(400):
        now = step * PERIOD
        if one.step(now, Sample(now, ENABLED, SPEED)) == DISABLE_VOLTAGE:
            sent.append(now)
        if one.is_over:
            break
    assert one.phase is Phase.LOST
    assert sent[-1] - sent[0] == pytest.approx(0.6, abs=0.03)
    assert max(after - before for before, after in pairwise(sent)) <= 0.02 + PERIOD


# --- exactly at a time, a speed or a rate is within it, and just beyond is not ------------------------------------
def fed(samples, *, begun=0.0, speed=SPEED, ramp=RAMP, rest=REST, holds=True):
    """Feed a stop with samples (time [s], speed [inc/s], statusword); return it, and its controlwords."""
    one = AxisStop(begun, speed, ramp, rest, holds)
    return one, [one.step(time, Sample(time, status, moving)) for time, moving, status in samples]


def braked(*rows):
    """Return samples in quick stop active."""
    return [(time, moving, STOPPING) for time, moving in rows]


def test_a_quick_stop_is_sent_every_20_ms_until_a_new_sample_shows_it():
    one = AxisStop(1.0, SPEED, RAMP, REST, holds=False)
    before = Sample(0.9, STOPPING, SPEED)  # from a stop before this one
    assert [one.step(now, before) for now in (1.0, 1.019, 1.0201, 1.03)] == [QUICK_STOP, None, QUICK_STOP, None]
    assert one.step(1.041, Sample(1.041, ENABLED, SPEED)) == QUICK_STOP
    assert [one.step(now, Sample(now, STOPPING, 0.8 * SPEED)) for now in (1.05, 1.07)] == [None, None]
    _, words = fed([(0.0, SPEED, ENABLED), (0.02, SPEED, ENABLED)])
    assert words == [QUICK_STOP, QUICK_STOP]


def test_an_axis_is_off_once_a_sample_from_after_the_first_command_shows_it():
    one, words = fed([(0.01, 0.0, OFF), (0.02, 0.0, OFF)])
    assert (words, one.phase) == ([QUICK_STOP, None], Phase.OFF)
    one = AxisStop(0.0, SPEED, RAMP, REST, holds=False)
    assert one.step(0.0, Sample(0.0, OFF, 0.0)) == QUICK_STOP
    assert one.step(0.01, Sample(0.0, OFF, 0.0)) is None
    assert one.phase is Phase.RAMP


def test_an_axis_that_is_held_and_that_somebody_switches_off_is_off():
    one, _ = fed(braked((0.05, 0.0), (0.1, 0.0)))
    assert one.phase is Phase.REST and one.is_over
    assert one.step(0.2, Sample(0.2, OFF, 0.0)) is None
    assert one.phase is Phase.OFF and one.is_over


@pytest.mark.parametrize(("time", "phase"), [(0.1, Phase.RAMP), (0.1001, Phase.CUT)])
def test_a_drive_has_100_ms_to_begin_its_ramp(time, phase):
    assert fed([(time, SPEED, ENABLED)])[0].phase is phase


def test_a_fault_reaction_is_a_ramp_that_has_begun():
    one, _ = fed([(0.15, 0.1 * SPEED, 0x021F)])
    assert one.phase is Phase.RAMP


@pytest.mark.parametrize(("time", "phase"), [(0.4, Phase.RAMP), (0.4001, Phase.CUT)])
def test_an_axis_may_be_unseen_for_400_ms_while_it_brakes(time, phase):
    one = AxisStop(0.0, SPEED, RAMP, REST, holds=True)
    one.step(time, Sample(0.0, STOPPING, SPEED))
    assert one.phase is phase
    assert not one.is_unseen(0.1)  # for 100 ms
    assert one.is_unseen(0.1001) == (phase is Phase.CUT)
    assert one.rests_for(9.0) == 0.0 and not one.is_over


@pytest.mark.parametrize(("time", "phase"), [(2.0, Phase.RAMP), (2.0001, Phase.CUT)])
def test_a_ramp_may_take_two_seconds(time, phase):
    one, _ = fed(braked((1.0, 0.5 * SPEED), (time, 0.5 * SPEED)), ramp=SPEED / 2.0)
    assert one.phase is phase


@pytest.mark.parametrize(
    ("rows", "phase"),
    [
        ([(0.0, REST), (0.02, -REST)], Phase.REST),
        ([(0.0, REST), (0.0199, REST)], Phase.RAMP),
        ([(0.0, 1.001 * REST), (0.02, REST)], Phase.RAMP),
        ([(0.0, REST), (0.01, 1.001 * REST), (0.02, REST)], Phase.RAMP),
        ([(0.0, REST), (0.01, 1.001 * REST), (0.02, REST), (0.04, REST)], Phase.REST),
    ],
)
def test_an_axis_is_at_rest_after_20_ms_below_its_speed_of_rest(rows, phase):
    one, _ = fed(braked(*rows), begun=-1.0)
    assert one.phase is phase
    assert one.is_over == (phase is Phase.REST)
    assert one.rests_for(rows[-1][0] + 0.5) == (pytest.approx(0.5) if phase is Phase.REST else 0.0)


def test_an_axis_that_is_released_while_it_turns_comes_to_rest_first():
    one, _ = fed(braked((0.05, 0.5 * SPEED)))
    one.release()
    assert one.step(0.08, Sample(0.08, STOPPING, 0.0)) is None
    assert one.step(0.11, Sample(0.11, STOPPING, 0.0)) == DISABLE_VOLTAGE
    assert (one.phase, one.why, one.is_over) == (Phase.CUT, "", False)


@pytest.mark.parametrize(("speed", "phase"), [(10.0 * REST, Phase.REST), (10.01 * REST, Phase.CUT)])
def test_an_axis_that_is_held_breaks_loose_at_ten_times_the_speed_of_rest(speed, phase):
    one, _ = fed(braked((0.05, 0.0), (0.1, 0.0), (0.2, speed)))
    assert one.phase is phase


@pytest.mark.parametrize(("time", "phase"), [(0.6, Phase.CUT), (0.6001, Phase.LOST)])
def test_an_axis_is_given_up_600_ms_after_its_voltage_should_have_gone(time, phase):
    one, _ = fed(braked((-0.5, 0.0), (0.0, 0.0), (time, 0.0)), begun=-1.0, holds=False)
    assert one.phase is phase
    assert one.is_over == (phase is Phase.LOST)


@pytest.mark.parametrize(
    ("speeds", "phase"),
    [
        ([0.0, 0.02, 0.039], Phase.RAMP),  # two measurements that are too low, each over 20 ms
        ([0.0, 0.02, 0.04], Phase.CUT),
        ([0.0, 0.019, 0.038], Phase.RAMP),
    ],
)
def test_the_deceleration_is_measured_every_20_ms(speeds, phase):
    one, _ = fed(braked(*((time, SPEED) for time in speeds)), begun=-1.0, ramp=0.0)
    assert one.phase is phase


SLOWER = SPEED * (1.0 + 2.0**-5)  # 2^-5 s before SPEED, at the rate that would bring it to rest within a second


@pytest.mark.parametrize(
    ("speeds", "phase"),
    [
        ([SLOWER, SLOWER, SPEED, SPEED], Phase.CUT),
        ([SLOWER, SLOWER, SPEED], Phase.RAMP),
        ([SLOWER, SLOWER, SPEED + 1.0], Phase.CUT),
        ([SLOWER, SPEED, SPEED], Phase.CUT),  # once it brakes, one measurement is enough
        ([SPEED, SPEED], Phase.RAMP),
        ([SPEED, SPEED, SPEED], Phase.CUT),
    ],
)
def test_an_axis_that_would_stand_within_a_second_brakes(speeds, phase):
    one, _ = fed(braked(*((k / 32.0, speed) for k, speed in enumerate(speeds))), begun=-1.0, ramp=0.0)
    assert one.phase is phase


@pytest.mark.parametrize(("share", "phase"), [(0.78, Phase.RAMP), (0.82, Phase.CUT)])
def test_half_of_the_ramp_is_enough(share, phase):
    """Half a second after its first 20 ms a ramp of a second has come to a quarter less; three speeds of rest more."""
    rows = [(0.5, 0.5), (0.52, share), (0.54, share)]
    one, _ = fed(braked(*((time, part * SPEED) for time, part in rows)), ramp=SPEED)
    assert one.phase is phase


@pytest.mark.parametrize(("ramp", "phase"), [(SPEED / 2.0, Phase.RAMP), (SPEED / 2.001, Phase.CUT)])
def test_a_ramp_that_takes_two_seconds_tells_what_to_expect(ramp, phase):
    rows = ((0.02 * k, SPEED - 0.25 * SPEED * max(0.02 * k - 0.02, 0.0)) for k in range(1, 20))
    one, _ = fed(braked(*rows), ramp=ramp)
    assert one.phase is phase


def test_the_speed_within_the_first_20_ms_is_that_with_which_the_ramp_begins():
    """What was known before was an axis at rest."""
    rows = [(0.01 * k, SPEED - 0.25 * SPEED * max(0.01 * k - 0.02, 0.0)) for k in range(1, 40)]
    assert fed(braked(*rows), speed=0.0, ramp=SPEED / 2.0)[0].phase is Phase.RAMP
    late = [(0.02, 1.5 * SPEED), (0.045, 1.5 * SPEED), (0.07, 1.5 * SPEED)]
    assert fed(braked(*late), ramp=SPEED)[0].phase is Phase.CUT


def test_a_stop_of_several_axes_is_over_when_each_is():
    sent = []

    def axis(phase, is_over, word):
        return SimpleNamespace(phase=phase, is_over=is_over, step=lambda now, sample: (now, sample, word)[2])

    axes = {
        1: axis(Phase.RAMP, False, QUICK_STOP), 2: axis(Phase.OFF, True, 7), 3: axis(Phase.LOST, True, 7),
        4: axis(Phase.REST, True, None), 5: axis(Phase.CUT, False, DISABLE_VOLTAGE),
    }  # fmt: skip
    several = Stop(axes, lambda number, word: sent.append((number, word)), lambda number: None)
    several.step(1.0)
    assert sent == [(1, QUICK_STOP), (5, DISABLE_VOLTAGE)]
    assert not several.is_over
    axes[1].is_over = axes[5].is_over = True
    assert several.is_over


@pytest.mark.parametrize(("follows_until", "begun"), [(0.0, 0.0), (0.1, 0.1), (9.0, LONGEST_FOLLOWING)])
def test_an_axis_that_is_left_to_its_set_point_gets_its_ramp_later_and_in_any_case(follows_until, begun):
    clock, axis = [0.0], Axis(lambda since: SPEED - RAMP * since if since < SPEED / RAMP else 0.0)
    one = AxisStop(0.0, SPEED, RAMP, REST, True, lambda: clock[0] < follows_until)
    sent = None
    for step in range(200):
        clock[0] = now = step * PERIOD
        word = one.step(now, axis.sample(now))
        if word is not None:
            axis.take(word, now)
        sent = now if sent is None and word == QUICK_STOP else sent
    assert sent == pytest.approx(begun, abs=2 * PERIOD) and one.phase is Phase.REST


def test_an_axis_that_is_left_to_its_set_point_and_not_seen_any_more_gets_its_ramp():
    axis = Axis(lambda since: SPEED, seen_until=0.05)
    one = AxisStop(0.0, SPEED, RAMP, REST, True, lambda: True)
    words = [one.step(step * PERIOD, axis.sample(step * PERIOD)) for step in range(60)]
    assert words.index(QUICK_STOP) * PERIOD == pytest.approx(0.05 + ANSWER, abs=2 * PERIOD)
