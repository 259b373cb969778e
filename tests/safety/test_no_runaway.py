"""No path on which a motor runs on: each one that was found, with the truth from inside the emulator.

Where a master may refuse or stop in time, both will do; what counts is where the rotor was and how it ended. Numbers of
the verdict are those of rigs/fault_injection.py: travel of 3 turns either way, a drive that notices its master's death
after 0.3 s, half of the commissioned deceleration.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import time
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from rigs.fault_injection import (
    DEAD_MASTER,
    EXPECTED,
    LIMITS,
    LIVING_MASTER,
    RADIANS,
    TO_AND_FRO,
    TRAVEL,
    TURN,
    FaultyBus,
    OtherMaster,
    Programs,
    no_interrupt_left,
    no_longer_than,
    problems,
    rest,
    served,
    until,
)

from drive_env import CanDrives, EmulatedDrives, Limits, SafetyError, cia402, motion
from drive_env.devices import find_device
from drive_env.fieldbus.errors import BusError
from drive_env.master.can.port import open_bus

SLOW, FAST = 2 * TURN, 15 * TURN  # pps
PP, PV = cia402.MODES["pp"], cia402.MODES["pv"]
TO_ENABLE = np.repeat([0x06, 0x07, 0x0F], 20)
linux_only = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals and fork")


class ProgramKilledError(RuntimeError):
    """Stands for the end of a program that was killed: the rest of it runs without a bus."""


@pytest.fixture(scope="module")
def emulated():
    with EmulatedDrives(load="inertia", num_threads=1) as drives:
        yield drives


@pytest.fixture(scope="module")
def programs():
    made = Programs()
    yield made
    made.close()


@pytest.fixture(autouse=True)
def no_test_hangs():
    with no_longer_than(60.0):
        yield


@contextmanager
def bench(emulated, nodes=(1,)):
    """Yield a world in real time and a master's bus on it."""
    with served(emulated, nodes) as (world, channel):
        bus = FaultyBus(open_bus(channel=channel))
        bus.channel = channel
        try:
            yield world, bus
        finally:
            bus.shutdown()


def run(bus, script, safety=LIMITS, **options):
    """Run a script as a program would; return the exception that ended it, or None."""
    opened = None
    with no_interrupt_left():
        try:
            with CanDrives(bus=bus, safety=safety, **{"timeout": 0.5} | options) as opened:
                script(opened)
        except EXPECTED as error:
            return error
        finally:
            if opened is not None:
                with suppress(*EXPECTED):
                    opened.close()  # as the interpreter does on its way out
    return None


def dies(bus):
    """Kill the program: nothing of it reaches the bus any more."""
    bus.cut()
    raise ProgramKilledError


def turn_at(drives, speed, seconds=0.1):
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", speed)
    drives.advance(seconds)


def download(message, index):
    """Return the value of an SDO download of an object of node 1, or None for another frame."""
    data = bytes(message.data)
    if message.arbitration_id != 0x601 or data[0] & 0xE0 != 0x20 or int.from_bytes(data[1:3], "little") != index:
        return None
    return int.from_bytes(data[4:8], "little")


def ended_well(world, reaction=DEAD_MASTER, travel=TRAVEL):
    rest(world)
    found = problems(world.truth, travel, reaction)
    assert not found, "; ".join(found)


def turned(world, speed=FAST):
    """Check that the axis did turn: a test of a stop that stops nothing shows nothing."""
    assert np.abs(world.truth.omega()).max() > 0.5 * speed * RADIANS


# --- left running without a watchdog ------------------------------------------------------------------------------
def test_ctrl_c_in_a_recording_whose_rows_enable(emulated):
    rows = {0x6040: np.concatenate([TO_ENABLE, np.full(440, 0x0F)]), 0x60FF: np.repeat([0, 10 * TURN], [80, 420])}
    with bench(emulated) as (world, bus):
        seen = []

        def meets(_, message):
            seen.extend([message] if message.arbitration_id == 0x080 else [])
            if len(seen) == 160:
                seen.append(None)
                signal.raise_signal(signal.SIGINT)

        def script(drives):
            motion.select_mode(drives, "pv")
            bus.meets = meets
            drives.record([0x606C], 0.5, play=rows)

        error = run(bus, script, timeout=20.0)  # on a busy computer an answer takes its time
        ended_well(world)
        if not isinstance(error, SafetyError):
            turned(world, 10 * TURN)


def test_the_answer_to_the_enabling_write_is_lost(emulated):
    with bench(emulated) as (world, bus):
        lost = []

        def meets(_, message):
            if download(message, 0x6040) == 0x0F:
                lost.append(False)
            elif lost == [False] and message.arbitration_id == 0x581 and message.data[0] == 0x60:
                lost.append(True)
                return False
            return True

        bus.meets = meets
        run(bus, lambda drives: turn_at(drives, SLOW))
        assert lost[:2] == [False, True]
        ended_well(world)


@pytest.mark.every(2)
@pytest.mark.parametrize("lost", ["the first two", "all"])
def test_stop_controlwords_are_lost(emulated, lost):
    with bench(emulated) as (world, bus):
        count = [0]

        def meets(_, message):
            if (word := download(message, 0x6040)) is not None and word & 0x8F != 0x0F:
                count[0] += 1
                return lost != "all" and count[0] > 2
            return True

        def script(drives):
            turn_at(drives, SLOW)
            bus.meets = meets

        run(bus, script, timeout=0.1)
        assert count[0] >= 2
        ended_well(world)
        turned(world, SLOW)


@pytest.mark.every(2)
@pytest.mark.parametrize("end", ["close", "death"])
def test_a_controlword_that_disables_nothing_is_no_stop(emulated, end):
    """8Fh has the bits of enable operation and that of fault reset: the drive stays enabled."""
    with bench(emulated) as (world, bus):

        def script(drives):
            turn_at(drives, SLOW)
            drives.write(0x6040, 0x8F)
            drives.advance(0.05)
            if end == "death":
                dies(bus)

        run(bus, script)
        ended_well(world)
        turned(world, SLOW)


@pytest.mark.every(3)
@pytest.mark.parametrize("after", [1, 5, 20])
def test_ctrl_c_pressed_again_while_it_stops(emulated, after):
    """The second and the third come some frames after the first, while the first is being worked on."""
    with bench(emulated) as (world, bus):
        frames = []

        def meets(*_):
            frames.append(None)
            if len(frames) in (after, 2 * after):
                signal.raise_signal(signal.SIGINT)

        def script(drives):
            turn_at(drives, TO_AND_FRO)
            bus.meets = meets
            raise KeyboardInterrupt

        with no_interrupt_left():
            run(bus, script)
        assert len(frames) >= 2 * after
        ended_well(world)
        turned(world, TO_AND_FRO)


@pytest.mark.slow
@linux_only
def test_three_ctrl_c_two_milliseconds_apart(emulated, programs):
    found = {}
    for frame in (250, 300, 350):
        with served(emulated) as (world, channel):
            pid = programs.start("run_on", channel, signal.SIGINT, frame, 3)
            until(lambda pid=pid: pid in programs.ended, "the end of the program")
            rest(world)
            found[frame] = problems(world.truth)
            turned(world, TO_AND_FRO)
    assert not any(found.values()), found


@pytest.mark.every(3)
@pytest.mark.parametrize("doing", ["records", "advances", "computes"])
def test_another_thread_stops_what_the_program_does(emulated, doing):
    """`Envelope.stop_at_once`: the button of a page, while a job of the same program is under way."""
    with bench(emulated) as (world, bus):
        begun, told = threading.Event(), []

        def press():
            begun.wait(20.0)
            time.sleep(0.2)
            told[0].stop_at_once("somebody pressed the button")

        def script(drives):
            told.append(drives.safety)
            turn_at(drives, SLOW)
            thread.start()
            begun.set()
            if doing == "records":
                drives.record([0x606C], 5.0)
            elif doing == "advances":
                drives.advance(5.0)
            else:
                end = time.monotonic() + 0.8
                while time.monotonic() < end:
                    np.sin(np.arange(1000.0))
                stood.append(bool(world.truth.stands().all()))
                drives.read(0x6041)

        stood, thread = [], threading.Thread(target=press, daemon=True)
        error = run(bus, script, safety=Limits())
        assert isinstance(error, SafetyError) and str(error).startswith("somebody pressed the button"), error
        assert stood in ([], [True])
        ended_well(world, travel=(-100 * TURN, 100 * TURN))
        turned(world, SLOW)


def test_a_stop_from_another_thread_while_nothing_is_enabled_does_nothing(emulated):
    with bench(emulated) as (world, bus):

        def script(drives):
            drives.safety.stop_at_once("somebody pressed the button")
            turn_at(drives, SLOW, 0.3)

        error = run(bus, script)
        assert error is None
        ended_well(world)
        turned(world, SLOW)


def test_what_is_read_before_the_first_enable_may_take_longer_than_the_drive_waits_for_its_master(emulated):
    silence = 0.25  # s
    with bench(emulated) as (world, bus):
        passed = []  # when 1016h was set, and when the first controlword went out [s]

        def slow_answers(_, message):
            if download(message, (0x1016, 0x6040)[min(len(passed), 1)]):
                passed.append(time.monotonic())
            if message.arbitration_id == 0x581 and len(passed) < 2:
                time.sleep(0.02)

        bus.meets = slow_answers
        error = run(bus, lambda drives: turn_at(drives, SLOW), safety=Limits(silence=silence))
        assert len(passed) >= 2, error
        assert passed[1] - passed[0] > silence  # or nothing is shown
        ended_well(world)


@pytest.mark.every(2)
@pytest.mark.parametrize("when", ["as it is enabled", "while it turns"])
def test_the_second_of_two_axes_falls_silent(when):
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as two, bench(two, (1, 2)) as (world, bus):

        def silent(_, message):
            return message.arbitration_id <= 0x80 or message.arbitration_id & 0x7F != 2

        def script(drives):
            motion.enable(drives, mode="pv")  # the drives' watchdogs are set once, before the silence
            motion.disable(drives)
            for word, state in ((0x06, cia402.READY_TO_SWITCH_ON), (0x07, cia402.SWITCHED_ON)):
                drives.write(0x6040, word)
                motion.wait_for(drives, state, 1.0, "the state before")
            if when == "as it is enabled":
                bus.meets = silent
            with suppress(BusError):
                drives.write(0x6040, 0x0F)
            drives.write(0x60FF, SLOW, where=np.array([True, when != "as it is enabled"]))
            drives.advance(0.1)
            bus.meets = silent
            drives.advance(0.1)

        run(bus, script, nodes=(1, 2), timeout=0.1)
        ended_well(world)


@pytest.mark.slow
def test_a_drive_found_enabled_is_commanded_and_the_program_dies(emulated):
    with bench(emulated) as (world, bus):
        other = OtherMaster(bus.channel)
        other.enable(PV)
        other.write(0x60FF, SLOW, 4)
        assert world.truth.is_on().all()

        def script(drives):
            drives.write(0x60FF, 2 * SLOW)
            drives.advance(0.1)
            dies(bus)

        error = run(bus, script)
        other.close()
        if isinstance(error, SafetyError) and world.truth.is_on().all():
            # Refused: the axis is the other master's, and does what that one commanded.
            assert np.abs(world.truth.omega()).max() < 1.5 * SLOW * RADIANS
        else:
            ended_well(world)


def test_lockstep_on_a_bus_in_real_time(emulated):
    with bench(emulated) as (world, bus):

        def script(drives):
            turn_at(drives, SLOW, 0.3)
            dies(bus)

        error = run(bus, script, pace="lockstep")
        ended_well(world)
        assert error is not None


def test_another_masters_pre_operational_and_then_death(emulated):
    """In pre-operational this drive sees no loss of heartbeats."""
    with bench(emulated) as (world, bus):
        other = OtherMaster(bus.channel)

        def script(drives):
            turn_at(drives, SLOW)
            other.send(0x000, b"\x80\x00")
            with suppress(*EXPECTED):
                end = time.monotonic() + 0.3
                while time.monotonic() < end:
                    drives.read(0x6041)
            dies(bus)

        run(bus, script)
        other.close()
        ended_well(world)
        turned(world, SLOW)


@pytest.mark.slow
@linux_only
def test_of_two_programs_on_one_bus_one_dies(programs):
    with EmulatedDrives(load="inertia", num_machines=2, num_threads=1) as two, served(two, (1, 2)) as (world, channel):
        living = programs.start("run_on", channel, nodes=(2,))
        dying = None
        try:
            until(lambda: world.truth.is_on()[1], "the first program's axis")
            dying = programs.start("run_on", channel, nodes=(1,))
            until(lambda: world.truth.is_on()[0] or dying in programs.ended, "the second program's axis")
            if dying not in programs.ended:
                os.kill(dying, signal.SIGKILL)
            end = world.cycles + 600
            until(lambda: world.cycles > end, "0.6 s")
            assert not world.truth.is_on()[0]
            assert world.truth.stands()[0]
            assert living not in programs.ended  # and is none the worse for it
            assert world.truth.is_on()[1]
        finally:
            for pid in (living, dying):
                if pid is not None and pid not in programs.ended:
                    os.kill(pid, signal.SIGKILL)
        ended_well(world)


def test_a_silence_that_rounds_to_none(emulated):
    """0 ms in 1016h switch the drive's watchdog off."""
    try:
        limits = Limits(position=TRAVEL, silence=0.0004)
    except ValueError:
        return
    with bench(emulated) as (world, bus):

        def script(drives):
            turn_at(drives, SLOW)
            dies(bus)

        run(bus, script, limits)
        ended_well(world)


# --- signals of a script that has no handlers -----------------------------------------------------------------------
@pytest.mark.every(3)
@linux_only
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda number: number.name)
def test_a_signal_stops_a_script_at_once(emulated, programs, number):
    """Not after the half second in which the drive waits for its master."""
    with served(emulated) as (world, channel):
        pid = programs.start("run_on", channel, safety=True)
        try:
            until(
                lambda: world.truth.is_on()[0] and world.truth.omega()[-1, 0] > 0.9 * TO_AND_FRO * RADIANS, "its speed"
            )
            begin, start = world.truth.cycles, world.truth.theta()[-1, 0]
            os.kill(pid, number)
            until(lambda: pid in programs.ended, "the end of the program")
        finally:
            if pid not in programs.ended:
                os.kill(pid, signal.SIGKILL)
        rest(world)
        at = round(start / RADIANS)
        found = problems(world.truth, (at - TURN // 4, at), LIVING_MASTER, begin)
        assert not found, "; ".join(found)


# --- limits that nobody watched ------------------------------------------------------------------------------------
def read_on(drives, seconds=1.5):
    """Read and nothing else, until something ends it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        drives.read(0x6064)


def turn_and_read(drives):
    turn_at(drives, FAST, 0.05)
    read_on(drives)


def turn_and_sleep(drives):
    turn_at(drives, FAST, 0.05)
    time.sleep(0.8)  # less than a stall


def play_that_enables(drives):
    motion.select_mode(drives, "pv")
    words = np.concatenate([TO_ENABLE, np.full(1440, 0x0F)])
    drives.record([0x606C], 1.5, play={0x6040: words, 0x60FF: np.repeat([0, FAST], [80, 1420])})


def record_eight_others(drives):
    turn_at(drives, FAST, 0.01)
    drives.record([0x6062, 0x6063, 0x606C, 0x607A, 0x60B0, 0x60B1, 0x60FF, 0x60FD], 1.0)


def record_eight_others_in_torque(drives):
    motion.enable(drives, mode="cst")
    objects = [0x6062, 0x6063, 0x606C, 0x607A, 0x60B0, 0x60B1, 0x60FF, 0x60FD]
    drives.record(objects, 0.5, play={0x6071: np.full(500, 800)})


@pytest.mark.every(3)
@pytest.mark.parametrize("script", [
    turn_and_read, turn_and_sleep, play_that_enables, record_eight_others, record_eight_others_in_torque,
], ids=lambda script: script.__name__)  # fmt: skip
def test_the_travel_is_kept_whatever_the_program_does(emulated, script):
    with bench(emulated) as (world, bus):
        error = run(bus, script)
        ended_well(world, LIVING_MASTER)
        if error is not None and not isinstance(error, SafetyError):
            raise error


def test_the_position_cannot_be_mapped(emulated, tmp_path):
    text = find_device("tmcm1636").eds.read_text(encoding="utf-8")
    section = re.search(r"(?ms)^\[6064\].*?(?=^\[)", text)[0]
    path = tmp_path / "unmappable.eds"
    path.write_text(text.replace(section, re.sub(r"(?im)^PDOMapping=.*$", "PDOMapping=0", section)), encoding="utf-8")
    with bench(emulated) as (world, bus):
        run(bus, lambda drives: turn_at(drives, FAST, 1.5), eds=path)
        ended_well(world, LIVING_MASTER)


def coarser_scale(drives):
    """2058h: what a turn is."""
    drives.write(0x2058, 1024)
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 20 * 1024)
    drives.write("Profile acceleration", 500 * 1024)
    drives.write("Profile deceleration", 500 * 1024)
    motion.start_move(drives, 2 * TURN)
    drives.advance(1.0)


def coarser_scale_in_torque(drives):
    """2058h, and then a speed instead of a position."""
    drives.write(0x2058, 1024)
    motion.enable(drives, mode="pv")
    drives.write("Target velocity", 15 * 1024)
    drives.advance(1.0)


def home_and_move_again(drives):
    """Method 35 calls the place where the axis is home."""
    drives.write(0x6098, 35)
    drives.write("Profile velocity", 20 * TURN)
    for _ in range(4):
        motion.home(drives, timeout=2.0)
        motion.select_mode(drives, "pp")
        motion.move_to(drives, 2 * TURN, timeout=3.0)


def offset_in_csp(drives):
    """60B0h is added to the target."""
    motion.enable(drives, mode="csp")
    offsets = np.linspace(0, 9 * TURN, 700).astype(int)
    drives.record([0x6064], 0.7, play={0x607A: np.zeros(700, int), 0x60B0: offsets})


def offset_by_sdo(drives):
    """The same in SDO transfers, beside which no SYNC goes out."""
    motion.enable(drives, mode="csp")
    for offset in np.linspace(0, 9 * TURN, 100).astype(int):
        drives.write(0x60B0, int(offset))
        drives.write(0x607A, 0)
        read_on(drives, 0.01)


def stacked_relative_moves(drives):
    """60F2h = 0: each counts from the target before, wherever the axis is."""
    motion.enable(drives, mode="pp")
    drives.write("Profile velocity", 10 * TURN)
    for _ in range(4):
        motion.start_move(drives, 2 * TURN, relative=True)
    read_on(drives, 1.5)


@pytest.mark.every(3)
@pytest.mark.parametrize("script", [
    coarser_scale, coarser_scale_in_torque, home_and_move_again, offset_in_csp, offset_by_sdo, stacked_relative_moves,
], ids=lambda script: script.__name__)  # fmt: skip
def test_the_travel_is_the_rotors_own(emulated, script):
    with bench(emulated) as (world, bus):
        error = run(bus, script)
        ended_well(world, LIVING_MASTER)
        if error is not None and not isinstance(error, SafetyError):
            raise error


def test_the_current_keeps_its_limit(emulated):
    """500 mA, and a quarter for overshoot; above that ten cycles and the envelope's 20 ms, to and fro."""
    with bench(emulated) as (world, bus):

        def script(drives):
            motion.enable(drives, mode="csv")
            for speed in (FAST, -FAST):
                drives.write(0x60FF, speed)
                read_on(drives, 0.15)

        run(bus, script, Limits(current=500, silence=0.1))
        ended_well(world, travel=(-1000 * TURN, 1000 * TURN))
        above = int((world.truth.current()[:, 0] > 0.5 * 1.25).sum())
        assert above <= 30, f"above the limit for {above} ms, up to {world.truth.current().max():.2f} A"


# --- stops ---------------------------------------------------------------------------------------------------------
@pytest.mark.every(4)
@pytest.mark.parametrize(
    "settings", [{0x6085: 1}, {0x6085: 1, 0x605A: 6}], ids=["deceleration of 1", "deceleration of 1 and stay"]
)
@pytest.mark.parametrize("end", ["close", "trip"])
def test_a_stop_does_not_depend_on_what_the_program_wrote(emulated, settings, end):
    with bench(emulated) as (world, bus):

        def script(drives):
            for name, value in settings.items():
                drives.write(name, value)
            turn_at(drives, FAST, 1.0 if end == "trip" else 0.1)

        run(bus, script)
        ended_well(world, LIVING_MASTER)


def test_after_our_stop_another_master_enables(emulated):
    with bench(emulated) as (world, bus):
        other = OtherMaster(bus.channel)

        def script(drives):
            turn_at(drives, SLOW)
            motion.quick_stop(drives)
            motion.wait_for(drives, cia402.SWITCH_ON_DISABLED, 1.0, "the end of the ramp")
            other.enable(PV)
            other.write(0x60FF, FAST, 4)
            read_on(drives, 1.0)

        run(bus, script)
        other.close()
        ended_well(world, LIVING_MASTER)
        turned(world, SLOW)


def close_at_speed(drives):
    """The end of the program."""


def exception_at_speed(drives):
    raise TimeoutError


def ctrl_c_at_speed(drives):
    raise KeyboardInterrupt


def too_fast(drives):
    """A limit of the speed, passed."""
    drives.write(0x6060, cia402.MODES["cst"])
    drives.record([0x606C], 0.3, play={0x6071: np.full(300, 800)})


@pytest.mark.every(4)
@pytest.mark.parametrize("end", [
    close_at_speed, exception_at_speed, ctrl_c_at_speed, too_fast,
], ids=lambda end: end.__name__)  # fmt: skip
def test_the_power_goes_off_when_the_axis_is_slow(emulated, end):
    with bench(emulated) as (world, bus):

        def script(drives):
            turn_at(drives, FAST)
            end(drives)

        run(bus, script, Limits(position=(-100 * TURN, 100 * TURN), velocity=2 * FAST, silence=0.1))
        ended_well(world, travel=(-100 * TURN, 100 * TURN))
        turned(world)
        on, omega = np.isin(world.truth.fsa()[:, 0], (4, 5, 6)), np.abs(world.truth.omega()[:, 0])
        off = np.flatnonzero(on[:-1] & ~on[1:])
        assert omega[off].max() < 0.1 * omega.max()


@pytest.mark.slow
def test_a_vertical_axis_does_not_fall_after_a_trip():
    """While the program lives something holds it; without power this one falls by several turns."""
    with EmulatedDrives(load="vertical_screw", num_threads=1) as vertical, bench(vertical) as (world, bus):
        vertical.machine.brake = "closed"  # until somebody holds it
        held = []

        def script(drives):
            motion.enable(drives, mode="pv")
            vertical.machine.brake = "open"
            drives.write("Target velocity", FAST)
            with pytest.raises(SafetyError):
                drives.advance(0.5)
            end = world.cycles + 200
            until(lambda: world.cycles > end, "the end of the ramp")
            held.append(world.truth.theta()[-1, 0])
            with suppress(*EXPECTED):
                read_on(drives, 0.5)
            held.append(world.truth.theta()[-1, 0])

        error = run(bus, script, Limits(position=(-TURN, 2 * TURN), silence=0.1))
        assert error is None
        turned(world)
        assert held[1] > held[0] - 0.25 * 2.0 * np.pi
        # Its program over, it is the brake's.
        until(lambda: not world.truth.is_on().any(), "the end of the power")
