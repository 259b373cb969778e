"""A second link: what drives, envelope and tools do on a fieldbus that is not CAN (tests/rigs/in_memory_link.py)."""

from __future__ import annotations

import ast
import inspect
import logging
import re
import time
from contextlib import contextmanager

import numpy as np
import pytest
from rigs import ROOT
from rigs.in_memory_link import (
    FIRST_ADDRESS,
    WATCHDOG_STEP,
    Images,
    ImageWatch,
    InputRows,
    Mailbox,
    MemoryBus,
    MemoryDrives,
    MemoryLink,
    NoOtherMasters,
    OutputRows,
    State,
)  # fmt: skip
from rigs.parity_scripts import SCRIPTS, TURN, emulated, run
from rigs.world_bus import assert_equal, served

from drive_env import EmulatedDrives, Limits, ObjectAccessError, SafetyError, cia402, motion
from drive_env.devices import find_device
from drive_env.fieldbus import link
from drive_env.fieldbus.errors import NoAnswerError, RefusedError
from drive_env.master import parameters
from drive_env.master.can.can_link import CanLink
from drive_env.master.can.dry_run import DrySdoClient
from drive_env.master.can.error_control import ErrorControls
from drive_env.master.can.other_masters import OtherMasters
from drive_env.master.can.process_data import PdoProcessData, RpdoRows
from drive_env.master.can.samples import PdoSamples
from drive_env.master.can.sdo import SdoClient
from drive_env.master.identity import read_identity
from drive_env.motors import find_motor
from drive_env.safety.envelope import swinging_allowed
from tuning.auto.one_button import auto
from tuning.identify.quick_identification import identify_briefly
from tuning.target import Target

GAIN_OBJECTS = find_device("tmcm1636").gains.keys


@contextmanager
def linked(safety=True, pace="lockstep", timeout=None, **machine):
    """Emulated drives behind the link; yield them and their bus."""
    with (
        EmulatedDrives(num_threads=1, **{"load": "inertia"} | machine) as emulator,
        MemoryBus(emulator, pace == "lockstep") as bus,
        MemoryDrives(bus, pace=pace, safety=safety, timeout=timeout) as drives,
    ):
        yield drives, bus


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
    with linked(safety, load="belt" if name == "homing" else "two_mass") as (drives, _):
        assert_equal(emulated(name), run(SCRIPTS[name], drives))


def test_several_nodes_are_the_axes_in_their_order():
    def different_targets(drives):
        motion.enable(drives, mode="csv")
        targets = np.linspace(0, 1, 50)[:, None] * np.array([300_000, -200_000, 50_000])
        return drives.record([0x6064, 0x606C], 0.05, {0x60FF: targets.astype(int)})

    machine = {"num_machines": 3, "seed": 4, "randomise": True}
    with EmulatedDrives(load="inertia", num_threads=1, **machine) as inside:
        expected = different_targets(inside)
    with linked(**machine) as (drives, _):
        found = different_targets(drives)
    np.testing.assert_array_equal(found[0x6064], expected[0x6064])
    np.testing.assert_array_equal(found[0x606C], expected[0x606C])


def test_objects_are_read_written_and_refused():
    with linked() as (drives, bus):
        drives.write("Profile velocity", "30 rpm")
        assert drives.read(0x6081) == [32768]
        assert list(drives.read(0x1008)) == ["TMCM-1636"]
        assert read_identity(drives).node == FIRST_ADDRESS
        drives.write(0x6060, 3)
        with pytest.raises(RefusedError, match=rf"node {FIRST_ADDRESS} refused the write of 3 to 6060h:00") as error:
            drives.write(0x6060, 3)
        assert error.value.abort_code == 0x08000022
        bus.nodes[0].is_listening = False
        drives.description.timeout = 0.01
        with pytest.raises(NoAnswerError, match=rf"node {FIRST_ADDRESS} did not answer the read of 6081h:00"):
            drives.read(0x6081)
        bus.nodes[0].is_listening = True


def test_a_node_that_a_dead_master_left_silent_is_woken(caplog):
    with EmulatedDrives(load="inertia", num_threads=1) as emulator, MemoryBus(emulator) as bus:
        bus.nodes[0].is_listening = False
        with MemoryDrives(bus, timeout=0.01) as drives:
            assert cia402.is_disabled(int(drives.read(0x6041)[0]))
    assert f"node {FIRST_ADDRESS} was stopped" in caplog.text


def test_what_does_not_fit_into_an_image_is_refused_and_what_is_watched_gives_way():
    wide = [0x6062, 0x6063, 0x6064, 0x606C, 0x607A, 0x60FD]  # four bytes each: all that an image holds
    with linked() as (drives, _):
        assert drives.record(wide, 0.003)[0x6064].shape == (3, 1)
        motion.enable(drives, mode="csv")
        assert drives.record(wide, 0.003)[0x6064].shape == (3, 1)  # the envelope asks for the statusword
        with pytest.raises(ObjectAccessError, match="7 objects are beyond 24 bytes"):
            drives.record([*wide, 0x6041], 0.003)
        with pytest.raises(ObjectAccessError, match=r"1008h.* cannot be recorded"):
            drives.record([0x1008], 0.003)


def test_a_reset_restores_the_stored_values_and_goes_on():
    with linked() as (drives, bus):
        drives.write(0x6081, 12345)
        motion.enable(drives, mode="pv")
        drives.reset_node()
        assert drives.read(0x6081) != [12345]
        assert bus.nodes[0].state is State.PREOP
        motion.enable(drives, mode="csv")
        assert drives.record([0x6041], 0.005)[0x6041].shape == (5, 1)


def test_emergencies_come_with_their_names():
    with linked(safety=False) as (drives, _):
        motion.enable(drives, mode="csp")
        drives.write(0x6065, 2000)
        drives.record([0x6064], 0.08, {0x607A: np.arange(80) * 4000})
        assert [message.name for message in drives.emergencies()] == ["following_error"]
        assert drives.emergencies() == []


def test_parameters_are_written_all_or_none():
    with linked() as (drives, _):
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
    with linked(limits) as (drives, _):
        found = passes_a_limit(drives)
    assert found == expected
    assert re.match(r"axis 0: its stop would end \d+ increments beyond the limits -65536 to 131072", found[0])


def test_an_exception_stops_the_axis_and_switches_it_off():
    with EmulatedDrives(load="inertia", num_threads=1) as emulator, MemoryBus(emulator) as bus:
        with pytest.raises(KeyError), MemoryDrives(bus) as drives:
            motion.enable(drives, mode="pv")
            drives.write(0x60FF, 500_000)
            drives.advance(0.2)
            raise KeyError("a mistake of the program")
        assert not cia402.is_live(emulator.read(0x6041)).any()
        assert abs(int(emulator.read(0x606C)[0])) < 5_000


def test_a_node_that_restarts_by_itself_is_told():
    with linked() as (drives, _):
        motion.enable(drives, mode="csv")
        drives.link.lose_power(0)
        with pytest.raises(SafetyError, match=rf"node {FIRST_ADDRESS} has restarted by itself"):
            drives.advance(0.01)
        motion.enable(drives, mode="csv")
        drives.advance(0.01)


def test_lockstep_on_a_bus_whose_time_passes_by_itself_is_refused():
    with (
        EmulatedDrives(load="inertia", num_threads=1) as emulator,
        MemoryBus(emulator, lockstep=False) as bus,
        MemoryDrives(bus) as drives,
        pytest.raises(SafetyError, match="time passes by itself on this bus"),
    ):
        motion.enable(drives, mode="csv")


# --- the watch over the master ----------------------------------------------------------------------------------------
def test_a_dead_master_is_noticed_by_the_process_data_watchdog(caplog):
    """The cable is pulled while the axis turns: nobody but the node itself can stop it."""
    silence = 0.2
    with linked(Limits(silence=silence), "real-time", timeout=0.05) as (drives, bus):
        motion.enable(drives, mode="pv")
        drives.write(0x60FF, 500_000)
        drives.advance(0.3)
        assert drives.link.watch.detection_time == bus.nodes[0].watchdog == pytest.approx(silence)
        assert abs(int(bus.drives.read(0x606C)[0])) > 400_000
        with caplog.at_level(logging.CRITICAL):
            bus.is_connected = False
            bus.let_pass(lambda: bus.nodes[0].state is State.SAFEOP)
            assert bus.nodes[0].lost_at - bus.nodes[0].exchanged_at == pytest.approx(1e3 * silence, abs=1)
            bus.let_pass(lambda: bus.cycles > bus.nodes[0].lost_at + 500)
            with bus.turn:
                assert abs(int(bus.drives.read(0x606C)[0])) < 5_000
                assert not cia402.matches(int(bus.drives.read(0x6041)[0]), cia402.OPERATION_ENABLED)
            with pytest.raises(SafetyError):
                drives.advance(0.01)
    assert bus.nodes[0].watchdog > 0.0  # it was never proved off, and keeps its watchdog


def test_a_program_that_computes_is_no_dead_master_and_one_that_ends_gives_the_watchdog_back():
    with linked(Limits(silence=0.3), "real-time") as (drives, bus):
        motion.enable(drives, mode="csv")
        time.sleep(0.5)  # the supervisor is heard meanwhile
        assert cia402.matches(int(drives.read(0x6041)[0]), cia402.OPERATION_ENABLED)
        assert bus.nodes[0].state is State.OP
        motion.disable(drives)
        drives.link.sync = lambda: None  # nobody looks at an axis that is off often enough for its watchdog
        time.sleep(0.5)
        assert bus.nodes[0].state is State.OP
    assert bus.nodes[0].watchdog == 0.0


def test_a_watchdog_that_notices_later_than_allowed_is_refused():
    limits, said = Limits(silence=0.5 * WATCHDOG_STEP), r"dead after 0\.04 s, and 0\.02 s are allowed; give Limits\(si"
    with linked(limits, "real-time") as (drives, bus), pytest.raises(SafetyError, match=said):
        motion.enable(drives, mode="csv")
    assert bus.nodes[0].watchdog == 0.0


# --- tuning -----------------------------------------------------------------------------------------------------------
def target_of(drives):
    motor, way = find_motor("qbl4208"), np.array([30.0])
    limits = motor.rated_speed, motor.rated_current
    return Target(drives, find_device("tmcm1636"), motor, np.array([24.0]), -way, way, *limits, bus={"channel": "here"})


@pytest.mark.slow
def test_an_axis_is_identified_over_it():
    with linked() as (drives, _), swinging_allowed(drives):
        (found,) = identify_briefly(target_of(drives))
        assert not cia402.is_live(drives.read(0x6041)).any()
    with EmulatedDrives(load="inertia", num_threads=1) as inside:
        (expected,) = identify_briefly(target_of(inside))
    assert found.told.keys() == expected.told.keys()
    inertia = found.told["inertia"].value
    assert inertia == pytest.approx(expected.told["inertia"].value, rel=0.05)


@pytest.mark.slow
def test_one_button_tunes_over_it(tmp_path):
    with linked() as (drives, _):
        before = np.stack([drives.read(name) for name in GAIN_OBJECTS])
        result = auto(target_of(drives), tmp_path / "before.toml", keep=False)
        assert result.accepted.all(), result.axes[0].reason
        assert not np.array_equal(np.stack([drives.read(name) for name in GAIN_OBJECTS]), before)
