"""Whoever changes drives leaves a file, and the state before comes back: at once, after an error, by one command."""

from __future__ import annotations

import uuid
from contextlib import contextmanager

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from drive_env import EmulatedDrives, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.gains import GAIN_OBJECTS, write_gains
from drive_env.master.errors import BusError
from tuning.cli import app
from tuning.snapshot import SnapshotError, Transaction, load_snapshot, restore, take
from tuning.target import FREE, emulated, on_bus

CURRENT_LIMIT, PROFILE_VELOCITY = (0x2003, 0), (0x6081, 0)
TRIED = np.array([[1000, 900, 800, 700, 600]])


@pytest.fixture
def target():
    with emulated(load="inertia", num_machines=3) as made:
        yield made


def gains(drives):
    return np.stack([drives.read(name) for name in GAIN_OBJECTS], axis=1)


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
    mask, enabled = motion.OPERATION_ENABLED
    assert not np.any(target.drives.read(0x6041) & mask == enabled)


def test_a_drive_in_fault_is_rolled_back_too(target, tmp_path):
    before = take(target)
    with Transaction(target, tmp_path / "before.toml"):
        change(target.drives)
        target.drives.machine.supply = 65.0  # V: over-voltage
        target.drives.advance(0.1)
        mask, fault = motion.FAULT
        assert np.all(target.drives.read(0x6041) & mask == fault)
    assert take(target) == before


def test_a_rollback_that_fails_names_the_file_that_helps(target, tmp_path, monkeypatch):
    truly = target.drives.write

    def refuse(name, value, where=None):
        if name == CURRENT_LIMIT and np.ndim(value) == 0 and value != 1234:
            raise BusError("the cable is out")
        truly(name, value, where=where)

    monkeypatch.setattr(target.drives, "write", refuse)
    with (
        pytest.raises(BusError, match=r"cable is out.*drive-tune restore .*before\.toml brings back"),
        Transaction(target, tmp_path / "before.toml"),
    ):
        change(target.drives)


def test_emulated_drives_have_nothing_that_outlives_them(target, tmp_path):
    with Transaction(target, tmp_path / "before.toml") as transaction:
        assert not transaction.store()
        transaction.commit()
    assert not load_snapshot(transaction.path).stored


# --- the file -----------------------------------------------------------------------------------------------------
def test_a_snapshot_reads_back_equal_and_says_what_its_numbers_are(target, tmp_path):
    before = take(target)
    path = before.save(tmp_path / "before.toml")
    assert load_snapshot(path) == before
    text = path.read_text(encoding="utf-8")
    assert "drive-tune restore before.toml" in text
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
    ("device = 3", "is no snapshot"),
    ("device = ", "is no TOML"),
    ('device = "tmcm1636"\n[[axis]]\n"6041:00" = 3', "6041:00 = 3: .* can only be read"),
    ('device = "tmcm1636"\n[[axis]]\n"2003:00" = 999999999', "2003:00 = 999999999"),
    ('device = "tmcm1636"\n[[axis]]\nx = 3', "x = 3"),
])  # fmt: skip
def test_a_file_that_is_no_snapshot_is_refused(tmp_path, text, message):
    (tmp_path / "x.toml").write_text(text, encoding="utf-8")
    with pytest.raises(SnapshotError, match=message):
        load_snapshot(tmp_path / "x.toml")


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


def drive_tune(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_one_command_brings_back_what_a_program_left_behind_that_was_killed(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    with served() as (channel, machines):
        before = [gains(machine).tolist() for machine in machines]
        target = opened(channel)
        with target:
            transaction = Transaction(target, tmp_path / "before.toml").__enter__()  # and no exit
            write_gains(target.drives, np.repeat(TRIED, 2, axis=0))
            target.drives.write(CURRENT_LIMIT, 1234)
        assert [gains(machine).tolist() for machine in machines] != before
        assert load_snapshot(transaction.path).bus == {
            "interface": "virtual", "channel": channel, "nodes": [1, 2], "pace": "lockstep",
        }  # fmt: skip
        done = drive_tune("restore", transaction.path, "--yes")
        assert done.exit_code == 0, done.output
        assert "axis 1: 2003h:00 Maximum Current: 1234 -> 7000" in done.stdout
        assert "12 parameters restored\n" in done.stdout
        assert [gains(machine).tolist() for machine in machines] == before
        assert [int(machine.read(CURRENT_LIMIT)[0]) for machine in machines] == [7000, 7000]
        again = drive_tune("restore", transaction.path, "--yes", "--json")
        assert again.stdout == '{"changed": [], "stored": false}\n'


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
        done = drive_tune("restore", transaction.path, "--yes")
        assert "10 parameters restored; the drives keep them" in done.stdout
        with opened(channel) as target:
            target.drives.reset_node()
        assert [gains(machine).tolist() for machine in machines] == before


def test_an_enabled_axis_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")
    with served() as (channel, machines):
        with opened(channel) as target:
            path = take(target).save(tmp_path / "before.toml")
        machines[0].write(CURRENT_LIMIT, 1234)
        for word in (0x06, 0x07, 0x0F):
            machines[0].write(0x6040, word)
        done = drive_tune("restore", path, "--yes")
        assert done.exit_code == 1
        assert "disable it first" in done.stderr
        assert machines[0].read(CURRENT_LIMIT) == [1234]


@pytest.mark.parametrize(("arguments", "code", "message"), [
    (["restore", "none.toml"], 2, "drive-tune: cannot read none.toml: No such file"),
    (["restore", "emulated.toml"], 2, "was taken from emulated drives, which ended with their program"),
    (["restore", "bus.toml"], 2, "Nobody is there to ask; say --yes"),
    (["restore", "bus.toml", "--yes", "--interface", "none"], 2, "cannot open interface 'none'"),
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
