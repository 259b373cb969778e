"""What a node tells of errors of its axes and its bus, with axes of this test: 1001h, 1003h, emergencies, reactions."""

from __future__ import annotations

import pytest

from drive_env.cia402 import State
from drive_env.devices import find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.node.axis import QueuedEmergency
from drive_env.node.error_history import CONDITIONS, OPTIONAL_CONDITIONS, ErrorHistory
from drive_env.node.node_errors import NodeErrors

GENERIC, COMMUNICATION, PROFILE = 0x01, 0x10, 0x20


class Axis:
    """An axis that had some emergencies, and its share of 1001h."""

    def __init__(self):
        self.error_register, self.queued, self.state = 0, [], State.SWITCH_ON_DISABLED

    def take_emergencies(self):
        taken, self.queued = self.queued, []
        return taken


class Sink:
    """Emergencies that were to be told: code, first byte, axis byte, error register."""

    def __init__(self):
        self.told, self.log, self.cleared = 0, [], 0

    def push(self, emergency, error_register):
        self.told = error_register
        self.log.append((emergency.code, emergency.extra[:2], error_register))

    def clear(self):
        self.cleared += 1

    def take(self):
        taken, self.log = self.log, []
        return taken


class Node:
    """Errors of a device's axes; "flush" and "react" are noted in their order."""

    def __init__(self, name):
        self.device = find_device(name)
        self.axes = [Axis() for _ in range(self.device.num_axes)]
        self.sink, self.log = Sink(), []
        self.errors = NodeErrors(
            self.device, self.axes, 4, self.sink, lambda now: self.log.append(("flush", now)),
            lambda: self.log.append("react"),
        )  # fmt: skip

    def queue(self, axis, name, register):
        row = [cause.name for cause in self.device.firmware.causes].index(name)
        self.axes[axis].queued.append(QueuedEmergency(row, register))
        self.axes[axis].error_register = register

    def history(self):
        read = self.errors.history.read
        return [read(sub) for sub in range(1, read(0) + 1)]


@pytest.fixture
def node():
    return Node("tmcm6212")


@pytest.fixture
def other():
    """Its 1001h and 1003h show the axis and the device's own number of an error."""
    return Node("tgz_d")


# --- axes -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("cause", "code", "reacts"), [
    ("overcurrent_high_side", 0x2310, True), ("following_error", 0x8611, True),  # cuts, stops
    ("positive_software_limit", 0xFF01, False), ("overtemperature_warning", 0x4310, False),
])  # fmt: skip
def test_an_error_of_an_axis_is_told_and_noted_and_a_fault_acts(node, cause, code, reacts):
    node.queue(2, cause, 0x21)
    node.errors.collect(5.0)
    ((told, extra, register),) = node.sink.take()
    assert (told, extra[1], register) == (code, 2, 0x21)
    assert node.history() == [code | 2 << 16]
    assert node.log == ([("flush", 5.0), "react"] if reacts else [])


def test_the_register_of_a_message_is_its_axis_of_that_moment_and_what_the_others_have_now(node):
    node.queue(1, "following_error", 0x21)
    node.axes[1].error_register = 0x80  # what it has had since
    node.axes[3].error_register = 0x04
    node.errors.condition("heartbeat_lost", 1.0)
    node.sink.take()
    node.errors.collect(5.0)
    assert node.sink.take() == [(0x8611, (0, 1), 0x21 | 0x04 | GENERIC | COMMUNICATION)]
    assert node.errors.register() == 0x80 | 0x04 | GENERIC | COMMUNICATION
    assert node.errors.register(without=node.axes[1]) == 0x04 | GENERIC | COMMUNICATION


def test_a_fault_reset_ends_conditions_and_is_no_fault(node):
    node.errors.condition("heartbeat_lost", 1.0)
    node.sink.take()
    node.log.clear()
    node.queue(4, "fault_reset", 0)
    node.errors.collect(5.0)
    assert node.sink.take() == [(0, (0, 4), 0)] and node.errors.conditions == {} and node.log == []
    assert len(node.history()) == 1, "it is no error"


def test_when_nothing_is_left_the_end_is_told_of_the_axis_that_was_told_last(node):
    node.queue(3, "following_error", 0x21)
    node.errors.collect(5.0)
    node.sink.take()
    node.errors.collect(6.0)
    assert node.sink.take() == [], "it lasts"
    node.axes[3].error_register = 0
    node.errors.collect(7.0)
    assert node.sink.take() == [(0, (0, 3), 0)]
    node.errors.collect(8.0)
    assert node.sink.take() == [], "once"


def test_who_was_told_by_a_message_before_is_told_the_end_of_the_first_axis(node):
    node.sink.told = 0x11
    node.errors.collect(1.0)
    assert node.sink.take() == [(0, (0, 0), 0)]


def test_what_the_whole_module_has_is_told_once_in_a_cycle(node):
    for axis in (1, 2, 5):
        node.queue(axis, "shutdown_switch", 0x21)
    node.errors.collect(5.0)
    assert [code for code, _, _ in node.sink.take()] == [0x5441] and len(node.history()) == 1
    assert node.log == [("flush", 5.0), "react"] * 3, "each of them acts"
    node.queue(1, "shutdown_switch", 0x21)
    node.errors.collect(6.0)
    assert [code for code, _, _ in node.sink.take()] == [0x5441], "in another cycle it is another"
    for axis in (1, 2):
        node.queue(axis, "following_error", 0x21)
    node.errors.collect(7.0)
    assert len(node.sink.take()) == 2, "what an axis has is its own"


# --- the bus ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("name", "code", "register", "lasts"), [
    ("communication_error", 0x8100, GENERIC | COMMUNICATION, False),
    ("pdo_not_accepted", 0x6320, GENERIC | PROFILE, True),
    ("pdo_too_short", 0x8210, GENERIC | COMMUNICATION, True),
    ("pdo_too_long", 0x8220, GENERIC | COMMUNICATION, True),
    ("heartbeat_lost", 0x8130, GENERIC | COMMUNICATION, True),
    ("error_passive", 0x8120, GENERIC | COMMUNICATION, False),
    ("controller_overflow", 0x8110, GENERIC | COMMUNICATION, False),
    ("transmit_overflow", 0x8110, GENERIC | COMMUNICATION, False),
    ("receive_overflow", 0x8110, GENERIC | COMMUNICATION, False),
    ("bus_off_recovered", 0x8140, GENERIC | COMMUNICATION, False),
])  # fmt: skip
def test_a_condition_of_the_bus_is_told_and_lasts_or_is_over_when_told(node, name, code, register, lasts):
    node.axes[2].error_register = 0x80
    node.errors.condition(name, 3.0)
    ((told, _, shown),) = node.sink.take()
    assert (told, shown) == (code, register | 0x80) and node.log == [("flush", 3.0)]
    assert node.history() == [code]
    assert node.errors.register() == 0x80 | (register if lasts else 0)
    node.errors.condition(name, 4.0)
    assert len(node.sink.take()) == (0 if lasts else 1), "what is known is not told again"


def test_conditions_are_those_of_whom_they_are(node):
    node.errors.condition("pdo_too_short", 3.0, key=1)
    node.errors.condition("pdo_too_short", 3.0, key=2)
    node.errors.condition("pdo_too_short", 3.0, key=1)
    assert len(node.sink.take()) == 2 and set(node.errors.conditions) == {1, 2}
    node.errors.condition("pdo_too_long", 3.0, key=1)
    assert len(node.sink.take()) == 1, "it has become another"
    node.errors.restart()
    assert node.errors.conditions == {} and node.sink.cleared == 1 and len(node.history()) == 3


def test_the_end_of_a_condition_is_told_of_no_further_axis(node):
    node.queue(3, "positive_software_limit", 0)
    node.errors.collect(1.0)
    node.errors.condition("heartbeat_lost", 2.0)
    node.sink.take()
    node.errors.conditions.clear()
    node.errors.collect(3.0)
    assert node.sink.take() == [(0, (0, 0), 0)]


def test_a_condition_that_a_device_s_table_lacks_is_not_told(node):
    node.errors.condition_if_known("sync_length", 3.0)
    assert node.sink.take() == []
    node.errors.condition_if_known("heartbeat_lost", 3.0)
    assert len(node.sink.take()) == 1
    assert {row.lasts for row in OPTIONAL_CONDITIONS.values()} == {True}
    assert {row.error_register for row in OPTIONAL_CONDITIONS.values()} == {GENERIC | COMMUNICATION}
    assert len(CONDITIONS) == 10


# --- objects ----------------------------------------------------------------------------------------------------------
def test_the_history_has_the_newest_first_and_so_many():
    history = ErrorHistory(3)
    for code in (0x1000, 0, 0x2000, 0x3000, 0x4000):
        history.add(code, axis=1, number=0x7F)
    assert [history.read(sub) for sub in (0, 1, 2, 3)] == [3, 0x3F014000, 0x3F013000, 0x3F012000]
    history = ErrorHistory(3)
    history.add(0x1000)
    assert history.read(1) == 0x1000
    with pytest.raises(ObjectAccessError, match=r"^1003h:02 holds no error; there are 1 ") as error:
        history.read(2)
    assert error.value.abort_code == 0x08000024
    with pytest.raises(ObjectAccessError, match=r"^1003h:00 cannot be 1; 0 clears it ") as error:
        history.write(1)
    assert error.value.abort_code == 0x06090030 and history.read(0) == 1
    history.write(0)
    assert history.read(0) == 0
