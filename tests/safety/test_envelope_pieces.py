"""Single rules of the envelope that no session needs: each drive here has what makes it need one."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from rigs.foreign_eds import ENCODER_RESOLUTION, foreign
from rigs.scripted_drive import ScriptedBus, ScriptedDrive

from drive_env import CanDrives, Limits, SafetyError, motion
from drive_env.dictionary.entries import Entry
from drive_env.safety.envelope import Envelope
from drive_env.safety.looks import Looks
from drive_env.safety.objects import SET_POINTS

TURN = 65536
TRAVEL = Limits(position=(-3 * TURN, 3 * TURN))
VALUES = {(0x2058, 0): (TURN, 4), (0x6085, 0): (1000 * TURN, 4), (0x605A, 0): (2, 2)}


def drive_of(node=1, **values):
    return ScriptedDrive(node, VALUES | {(int(name[1:], 16), 0): value for name, value in values.items()})


@pytest.mark.parametrize(("option", "refused"), [(0, False), (2, True)])
def test_a_relative_move_may_count_from_where_the_axis_is(option, refused):
    """60F2h = 2 (CiA 402): from the actual position, which here is 2.5 turns ahead of the demand."""
    drive = drive_of(x60F2=(option, 2), x6064=(5 * TURN // 2, 4))
    with ScriptedBus(drive) as bus, CanDrives(bus=bus, pace="lockstep", safety=TRAVEL) as drives:
        motion.enable(drives, mode="pp")
        drive.set(0x6062, 0)
        drive.set(0x6064, 5 * TURN // 2)
        if refused:
            with pytest.raises(SafetyError, match="beyond the limits"):
                motion.start_move(drives, TURN, relative=True)
        else:
            motion.start_move(drives, TURN, relative=True)


@pytest.mark.parametrize(("turns", "stops"), [(3, False), (5, True)])
def test_where_the_ramp_is_not_known_a_stop_may_take_half_a_second_at_full_speed(tmp_path, turns, stops):
    """STOP_WITHIN at a speed that falls evenly: from 1 turn, 3 turns/s lead to 2.53 turns, 5 turns/s to 3.55."""
    drive = drive_of(x6064=(TURN, 4))
    for index in (0x6084, 0x6085):
        drive.values.pop((index, 0), None)
    text = foreign(tmp_path, ENCODER_RESOLUTION).read_text(encoding="utf-8")
    path = tmp_path / "without.eds"
    path.write_text(re.sub(r"\n\d+=0x60(84|85)\b", "", text), encoding="utf-8")
    drive.values[0x608F, 1], drive.values[0x608F, 2] = (TURN, 4), (1, 4)
    with ScriptedBus(drive) as bus, CanDrives(eds=path, bus=bus, pace="lockstep", safety=TRAVEL) as drives:
        motion.enable(drives, mode="csv")
        drives.advance(0.03)
        drive.motion = lambda d: d.set(0x6064, d.get(0x6064) + turns * TURN // 1000)
        if stops:
            with pytest.raises(SafetyError, match="its stop would end"):
                drives.advance(0.03)
        else:
            drives.advance(0.03)
        drive.motion = lambda d: None


@pytest.mark.parametrize("silent", [0, 1, 2])
def test_what_comes_of_an_axis_ends_with_the_first_object_that_does_not(silent):
    """A node that is silent costs the others one time-out, not one for each object."""
    asked = []

    def ask(index, sub, timeout):
        asked.append(index)
        return None if index == silent else bytes([7])

    drives = SimpleNamespace(
        num_axes=2,
        sdo=lambda node: SimpleNamespace(ask=ask),
        description=SimpleNamespace(
            num_axes=1, key=lambda entry, axis: (entry.index, entry.sub), decode=lambda entry, data: data[0]
        ),
    )
    entries = [SimpleNamespace(index=k, sub=0) for k in range(3)]
    found = Looks._ask_axis(SimpleNamespace(_drives=drives), 1, 1, entries, 0.1)
    assert asked == list(range(silent + 1))
    assert {key: row.tolist() for key, row in found.items()} == {(k, 0): [[0, 7]] for k in range(silent)}


def envelope_of(is_armed=False, live=True):
    """An envelope whose parts do nothing, and what it does besides."""
    done, nothing = [], lambda *arguments: None
    made = Envelope.__new__(Envelope)
    made._drives = SimpleNamespace(
        description=SimpleNamespace(
            dictionary=SimpleNamespace(roles={}), has=lambda key: False, role=lambda part: None
        ),
        nodes=(),
        link=SimpleNamespace(process=None),
    )
    made._axes, made._set_points = SimpleNamespace(is_armed=is_armed), frozenset(SET_POINTS)
    made._axes.may_turn = np.zeros(1, bool)
    made._watch = SimpleNamespace(await_stop=nothing, is_supervised=False)
    made._watchdogs = SimpleNamespace(check_not_held=nothing)
    made._commands = SimpleNamespace(check_write=lambda *arguments: done.append("checked"))
    made._stops = SimpleNamespace(keep_ramps=lambda *arguments: done.append("ramps kept"))
    made._give_all_back = lambda entry: done.append("given back")
    made._drives.num_axes, made._of_further_axes = 1, {}
    made._finds_live = lambda where: live
    made._arm = lambda: done.append("armed")
    return made, done


@pytest.mark.parametrize(
    ("index", "is_armed", "live", "done"),
    [
        (0x1FFF, False, True, ["checked"]),  # how a node talks
        (0x2000, False, True, ["armed", "checked"]),  # somebody else has enabled the axis that it changes
        (0x6081, False, True, ["armed", "checked"]),
        (0x6081, False, False, ["checked"]),
        (0x6081, True, True, ["checked", "ramps kept"]),
        (0x60FF, False, False, ["checked", "armed"]),  # a set-point
        (0x607A, False, False, ["checked", "armed"]),
        (0x1010, True, True, ["checked", "ramps kept", "given back"]),  # what the drives store is their own
        (0x1010, False, False, ["checked"]),
    ],
)
def test_what_makes_ready_for_motion_before_it_is_written(index, is_armed, live, done):
    envelope, found = envelope_of(is_armed, live)
    envelope.before_write(SimpleNamespace(index=index, sub=0, label="it"), np.array([1]), np.array([True]))
    assert found == done


def test_of_what_was_played_the_last_row_is_what_the_drives_have():
    envelope, found = envelope_of()
    envelope._axes.everywhere = np.array([True, True])
    envelope.after_write = lambda entry, raw, where: found.append((entry.index, raw.tolist(), where.tolist()))
    envelope.after_failed_write = lambda entry: found.append(entry.index)
    speed, word, none = (Entry(index, 0, "it", 32, "rw", None, None, 0, "", True) for index in (0x60FF, 0x6040, 0x607A))
    played = {speed: np.array([[1, 2], [3, 4]]), none: np.empty((0, 2), np.int64), word: np.array([[6, 7]])}
    envelope.after_play(played)
    assert found == [(0x60FF, [3, 4], [True, True]), (0x6040, [6, 7], [True, True])]
    found.clear()
    envelope.after_failed_play(played)
    assert found == [0x60FF, 0x607A, 0x6040]  # any of them may have been taken
