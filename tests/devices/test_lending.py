"""Objects that have another value for a while: what the program sees of them, and what the drive has afterwards."""

from __future__ import annotations

import pytest
from rigs.held_objects import HeldObjects

from drive_env.dictionary.aborts import WRONG_STATE, ObjectAccessError
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.safety.lending import Lending

KEY, OTHER = (0x6065, 0), (0x607F, 0)


def lending_of(axes=2, **options):
    drives = HeldObjects({KEY: 100, OTHER: 7}, axes, **options)
    return Lending(drives), drives


def test_what_is_lent_and_given_back():
    lending, drives = lending_of()
    assert not lending.is_lent(KEY, 0) and not lending.has_lent({0, 1})
    assert lending.lend(KEY, 1, 40_000)
    assert drives.values[KEY].tolist() == [100, 40_000]
    assert (lending.is_lent(KEY, 1), lending.is_lent(KEY, 0), lending.is_lent(OTHER, 1)) == (True, False, False)
    assert (lending.has_lent({1}), lending.has_lent({0}), lending.has_lent({0, 1})) == (True, False, True)
    assert lending.owned(KEY, 1) == 100
    lending.give_back({0})
    assert lending.is_lent(KEY, 1)
    lending.give_back({1})
    assert drives.values[KEY].tolist() == [100, 100] and not lending.has_lent({0, 1})


def test_a_program_sees_its_own_value_where_another_is_lent_and_what_is_there_otherwise():
    lending, _ = lending_of()
    assert lending.own(KEY, 0, 55) == 55
    lending.lend(KEY, 0, 40)
    assert lending.own(KEY, 0, 40) == 100
    assert lending.own(KEY, 0, 55) == 55  # somebody else wrote it
    assert lending.own(KEY, 1, 40) == 40


def test_what_is_lent_twice_is_given_back_as_it_was_at_first():
    lending, drives = lending_of()
    lending.lend(KEY, 0, 40)
    lending.lend(KEY, 0, 30)
    assert lending.owned(KEY, 0) == 100 and lending.own(KEY, 0, 30) == 100
    lending.give_back({0})
    assert drives.values[KEY][0] == 100


def test_what_a_program_writes_meanwhile_is_for_afterwards():
    lending, drives = lending_of()
    lending.lend(KEY, 0, 40)
    lending.settle(KEY, 0, 77)
    assert drives.values[KEY][0] == 40 and lending.own(KEY, 0, 40) == 77
    lending.give_back({0})
    assert drives.values[KEY][0] == 77


def test_what_is_passed_on_is_there_at_once_and_afterwards():
    lending, drives = lending_of()
    lending.lend(KEY, 0, 40)
    lending.pass_on(KEY, 0, 77)
    assert drives.values[KEY][0] == 77 and lending.own(KEY, 0, 77) == 77 and lending.owned(KEY, 0) == 77
    drives.log.clear()
    lending.give_back({0})
    assert drives.values[KEY][0] == 77


def test_one_object_is_given_back_by_itself():
    lending, drives = lending_of()
    lending.lend(KEY, 0, 40)
    lending.lend(OTHER, 0, 4)
    lending.give_back_one(KEY, 0)
    assert drives.values[KEY][0] == 100 and drives.values[OTHER][0] == 4
    assert not lending.is_lent(KEY, 0) and lending.is_lent(OTHER, 0)


def test_what_somebody_else_changed_stays():
    lending, drives = lending_of()
    lending.lend(KEY, 0, 40)
    drives.values[KEY][0] = 55
    lending.give_back({0})
    assert drives.values[KEY][0] == 55 and not lending.is_lent(KEY, 0)


def test_a_node_that_was_reset_has_its_own_again():
    lending, _ = lending_of()
    for axis in (0, 1):
        lending.lend(KEY, axis, 40)
    lending.forget({0})
    assert not lending.is_lent(KEY, 0) and lending.is_lent(KEY, 1)


def test_what_a_drive_makes_of_a_value_is_lent_as_well(caplog):
    lending, drives = lending_of(takes={KEY: lambda value: max(value, 50)})
    assert not lending.lend(KEY, 0, 40)
    assert (
        "axis 0 does not accept 6065h:00 object 6065h = 40; this limit is monitored by this computer only"
        in caplog.text
    )
    assert lending.own(KEY, 0, 50) == 100
    lending.give_back({0})
    assert drives.values[KEY][0] == 100


def test_a_drive_that_refuses_keeps_what_it_had(caplog):
    lending, drives = lending_of(takes={KEY: lambda value: None if value < 50 else value})
    assert not lending.lend(KEY, 0, 40)
    assert not lending.is_lent(KEY, 0) and drives.values[KEY][0] == 100
    assert "this limit is monitored by this computer only" in caplog.text
    assert lending.lend(KEY, 0, 60)
    assert not lending.lend(KEY, 0, 40)
    assert lending.own(KEY, 0, 60) == 100  # the loan before still holds
    lending.give_back({0})
    assert drives.values[KEY][0] == 100


@pytest.mark.parametrize("came", [False, True])
def test_an_answer_that_is_lost_does_not_say_which_of_them_the_drive_has(came):
    lending, drives = lending_of()
    lending.lend(KEY, 0, 60)
    write = drives.write_raw

    def lost(entry, axis, value):
        if came:
            write(entry, axis, value)
        raise NoAnswerError("no answer")

    drives.write_raw = lost
    with pytest.raises(NoAnswerError):
        lending.lend(KEY, 0, 40)
    drives.write_raw = write
    assert lending.own(KEY, 0, 40) == lending.own(KEY, 0, 60) == 100
    lending.give_back({0})
    assert drives.values[KEY][0] == 100


def test_a_drive_that_does_not_take_its_own_value_back_is_told_of_after_all_others_were_asked():
    lending, drives = lending_of()
    for key, axis in ((KEY, 0), (OTHER, 0)):
        lending.lend(key, axis, 4)
    drives.takes[KEY] = lambda value: 41
    with pytest.raises(BusError, match="axis 0: 6065h:00 object 6065h should have 100 again, and has 41"):
        lending.give_back({0})
    assert drives.values[OTHER][0] == 7
    assert lending.is_lent(KEY, 0) and not lending.is_lent(OTHER, 0)


def test_what_is_refused_when_it_is_passed_on_changes_nothing():
    lending, drives = lending_of()
    lending.lend(KEY, 0, 40)

    def refuse(entry, axis, value):
        raise ObjectAccessError(WRONG_STATE, "refused")

    write, drives.write_raw = drives.write_raw, refuse
    with pytest.raises(ObjectAccessError):
        lending.pass_on(KEY, 0, 77)
    drives.write_raw = write
    assert lending.owned(KEY, 0) == 100
