"""The EtherCAT state machine: every transition, every refusal with its AL status code, what the watchdog forces."""

from __future__ import annotations

import struct

import pytest
from rigs.ethercat_rig import MAILBOXES, NO_BOOTSTRAP, PROCESS_DATA, STATION, Rig

from drive_env.ethercat.application import AlState, AlStatusCode

I, P, B, S, O = AlState.INIT, AlState.PRE_OP, AlState.BOOTSTRAP, AlState.SAFE_OP, AlState.OP
ERROR, ACKNOWLEDGE = 0x10, 0x10


def rig_in(state, **arguments):
    rig = Rig(**arguments)
    rig.address()
    rig.bring_to(state)
    return rig


@pytest.mark.parametrize(("start", "wanted"), [
    (I, I), (I, P), (I, B), (P, P), (P, I), (P, S), (B, B), (B, I), (S, S), (S, I), (S, P), (S, O), (O, O), (O, I),
    (O, P), (O, S),
])  # fmt: skip
def test_a_transition(start, wanted):
    rig = rig_in(start)
    if (start, wanted) in ((I, P), (I, B)):
        rig.write(0x0800, MAILBOXES)
    elif (start, wanted) == (P, S):
        rig.write(0x0810, PROCESS_DATA)
    assert rig.request(wanted) == (wanted, 0)
    if wanted is not start:
        assert rig.devices[0].events[-1] == (wanted.name, 0)


@pytest.mark.parametrize(("start", "wanted", "code"), [
    (I, S, 0x0011), (I, O, 0x0011), (P, O, 0x0011), (P, B, 0x0011), (S, B, 0x0011), (O, B, 0x0011), (B, P, 0x0011),
    (B, S, 0x0011), (B, O, 0x0011),
    (I, 0, 0x0012), (P, 5, 0x0012), (S, 9, 0x0012), (O, 15, 0x0012), (B, 7, 0x0012),
])  # fmt: skip
def test_a_transition_that_does_not_exist(start, wanted, code):
    rig = rig_in(start)
    assert rig.request(wanted) == (start | ERROR, code)


@pytest.mark.parametrize(("start", "wanted", "address", "setting", "code"), [
    (I, P, 0x0800, "", 0x0016),  # no sync manager at all
    (I, P, 0x0800, "00 10 40 00 26 00 01 00", 0x0016),  # the second is missing
    (I, P, 0x0800, "00 10 40 00 26 00 00 00  80 10 40 00 22 00 01 00", 0x0016),  # switched off
    (I, P, 0x0800, "10 10 40 00 26 00 01 00  80 10 40 00 22 00 01 00", 0x0016),  # elsewhere
    (I, P, 0x0800, "00 10 41 00 26 00 01 00  80 10 40 00 22 00 01 00", 0x0016),  # longer
    (I, P, 0x0800, "00 10 40 00 22 00 01 00  80 10 40 00 22 00 01 00", 0x0016),  # the other direction
    (I, P, 0x0800, "00 10 40 00 24 00 01 00  80 10 40 00 22 00 01 00", 0x0016),  # three buffers
    (I, B, 0x0800, "00 10 40 00 26 00 01 00", 0x0015),
    (P, S, 0x0810, "", 0x001D),
    (P, S, 0x0810, "00 11 05 00 64 00 01 00  80 11 06 00 20 00 01 00", 0x001D),
    (P, S, 0x0810, "00 11 04 00 26 00 01 00  80 11 06 00 20 00 01 00", 0x001D),  # a mailbox
    (P, S, 0x0810, "00 11 04 00 64 00 01 00  80 11 06 00 20 00 00 00", 0x001E),
    (P, S, 0x0810, "00 11 04 00 64 00 01 00  80 11 05 00 20 00 01 00", 0x001E),
    (P, S, 0x0810, "00 11 04 00 64 00 01 00  80 11 06 00 24 00 01 00", 0x001E),
])  # fmt: skip
def test_a_state_is_refused_for_its_sync_managers(start, wanted, address, setting, code):
    rig = rig_in(start)
    if setting:
        rig.write(address, setting)
    assert rig.request(wanted) == (start | ERROR, code)


def test_bootstrap_that_a_device_does_not_have():
    rig = Rig(layout=NO_BOOTSTRAP)
    rig.address()
    rig.write(0x0800, MAILBOXES)
    assert rig.request(B) == (I | ERROR, 0x0013)


@pytest.mark.parametrize("code", [AlStatusCode.INPUT_MAPPING, AlStatusCode.DC_CYCLE_TIME, AlStatusCode.UNSPECIFIED])
@pytest.mark.parametrize(("start", "wanted"), [(P, S), (S, O)])
def test_the_device_refuses(start, wanted, code):
    rig = rig_in(start)
    if start is P:
        rig.write(0x0810, PROCESS_DATA)
    rig.devices[0].refuses = code
    assert rig.request(wanted) == (start | ERROR, code)
    rig.devices[0].refuses = AlStatusCode.NO_ERROR
    assert rig.request(wanted | ACKNOWLEDGE) == (wanted, 0)


def test_nobody_goes_up_before_the_error_is_acknowledged():
    rig = rig_in(P)
    assert rig.request(O) == (P | ERROR, 0x0011)
    rig.write(0x0810, PROCESS_DATA)
    assert rig.request(S) == (P | ERROR, 0x0011)  # nothing happens
    assert rig.request(P) == (P | ERROR, 0x0011)
    assert rig.request(P | ACKNOWLEDGE) == (P, 0)
    assert rig.request(S) == (S, 0)


def test_down_it_goes_without():
    rig = rig_in(S)
    rig.request(7)
    assert rig.request(P) == (P, 0)


@pytest.mark.parametrize(("start", "register", "forced", "code"), [
    (P, 0x0806, I, 0x0016), (S, 0x080E, I, 0x0016), (B, 0x0806, I, 0x0015), (S, 0x0816, P, 0x001D),
    (O, 0x081E, P, 0x001E),
])  # fmt: skip
def test_a_sync_manager_that_is_switched_off(start, register, forced, code):
    rig = rig_in(start)
    rig.write(register, "00")
    assert (rig.value(0x0130), rig.value(0x0134)) == (forced | ERROR, code)
    assert rig.devices[0].events[-1] == (forced.name, code)


def test_a_device_without_outputs_has_their_sync_manager_off():
    rig = Rig()
    rig.address()
    rig.bring_to(P)
    rig.devices[0].output_size = 0
    rig.write(0x0810, PROCESS_DATA)
    assert rig.request(S) == (P | ERROR, 0x001D)
    rig.write(0x0816, "00")
    assert rig.request(S | ACKNOWLEDGE) == (S, 0)


def test_outputs_reach_the_device_in_op_alone():
    rig = rig_in(S)
    _, counter = rig.exchange(b"\1\2\3\4")
    assert counter == 3 and rig.devices[0].taken == bytes(4)
    rig.request(O)
    rig.exchange(b"\1\2\3\4")
    assert rig.devices[0].taken == b"\1\2\3\4"


def test_inputs_are_there_as_soon_as_it_is_in_safe_op():
    rig = rig_in(P)
    rig.write(0x0810, PROCESS_DATA)
    assert rig.read(0x1180, 6) is None
    rig.request(S)
    assert rig.read(0x1180, 6) is not None


# --- the watchdog of process data -------------------------------------------------------------------------------------
def test_silence_in_op_ends_it():
    """100 ms after the last outputs: divider 2498 + 2 of 40 ns, 1000 times (ET1100, 0400h, 0420h)."""
    rig = rig_in(O)
    rig.exchange(b"\1\2\3\4")
    world, device = rig.world, rig.devices[0]
    world.lockstep = False
    start = world.time
    world.run_until(start + 0.098)
    assert rig.value(0x0130) == O and rig.value(0x0440) == 1
    world.run_until(start + 0.102)
    assert (rig.value(0x0130), rig.value(0x0134)) == (S | ERROR, 0x001B)
    assert rig.value(0x0440) == 0 and rig.value(0x0442, 1) == 1
    assert [event[0] for event in device.events[-2:]] == ["watchdog", "SAFE_OP"]
    assert device.events[-1] == ("SAFE_OP", 0x001B)
    world.run_until(start + 0.5)
    assert rig.value(0x0442, 1) == 1  # once
    assert rig.request(O | ACKNOWLEDGE) == (O, 0)  # it is back without a restart
    rig.exchange(b"\1\2\3\4")
    world.run_until(start + 0.55)
    assert rig.value(0x0130) == O


@pytest.mark.parametrize(("divider", "time", "limit"), [(2498, 10, 1e-3), (2498, 250, 25e-3), (998, 500, 20e-3)])
def test_the_watchdogs_time_is_the_masters(divider, time, limit):
    rig = rig_in(S)
    rig.write(0x0400, struct.pack("<H", divider))
    rig.write(0x0420, struct.pack("<H", time))
    rig.request(O)
    world = rig.world
    world.lockstep = False
    start = world.time
    world.run_until(start + 0.98 * limit)
    assert rig.value(0x0130) == O
    world.run_until(start + 1.02 * limit)
    assert rig.value(0x0134) == 0x001B


@pytest.mark.parametrize("off", ["time", "control"])
def test_a_watchdog_that_is_off_never_expires(off):
    rig = rig_in(P)
    rig.write(0x0810, PROCESS_DATA)
    if off == "time":
        rig.write(0x0420, "00 00")
    else:
        rig.write(0x0816, "00")
        rig.write(0x0810, PROCESS_DATA.replace("64", "24", 1))
    assert rig.request(S) == (S, 0) and rig.request(O) == (O, 0)
    rig.world.lockstep = False
    rig.world.run_until(10.0)
    assert rig.value(0x0130) == O


def test_reading_inputs_does_not_feed_it():
    rig = rig_in(O)
    world = rig.world
    world.lockstep = False
    start = world.time
    for k in range(120):
        world.run_until(start + k * 1e-3)
        rig.read(0x1180, 6)
    assert rig.value(0x0134) == 0x001B


def test_each_slave_has_its_own():
    rig = Rig(2)
    rig.address()
    for k in range(2):
        rig.bring_to(O, STATION + k)
    world = rig.world
    world.lockstep = False
    start = world.time
    for k in range(120):
        world.run_until(start + k * 1e-3)
        rig.write(0x1100, "01 02 03 04", STATION + 1)
    assert [rig.value(0x0130, station=STATION + k) for k in range(2)] == [S | ERROR, O]


@pytest.mark.parametrize(
    ("state", "mailbox", "counter", "locked"),
    [
        (AlState.OP, 1, 3, "0000"),
        (AlState.SAFE_OP, 1, 3, "0000"),
        (AlState.PRE_OP, 1, 0, "0011"),
        (AlState.INIT, 0, 0, "1111"),
    ],
)
def test_the_working_counter_says_that_a_slave_has_left_op(state, mailbox, counter, locked):
    """A device deactivates the sync managers that its state has not (ET1100, section I, 8: 0807h bit 0)."""
    rig = Rig()
    rig.address()
    rig.bring_to(AlState.OP)
    if state is not AlState.OP:
        assert rig.request(state) == (state, 0)
    assert "".join(str(rig.value(0x0807 + 8 * k, 1) & 1) for k in range(4)) == locked
    assert rig.exchange(bytes(4))[1] == counter
    assert rig.mail(3, bytes(10)) == mailbox
    if state < AlState.SAFE_OP:  # and it can be had again
        rig.bring_to(AlState.OP)
        assert rig.exchange(bytes(4))[1] == 3 and rig.mail(3, bytes(10)) == 1
