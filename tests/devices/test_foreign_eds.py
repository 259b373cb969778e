"""Drives of other makers, whose EDS lists what they lack, or is written as the rules do not foresee."""

from __future__ import annotations

import re

import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive

from drive_env import CanDrives, Limits, motion
from drive_env.devices import find_device

TURN = 65536
VALUES = {(0x2058, 0): (TURN, 4), (0x6085, 0): (1000 * TURN, 4), (0x605A, 0): (2, 2)}
EDS = find_device("tmcm1636").eds.read_text(encoding="utf-8")


def listed(index, name, data_type="0x0007"):
    """Return the section of an object that the drive does not have."""
    return f"\n[{index}]\nParameterName={name}\nObjectType=0x7\nDataType={data_type}\nAccessType=rw\nPDOMapping=1\n"


LACKING = EDS + listed("607F", "Max profile velocity") + listed("6073", "Max current", "0x0006")
WRITE_ONLY = re.sub(r"(\[6060\][^\[]*?AccessType=)rw", r"\1wo", EDS)


def turn(drive, path, **options):
    """Enable a drive by an EDS and let it turn; return it."""
    with ScriptedBus(drive) as bus, CanDrives(eds=path, bus=bus, pace="lockstep", **options) as drives:
        motion.enable(drives, mode="csv")
        drives.record([0x6064], 0.003, play={0x60FF: [1000, 2000, 3000]})
        assert drive.get(0x6041) & 0x6F == 0x27
        assert (drive.get(0x6060), drive.get(0x60FF)) == (9, 3000)
        drives.write(0x60FF, 0)
    assert drive.get(0x6041) & 0x6F != 0x27
    return drive


@pytest.mark.every(3)
@pytest.mark.parametrize(
    "data",
    [
        LACKING.encode(),
        WRITE_ONLY.encode(),
        b"\xef\xbb\xbf" + EDS.encode(),
        EDS.replace("ParameterName=Controlword", "ParameterName=Mot d'\xe9tat").encode("cp1252"),
        EDS.replace("ParameterName=Controlword", "ParameterName=Control\x81word").encode("latin-1"),
    ],
    ids=["lists objects that the drive lacks", "6060h write-only", "byte order mark", "cp1252", "neither"],
)
@pytest.mark.parametrize("safety", [Limits(), Limits(velocity=5 * TURN, current=3000, position=(-TURN, TURN))])
def test_a_drive_turns_whatever_its_eds_says(tmp_path, data, safety):
    path = tmp_path / "foreign.eds"
    path.write_bytes(data)
    turn(ScriptedDrive(values=VALUES), path, safety=safety)
