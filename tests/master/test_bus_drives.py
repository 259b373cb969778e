"""Drives on a link of this test: which objects of which node are asked, what the envelope is told, and when."""

from __future__ import annotations

import logging
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.small_eds import TYPES, eds_of

from drive_env import Limits
from drive_env.dictionary.aborts import WRONG_STATE, ObjectAccessError
from drive_env.dictionary.position_scale import position_scale
from drive_env.dictionary.roles import Role
from drive_env.fieldbus.description import describe
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.fieldbus.link import ReceivedEmergency
from drive_env.master.bus_drives import BusDrives, checked_limits
from drive_env.master.pace import LockstepPace, RealTimePace

IDENTITY = [(0x1000, 0), (0x1018, 1), (0x1018, 2)]


class Objects:
    """A node's objects as bytes; what is in `silent` or `refused` says so."""

    def __init__(self, link, node):
        self.link, self.node, self.values = link, node, {}
        self.silent, self.refused, self.patience = set(), set(), {}

    def _ask(self, what, key, timeout):
        self.link.log.append((what, self.node, *key))
        self.patience[key] = timeout
        if key in self.silent:
            raise NoAnswerError(f"node {self.node} is silent")
        if key in self.refused:
            raise ObjectAccessError(WRONG_STATE, f"node {self.node} refuses")

    def read(self, index, sub, label, timeout):
        self._ask("read", (index, sub), timeout)
        return self.values.get((index, sub), bytes(4))

    def write(self, index, sub, data, label, timeout):
        self._ask("write", (index, sub), timeout)
        self.values[index, sub] = data
        self.link.labels.append(label)


class Process:
    """Process data: everything fits, and samples come at once."""

    def __init__(self, link):
        self.link, self.mapping, self.mapped = link, 0, ((), ())
        self.broken, self.rows = set(), {}

    def before(self, node, key):
        return None

    def check_sampled(self, entries):
        pass

    check_played = check_sampled

    def choose(self, wanted, welcome, played=()):
        return tuple(dict.fromkeys((*wanted, *welcome)))

    def is_mapped(self, played, sampled):
        return (not played or played == self.mapped[0]) and set(sampled) <= set(self.mapped[1])

    def map(self, played, sampled):
        self.mapping += 1
        self.mapped = (played, sampled)

    def sampled_entries(self):
        return self.mapped[1]

    def outputs(self, played):
        self.link.log += [("out", f"{entry.index:04X}", rows.tolist()) for entry, rows in played.items()]
        return self if played else None

    def send(self, row):
        self.link.log.append(("row", row))

    def samples(self):
        if not self.mapped[1]:
            return None
        self.first = self.link.syncs
        return self

    def complete(self):
        return self.link.syncs - self.first

    def decode(self, first, last):
        axes = len(self.link.nodes) * self.link.axes
        rows = np.arange(first, last)[:, None] * 100 + np.arange(axes)
        return {(entry.index, entry.sub): rows for entry in self.mapped[1]}

    def close(self):
        pass

    def forget(self, nodes):
        self.link.log.append(("forget", *nodes))

    def restore(self, node):
        self.link.log.append(("restore", node))
        if node in self.broken:
            raise BusError("it is gone")


class Line:
    """The link."""

    is_dry = False

    def __init__(self, description, *nodes, whole=True):
        self.nodes, self.log, self.labels, self.syncs, self.starts = nodes, [], [], 0, 0
        self.axes, self.emergencies, self.is_closed = description.num_axes, [], False
        self.objects = [Objects(self, k) for k in range(len(nodes))]
        for node in self.objects if whole else ():
            for key in IDENTITY:
                node.values[key] = int(description.dictionary.find(key).default).to_bytes(4, "little")
        self.process = Process(self)

    def hear(self, alive, restarted):
        self.alive, self.restarted = alive, restarted

    def sdo(self, node):
        return self.objects[node]

    def wake(self, node):
        self.log.append(("wake", node))
        self.objects[node].silent.clear()

    def welcome(self, node):
        self.log.append(("welcome", node))

    def start(self, nodes=None):
        self.starts += 1

    def reset(self, nodes):
        self.log.append(("reset", *nodes))

    def take_emergencies(self):
        taken, self.emergencies = self.emergencies, []
        return taken

    def sync(self):
        self.syncs += 1

    def receive(self, timeout=0.0):
        return False

    def wait(self, done, timeout):
        return done()

    def close(self):
        self.is_closed = True


class Watcher:
    """An envelope that notes what it is told."""

    epoch = 7

    def __init__(self, log):
        self.log, self.lost, self.lent = log, set(), {}
        self.entries = ()

    def __getattr__(self, name):
        return lambda *arguments: self.log.append((name, *arguments))

    def has_lost(self, node):
        return node in self.lost

    def own(self, entry, axis, found):
        return self.lent.get(axis, found)

    def write_lent(self, entry, axis, value):
        if axis in self.lent:
            self.lent[axis] = value
        return axis in self.lent

    def watched(self):
        return self.entries

    def told(self):
        """Return the names of what it was told, but for its being entered."""
        return [row[0] for row in self.log if row[0] != "enter"]


def opened(*nodes, device="tmcm1636", pace=None, **options):
    description = describe(device, None)
    link = Line(description, *(nodes or (5,)))
    drives = BusDrives(link, description, pace or LockstepPace(), safety=options.pop("safety", False))
    link.log.clear()
    return drives, link


@pytest.fixture
def two():
    drives, link = opened(5, 9)
    yield drives, link
    drives.close()


@pytest.fixture
def watched(two):
    drives, link = two
    drives.safety = watcher = Watcher([])
    yield drives, link, watcher
    drives.safety = None


# --- who is there -----------------------------------------------------------------------------------------------------
def test_every_node_is_asked_who_it_is():
    description = describe("tmcm1636", None)
    link = Line(description, 5, 9)
    drives = BusDrives(link, description, LockstepPace(), safety=False)
    each = [[("read", k, *key) for key in IDENTITY] + [("welcome", k)] for k in (0, 1)]
    assert link.log == each[0] + each[1]
    assert drives.nodes == (5, 9) and drives.num_axes == 2 and drives.safety is None and drives.bus is drives
    drives.close()


@pytest.mark.parametrize(
    ("key", "said"),
    [
        (
            (0x1018, 1),
            r"node 9 is not a tmcm1636: its vendor \(1018h:01 .*\) is 7B, and the EDS says 286h; give its own",
        ),
        ((0x1018, 2), r"node 9 is not a tmcm1636: its product \(1018h:02 .*\) is 7B, and the EDS says"),
    ],
)
def test_another_device_is_refused_and_the_link_closed(key, said):
    description = describe("tmcm1636", None)
    link = Line(description, 5, 9)
    link.objects[1].values[key] = (0x7B).to_bytes(4, "little")
    with pytest.raises(BusError, match=said.replace("7B", "7Bh")):
        BusDrives(link, description, LockstepPace(), safety=False)
    assert link.is_closed
    assert ("welcome", 0) in link.log and ("welcome", 1) not in link.log


def test_a_device_that_is_known_is_named_with_the_way_to_open_it():
    description, other = describe("tmcm1636", None), describe("tmcm6212", None)
    link = Line(description, 5)
    for key in IDENTITY:
        link.objects[0].values[key] = int(other.dictionary.find(key).default).to_bytes(4, "little")
    with pytest.raises(BusError, match=r"it is a tmcm6212: name it so \(device='tmcm6212', --device tmcm6212\)"):
        BusDrives(link, description, LockstepPace(), safety=False)


@pytest.mark.parametrize(("kind", "said"), [
    (0x420192, r"node 5 is a tmcm1636_fw109, not a tmcm1636: its device type \(1000h:00\) is 00420192h; name it so "
     r"\(device='tmcm1636_fw109', --device tmcm1636_fw109\)"),
    (0x420193, None),  # of no variant that is known
])  # fmt: skip
def test_another_variant_may_count_in_other_units_and_is_named(kind, said):
    description = describe("tmcm1636", None)
    link = Line(description, 5)
    link.objects[0].values[0x1000, 0] = kind.to_bytes(4, "little")
    if said is None:
        BusDrives(link, description, LockstepPace(), safety=False).close()
        return
    with pytest.raises(BusError, match=said):
        BusDrives(link, description, LockstepPace(), safety=False)


def test_a_stopped_node_is_woken_and_told_of(caplog):
    description = describe("tmcm1636", None)
    link = Line(description, 5, 9)
    link.objects[1].silent.add((0x1000, 0))
    with caplog.at_level(logging.WARNING):
        BusDrives(link, description, LockstepPace(), safety=False).close()
    assert link.log.count(("wake", 1)) == 1 and ("wake", 0) not in link.log
    assert "node 9 was stopped (a master that died?) and is pre-operational now" in caplog.text


def test_safety_is_limits_or_a_truth_value():
    assert checked_limits(False) is None
    assert checked_limits(True) == Limits()
    limits = Limits(velocity=100)
    assert checked_limits(limits) is limits
    for wrong in (None, 1, "no"):
        with pytest.raises(TypeError, match=rf"safety = {wrong!r} must be Limits, True for those of the drives, or"):
            checked_limits(wrong)


# --- objects ----------------------------------------------------------------------------------------------------------
def test_an_object_is_read_of_every_axis_in_turn(two):
    drives, link = two
    link.objects[0].values[0x606C, 0], link.objects[1].values[0x606C, 0] = b"\x01\0\0\0", b"\xfe\xff\xff\xff"
    assert drives.read(0x606C).tolist() == [1, -2]
    assert link.log == [("read", 0, 0x606C, 0), ("read", 1, 0x606C, 0)]


def test_axes_of_a_node_have_objects_of_their_own():
    drives, link = opened(5, 9, device="tmcm3313")
    assert drives.num_axes == 6
    drives.write(0x60FF, np.arange(6), where=np.array([1, 0, 1, 0, 1, 0], bool))
    assert link.log == [("write", 0, 0x60FF, 0), ("write", 0, 0x70FF, 0), ("write", 1, 0x68FF, 0)]
    assert link.objects[1].values[0x68FF, 0] == b"\x04\0\0\0"
    assert link.labels[-1].startswith("4 to 68FFh:00 ")
    drives.close()


def test_what_cannot_be_written_is_not_sent(two):
    drives, link = two
    for name, value in ((0x6041, 1), (0x6040, 0x10000), (0x6060, [3, 300])):
        with pytest.raises(ObjectAccessError):
            drives.write(name, value)
    assert link.log == []


def test_an_axis_that_refuses_ends_the_write_and_those_before_keep_it(two):
    drives, link = two
    link.objects[1].refused.add((0x60FF, 0))
    with pytest.raises(ObjectAccessError, match="node 1 refuses"):
        drives.write(0x60FF, [3, 4])
    assert link.objects[0].values[0x60FF, 0] == b"\x03\0\0\0"


def test_the_envelope_is_told_of_a_write_before_and_after(watched):
    drives, link, watcher = watched
    drives.write(0x60FF, [3, 4])
    assert watcher.told() == ["before_write", "after_write"]
    assert watcher.log[-1][2].tolist() == [3, 4] and watcher.log[-1][3].tolist() == [True, True]
    watcher.log.clear()
    link.objects[1].refused.add((0x60FF, 0))
    with pytest.raises(ObjectAccessError):
        drives.write(0x60FF, [3, 4])
    assert watcher.told() == ["before_write", "after_failed_write"]


def test_what_is_lent_is_read_and_written_as_the_programs_own(watched):
    drives, link, watcher = watched
    watcher.lent[1] = 77
    assert drives.read(0x6065).tolist()[1] == 77
    link.log.clear()
    drives.write(0x6065, 5)
    assert link.log == [("write", 0, 0x6065, 0)] and watcher.lent[1] == 5
    assert drives.read_raw(drives.description.dictionary.find(0x6065), 1) == 0, "as the drive has it"


def test_slow_objects_are_waited_for(two):
    drives, link = two
    entry = drives.description.dictionary.find((0x1010, 1))
    drives.write_raw(entry, 1, 0x65766173)
    drives.read(0x6041)
    assert link.objects[1].patience[0x1010, 1] == drives.description.patience(entry)
    drives.description.timeout = 0.25
    drives.read(0x6041)
    drives.read_raw(entry, 1)
    assert link.objects[1].patience[0x6041, 0] == 0.25
    assert link.objects[1].patience[0x1010, 1] >= drives.description.hints.timeouts.get(0x1010, 0.25)


def test_a_scale_that_several_objects_make_is_reckoned():
    """A stepper counts microsteps: full steps of a turn, times two to the power of the resolution."""
    drives, link = opened(device="tmcm6212")
    scale = position_scale(drives.description.dictionary.roles)
    steps, exponent = (drives.description.dictionary.find(key) for key in scale.keys)
    for axis in range(drives.num_axes):
        for entry, value in ((steps, 200), (exponent, axis)):
            key = drives.description.key(entry, axis)
            link.objects[0].values[key] = drives.description.encode(entry, value)
    found = drives.read(Role.POSITION_SCALE)
    assert found.tolist() == [200, 400, 800, 1600, 3200, 6400] and found.dtype == np.int64
    drives.close()
    drives, link = opened()
    link.objects[0].values[drives.description.role(Role.POSITION_SCALE)] = (4096).to_bytes(4, "little")
    assert drives.read(Role.POSITION_SCALE).tolist() == [4096]  # that of one object is as the wire has it
    drives.close()


def test_a_quantity_becomes_the_integer_of_each_axis(two):
    drives, link = two
    scale = drives.description.role(Role.POSITION_SCALE)
    for node, increments in zip(link.objects, (1000, 4000), strict=True):
        node.values[scale] = increments.to_bytes(4, "little")
    drives.write(0x60FF, "30 rpm")
    assert [node.values[0x60FF, 0] for node in link.objects] == [b"\xf4\x01\0\0", b"\xd0\x07\0\0"]
    link.log.clear()
    drives.write(0x2003, "2 A", where=np.array([False, True]))
    assert link.log == [("write", 1, 0x2003, 0)]  # what follows no scale needs none
    assert link.objects[1].values[0x2003, 0] == b"\xd0\x07\0\0"


@pytest.mark.parametrize(("kind", "dtype"), [("u64", np.uint64), ("i64", np.int64), ("u32", np.int64)])
def test_an_unsigned64_comes_as_such_and_a_text_as_text(tmp_path, kind, dtype):
    TYPES.setdefault("u64", "0x001B")
    path = eds_of(tmp_path, (0x6041, "u16", "ro"), (0x2000, kind, "ro"), (0x2001, "text", "rw"))
    description = describe(None, path)
    link = Line(description, 5, whole=False)
    drives = BusDrives(link, description, LockstepPace(), safety=False)
    link.objects[0].values[0x2000, 0] = b"\xff" * (4 if kind == "u32" else 8)
    found = drives.read(0x2000)
    assert found.dtype == dtype and int(found[0]) == {"u64": 2**64 - 1, "i64": -1, "u32": 2**32 - 1}[kind]
    drives.write(0x2001, "left arm")
    assert link.objects[0].values[0x2001, 0] == b"left arm" and link.labels[-1] == "left arm to 2001h:00 object 2001"
    assert drives.read(0x2001).tolist() == ["left arm"]
    drives.close()


# --- cycles -----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("per_sync", "duration", "syncs"), [(1, 0.0, 0), (1, 0.005, 5), (4, 0.004, 1), (4, 0.005, 2), (4, 0.008, 2)]
)
def test_time_is_whole_syncs(per_sync, duration, syncs):
    drives, link = opened()
    drives.description.cycle, drives.description.cycles_per_sync = per_sync * 0.001, per_sync
    drives.advance(duration)
    assert link.syncs == syncs
    drives.close()


def test_a_record_has_a_row_for_every_period(two):
    drives, link = two
    trace = drives.record([0x6064, 0x606C], 0.005, period=0.002)
    assert link.syncs == 5 and link.starts == 1
    assert trace[0x6064].tolist() == [[0, 1], [200, 201], [400, 401]]
    assert trace.t.tolist() == pytest.approx([0.0, 0.002, 0.004])
    drives.record([0x6064, 0x606C], 0.001)
    assert link.process.mapping == 1, "the same call costs no configuration"
    with pytest.raises(ValueError, match=r"period must be at least 0\.001 s, not 0 s"):
        drives.record(0x6064, 0.005, period=0.0)


def test_a_call_is_known_again_until_64_others_were_made(two):
    drives, _ = two
    names = [(entry.index, entry.sub) for entry in drives.description.dictionary if entry.access in ("ro", "rw")][:65]
    first = drives._cycle_runner.call(names[:1], ())
    for name in names[1:64]:
        drives._cycle_runner.call([name], ())
        assert drives._cycle_runner.call(names[:1], ()) is first
    drives._cycle_runner.call(names[64:], ())
    assert drives._cycle_runner.call(names[:1], ()) is not first
    with pytest.raises(ObjectAccessError):
        drives._cycle_runner.call([[1, 2]], ())  # a name that is none


def test_rows_are_played_for_all_axes_or_each(two):
    drives, link = two
    drives.record(0x6064, 0.002, play={0x60FF: [1, 2], 0x6040: [[6, 7], [8, 9]]})
    assert [row for row in link.log if row[0] == "out"] == [
        ("out", "60FF", [[1, 1], [2, 2]]),
        ("out", "6040", [[6, 7], [8, 9]]),
    ]
    assert [row for row in link.log if row[0] == "row"] == [("row", 0), ("row", 1)]
    said = r"60FFh:00 .*: play takes shape \(2,\) or \(2, 2\), one row per cycle, not \(3,\)"
    with pytest.raises(ValueError, match=said):
        drives.record(0x6064, 0.002, play={0x60FF: [1, 2, 3]})
    with pytest.raises(ObjectAccessError):
        drives.record(0x6064, 0.001, play={0x6040: [0x10000]})


def test_set_points_to_drives_of_which_none_is_enabled_are_told_once(two):
    drives, _ = two
    drives.record(0x6064, 0.0, play={0x60FF: np.zeros(0, int)})
    drives.record(0x6064, 0.001, play={0x60FF: [1], 0x6040: [6]})  # who plays controlwords may enable
    with pytest.warns(UserWarning, match=r"^60FFh is played, but no axis is enabled \(6041h = 0000h\): nothing moves"):
        drives.record(0x6064, 0.001, play={"Target velocity": [1]})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drives.record(0x6064, 0.001, play={0x60FF: [1]})


def test_the_envelope_sees_what_is_played_and_what_comes_back(watched):
    drives, _, watcher = watched
    drives.record(0x6064, 0.002, play={0x60FF: [1, 2]})
    seen = watcher.told()
    assert seen == ["before_play", "sampled", "observe", "observe", "after_play"]
    assert [row[2] for row in watcher.log if row[0] == "observe"] == [7, 7]
    watcher.log.clear()
    drives.record(0x6064, 0.001, play={0x6040: [6]})
    assert [row[2] for row in watcher.log if row[0] == "observe"] == [-1], "samples that do not tell what a word did"
    watcher.log.clear()
    drives.record(0x6064, 0.0)
    assert "after_play" not in watcher.told()


def test_a_run_that_fails_is_told_to_the_envelope(watched):
    drives, link, watcher = watched

    def gone():
        raise BusError("gone")

    link.sync = gone
    with pytest.raises(BusError):
        drives.record(0x6064, 0.002, play={0x60FF: [1, 2]})
    assert watcher.told()[-1] == "after_failed_play" and "after_play" not in watcher.told()


def test_a_look_of_the_supervisors_own_is_one_sync(watched):
    drives, link, watcher = watched
    assert drives.poll(watcher) is None, "nothing is mapped"
    assert link.syncs == 0
    watcher.entries = (drives.description.dictionary.find(0x6041),)
    drives.prepare_watch(watcher)
    assert drives.sampled_entries() == watcher.entries
    assert drives.poll(watcher) is True and link.syncs == 1
    assert watcher.log[-1][0] == "observe" and watcher.log[-1][2] == 7
    watcher.log.clear()
    link.wait = lambda done, timeout: False
    assert drives.poll(watcher) is False and watcher.log == []


def test_nodes_are_started_once_and_after_a_restart(two):
    drives, link = two
    for _ in range(2):
        drives.start()
    assert link.starts == 1
    drives.must_start()
    drives.start()
    assert link.starts == 2
    drives.forget([1])
    drives.start()
    assert link.starts == 3 and ("forget", 1) in link.log


# --- emergencies and resets -------------------------------------------------------------------------------------------
def test_emergencies_are_of_an_axis_and_in_its_order(two):
    drives, link = two
    link.emergencies = [
        ReceivedEmergency(9, 0x8611, 0x20, (0,) * 5),
        ReceivedEmergency(5, 0x3210, 0x04, (1, 0, 0, 0, 0)),
        ReceivedEmergency(9, 0x0000, 0x00, (0,) * 5),
    ]
    found = drives.emergencies()
    assert [(one.axis, one.code, one.error_register) for one in found] == [
        (0, 0x3210, 4), (1, 0x8611, 0x20), (1, 0, 0),
    ]  # fmt: skip
    assert drives.emergencies() == []
    assert ("read", 0, 0x1000, 0) in link.log, "in lockstep what is on its way is waited for"


def test_in_real_time_nobody_is_asked_for_emergencies():
    drives, link = opened(pace=RealTimePace(0.001))
    assert drives.emergencies() == [] and link.log == []
    drives.close()


def test_a_node_of_several_axes_names_the_first_where_nothing_tells():
    drives, link = opened(5, 9, device="tmcm3313")
    link.emergencies = [ReceivedEmergency(9, 0x1234, 0, (0,) * 5)]
    assert [one.axis for one in drives.emergencies()] == [3]
    drives.close()


def test_a_node_is_reset_with_all_its_axes():
    drives, link = opened(5, 9, device="tmcm3313")
    drives.reset_node(np.array([0, 0, 0, 1, 1, 1], bool))
    assert [row for row in link.log if row[0] in ("reset", "forget")] == [("reset", 1), ("forget", 1)]
    link.log.clear()
    drives.reset_node()
    assert [row for row in link.log if row[0] in ("reset", "forget")] == [("reset", 0, 1), ("forget", 0, 1)]
    link.log.clear()
    drives.reset_node(np.zeros(6, bool))
    with pytest.raises(ValueError, match=r"a node is reset with all its axes; choose all axes of a node or none"):
        drives.reset_node(np.array([1, 0, 0, 0, 0, 0], bool))
    assert link.log == []
    drives.close()


def test_the_envelope_is_told_of_a_reset(watched):
    drives, _, watcher = watched
    drives.reset_node(np.array([False, True]))
    assert [row for row in watcher.log if "reset" in row[0]] == [("before_reset", [1]), ("after_reset", [1])]


def test_on_a_dry_run_nothing_restarts(two):
    drives, link = two
    link.is_dry = True
    assert drives.is_dry
    drives.reset_node()
    assert link.log == [("forget", 0, 1)]


# --- the end ----------------------------------------------------------------------------------------------------------
def test_closing_puts_process_data_back_and_works_once(caplog):
    drives, link = opened(5, 9)
    link.process.broken.add(0)
    with caplog.at_level(logging.ERROR):
        drives.close()
        drives.close()
    assert link.log == [("restore", 0), ("restore", 1)] and link.is_closed
    assert "it is gone: the PDOs of node 5 stay as they are" in caplog.text
    for use in (lambda: drives.read(0x6041), lambda: drives.advance(0.0), drives.emergencies, drives.reset_node):
        with pytest.raises(BusError, match=r"these drives are closed; open them again"):
            use()


def test_a_node_that_was_lost_is_left_to_its_watchdog():
    drives, link = opened(5, 9)
    drives.safety = Watcher([])
    drives.safety.lost.add(0)
    drives.close()
    assert link.log == [("restore", 1)] and drives.safety.told() == ["close"]


def test_an_error_in_the_program_stops_the_drives_first():
    drives, link = opened()
    drives.safety = watcher = Watcher([])
    with pytest.raises(KeyError), drives:
        raise KeyError("x")
    assert watcher.log == [("stop", "KeyError in the program"), ("close",)] and link.is_closed
    drives, link = opened()
    drives.safety = watcher = Watcher([])
    with drives:
        pass
    assert watcher.told() == ["close"] and link.is_closed


def test_the_link_tells_the_envelope_of_life_and_of_restarts(watched):
    _, link, watcher = watched
    link.alive()
    link.restarted(1)
    assert watcher.log == [("alive",), ("restarted", 1)]


def test_without_an_envelope_nobody_is_told(two):
    _, link = two
    link.alive()
    link.restarted(1)
    assert link.log == []


def test_how_punctual_it_was_is_the_paces(two):
    drives, _ = two
    drives._pace = SimpleNamespace(timing=1, total=2, time_waits=True)
    assert (drives.timing, drives.total_timing, drives.time_waits) == (1, 2, True)
