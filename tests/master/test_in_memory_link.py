"""A second link: what drives, envelope and tools do on a fieldbus that is not CAN (tests/rigs/in_memory_link.py)."""

from __future__ import annotations

import ast
import inspect
import re
from contextlib import contextmanager

import numpy as np
import pytest
from rigs import ROOT
from rigs.in_memory_link import (
    Images,
    ImageWatch,
    InputRows,
    Mailbox,
    MemoryBus,
    MemoryDrives,
    MemoryLink,
    NoOtherMasters,
    OutputRows,
)  # fmt: skip
from rigs.parity_scripts import SCRIPTS, TURN, emulated, run
from rigs.world_bus import assert_equal, served

from drive_env import EmulatedDrives, Limits, SafetyError, motion
from drive_env.devices import find_device
from drive_env.fieldbus import link
from drive_env.master import parameters
from drive_env.master.can.can_link import CanLink
from drive_env.master.can.dry_run import DrySdoClient
from drive_env.master.can.error_control import ErrorControls
from drive_env.master.can.other_masters import OtherMasters
from drive_env.master.can.process_data import PdoProcessData, RpdoRows
from drive_env.master.can.samples import PdoSamples
from drive_env.master.can.sdo import SdoClient

GAIN_OBJECTS = find_device("tmcm1636").gains.keys


@contextmanager
def linked(safety=True, load="inertia"):
    """Emulated drives behind the link."""
    with (
        EmulatedDrives(load=load, num_threads=1) as emulator,
        MemoryDrives(MemoryBus(emulator), safety=safety) as drives,
    ):
        yield drives


def test_what_is_common_imports_nothing_of_can():
    """But for the bit with which CiA 301 switches PDOs off, which a drive's parameters have on any bus."""
    common = [*(ROOT / "drive_env/master").glob("*.py"), *(ROOT / "drive_env/safety").rglob("*.py")]
    for path in common:
        if path.name in ("can_drives.py", "parameters.py") or "model" in path.parts:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                assert not (node.module or "").startswith(("drive_env.canopen", "drive_env.master.can.")), path
    assert len(common) > 30


@pytest.mark.parametrize(("protocol", "kinds"), [
    (link.Link, (CanLink, MemoryLink)), (link.ObjectClient, (SdoClient, DrySdoClient, Mailbox)),
    (link.ProcessData, (PdoProcessData, Images)), (link.Samples, (PdoSamples, InputRows)),
    (link.Outputs, (RpdoRows, OutputRows)), (link.MasterWatch, (ErrorControls, ImageWatch)),
    (link.OtherMastersHeard, (OtherMasters, NoOtherMasters)),
], ids=lambda one: getattr(one, "__name__", ""))  # fmt: skip
def test_links_have_what_is_asked_of_them(protocol, kinds):
    asked = {name: one for name, one in vars(protocol).items() if inspect.isfunction(one) and name[0] != "_"}
    assert asked
    for kind in kinds:
        for name, one in asked.items():
            found = inspect.signature(getattr(kind, name)).parameters.values()
            wanted = inspect.signature(one).parameters.values()
            assert [(p.name, p.default) for p in found] == [(p.name, p.default) for p in wanted], (kind, name)


# --- the interface ----------------------------------------------------------------------------------------------------
@pytest.mark.every(8)
@pytest.mark.parametrize("safety", [True, False], ids=["enveloped", "bare"])
@pytest.mark.parametrize("name", SCRIPTS)
def test_the_same_script_gives_the_same_integers(name, safety):
    with linked(safety, load="belt" if name == "homing" else "two_mass") as drives:
        assert_equal(emulated(name), run(SCRIPTS[name], drives))


def test_parameters_are_written_all_or_none():
    with linked() as drives:
        before = parameters.read_parameters(drives)
        assert len(before) > 100
        wanted = {(0x6081, 0): before[0x6081, 0] + 1, GAIN_OBJECTS[0]: before[GAIN_OBJECTS[0]] + 1}
        assert len(parameters.write_all_or_none(drives, wanted)) == 2
        assert parameters.compare(drives, wanted) == []
        with pytest.raises(parameters.NotRestoredError, match="everything was taken back"):
            parameters.write_all_or_none(drives, {**before, (0x605A, 0): 3})  # an option that the drive does not know
        assert parameters.compare(drives, wanted) == []
        parameters.write_all_or_none(drives, before)
        assert parameters.compare(drives, before) == []


# --- the envelope -----------------------------------------------------------------------------------------------------
def passes_a_limit(drives):
    """Return what the envelope says, and where it has brought the axis."""
    motion.enable(drives, mode="csv")
    with pytest.raises(SafetyError) as error:
        drives.record([0x6064], 0.5, {0x60FF: np.full(500, 900_000)})
    drives.advance(0.3)
    return str(error.value), drives.read(0x6041).tolist(), drives.read(0x6064).tolist()


def test_a_limit_that_is_passed_stops_the_axis_as_over_can():
    limits = Limits(position=(-TURN, 2 * TURN))
    with served("calls", load="inertia", safety=limits) as drives:
        expected = passes_a_limit(drives)
    with linked(limits) as drives:
        found = passes_a_limit(drives)
    assert found == expected
    assert re.match(r"axis 0: its stop would end \d+ increments beyond the limits -65536 to 131072", found[0])
