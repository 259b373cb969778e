"""`drive-env frames replay`: no motor that its frames enabled is left alone at its end; what is not proven is said."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time

import can
import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from rigs.served_drives import environment, node, wait_until
from typer.testing import CliRunner

from drive_env.commands import replayed_motors
from drive_env.commands.cli import app
from drive_env.commands.replayed_motors import nodes_spoken_to

pytestmark = pytest.mark.usefixtures("files_read_here")
DONE, REFUSED, USER_ERROR, INTERRUPTED = 0, 1, 2, 130
OFF, ENABLED, QUICK_STOP = 0x0240, 0x0637, 0x0607
SPEED = 1_000_000  # inc/s


class Turning(ScriptedDrive):
    """A drive that turns while it is enabled; its quick stop takes `ramp` [s], and it stays in it (605Ah = 6)."""

    def __init__(self, ramp=0.2, **others):
        super().__init__(**others)
        self.values[0x2058, 0] = (65536, 4)
        self.ramp = ramp
        self.since = {}  # axis -> when its quick stop began
        self.looked = {}  # axis -> when its position was last read
        self.controlwords = []  # (axis, word)
        self.turned_when_cut = []

    def speed(self, axis):
        """Return the speed [inc/s] of an axis."""
        status = self.get(0x6041 + 0x800 * axis)
        if status == ENABLED:
            return SPEED
        left = 1.0 - (time.monotonic() - self.since.get(axis, 0.0)) / self.ramp
        return SPEED * max(left, 0.0) if status == QUICK_STOP else 0.0

    def get(self, index, sub=0):
        axis = (index - 0x6000) // 0x800
        if index == 0x6064 + 0x800 * axis and 0 <= axis < 8:
            before, self.looked[axis] = self.looked.get(axis, time.monotonic()), time.monotonic()
            position = super().get(index) + round(self.speed(axis) * (self.looked[axis] - before))
            self.values[index, 0] = (position, 4)
        return super().get(index, sub)

    def set(self, index, value, sub=0):
        axis = (index - 0x6000) // 0x800
        if 0 <= axis < 8 and index == 0x6040 + 0x800 * axis:
            self.controlwords.append((axis, value))
            self.values[index, 0] = (value, 2)
            if value & 0x0F == 0x0F:
                status = ENABLED
            elif value & 0x86 == 0x02 and self.get(0x6041 + 0x800 * axis) in (ENABLED, QUICK_STOP):
                status = QUICK_STOP
                self.since.setdefault(axis, time.monotonic())
            else:
                if value == 0 and self.speed(axis) > 6554:
                    self.turned_when_cut.append(axis)
                status = OFF
            self.values[0x6041 + 0x800 * axis, 0] = (status, 2)
            return
        super().set(index, value, sub)

    def _sdo(self, data):
        index = int.from_bytes(data[1:3], "little")
        if data[0] == 0x40 and (index, 0) in self.values and index % 0x800 == 0x64:
            self.get(index)
        return super()._sdo(data)


def write(index, value, size, node=1):
    command = 0x23 | (4 - size) << 2
    return 0x600 + node, bytes([command, *index.to_bytes(2, "little"), 0, *value.to_bytes(4, "little")])


def enabled_by_sdo(node=1, offset=0):
    return [write(0x6040 + offset, word, 2, node) for word in (6, 7, 15)]


START = (0x000, b"\1\1")
BY_RPDO = [START, *[(0x201, bytes((word, 0))) for word in (6, 7, 15)]]
PAUSE = (0x080, b"")


def recorded(path, frames, every=0.01, pause=0.0):
    """Write frames to a candump log, the last one after a pause [s]."""
    with can.CanutilsLogWriter(str(path)) as writer:
        for k, (can_id, data) in enumerate(frames):
            late = pause if k == len(frames) - 1 else 0.0
            writer(can.Message(1.0 + every * k + late, can_id, is_extended_id=False, data=data, channel="can0"))
    return str(path)


@pytest.fixture
def bus(monkeypatch):
    """The bus that the command opens; put drives into its list."""
    made = ScriptedBus()
    made.drives = []
    monkeypatch.setattr("drive_env.master.can.port.open_bus", lambda *_, **__: made)
    return made


def replay(*arguments, timeout=0.05):
    result = CliRunner().invoke(app, ["frames", "replay", *map(str, arguments), "--timeout", str(timeout)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


@pytest.mark.every(4)
@pytest.mark.parametrize("frames", [enabled_by_sdo(), BY_RPDO, [START, *enabled_by_sdo()]], ids=["SDO", "RPDO", "both"])
def test_what_is_enabled_at_the_end_is_stopped_and_said(bus, tmp_path, frames):
    drive = Turning()
    bus.drives.append(drive)
    code, out, error = replay(recorded(tmp_path / "a.log", frames))
    assert (code, out) == (DONE, f"{len(frames)} frames sent\n")
    said = "node 1 was left enabled by the frames: stopped by its quick stop, at rest; off (0240h)"
    assert error == f"drive-env: {said}\n"
    assert drive.get(0x6041) == OFF
    assert drive.controlwords[:4] == [(0, 6), (0, 7), (0, 15), (0, 2)]
    assert drive.controlwords[-1] == (0, 0) and drive.turned_when_cut == []


def test_frames_that_leave_nothing_enabled_are_sent_and_no_more(bus, tmp_path):
    drive = Turning()
    bus.drives.append(drive)
    frames = [*enabled_by_sdo(), write(0x6040, 0, 2)]
    drive.ramp = 1e-3
    code, out, error = replay(recorded(tmp_path / "a.log", frames), "--json")
    assert (code, json.loads(out), error) == (DONE, {"frames": 4, "stopped": []}, "")
    assert [word for _, word in drive.controlwords] == [6, 7, 15, 0]


def test_the_second_axis_of_a_node_is_stopped_too_and_every_node(bus, tmp_path):
    two, other = Turning(axes=2), Turning(node=5)
    bus.drives += [two, other]
    frames = [*enabled_by_sdo(offset=0x800), *enabled_by_sdo(5)]
    code, out, error = replay(recorded(tmp_path / "a.log", frames), "--json")
    assert code == DONE, error
    assert [(row["node"], row["axis"], row["statusword"], row["cut"]) for row in json.loads(out)["stopped"]] == [
        (1, 1, OFF, ""), (5, 0, OFF, ""),
    ]  # fmt: skip
    assert (two.get(0x6841), other.get(0x6041)) == (OFF, OFF)
    assert "node 1 axis 1 was left enabled" in error and "node 5 was left enabled" in error


@pytest.mark.parametrize(("ramp", "words"), [(1e9, "its quick stop did not slow it down within 0.")])
def test_a_quick_stop_that_does_not_slow_it_down_is_not_waited_for(bus, tmp_path, ramp, words):
    drive = Turning(ramp)
    bus.drives.append(drive)
    begin = time.monotonic()
    code, _, error = replay(recorded(tmp_path / "a.log", enabled_by_sdo()))
    assert (code, drive.get(0x6041), drive.turned_when_cut[:1]) == (DONE, OFF, [0])
    assert f"its voltage was switched off while it turned: {words}" in error
    assert time.monotonic() - begin < replayed_motors.RAMP


def test_lost_answers_and_lost_stops_are_no_reason_to_leave_off(bus, tmp_path):
    class Deaf(Turning):
        losses = 2

        def _sdo(self, data):
            if data[:3] == b"\x2b\x40\x60" and data[4] in (0, 2) and self.losses:
                self.losses -= 1
                return []
            return super()._sdo(data)

    drive = Deaf()
    bus.drives.append(drive)
    code, _, error = replay(recorded(tmp_path / "a.log", enabled_by_sdo()))
    assert (code, drive.get(0x6041), drive.losses, drive.turned_when_cut) == (DONE, OFF, 0, []), error


def test_a_drive_that_does_not_switch_off_is_not_said_to_be(bus, tmp_path, monkeypatch):
    monkeypatch.setattr(replayed_motors, "OFF_TIME", 0.2)
    drive = Turning()
    drive.refusals[0x6040, 0] = 0x08000022
    bus.drives.append(drive)
    code, out, error = replay(recorded(tmp_path / "a.log", BY_RPDO))
    assert (code, out) == (REFUSED, "")
    assert "node 1 is not off: its statusword stays 0637h; its motor may be running: use the emergency stop" in error


def test_a_node_that_falls_silent_is_not_said_to_be_off(bus, tmp_path):
    class Dying(Turning):
        def _sdo(self, data):
            return [] if self.get(0x6041) == ENABLED else super()._sdo(data)

    bus.drives.append(Dying())
    code, out, error = replay(recorded(tmp_path / "a.log", enabled_by_sdo()))
    assert (code, out) == (REFUSED, "")
    assert "node 1 does not answer any more: its motor may be running" in error


def test_a_node_that_is_stopped_is_woken_for_it(bus, tmp_path):
    class Sleeping(Turning):
        awake = True

        def receive(self, can_id, data, remote):
            if can_id == 0x000:
                self.awake = data[0] != 0x02
            return super().receive(can_id, data, remote) if self.awake else []

    drive = Sleeping()
    bus.drives.append(drive)
    code, _, error = replay(recorded(tmp_path / "a.log", [*enabled_by_sdo(), (0x000, b"\2\1")]))
    assert (code, drive.get(0x6041)) == (DONE, OFF), error


def test_frames_to_nobody_are_sent_and_nothing_is_claimed(bus, tmp_path):
    assert replay(recorded(tmp_path / "a.log", [START, *enabled_by_sdo()]))[::2] == (DONE, "")


def test_an_io_node_is_no_drive(bus, tmp_path):
    node_2 = ScriptedDrive(node=2)
    del node_2.values[0x6041, 0]
    bus.drives.append(node_2)
    assert replay(recorded(tmp_path / "a.log", [write(0x2003, 1, 4, 2)]))[::2] == (DONE, "")


def test_a_drive_that_somebody_else_runs_is_told_before_a_frame_is_sent(bus, tmp_path):
    drive = Turning()
    drive.set(0x6040, 15)
    bus.drives.append(drive)
    code, _, error = replay(recorded(tmp_path / "a.log", enabled_by_sdo()))
    assert (code, drive.controlwords, drive.get(0x6041)) == (REFUSED, [(0, 15)], ENABLED)
    assert "node 1 (0637h) is enabled already, so another master controls it; no frame was sent" in error
    assert "drive-env set 6040 2 --node 1" in error


def test_an_error_on_the_way_stops_them_and_is_said(bus, tmp_path, monkeypatch):
    drive = Turning()
    bus.drives.append(drive)
    send = ScriptedBus.send

    def broken(self, message, timeout=None):
        if message.arbitration_id == 0x123:
            raise can.CanOperationError("no buffer space")
        send(self, message, timeout)

    monkeypatch.setattr(ScriptedBus, "send", broken)
    code, _, error = replay(recorded(tmp_path / "a.log", [*enabled_by_sdo(), (0x123, b"")]), "--all")
    assert (code, drive.get(0x6041)) == (REFUSED, OFF)
    assert error.splitlines()[-1].startswith("drive-env: the bus did not take frame 123h: no buffer space")


def test_a_bus_that_is_lost_is_not_called_safe(bus, tmp_path, monkeypatch):
    bus.drives.append(Turning())
    send = ScriptedBus.send

    def broken(self, message, timeout=None):
        if bus.drives[0].get(0x6041) == ENABLED:
            raise can.CanOperationError("the adapter is gone")
        send(self, message, timeout)

    monkeypatch.setattr(ScriptedBus, "send", broken)
    code, _, error = replay(recorded(tmp_path / "a.log", [*enabled_by_sdo(), PAUSE]))
    assert (code, "the motors of node 1 may be running" in error) == (REFUSED, True)


@pytest.mark.every(6)
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("times", [1, 3])
def test_a_signal_in_a_pause_stops_them_however_often_it_comes(bus, tmp_path, number, times):
    drive = Turning()
    bus.drives.append(drive)
    before = signal.getsignal(getattr(signal, number))

    def press():
        while drive.get(0x6041) != ENABLED:
            time.sleep(0.001)
        for _ in range(times):
            os.kill(os.getpid(), getattr(signal, number))
            time.sleep(0.002)

    user = threading.Thread(target=press)
    user.start()
    code, _, error = replay(recorded(tmp_path / "a.log", [*enabled_by_sdo(), PAUSE], pause=60.0))
    user.join()
    assert (code, drive.get(0x6041), drive.turned_when_cut) == (INTERRUPTED, OFF, [])
    assert error.splitlines()[-1] == ("drive-env: interrupted; 3 of 4 frames were sent, and no motor is left enabled")
    assert signal.getsignal(getattr(signal, number)) is before


@pytest.mark.parametrize(
    ("frames", "nodes"),
    [
        ([(0x605, bytes(8)), (0x000, b"\1\7"), (0x080, b""), (0x77F, b"\5")], (5, 7)),
        ([(0x605, bytes(8)), (0x000, b"\1\0")], tuple(range(1, 128))),
        ([(0x315, bytes(8))], tuple(range(1, 128))),  # whose it is a mapping alone says
        ([(0x585, bytes(8)), (0x185, bytes(8))], ()),
    ],
)
def test_who_may_obey(frames, nodes):
    assert nodes_spoken_to(can.Message(arbitration_id=one, data=data) for one, data in frames) == nodes


# --- what stops them when the program itself is killed ------------------------------------------------------------
def test_a_drive_watches_over_the_program_meanwhile_and_gets_back_what_it_had(bus, tmp_path):
    drive = Turning()
    drive.values |= {(0x1029, 1): (1, 1), (0x6007, 0): (0, 2)}
    changed = []
    plain = drive.set

    def note(index, value, sub=0):
        if index in (0x1016, 0x1029, 0x6007, 0x6040):
            changed.append((index, value))
        plain(index, value, sub)

    drive.set = note
    bus.drives.append(drive)
    assert replay(recorded(tmp_path / "a.log", enabled_by_sdo()))[0] == DONE
    watch = changed[0][1]
    assert changed[:3] == [(0x1016, watch), (0x1029, 0), (0x6007, 3)]  # before the first frame
    assert watch & 0xFFFF == 500 and watch >> 16 in range(96, 128)
    assert changed[3:6] == [(0x6040, 6), (0x6040, 7), (0x6040, 15)]
    assert changed[-3:] == [(0x6007, 0), (0x1029, 1), (0x1016, 0)]  # when it is off
    assert changed[-4] == (0x6040, 0)
    assert bus.sent(0x000) == [b"\1\1"]  # in pre-operational it may watch no master
    beats = bus.sent(0x700 + (watch >> 16))
    assert beats and set(beats) == {b"\5"}


@pytest.mark.every(8)
@pytest.mark.parametrize(
    ("values", "frames", "why"),
    [
        ({}, [], "no heartbeat consumer (1016h) that is free"),
        ({(0x1016, 1): (0x0005_01F4, 4)}, [], "no heartbeat consumer (1016h) that is free"),
        ({(0x1016, 1): (0, 4)}, [(0x000, b"\x82\1")], "the frames reset it"),
        ({(0x1016, 1): (0, 4)}, [(0x000, b"\x81\0")], "the frames reset it"),
        ({(0x1016, 1): (0, 4)}, [(0x000, b"\x80\1")], "the frames take it out of NMT operational"),
    ],
)
def test_what_cannot_watch_over_the_program_is_said(bus, tmp_path, values, frames, why):
    drive = Turning()
    del drive.values[0x1016, 1]
    drive.values |= values
    bus.drives.append(drive)
    code, _, error = replay(recorded(tmp_path / "a.log", [*frames, *enabled_by_sdo()]))
    assert code == DONE
    assert "drive-env: node 1 would run on if this program were killed: " in error and why in error


def test_a_watchdog_that_the_frames_set_is_theirs(bus, tmp_path):
    drive = Turning()
    bus.drives.append(drive)
    theirs = (0x601, bytes.fromhex("23 16 10 01 F4 01 7F 00"))
    code, _, error = replay(recorded(tmp_path / "a.log", [theirs, *enabled_by_sdo()]))
    assert code == DONE and "would run on" not in error
    assert drive.get(0x1016, 1) == 0x007F01F4


def test_a_drive_that_is_not_proved_off_keeps_its_watchdog(bus, tmp_path, monkeypatch):
    monkeypatch.setattr(replayed_motors, "OFF_TIME", 0.1)
    drive = Turning()
    bus.drives.append(drive)
    plain = drive.set
    drive.set = lambda index, value, sub=0: (
        plain(index, value or 15, sub) if index == 0x6040 else plain(index, value, sub)
    )
    code, _, error = replay(recorded(tmp_path / "a.log", enabled_by_sdo()))
    assert code == REFUSED and "its motor may be running" in error
    assert drive.get(0x1016, 1) & 0xFFFF == 500  # and no heartbeat comes any more


# --- an emulated drive in real time, and the program that a user starts -------------------------------------------
@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("how", ["SIGINT", "SIGTERM", "SIGHUP", "SIGKILL"])
def test_a_motor_that_runs_by_replayed_frames_is_at_rest_and_off_after_a_signal(tmp_path, how):
    velocity = 1_092_267
    frames = [
        write(0x6060, 3, 1), write(0x60FF, velocity, 4), *enabled_by_sdo(), *[PAUSE] * 2,
    ]  # fmt: skip
    log = recorded(tmp_path / "move.log", frames, every=0.05, pause=120.0)
    with node(lockstep=False) as (machine, bus):
        process = subprocess.Popen(
            [sys.executable, "-c", "from drive_env.programs import drive_env; drive_env()", "frames", "replay", log,
             *bus, "--timeout", "5"],
            cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            wait_until(lambda: int(machine.read(0x606C)[0]) > 0.9 * velocity, process)
            assert int(machine.read(0x606C)[0]) > 0.9 * velocity
            process.send_signal(getattr(signal, how))
            _, said = process.communicate(timeout=60)
        finally:
            if process.poll() is None:
                process.kill()
                process.communicate()
        if how == "SIGKILL":
            wait_until(lambda: not int(machine.read(0x6041)[0]) & 0x04)  # its own watchdog: off
            assert process.returncode == -signal.SIGKILL
            assert abs(int(machine.read(0x606C)[0])) < 16384
            return
        assert process.returncode == INTERRUPTED, said
        assert "node 1 was left enabled by the frames: stopped by its quick stop, at rest; off" in said
        assert int(machine.read(0x6041)[0]) & 0x4F == 0x40
        assert abs(int(machine.read(0x606C)[0])) < 16384  # what an encoder shows of rest
