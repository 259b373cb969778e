"""Single rules of the envelope that no session needs: each drive here has what makes it need one."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest
from scripted_drive import ScriptedBus, ScriptedDrive
from test_envelope_limits import ENCODER_RESOLUTION, foreign

from drive_env import CanDrives, Limits, SafetyError, motion
from drive_env.safety.looks import Looks

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
    with (
        ScriptedBus(drive) as bus,
        CanDrives(eds=path, bus=bus, pace="lockstep", safety=TRAVEL) as drives,
    ):
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
