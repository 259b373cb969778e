"""The master's use of a slave's watchdog of process data, by its registers alone."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import pytest

from drive_env.ethercat import registers
from drive_env.fieldbus.link import NoWatchdogError
from drive_env.master.ethercat import process_watchdog
from drive_env.master.ethercat.process_watchdog import OUTPUTS_CONTROL, ProcessWatchdog


class Slaves:
    """The registers of slaves, by position; one that is none reads as None, one of another length is a mistake."""

    def __init__(self, dividers, control=0x64, takes=True):
        self.registers = {
            position: {
                OUTPUTS_CONTROL: bytes((control,)),
                registers.WATCHDOG_DIVIDER: struct.pack("<H", divider),
                registers.SM_WATCHDOG: struct.pack("<H", 1000),
            }
            for position, divider in dividers.items()
        }
        self.takes, self.is_op = takes, True

    def register(self, position, address, size):
        found = self.registers[position].get(address)
        assert found is None or len(found) == size
        return None if found is None else bytes(bytearray(found))  # as it comes over a cable

    def write_register(self, position, address, data):
        if self.takes:
            self.registers[position][address] = data

    def status(self, position):
        return SimpleNamespace(is_op=self.is_op)

    def count(self, position):
        return struct.unpack("<H", self.registers[position][registers.SM_WATCHDOG])[0]


class Data:
    """Process data that notes each exchange."""

    def __init__(self):
        self.exchanges, self.exchanged_at, self.is_silent = [], 0.0, True

    def exchange(self, *, is_cycle):
        self.exchanges.append(is_cycle)


class Objects:
    """The objects of a node by which it stops when its connection is lost."""

    def __init__(self):
        self.done, self.in_force = [], True

    def quick_stop_on_lost_connection(self):
        self.done.append("set")

    def restore(self):
        self.done.append("restored")

    def forget(self):
        self.done.append("forgotten")

    def are_in_force(self):
        return self.in_force

    def holds(self, key):
        return key == (0x605E, 0)


def watch(slaves):
    nodes = tuple(slaves.registers)
    watchdog = ProcessWatchdog(slaves, nodes, [None] * len(nodes), Data(), None)
    watchdog._objects = [Objects() for _ in nodes]
    return watchdog


@pytest.mark.parametrize(("divider", "silence", "count", "time"), [
    (2498, 0.3, 3000, 0.3),  # (2498 + 2) times 40 ns: 100 us, of which 3000 are 0.3 s
    (2498, 0.10009, 1000, 0.1),  # less is allowed, more is not
    (0, 1e-3, 12500, 1e-3),  # 80 ns
    (2498, 1e-6, 1, 1e-4),  # never 0, which would switch it off
    (2498, 60.0, 0xFFFF, 6.5535),  # the register's most
])  # fmt: skip
def test_the_count_of_ticks_is_the_silence_over_the_divider_s_tick(divider, silence, count, time):
    slaves = Slaves({1: divider})
    watchdog = watch(slaves)
    assert watchdog.detection_time == float("inf")
    watchdog.begin(silence)
    assert slaves.count(1) == count
    assert watchdog.detection_time == pytest.approx(time)
    assert watchdog._objects[0].done == ["set"]


def test_all_have_noticed_when_the_last_one_has():
    watchdog = watch(Slaves({1: 2498, 2: 24998, 3: 2498}))
    watchdog.begin(2.5e-3)  # 25 ticks of 100 us, 2 of 1 ms
    assert watchdog.detection_time == pytest.approx(2.5e-3)
    watchdog = watch(Slaves({1: 24998, 2: 2498}))
    watchdog.begin(0.5e-3)  # one tick of 1 ms is the least that the first slave has
    assert watchdog.detection_time == pytest.approx(1e-3)


def test_the_control_of_the_outputs_is_at_0814h():
    assert OUTPUTS_CONTROL == 0x0814


@pytest.mark.parametrize(("slaves", "said"), [
    (Slaves({4: 2498}, control=0xBF), "position 4 does not watch its outputs"),
    (Slaves({4: 2498}, control=0x24), "position 4 does not watch its outputs"),
    (Slaves({4: 2498}, takes=False), "position 4 took b80b for 0420h and has e803"),
])  # fmt: skip
def test_a_slave_that_does_not_watch_is_refused(slaves, said):
    with pytest.raises(NoWatchdogError, match=said):
        watch(slaves).begin(0.3)


def test_a_slave_that_does_not_answer_is_refused():
    slaves = Slaves({4: 2498})
    del slaves.registers[4][registers.WATCHDOG_DIVIDER]
    with pytest.raises(NoWatchdogError, match="position 4 does not answer"):
        watch(slaves).begin(0.3)


def test_it_is_in_force_only_in_op_with_the_time_and_the_objects_that_were_set():
    slaves = Slaves({1: 2498, 2: 2498})
    watchdog = watch(slaves)
    assert not watchdog.is_in_force(1), "nothing was set"
    watchdog.begin(0.3)
    assert watchdog.is_in_force(1) and watchdog.is_set(1)
    slaves.is_op = False
    assert not watchdog.is_in_force(1), "it watches in Op alone"
    slaves.is_op, watchdog._objects[1].in_force = True, False
    assert not watchdog.is_in_force(1)
    watchdog._objects[1].in_force = True
    slaves.write_register(2, registers.SM_WATCHDOG, struct.pack("<H", 0))
    assert not watchdog.is_in_force(1), "somebody else set it"
    assert watchdog.is_in_force(0)


def test_what_was_found_is_put_back_once_and_of_the_first_time():
    slaves = Slaves({1: 2498, 2: 2498})
    watchdog = watch(slaves)
    watchdog.begin(0.3)
    watchdog.begin(0.2)  # finds what it set itself
    watchdog.restore(0)
    assert (slaves.count(1), slaves.count(2)) == (1000, 2000)
    assert not watchdog.is_set(0) and watchdog.is_set(1)
    assert watchdog._objects[0].done == ["set", "set", "restored"]
    slaves.write_register(1, registers.SM_WATCHDOG, struct.pack("<H", 7))
    watchdog.restore(0)
    assert slaves.count(1) == 7, "nothing is left to put back"
    watchdog.forget(1)
    watchdog.restore(1)
    assert slaves.count(2) == 2000, "it was reset, and has its own values"


def test_it_depends_on_the_objects_of_nodes_that_are_set():
    watchdog = watch(Slaves({1: 2498}))
    assert not watchdog.holds((0x605E, 0))
    watchdog.begin(0.3)
    assert watchdog.holds((0x605E, 0)) and not watchdog.holds((0x605D, 0))


@pytest.mark.parametrize(("silence", "idle", "exchanges"), [
    (0.03, 0.009, []), (0.03, 0.011, [False]),  # a third of its time
    (None, 0.032, []), (None, 0.034, [False]),  # of the factory's 100 ms, as long as nothing else is set
    (3.0, 0.034, [False]),  # and of these with a longer one
])  # fmt: skip
def test_images_keep_it_quiet_before_its_time_is_over(silence, idle, exchanges, monkeypatch):
    watchdog = watch(Slaves({1: 2498}))
    monkeypatch.setattr(process_watchdog.time, "monotonic", lambda: 1000.0)
    watchdog._data.exchanged_at = 1000.0
    if silence:
        watchdog.begin(silence)
        assert not watchdog._data.is_silent
    watchdog._data.exchanged_at = 1000.0 - idle
    watchdog.keep()
    assert watchdog._data.exchanges == exchanges
    watchdog.cease()
    assert watchdog._data.exchanges == [*exchanges, False] and watchdog._data.is_silent
    watchdog.end()
    assert watchdog.detection_time == float("inf")


@pytest.mark.parametrize(("address", "value"), [(0x0420, 0), (0x0420, 0xFFFF), (0x0400, 0xFFFF), (0x0400, 0)])
def test_a_watchdog_that_another_master_has_changed_is_told_once_and_set_again(address, value, monkeypatch):
    slaves, now = Slaves({1: 2498, 4: 2498}), SimpleNamespace(now=100.0)
    monkeypatch.setattr(process_watchdog, "time", SimpleNamespace(monotonic=lambda: now.now))
    watchdog = watch(slaves)
    assert watchdog.take_rival() == "", "none is set"
    now.now += 1.0
    watchdog.begin(0.1)
    now.now += 1.0
    assert watchdog.take_rival() == "" and watchdog.is_in_force(1)
    before = struct.unpack("<H", slaves.registers[4][address])[0]
    slaves.write_register(4, address, struct.pack("<H", value))
    assert not watchdog.is_in_force(1)
    assert watchdog.take_rival() == "", "it looks every 50 ms"
    now.now += 0.06
    told = watchdog.take_rival()
    assert told.startswith("another master has changed the watchdog of position 4 (0400h, 0420h), so that")
    assert slaves.registers[4][address] == struct.pack("<H", before) and watchdog.is_in_force(1)
    now.now += 1.0
    assert watchdog.take_rival() == ""


def test_a_slave_that_does_not_answer_is_no_rival():
    slaves = Slaves({1: 2498})
    watchdog = watch(slaves)
    watchdog.begin(0.1)
    slaves.registers[1].clear()
    assert watchdog.take_rival() == "" and not slaves.registers[1]
