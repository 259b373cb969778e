"""Paths around the envelope that a reader of its code found: each let an axis be live and unguarded."""

from __future__ import annotations

import numpy as np
import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from rigs.world_bus import served

from drive_env import CanDrives, Limits, SafetyError, motion

TURN = 65536
FAST = 15 * TURN


@pytest.fixture
def drive():
    return ScriptedDrive(values={(0x2058, 0): (TURN, 4), (0x6085, 0): (1000 * TURN, 4)})


@pytest.fixture
def bus(drive):
    with ScriptedBus(drive) as made:
        yield made


def machine_of(drives):
    return drives._port._bus._world


def test_after_a_shared_heartbeat_number_another_one_is_armed(bus, drive):
    with CanDrives(bus=bus) as drives:
        motion.enable(drives, mode="csv")
        shared = drive.get(0x1016, 1) >> 16
        bus.push(0x700 + shared, b"\x05")
        with pytest.raises(SafetyError, match="another program sends heartbeats as node-ID"):
            for _ in range(1000):
                drives.advance(0.002)
        bus.log.clear()
        motion.enable(drives, mode="csv")
        own = drive.get(0x1016, 1) >> 16
        assert own not in (0, shared)
        assert len(bus.sent(0x700 + own)) >= 3 and not bus.sent(0x700)
        motion.disable(drives)


@pytest.mark.parametrize("command", [
    lambda drives: drives.write(0x6040, 0x0F),
    lambda drives: drives.write(0x60FF, 0),
    lambda drives: drives.record([0x6064], 0.003, play={0x6040: [6, 7, 15]}),
], ids=["a controlword", "a set-point", "a play"])  # fmt: skip
def test_an_axis_that_could_not_be_proved_off_is_not_commanded_again(bus, drive, command):
    with CanDrives(bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="csv")
        drives.safety._axes.lost.add(0)
        with pytest.raises(SafetyError, match="axis 0 could not be confirmed to be off"):
            command(drives)
        drives.safety._axes.lost.clear()


def test_a_reset_of_one_node_leaves_the_other_guarded():
    with served("calls", nodes=(1, 2), load="inertia", num_machines=2) as drives:
        first = np.array([True, False])
        motion.enable(drives, mode="pv", where=first)
        drives.write(0x60FF, FAST, where=first)
        drives.advance(0.2)
        drives.reset_node(~first)
        with pytest.raises(SafetyError, match="changes the scale of positions, and the axis is enabled"):
            drives.write(0x2058, 1024, where=first)
        speeds = []
        write = drives.write_axis

        def watch(entry, axis, value):
            if entry.index == 0x6040 and value == 0:
                speeds.append(abs(drives.read_axis(drives.description.dictionary.find(0x606C), axis)))
            write(entry, axis, value)

        drives.write_axis = watch
        drives.write(0x6040, 0, where=first)
        assert speeds == [pytest.approx(0, abs=TURN)]  # braked before the voltage went


def test_a_drive_found_turning_is_braked_before_its_voltage_is_taken():
    with served("calls", load="inertia", safety=False) as other:
        motion.enable(other, mode="pv")
        other.write(0x60FF, FAST)
        other.advance(0.3)
        with CanDrives(bus=other._port._bus, pace="lockstep") as drives:
            drives.write(0x6040, 0)
            assert abs(drives.read(0x606C)[0]) < TURN
            assert drives.read(0x6041)[0] & 0x4F == 0x40


@pytest.mark.parametrize("cut", [0x00, 0x06])
def test_rows_that_cut_the_voltage_of_what_they_enable_are_refused(bus, drive, cut):
    with CanDrives(bus=bus, pace="lockstep") as drives:
        motion.enable(drives, mode="csv")
        with pytest.raises(SafetyError, match="these rows take the voltage away after they have enabled it"):
            drives.record([0x6064], 0.004, play={0x6040: [15, 15, cut, cut]})
        assert drive.get(0x6040) == 15
        drives.record([0x6064], 0.003, play={0x6040: [15, 2, 2]})


def test_a_look_at_one_axis_says_nothing_of_another():
    nodes = [ScriptedDrive(node, {(0x2058, 0): (TURN, 4)}) for node in (1, 2)]
    with (
        ScriptedBus(*nodes) as bus,
        CanDrives(bus=bus, nodes=(1, 2), pace="lockstep", safety=Limits(current=500)) as drives,
    ):
        motion.enable(drives, mode="csv")
        nodes[0].set(0x6077, 3000)
        current = [drives.description.dictionary.find(0x6077)]
        with pytest.raises(SafetyError, match="axis 0: the current is 3000 for 10 cycles"):
            for _ in range(20):
                drives.safety._watch.looks.ask(current)
        nodes[0].set(0x6077, 0)


def test_closing_beyond_a_limit_stops_all_the_same():
    with served("calls", load="inertia") as drives:
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, FAST)
        drives.advance(0.2)
        drives.safety.change(Limits(velocity=TURN))
        drives.safety.close()
        assert drives.read(0x6041)[0] & 0x4F == 0x40
        assert abs(drives.read(0x606C)[0]) < TURN


def test_an_offset_of_before_a_reset_does_not_hide_a_target():
    with served("calls", load="inertia", safety=Limits(position=(-3 * TURN, 3 * TURN))) as drives:
        motion.enable(drives, mode="csp")
        drives.write(0x60B0, -2 * TURN)
        drives.reset_node()
        motion.enable(drives, mode="csp")
        with pytest.raises(SafetyError, match="607Ah:00 Target position would lead to"):
            drives.write(0x607A, 4 * TURN)
