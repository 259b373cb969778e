"""Whoever changes drives leaves a file, and the state before comes back: at once, after an error, by one command."""

from __future__ import annotations

import json
import os
import re
import uuid
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import can
import numpy as np
import pytest
from rigs.commands import drive_tune
from rigs.fault_injection import ON, ObservedWorld, WorldBus
from rigs.known_machines import gains

from drive_env import EmulatedDrives, cia402, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.devices import find_device
from drive_env.drives.raw_gains import write_gains
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.sdo import SdoClient
from drive_env.safety.envelope import SafetyError
from tuning import snapshot as module
from tuning.snapshot import (
    Snapshot,
    SnapshotError,
    Transaction,
    can_store,
    check_place,
    check_same_drives,
    file_before,
    load_snapshot,
    restore,
    take,
)
from tuning.target import FREE, emulated, on_bus

GAIN_OBJECTS = find_device("tmcm1636").gains.keys

CURRENT_LIMIT, PROFILE_VELOCITY = (0x2003, 0), (0x6081, 0)
TRIED = np.array([[1000, 900, 800, 700, 600]])


@pytest.fixture
def target():
    with emulated(load="inertia", num_machines=3) as made:
        yield made


def change(drives):
    """Change gains and settings of enabled drives."""
    motion.enable(drives, mode="pv")
    write_gains(drives, np.repeat(TRIED, drives.num_axes, axis=0))
    drives.write(CURRENT_LIMIT, 1234)
    drives.advance(0.01)


# --- the transaction ----------------------------------------------------------------------------------------------
def test_the_file_is_there_before_anything_is_changed(target, tmp_path):
    before = gains(target.drives)
    with Transaction(target, tmp_path / "runs" / "before.toml") as transaction:
        found = load_snapshot(transaction.path)
        change(target.drives)
    assert [[values[key] for key in GAIN_OBJECTS] for values in found.axes] == before.tolist()
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["before.toml"]


def test_what_is_not_committed_is_rolled_back_axis_by_axis(target, tmp_path):
    before, limit = gains(target.drives), target.drives.read(CURRENT_LIMIT)
    kept = np.array([False, True, False])
    with Transaction(target, tmp_path / "before.toml") as transaction:
        change(target.drives)
        transaction.commit(kept)
    assert gains(target.drives).tolist() == np.where(kept[:, None], TRIED, before).tolist()
    assert target.drives.read(CURRENT_LIMIT).tolist() == np.where(kept, 1234, limit).tolist()


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt()])
def test_an_error_rolls_everything_back_and_goes_on_its_way(target, tmp_path, error):
    before = take(target)
    with pytest.raises(type(error)), Transaction(target, tmp_path / "before.toml"):
        change(target.drives)
        raise error
    assert take(target) == before
    assert not np.any(cia402.matches(target.drives.read(0x6041), cia402.OPERATION_ENABLED))


def test_a_drive_in_fault_is_rolled_back_too(target, tmp_path):
    before = take(target)
    with Transaction(target, tmp_path / "before.toml"):
        change(target.drives)
        target.drives.machine.supply = 65.0  # V: over-voltage
        target.drives.advance(0.1)
        assert np.all(cia402.matches(target.drives.read(0x6041), cia402.FAULT))
    assert take(target) == before


def test_a_fault_reaction_that_is_under_way_is_waited_for_before_anything_is_put_back(target, tmp_path, monkeypatch):
    before, read, words = take(target), target.drives.read, [0x060F] * 5

    def reacting(name):
        return read(name) * 0 + words.pop() if name == 0x6041 and words else read(name)

    with Transaction(target, tmp_path / "before.toml"):
        change(target.drives)
        monkeypatch.setattr(target.drives, "read", reacting)
    assert (take(target), words) == (before, [])


def test_a_rollback_that_fails_names_the_file_that_helps(target, tmp_path, monkeypatch):
    truly = target.drives.write

    def refuse(name, value, where=None):
        if name == CURRENT_LIMIT and np.ndim(value) == 0 and value != 1234:
            raise BusError("the cable is out")
        truly(name, value, where=where)

    monkeypatch.setattr(target.drives, "write", refuse)
    with (
        pytest.raises(BusError, match=r"cable is out.*drive-tune undo .*before\.toml restores"),
        Transaction(target, tmp_path / "before.toml"),
    ):
        change(target.drives)


def test_emulated_drives_have_nothing_that_outlives_them(target, tmp_path):
    with Transaction(target, tmp_path / "before.toml") as transaction:
        assert not transaction.store()
        transaction.commit()
    assert not load_snapshot(transaction.path).stored


def test_an_axis_that_somebody_else_runs_and_nothing_has_changed_is_left_running(target, tmp_path):
    motion.enable(target.drives, mode="pv", where=np.array([True, True, False]))
    with pytest.raises(RuntimeError, match="axis 0 is enabled"), Transaction(target, tmp_path / "before.toml"):
        target.drives.write(CURRENT_LIMIT, 1234, where=np.array([False, True, False]))
        raise RuntimeError("axis 0 is enabled: disable it")
    assert cia402.matches(target.drives.read(0x6041), cia402.OPERATION_ENABLED).tolist() == [True, False, False]
    assert target.drives.read(CURRENT_LIMIT).tolist() == [7000, 7000, 7000]


# --- the file -----------------------------------------------------------------------------------------------------
def test_a_snapshot_reads_back_equal_and_says_what_its_numbers_are(target, tmp_path):
    before = take(target)
    path = before.save(tmp_path / "before.toml")
    assert load_snapshot(path) == before
    text = path.read_text(encoding="utf-8")
    assert "drive-tune undo before.toml" in text
    assert '"2003:00" = 7000  # Maximum Current\n' in text
    keys = set(before.axes[0])
    assert {*GAIN_OBJECTS, CURRENT_LIMIT, PROFILE_VELOCITY} <= keys
    assert not {(0x6040, 0), (0x60FF, 0), (0x607A, 0), (0x1010, 1)} & keys  # commands and services are no parameters


def test_drives_of_another_kind_or_number_are_refused(target):
    with (
        EmulatedDrives(load="inertia", num_machines=2) as others,
        pytest.raises(SnapshotError, match="is of 3 axes of tmcm1636, and here are 2"),
    ):
        restore(others, take(target))


@pytest.mark.parametrize(("text", "message"), [
    ("device = 3", "is not a file with the state before"),
    ("device = ", "is not TOML"),
    ('device = "mine"\n[[axis]]\n', "no device is named 'mine'.*: call drive-tune undo in the one where the run"),
    ('device = "tmcm1636"\n[[axis]]\n"6041:00" = 3', "6041:00 = 3: .* can only be read"),
    ('device = "tmcm1636"\n[[axis]]\n"2003:00" = 999999999', "2003:00 = 999999999"),
    ('device = "tmcm1636"\n[[axis]]\nx = 3', "x = 3"),
])  # fmt: skip
def test_a_file_that_is_no_snapshot_is_refused(tmp_path, text, message):
    (tmp_path / "x.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SnapshotError, match=message):
        load_snapshot(tmp_path / "x.toml", unchecked=True)


def test_a_file_that_cannot_be_written_is_one_line_and_nothing_is_left(target, tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "replace", lambda self, other: (_ for _ in ()).throw(OSError(28, "No space left")))
    before = take(target)
    with (
        pytest.raises(OSError, match=r"the state before cannot be written: No space left; choose .*before\.toml"),
        Transaction(target, tmp_path / "before.toml"),
    ):
        change(target.drives)
    assert take(target) == before
    assert list(tmp_path.iterdir()) == []


def test_a_folder_of_others_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(OSError, match=r"cannot be written to .*found-before\.toml: .* is not writable"):
        file_before("identify", tmp_path / "found")


def test_a_file_that_is_there_is_never_replaced(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = file_before("identify", tmp_path / "found")
    first.write_text("left by a run that was killed", encoding="utf-8")
    assert [first.name, file_before("identify", tmp_path / "found").name] == [
        "found-before.toml", "found-before-2.toml",
    ]  # fmt: skip
    with pytest.raises(OSError, match="exists already, and may be the state before an earlier run"):
        check_place(first)
    assert re.fullmatch(r"runs/\d{8}-\d{6}-identify-before\.toml", file_before("identify").as_posix())
    assert list(tmp_path.iterdir()) == [first]


# --- over the bus -------------------------------------------------------------------------------------------------
@contextmanager
def served():
    """Two emulated drives as nodes 1 and 2 of a virtual bus, whose time passes by SYNC: their channel, and they."""
    world = World(lockstep=True)
    machines = [EmulatedDrives(load="inertia", num_threads=1) for _ in range(2)]
    for node, machine in enumerate(machines, 1):
        world.add(machine, [node])
    channel = str(uuid.uuid4())
    try:
        with Server(world, CanPort(can.Bus(interface="virtual", channel=channel))):
            yield channel, machines
    finally:
        world.close()


def opened(channel):
    return on_bus(
        interface="virtual", channel=channel, nodes=(1, 2), travel=FREE, supply=24.0, pace="lockstep", timeout=20.0
    )


def test_one_command_brings_back_what_a_program_left_behind_that_was_killed(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    with served() as (channel, machines):
        before = [gains(machine).tolist() for machine in machines]
        target = opened(channel)
        with target:
            transaction = Transaction(target, tmp_path / "before.toml").__enter__()  # and no exit
            write_gains(target.drives, np.repeat(TRIED, 2, axis=0))
            target.drives.write(CURRENT_LIMIT, 1234)
        machines[0].write(cia402.TARGET_VELOCITY, 5)  # of a program that was killed: no file has it
        assert [gains(machine).tolist() for machine in machines] != before
        assert load_snapshot(transaction.path).bus == {
            "interface": "virtual", "channel": channel, "nodes": [1, 2], "pace": "lockstep",
        }  # fmt: skip
        told = json.loads(drive_tune("undo", transaction.path, "--dry-run", "--json").stdout)["would change"]
        done = drive_tune("undo", transaction.path, "--yes")
        assert done.exit_code == 0, done.output
        for row in told:
            assert f"axis {row['axis']}: {row['object']}: {row['found']} -> {row['wanted']}" in done.stdout
        assert "axis 1: 2003h:00 Maximum Current: 1234 -> 7000" in done.stdout
        assert re.search(r"^13 parameters restored, \d{3} verified by a second reading$", done.stdout, re.MULTILINE)
        assert [gains(machine).tolist() for machine in machines] == before
        assert [int(machine.read(CURRENT_LIMIT)[0]) for machine in machines] == [7000, 7000]
        again = drive_tune("undo", transaction.path, "--yes", "--json")
        assert re.fullmatch(r'\{"changed": \[\], "verified": \d{3}, "stored": false\}\n', again.stdout)


def test_what_turns_is_braked_before_it_is_put_back_also_after_a_stall(tmp_path, monkeypatch):
    """An envelope refuses one call after a stall, to tell of it: that must not cost the way back."""
    machines = EmulatedDrives(load="inertia", num_machines=2, num_threads=1)
    world = ObservedWorld(machines, (1, 2), lockstep=True)
    with on_bus(bus=WorldBus(world), nodes=(1, 2), travel=FREE, supply=24.0, pace="lockstep") as target:
        before = take(target)
        transaction = Transaction(target, tmp_path / "before.toml")
        with pytest.raises(ValueError, match="no"), transaction:
            motion.enable(target.drives, mode="pv")
            target.drives.write(0x60FF, 65536 * 10)
            target.drives.advance(0.3)
            asked, truly = [], transaction.roll_back

            def refuse_once(where=None):
                asked.append(world.cycles)
                if len(asked) == 1:
                    raise SafetyError("the program made no call for 0.6 s")
                truly(where)

            monkeypatch.setattr(transaction, "roll_back", refuse_once)
            assert np.all(np.abs(world.truth.omega()[-1]) > 6.0 * np.pi)
            raise ValueError("no")
        after = take(target)
    assert len(asked) == 2
    own = [{key: v for key, v in axis.items() if key[0] >= 0x2000} for axis in before.axes]
    assert [{key: v for key, v in axis.items() if key[0] >= 0x2000} for axis in after.axes] == own
    on, speed = np.isin(world.truth.fsa(), ON), np.abs(world.truth.omega())
    assert speed[asked[0] - 1].max() < 2.0  # rad/s: at rest before anything is put back
    assert speed[1:][on[:-1] & ~on[1:]].max() < 2.0  # and braked: the power stayed on until then
    machines.close()


def test_a_change_that_the_drives_keep_is_undone_for_good(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    with served() as (channel, machines):
        before = [gains(machine).tolist() for machine in machines]
        with opened(channel) as target:
            with Transaction(target, tmp_path / "before.toml") as transaction:
                write_gains(target.drives, np.repeat(TRIED, 2, axis=0))
                assert transaction.store()
                transaction.commit()
            target.drives.reset_node()
            assert gains(target.drives).tolist() == np.repeat(TRIED, 2, axis=0).tolist()
        done = drive_tune("undo", transaction.path, "--yes")
        assert re.search(r"^10 parameters restored, \d+ verified .*; stored in the drives$", done.stdout, re.MULTILINE)
        with opened(channel) as target:
            target.drives.reset_node()
        assert [gains(machine).tolist() for machine in machines] == before


def test_what_drives_were_told_to_keep_is_taken_back_for_good(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    with served() as (channel, machines), opened(channel) as target:
        before = [gains(machine).tolist() for machine in machines]
        with pytest.raises(KeyboardInterrupt), Transaction(target, tmp_path / "before.toml") as transaction:
            write_gains(target.drives, np.repeat(TRIED, 2, axis=0))
            transaction.store()
            raise KeyboardInterrupt
        target.drives.reset_node()
        assert [gains(machine).tolist() for machine in machines] == before


def test_a_disk_that_is_full_when_drives_are_to_keep_a_change_gives_them_back_what_they_had(tmp_path, monkeypatch):
    """As in `rules --apply --store`: the file must say that the change is kept before it is."""
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    file = tmp_path / "before.toml"
    with served() as (channel, machines), opened(channel) as target:
        before = [gains(machine).tolist() for machine in machines]
        with (
            pytest.raises(OSError, match="No space left on device") as caught,
            Transaction(target, file) as transaction,
        ):
            write_gains(target.drives, np.repeat(TRIED, 2, axis=0))
            (tmp_path / ".before.toml.partial").symlink_to("/dev/full")
            transaction.store()
        assert caught.value.filename == str(file)
        assert caught.value.strerror == (
            "the state before cannot be written: No space left on device; choose another place; the drives have their "
            f"state from before; if not, drive-tune undo {file} restores it"
        )
        assert [gains(machine).tolist() for machine in machines] == before
        target.drives.reset_node()
        assert [gains(machine).tolist() for machine in machines] == before
        assert not load_snapshot(file).stored


def test_the_way_back_is_read_again_before_anything_is_changed(target, tmp_path, monkeypatch):
    monkeypatch.setattr("tuning.snapshot.write_whole", lambda path, text: path.write_text(text.replace("7000", "7001")))
    before = take(target)
    with pytest.raises(ValueError, match="was changed since it was written"), Transaction(target, tmp_path / "b.toml"):
        change(target.drives)
    assert take(target) == before


@pytest.mark.every(3)
@pytest.mark.parametrize(
    ("spoil", "words", "unchecked"),
    [
        (lambda text: text.replace('"2003:00" = 7000', '"2003:00" = 9000'), "was changed since it was written", 0),
        (lambda text: text[: text.index('"2042')], "is incomplete: it ends before its check sum", 2),
        (lambda text: text[: text.index("[check]")].replace("format = 2\n", ""), "has no check sum", 0),
        (
            lambda text: text.replace('"2003:00"', '"6040:00" = 15\n"2003:00"'),
            "holds objects that are not parameters: 6040h",
            2,
        ),
    ],
    ids=["changed", "torn", "old", "a command"],
)
def test_restore_refuses_a_file_that_is_not_as_it_was_written(tmp_path, monkeypatch, spoil, words, unchecked):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    with served() as (channel, machines):
        with opened(channel) as target:
            path = take(target).save(tmp_path / "before.toml")
        machines[1].write(CURRENT_LIMIT, 1234)
        path.write_text(spoil(path.read_text(encoding="utf-8")), encoding="utf-8")
        done = drive_tune("undo", path, "--yes")
        assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
        assert done.stderr.startswith(f"drive-tune: {path} {words}")
        assert machines[1].read(CURRENT_LIMIT) == [1234]
        assert drive_tune("undo", path, "--yes", "--unchecked").exit_code == unchecked


@pytest.mark.slow
def test_a_snapshot_says_of_which_drives_it_is_and_is_not_written_to_others(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    serial = {"now": 4711}
    truly = SdoClient.read

    def read(self, index, sub, label, timeout):
        if (index, sub) == (0x1018, 4):
            return (serial["now"] + self._node).to_bytes(4, "little")
        return truly(self, index, sub, label, timeout)

    monkeypatch.setattr(SdoClient, "read", read)
    with served() as (channel, machines):
        with opened(channel) as target:
            path = take(target).save(tmp_path / "before.toml")
        one, two = load_snapshot(path).identities
        assert (one.serial, two.serial, two.node, two.product, two.name) == (4712, 4713, 2, 1636, "TMCM-1636")
        machines[1].write(CURRENT_LIMIT, 1234)
        serial["now"] = 50
        done = drive_tune("undo", path, "--yes")
        assert (done.exit_code, machines[1].read(CURRENT_LIMIT)) == (2, [1234])
        assert "it was read from serial number 4712, and here is 51. Nothing was written" in done.stderr
        assert drive_tune("undo", path, "--yes", "--other-drive").exit_code == 0
        assert machines[1].read(CURRENT_LIMIT) == [7000]


def test_no_axis_is_written_where_a_later_one_may_turn(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    with served() as (channel, machines):
        with opened(channel) as target:
            path = take(target).save(tmp_path / "before.toml")
        for machine in machines:
            machine.write(CURRENT_LIMIT, 1234)
        for word in (0x06, 0x07, 0x0F):
            machines[1].write(0x6040, word)
        done = drive_tune("undo", path, "--yes")
        assert (done.exit_code, "disable it first" in done.stderr) == (1, True)
        assert [int(machine.read(CURRENT_LIMIT)[0]) for machine in machines] == [1234, 1234]


def test_the_writer_of_a_restore_is_not_believed(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    monkeypatch.setattr("tuning.snapshot.write_all_or_none", lambda drives, wanted, axis: [])
    with served() as (channel, machines):
        with opened(channel) as target:
            path = take(target).save(tmp_path / "before.toml")
        machines[1].write(CURRENT_LIMIT, 1234)
        done = drive_tune("undo", path, "--yes")
        assert (done.exit_code, done.stdout) == (1, "")
        assert "axis 1 does not have the values that were written, by a second reading: 2003h:00" in done.stderr


@pytest.mark.parametrize(("arguments", "code", "message"), [
    (["undo", "none.toml"], 2, "drive-tune: cannot read none.toml: No such file"),
    (["undo", "emulated.toml"], 2, "is from emulated drives, which existed in their program only"),
    (["undo", "bus.toml"], 2, "drive-tune: Restore node 1, 2, 3 on x? There is no terminal to ask; confirm with --yes"),
    (["undo", "bus.toml", "--yes", "--interface", "none"], 2, "cannot open interface 'none'"),
])  # fmt: skip
def test_a_mistake_is_one_line(target, tmp_path, monkeypatch, arguments, code, message):
    monkeypatch.chdir(tmp_path)
    found = take(target)
    found.save("emulated.toml")
    type(found)(found.device, found.axes, {"channel": "x", "nodes": [1, 2, 3]}).save("bus.toml")
    done = drive_tune(*arguments)
    assert done.exit_code == code
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("bus", "said"),
    [('[bus]\nsafety = false\n', r"\[bus\] has a key 'safety', which is not one of interface, channel"),
     ('[bus]\nnodes = 1\n', r"\[bus\] nodes = 1 is not of type int"),
     ('[bus]\nnodes = ["1"]\n', "is not of type int"),
     ('[bus]\nchannel = 3\n', "channel = 3 is not of type str"),
     ('bus = 3\n', "must be a table")],
)  # fmt: skip
def test_a_file_does_not_say_how_else_drives_are_opened(tmp_path, bus, said):
    """A key that is handed on could switch the envelope off."""
    file = tmp_path / "before.toml"
    head = 'device = "tmcm1636"\n'
    table = '[[axis]]\n"2003:00" = 7000\n'
    file.write_text(head + (bus + table if not bus.startswith("[") else table + bus))
    with pytest.raises(SnapshotError, match=said):
        load_snapshot(file, unchecked=True)


@pytest.mark.parametrize(
    ("bus", "has", "can"), [({}, True, False), ({"nodes": [1]}, True, True), ({"nodes": [1]}, False, False)]
)
def test_only_drives_of_a_bus_that_have_1010h_can_store(bus, has, can):
    description = SimpleNamespace(has=lambda key: has and key == (0x1010, 1))
    drives = SimpleNamespace(bus=SimpleNamespace(description=description))
    assert can_store(SimpleNamespace(bus=bus, drives=drives)) is can


# --- by hand, on drives that a test plays -----------------------------------------------------------------------------
GAIN = GAIN_OBJECTS[0]


class Played:
    """Three axes with a gain and a current limit each; what is done to them is noted."""

    num_axes, bus, safety, device = 3, None, None, find_device("tmcm1636")

    def __init__(self, status=(0x0240,) * 3, stays=0):
        self.log, self.status, self.stays = [], np.array(status), stays

    def read(self, name):
        if name == cia402.STATUSWORD:
            self.stays -= 1
            return np.where(self.stays >= 0, 0x0637, self.status)
        return np.zeros(3, int)

    def write(self, name, value, *, where):
        self.log.append((name, np.asarray(value).tolist(), None if where is None else where.tolist()))

    def advance(self, seconds):
        self.log.append(("wait", seconds))


BEFORE = tuple({GAIN: 10 + k, CURRENT_LIMIT: 7000} for k in range(3))


@pytest.fixture
def transaction(monkeypatch, tmp_path):
    """A transaction of such axes, as if it had been entered while none was enabled; what it restores is noted."""

    def start(ran=(False, False, False), now=BEFORE, bus=None, **played):
        drives = Played(**played)
        target = SimpleNamespace(num_axes=3, drives=drives, bus=bus or {})
        made = Transaction(target, tmp_path / "before.toml")
        made._ran, made.before = np.array(ran), Snapshot("tmcm1636", BEFORE, target.bus)
        monkeypatch.setattr(module, "_read_axes", lambda drives: now)
        monkeypatch.setattr(
            module, "restore",
            lambda drives, snapshot, where, *, whole: drives.log.append(("restored", where.tolist(), whole)),
        )  # fmt: skip
        return made, drives

    return start


YES, FIRST = [True] * 3, np.array([True, False, False])


def test_a_rollback_gives_gains_back_at_once_and_the_rest_when_no_axis_may_turn(transaction):
    made, drives = transaction(stays=3)
    made.roll_back()
    gains = [(key, [10, 11, 12] if key == GAIN else [0, 0, 0], YES) for key in GAIN_OBJECTS]
    off = (cia402.CONTROLWORD, 0, YES)
    assert drives.log == [*gains, off, *[("wait", 0.001)] * 3, ("restored", YES, False)]
    made, drives = transaction()
    made.roll_back(FIRST)
    assert {tuple(entry[2]) for entry in drives.log[:-1]} == {(True, False, False)}
    assert drives.log[-1] == ("restored", [True, False, False], False)


def test_an_axis_that_stays_enabled_for_a_second_is_told(transaction):
    made, drives = transaction(stays=10**9)
    with pytest.raises(TimeoutError, match="an axis stays enabled for 1 s after its voltage was switched off"):
        made.roll_back(FIRST)
    assert drives.log[-1000:] == [("wait", 0.001)] * 1000 and drives.log[-1001][0] == cia402.CONTROLWORD
    made, drives = transaction(status=(0x0240, 0x0637, 0x0240))  # one that is not asked for may be on
    made.roll_back(FIRST)
    assert drives.log[-1][0] == "restored"


@pytest.mark.parametrize(
    ("committed", "ran", "changed", "back"),
    [
        ([], [0, 0, 0], [], [1, 1, 1]),
        ([1], [0, 0, 0], [], [1, 0, 1]),
        ([0, 1, 2], [0, 0, 0], [], None),
        ([], [1, 1, 0], [], [0, 0, 1]),  # somebody else's that nobody has changed
        ([], [1, 1, 0], [1], [0, 1, 1]),
        ([0], [1, 1, 0], [1], [0, 1, 1]),
    ],
)
def test_which_axes_are_brought_back_at_the_end(transaction, committed, ran, changed, back):
    now = tuple(values | {CURRENT_LIMIT: 7001} if k in changed else values for k, values in enumerate(BEFORE))
    made, drives = transaction(np.array(ran, bool), now)
    for k in committed:
        made.commit(np.arange(3) == k)
    assert made.changed == bool(committed)
    made.__exit__(None, None, None)
    restored = [entry for entry in drives.log if entry[0] == "restored"]
    assert restored == ([] if back is None else [("restored", [bool(k) for k in back], False)])
    if back is None:
        assert drives.log == []
    made.commit()
    drives.log.clear()
    made.__exit__(None, None, None)
    assert drives.log == []


def test_objects_of_the_communication_area_are_no_change_of_an_axis(transaction):
    """They are how drives talk, which a master has in use: 1FFFh is the last of them."""
    now = tuple(values | {(0x1FFF, 0): 5} for values in BEFORE)
    made, drives = transaction((True, True, True), now)
    made.__exit__(None, None, None)
    assert drives.log[-1] == ("restored", [False] * 3, False)
    made, drives = transaction((True, True, True), tuple(values | {(0x2000, 0): 5} for values in BEFORE))
    made.__exit__(None, None, None)
    assert drives.log[-1] == ("restored", YES, False)


def test_what_was_stored_is_stored_again_where_it_is_brought_back(transaction, monkeypatch):
    stored = []
    monkeypatch.setattr(module, "store", lambda drives, where: stored.append(None if where is None else where.tolist()))
    made, _ = transaction(bus={"channel": "x"})
    assert made.store(np.array([True, True, False])) and load_snapshot(made.path).stored
    made.commit(FIRST)
    made.__exit__(None, None, None)
    assert stored == [[True, True, False], [False, True, False]]
    made, _ = transaction(bus={"channel": "x"})
    assert made.store()
    assert stored[2:] == [None] and made._stored.tolist() == YES
    made, _ = transaction()
    assert not made.store() and len(stored) == 3 and not made._stored.any()
    made.__exit__(None, None, None)
    assert len(stored) == 3


@pytest.mark.parametrize(
    ("error", "reason"), [(ValueError("too far"), "too far"), (KeyboardInterrupt(), "KeyboardInt")]
)
def test_what_still_turns_is_braked_after_an_error_alone(transaction, error, reason):
    for given, stops in ((error, 1), (None, 0)):
        made, drives = transaction()
        stopped = []
        drives.safety = SimpleNamespace(stop=stopped.append)
        made.__exit__(type(given), given, None)
        assert len(stopped) == stops and (not stops or stopped[0].startswith(reason))
        assert drives.log[-1][0] == "restored"


def test_an_envelope_may_refuse_one_call_of_a_rollback_and_no_second(transaction, monkeypatch):
    made, _ = transaction()
    tried = []

    def refuse(where):
        tried.append(where.tolist())
        raise SafetyError("stalled")

    monkeypatch.setattr(made, "roll_back", refuse)
    with pytest.raises(BusError, match=r"stalled; the drives may have the gains that were tried: drive-tune undo .*"):
        made.__exit__(None, None, None)
    assert tried == [YES, YES]


def test_a_disk_that_is_full_is_told_with_what_the_drives_have(transaction):
    full = OSError(28, "No space left", "a.toml")
    made, _ = transaction()
    with pytest.raises(OSError, match="No space left; the drives have their state from before; if not") as caught:
        made.__exit__(OSError, full, None)
    assert (caught.value.errno, caught.value.filename) == (28, "a.toml")
    made, _ = transaction()
    made.commit(FIRST)
    made.__exit__(OSError, full, None)  # what was kept is not what was before
    made, _ = transaction()
    made.__exit__(OSError, OSError("of no file"), None)


def test_a_file_that_does_not_read_back_ends_it_before_anything_is_changed(transaction, monkeypatch):
    made, _ = transaction()
    monkeypatch.setattr(module, "take", lambda target: Snapshot("tmcm1636", BEFORE))
    monkeypatch.setattr(module, "load_snapshot", lambda path: Snapshot("tmcm1636", BEFORE, stored=True))
    with pytest.raises(OSError, match="the state before does not read back as it was written") as caught:
        made.__enter__()
    assert caught.value.errno == 5 and caught.value.filename == str(made.path)


def test_a_snapshot_is_restored_axis_by_axis_when_all_of_them_rest(monkeypatch):
    done = []
    monkeypatch.setattr(module, "_per_axis", lambda drives: "single")
    monkeypatch.setattr(module, "check_at_rest", lambda single, values, axis: done.append(("look", axis)))

    def write(single, values, axis):
        done.append((dict(values), axis))
        return [axis]

    monkeypatch.setattr(module, "write_all_or_none", write)
    axes = tuple({(0x1FFF, 0): 1, (0x2000, 0): k} for k in range(3))
    snapshot = Snapshot("tmcm1636", axes)
    assert restore(Played(), snapshot) == [[0], [1], [2]]
    assert done == [*(("look", k) for k in range(3)), *((axes[k], k) for k in range(3))]
    done.clear()
    assert restore(Played(), snapshot, np.array([True, False, True]), whole=False) == [[0], [], [2]]
    assert done == [("look", 0), ("look", 2), ({(0x2000, 0): 0}, 0), ({(0x2000, 0): 2}, 2)]
    with pytest.raises(SnapshotError, match="is of 3 axes of tmcm6212, and here are 3 of tmcm1636; open the drives"):
        restore(Played(), Snapshot("tmcm6212", axes))


def test_an_object_of_one_emulated_axis_is_read_and_written_by_itself():
    drives = Played()
    drives.read = lambda name: np.array([4, 5, 6]) if name == CURRENT_LIMIT else None
    single = module._per_axis(drives)
    entry = SimpleNamespace(index=0x2003, sub=0, bits=16)
    assert [single.read_axis(entry, k) for k in range(3)] == [4, 5, 6]
    single.write_axis(entry, 1, 77)
    assert drives.log == [(CURRENT_LIMIT, 77, [False, True, False])]
    drives.bus = "of a bus"
    assert module._per_axis(drives) == "of a bus"


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ("axis = 3\n", "is not a file with the state before a change"),
        ("axis = []\n", "is not a file with the state before a change"),
        ("axis = [3]\n", "x.toml: 3 is not an axis; give a file that drive-tune saved before a change"),
        ('[[axis]]\n"2003:00" = 7000\n"20G0:00" = 1\n', "20G0:00 = 1: "),
        ('[[axis]]\n"2003:00" = 7000\n', None),
    ],
)
def test_axes_of_a_file_are_tables_of_objects(tmp_path, axes, message):
    file = tmp_path / "x.toml"
    file.write_text('device = "tmcm1636"\n' + axes, encoding="utf-8")
    if message is None:
        found = load_snapshot(file, unchecked=True)
        assert found == Snapshot("tmcm1636", ({CURRENT_LIMIT: 7000},)) and found.stored is False
        return
    with pytest.raises(SnapshotError, match=message):
        load_snapshot(file, unchecked=True)


def test_identities_are_compared_node_by_node(monkeypatch):
    compared = []
    monkeypatch.setattr(module, "read_identity", lambda bus, node: f"here {node}")
    monkeypatch.setattr(
        module, "check_same_drive",
        lambda file, written, here, *, other_drive: compared.append((file, written, here, other_drive)),
    )  # fmt: skip
    drives = SimpleNamespace(nodes=(7, 9), bus=None)
    check_same_drives("f", Snapshot("tmcm1636", (), identities=("a", "b")), drives)
    check_same_drives("f", Snapshot("tmcm1636", (), identities=("a",)), drives, other_drive=True)
    check_same_drives("f", Snapshot("tmcm1636", ()), drives)
    assert compared == [("f", "a", "here 0", False), ("f", "b", "here 1", False), ("f", "a", "here 0", True)]
