"""Whether a drive notices that its master is dead: what it is told to watch, and what the master sends it when."""

from __future__ import annotations

import math
import os
import struct
from types import SimpleNamespace

import pytest

from drive_env.dictionary.aborts import NO_SUCH_OBJECT, VALUE_RANGE, ObjectAccessError
from drive_env.fieldbus.errors import BusError
from drive_env.fieldbus.link import NoWatchdogError
from drive_env.master.can import error_control as module
from drive_env.master.can.error_control import MASTERS, Beats, ErrorControl, ErrorControls, Heartbeats, is_of_a_watchdog
from drive_env.master.changed_objects import ChangedObjects

CONSUMER, CONSUMER_2, GUARD, LIFE, BEHAVIOUR, LOST = (
    (0x1016, 1), (0x1016, 2), (0x100C, 0), (0x100D, 0), (0x1029, 1), (0x6007, 0)
)  # fmt: skip
OURS = 100  # the node-ID of this process


def consumer(node, milliseconds):
    """A value of 1016h: the node-ID above, the time below (CiA 301)."""
    return struct.pack("<HH", milliseconds, node)


class Objects:
    """A node's objects, as bytes; `takes` says what it makes of a value, None for a refusal."""

    def __init__(self, values, takes=None):
        self.values, self.takes, self.log = dict(values), takes or {}, []

    def read(self, index, sub, label, timeout):
        if (index, sub) not in self.values:
            raise ObjectAccessError(NO_SUCH_OBJECT, f"{label} is not there")
        return self.values[index, sub]

    def write(self, index, sub, data, label, timeout):
        taken = self.takes.get((index, sub), lambda data: data)(data)
        if taken is None:
            raise ObjectAccessError(VALUE_RANGE, f"{label} is refused")
        self.log.append(((index, sub), data))
        self.values[index, sub] = taken

    put_back = write


def control_of(values, *, takes=None, listed=None, alive=(), num_axes=1):
    """The error control of node 5, its objects, and how often its life was asked for."""
    objects = Objects(values, takes)
    keys = list(values) if listed is None else listed
    entries = {key: SimpleNamespace(index=key[0], sub=key[1]) for key in keys}

    class Known:
        def __iter__(self):
            return iter(entries.values())

        def find(self, key):
            return entries[key]

    description = SimpleNamespace(
        has=entries.__contains__, dictionary=Known(), device=None, answer_timeout=0.1, num_axes=num_axes,
        key=lambda entry, part: (entry.index + 0x800 * part, entry.sub),
    )  # fmt: skip
    waited = []
    heartbeats = SimpleNamespace(node_id=OURS, is_alive=lambda node, within: waited.append(within) or node in alive)
    asked = []
    return ErrorControl(5, objects, description, heartbeats, lambda: asked.append(1)), objects, waited, asked


# --- what a drive is told to watch --------------------------------------------------------------------------------
def test_a_drive_watches_our_heartbeats_and_has_what_it_had_afterwards():
    control, objects, waited, asked = control_of({CONSUMER: bytes(4)})
    assert (control.kind, control.time, control.holds(CONSUMER)) == ("none", math.inf, False)
    control.configure(0.5)
    assert objects.values[CONSUMER] == consumer(OURS, 500)
    assert (control.kind, control.time) == ("heartbeat", 0.5)
    assert control.holds(CONSUMER) and control.holds(BEHAVIOUR) and control.holds(LOST) and not control.holds(GUARD)
    assert control.is_in_force() and not waited
    control.beat()
    assert not asked  # whoever consumes heartbeats is not guarded besides
    control.restore()
    assert objects.values[CONSUMER] == bytes(4) and control.kind == "none"
    assert not control.holds(CONSUMER) and not control.holds(BEHAVIOUR)


@pytest.mark.parametrize(("found", "is_kept"), [
    (consumer(7, 0), True), (consumer(0, 300), True),  # switched off: nobody is watched
    (consumer(OURS, 300), True), (consumer(7, 300), True), (consumer(MASTERS[3], 300), False),
])  # fmt: skip
def test_what_a_drive_watched_before_is_put_back_unless_it_was_a_dead_master_of_ours(found, is_kept, caplog):
    control, objects, waited, _ = control_of({CONSUMER: found})
    control.configure(0.3)
    assert objects.values[CONSUMER] == consumer(OURS, 300)
    control.restore()
    of_a_master = found == consumer(OURS, 300)  # of one that died with this number
    assert objects.values[CONSUMER] == (bytes(4) if of_a_master or not is_kept else found)
    watched, period = found[2], int.from_bytes(found[:2], "little")
    looked = watched not in (0, OURS) and period > 0
    assert waited == ([0.3] if looked else [])
    assert ("monitors a master that is gone" in caplog.text) == (looked and watched in MASTERS)
    assert ("which sends no heartbeat: replaced for now" in caplog.text) == (looked and watched == 7)


def test_a_master_that_lives_has_its_entry_and_we_take_the_next():
    control, objects, waited, _ = control_of({CONSUMER: consumer(7, 250), CONSUMER_2: consumer(7, 0)}, alive={7})
    control.configure(0.5)
    assert waited == [0.25]
    assert objects.values == {CONSUMER: consumer(7, 250), CONSUMER_2: consumer(OURS, 500)}
    assert control.holds(CONSUMER_2) and not control.holds(CONSUMER)


def test_of_two_entries_for_a_node_the_first_of_which_is_off_the_first_is_taken():
    """A time of 0 switches an entry off (CiA 301), whatever node-ID stands there."""
    control, objects, waited, _ = control_of({CONSUMER: consumer(7, 0), CONSUMER_2: consumer(7, 500)}, alive={7})
    control.configure(0.5)
    assert not waited and objects.values == {CONSUMER: consumer(OURS, 500), CONSUMER_2: consumer(7, 500)}


def test_a_drive_that_only_watches_masters_that_live_is_not_moved():
    control, _, _, _ = control_of({CONSUMER: consumer(7, 250)}, alive={7})
    with pytest.raises(NoWatchdogError, match=r"node 5 has another master, whose heartbeats still come .node-ID 7"):
        control.configure(0.5)
    assert control.kind == "none"


def test_a_second_configuration_is_ours_and_asks_nobody():
    control, objects, waited, _ = control_of({CONSUMER: bytes(4)})
    control.configure(0.5)
    control.configure(0.2)
    assert objects.values[CONSUMER] == consumer(OURS, 200) and not waited
    control.restore()
    assert objects.values[CONSUMER] == bytes(4)


@pytest.mark.parametrize(("silence", "time", "acts"), [(0.5, 166, 0.498), (0.3, 100, 0.3), (0.02, 6, 0.018)])
def test_without_heartbeats_a_drive_guards_its_masters_life(silence, time, acts):
    """100Ch times 100Dh: three requests within the silence, in whole milliseconds."""
    control, objects, _, asked = control_of({GUARD: bytes(2), LIFE: bytes(1)})
    control.configure(silence)
    assert objects.values == {GUARD: time.to_bytes(2, "little"), LIFE: b"\3"}
    assert (control.kind, control.time) == ("life guarding", pytest.approx(acts))
    control.beat()
    assert asked == [1]
    assert control.is_in_force()


@pytest.mark.parametrize("values", [{}, {GUARD: bytes(2)}, {LIFE: bytes(1)}, {BEHAVIOUR: b"\1"}])
def test_a_drive_that_has_neither_is_not_moved(values):
    control, objects, _, _ = control_of(values)
    with pytest.raises(NoWatchdogError, match=r"node 5 would not stop by itself when this process dies"):
        control.configure(0.5)
    assert not objects.log and not control.holds(BEHAVIOUR)


@pytest.mark.parametrize(("found", "has"), [(b"\1", b"\0"), (b"\0", b"\0"), (b"\2", b"\2")])
def test_a_communication_error_must_change_something(found, has):
    """1029h:01 = 1 would let the drive go on; 0 is pre-operational, 2 stopped, by which it stops as well."""
    control, objects, _, _ = control_of({CONSUMER: bytes(4), BEHAVIOUR: found})
    control.configure(0.5)
    assert objects.values[BEHAVIOUR] == has
    control.restore()
    assert objects.values[BEHAVIOUR] == found


@pytest.mark.parametrize(("first", "second"), [(b"\0\0", b"\3\0"), (b"\2\0", b"\0\0"), (b"\1\0", b"\3\0")])
def test_every_axis_that_would_do_nothing_when_the_connection_is_lost_does_a_quick_stop(first, second):
    values = {CONSUMER: bytes(4), LOST: first, (0x6807, 0): second}
    control, objects, _, _ = control_of(values, listed=[CONSUMER, LOST], num_axes=2)
    control.configure(0.5)
    for key, found in ((LOST, first), ((0x6807, 0), second)):
        assert objects.values[key] == (b"\3\0" if found == b"\0\0" else found)
    control.restore()
    assert objects.values == values


def test_what_a_drive_refuses_or_makes_something_else_of_is_no_watchdog():
    control, _, _, _ = control_of({CONSUMER: bytes(4)}, takes={CONSUMER: lambda data: None})
    with pytest.raises(NoWatchdogError, match=r"node 5 cannot monitor its master: 1016h:01 is refused"):
        control.configure(0.5)
    control, _, _, _ = control_of({CONSUMER: bytes(4)}, takes={CONSUMER: lambda data: data[:3] + b"\1"})
    with pytest.raises(NoWatchdogError, match=r"node 5 took f4016400 for 1016h:01 and has f4016401;"):
        control.configure(0.5)


def test_a_watchdog_is_in_force_while_the_node_has_it_and_it_is_of_our_heartbeats():
    control, objects, _, _ = control_of({CONSUMER: bytes(4)})
    control.configure(0.5)
    control._heartbeats.node_id = OURS + 1  # another program had ours
    assert not control.is_in_force()
    control._heartbeats.node_id = OURS
    objects.values[CONSUMER] = bytes(4)  # the node has restarted
    assert not control.is_in_force()
    control.forget()
    assert control.is_in_force() and control.kind == "none"  # nothing was asked for
    control.restore()
    assert objects.values[CONSUMER] == bytes(4)


@pytest.mark.parametrize(("index", "depends"), [
    (0x1016, True), (0x100C, True), (0x100D, True), (0x1029, True), (0x6007, True), (0x6807, True), (0x7007, True),
    (0x1017, False), (0x6040, False), (0x2007, False), (0x1006, False),
])  # fmt: skip
def test_what_a_drives_watch_depends_on(index, depends):
    assert is_of_a_watchdog(index) == depends


# --- objects that have another value for a while ------------------------------------------------------------------
def test_what_does_not_read_back_is_told_and_the_rest_put_back():
    changed, objects = changed_of({GUARD: b"\1\0", LIFE: b"\2", BEHAVIOUR: b"\1"})
    for key, data in ((GUARD, b"\5\0"), (LIFE, b"\6"), (BEHAVIOUR, b"\0")):
        changed.change(key, data)
    objects.takes[GUARD] = lambda data: b"\7\0"
    with pytest.raises(BusError, match=r"node 5: 100Ch:00 should have 0100 again, and has 0700$"):
        changed.restore()
    assert objects.values[LIFE] == b"\2" and objects.values[BEHAVIOUR] == b"\1"
    objects.log.clear()
    changed.restore()  # once
    assert not objects.log


def changed_of(values):
    objects = Objects(values)
    return ChangedObjects(5, objects, SimpleNamespace(device=None, answer_timeout=0.1)), objects


def test_what_is_there_already_is_not_written_and_longer_answers_count_by_their_beginning():
    changed, objects = changed_of({GUARD: b"\5\0\0\0"})
    changed.change(GUARD, b"\5\0")
    assert not objects.log and GUARD in changed and changed.are_in_force()
    changed.change(GUARD, b"\6\0", only_from=b"\7\0")
    assert not objects.log
    changed.change(GUARD, b"\6\0", only_from=b"\5\0")
    assert objects.log == [(GUARD, b"\6\0")] and changed.are_in_force()
    objects.values[GUARD] = b"\5\0"
    assert not changed.are_in_force()


# --- what the master sends ------------------------------------------------------------------------------------------
class Port:
    """A port whose frames a test hands out."""

    def __init__(self, heard=()):
        self.takers, self.sent, self.heard, self.waits = {}, [], list(heard), []

    def subscribe(self, can_id, taker):
        self.takers[can_id] = taker

    def send(self, can_id, data=b"", *, remote=False, length=0):
        self.sent.append((can_id, data, remote, length))

    def drain(self):
        for node in self.heard:
            self.takers[0x700 + node](b"\5")

    def wait(self, done, timeout):
        self.waits.append(timeout)
        self.drain()
        return done()


def test_a_process_takes_a_number_of_its_own_that_nobody_is_heard_under(monkeypatch):
    monkeypatch.setattr(module, "os", SimpleNamespace(getpid=lambda: 32 * 50 + 30))
    beats = Heartbeats(Port(), [5])
    assert set(beats._port.takers) == {0x700 + k for k in range(1, 128)} - {0x705}
    beats.send()
    assert not beats._port.sent and beats.node_id == 0  # none is chosen yet
    beats.choose()
    assert beats.node_id == 96 + 30
    beats.send()
    assert beats._port.sent == [(0x700 + 126, b"\5", False, 0)]
    beats.choose()
    assert beats.node_id == 126
    beats._port.heard = [126, 127]
    assert not beats.is_shared
    beats.choose()
    assert beats.node_id == 96  # the next one round
    beats = Heartbeats(Port([126]), [127, 96])
    beats.choose()
    assert beats.node_id == 97


def test_somebody_is_alive_who_is_heard_from_now_on():
    beats = Heartbeats(Port([7]), [5])
    beats._port.drain()
    beats._port.heard = []
    assert not beats.is_alive(7, 0.25) and beats._port.waits == [0.25]
    beats._port.heard = [7]
    assert beats.is_alive(7, 0.25) and not beats.is_alive(8, 0.25)


@pytest.mark.parametrize(("kinds", "heartbeats", "requests"), [
    (["heartbeat"], 1, 0), (["heartbeat", "heartbeat"], 1, 0), (["life guarding"], 0, 1),
    (["heartbeat", "life guarding"], 1, 1), (["none"], 0, 0),
])  # fmt: skip
def test_one_heartbeat_is_for_all_and_each_guarded_node_is_asked(kinds, heartbeats, requests):
    sent, asked, now = [], [], [50.0]
    controls = [
        SimpleNamespace(kind=kind, beat=lambda kind=kind: asked.append(1) if kind == "life guarding" else None)
        for kind in kinds
    ]
    beats = Beats(SimpleNamespace(send=lambda: sent.append(1)), controls, 0.3, lambda: now[0])
    beats.keep()
    assert (len(sent), len(asked)) == (heartbeats, requests)
    for time, due in ((0.0999, 1), (0.1001, 2), (0.15, 2), (0.2003, 3)):  # a third of the silence
        now[0] = 50.0 + time
        beats.keep()
        assert (len(sent), len(asked)) == (heartbeats * due, requests * due)
    beats.begin()  # one alone may be lost
    assert (len(sent), len(asked)) == (heartbeats * 6, requests * 6)
    beats.cease()
    now[0] += 10.0
    beats.keep()
    assert (len(sent), len(asked)) == (heartbeats * 9, requests * 9) and beats.has_ceased


def controls_of(*kinds):
    port = Port()
    values = {"heartbeat": {CONSUMER: bytes(4)}, "life guarding": {GUARD: bytes(2), LIFE: bytes(1)}}
    objects = [Objects(values[kind]) for kind in kinds]
    entries = {key: SimpleNamespace(index=key[0], sub=key[1]) for key in values[kinds[0]]}
    description = SimpleNamespace(
        has=entries.__contains__, dictionary=list(entries.values()), device=None, answer_timeout=0.1
    )
    return ErrorControls(port, list(range(5, 5 + len(kinds))), objects, description), port, objects


def test_all_nodes_watch_and_the_slowest_counts(monkeypatch):
    monkeypatch.setattr(module, "os", SimpleNamespace(getpid=lambda: 4))
    controls, port, _ = controls_of("heartbeat", "heartbeat")
    assert controls.detection_time == math.inf and not controls.is_set(0)
    controls.keep()
    controls.cease()
    assert not port.sent  # nobody watches
    controls.begin(0.3)
    assert controls.detection_time == 0.3 and controls.is_set(0) and controls.is_set(1)
    assert port.sent == [(0x700 + 100, b"\5", False, 0)] * 3
    assert controls.holds(CONSUMER) and not controls.holds(GUARD)
    controls.restore(0)
    assert (controls.is_set(0), controls.is_set(1)) == (False, True) and controls.holds(CONSUMER)
    controls.forget(1)
    assert not controls.is_set(1) and not controls.holds(CONSUMER)
    controls.end()
    port.sent.clear()
    controls.cease()
    assert controls.detection_time == math.inf and not port.sent


def test_another_program_with_our_number_is_told_once():
    controls, port, _ = controls_of("heartbeat")
    controls.begin(0.3)
    assert controls.take_rival() == ""
    ours = 96 + os.getpid() % 32
    port.heard = [ours]
    port.drain()
    assert f"another program sends heartbeats as node-ID {ours}, too" in controls.take_rival()
    assert controls.take_rival() == "" and not controls.is_in_force(0)
    port.sent.clear()
    controls.cease()
    assert not port.sent  # under no number
    controls.begin(0.3)
    assert port.sent[0][0] != 0x700 + ours


def test_a_guarded_node_is_asked_by_a_remote_frame():
    controls, port, objects = controls_of("life guarding")
    controls.begin(0.3)
    assert port.sent == [(0x705, b"", True, 1)] * 3
    assert objects[0].values[LIFE] == b"\3"


@pytest.mark.parametrize(
    ("found", "has"), [(b"\0", b"\2"), (b"\1", b"\2"), (b"\2", b"\2"), (b"\3", b"\3"), (b"\4", b"\4")]
)
def test_of_a_known_drive_what_leads_elsewhere_than_stopped_is_made_to_lead_there(found, has):
    control, objects, _, _ = control_of({CONSUMER: bytes(4), BEHAVIOUR: found})
    behaviour = {0: "PRE_OPERATIONAL", 1: "OPERATIONAL", 2: "STOPPED", 4: "STOPPED"}
    control._description.device = SimpleNamespace(canopen=SimpleNamespace(error_behaviour=behaviour))
    control.configure(0.5)
    assert objects.values[BEHAVIOUR] == has


@pytest.mark.parametrize("listed", [[GUARD], [LIFE]])
def test_life_guarding_takes_both_its_objects(listed):
    control, objects, _, _ = control_of({GUARD: bytes(2), LIFE: bytes(1)}, listed=listed)
    with pytest.raises(
        NoWatchdogError, match=r"it has neither a heartbeat consumer .1016h. nor life guarding .100Ch.;"
    ):
        control.configure(0.5)
    assert not objects.log


def test_a_consumer_s_sub_index_0_is_none():
    control, objects, _, _ = control_of({(0x1016, 0): b"\1", CONSUMER: bytes(4)})
    control.configure(0.5)
    assert objects.values[0x1016, 0] == b"\1" and objects.values[CONSUMER] == consumer(OURS, 500)


def test_a_time_out_is_in_whole_milliseconds():
    control, objects, _, _ = control_of({CONSUMER: consumer(7 | 0x80, 1)})
    control.configure(0.0126)
    assert objects.values[CONSUMER] == consumer(OURS, 13) and control.time == pytest.approx(0.013)
