"""`drive-env frames`: the frames of a bus in a file, and back."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from drive_env.commands.options import (
    INTERRUPTED,
    REFUSED,
    Bitrate,
    Channel,
    DryRun,
    Interface,
    Json,
    Timeout,
    check_free,
    check_time,
    errors_as_exit_codes,
    fail,
    print_json,
    print_result,
)
from drive_env.drives.arguments import LONGEST

MOST_CHANNELS = 0xFFFF
HIGHEST_ID, LONGEST_DATA = 0x7FF, 8  # of the frames that are sent
SIGNAL_WAIT = 0.02  # s, the longest pause between two looks whether the user has pressed Ctrl-C
FORMATS = (".log", ".blf", ".asc", ".csv", ".db", ".trc", ".pcap", ".pcapng")
NOT_HELD = {".trc": "remote frames and no CAN FD", ".csv": "CAN FD", ".db": "CAN FD"}  # of python-can's writers

frames_app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")


@frames_app.callback()
def frames() -> None:
    """The frames of a bus in a file, and back."""


@frames_app.command()
def log(
    file: Annotated[
        Path,
        typer.Argument(
            help="New file; Wireshark opens .log (candump's), .pcap and .pcapng, .blf is Vector's, also .asc .csv "
            ".trc; - prints the frames as they come."
        ),
    ],
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    duration: Annotated[
        float | None, typer.Option(help="Stop after this time [s]; otherwise stop with Ctrl-C.")
    ] = None,
    json: Json = False,
) -> None:
    """Write every frame of the bus to a file, or to the screen; nothing is sent.

    If the bus is lost, the frames so far are kept. On the screen: time [s], identifier, length, data, and the service
    of CiA 301's predefined connection set; with --json a line for each frame.
    """
    with errors_as_exit_codes():
        import can
        from can.util import channel2int

        from drive_env.commands.frame_files import FRAME_FILES, FrameFile, FrameLines
        from drive_env.held_signals import held_signals
        from drive_env.master.can.port import open_bus

        ending, is_shown = file.suffix.lower(), str(file) == "-"
        if not is_shown:
            _check_new(file, ending)
        check_time("--duration", duration)
        bus = open_bus(interface, channel, **({"bitrate": bitrate} if bitrate else {}))
        count = left_out = 0
        lost: Exception | None = None
        taken = _take_interrupts()
        end = time.monotonic() + (float("inf") if duration is None else duration)
        try:
            # Signals are held before the file is there, which tells a script that the log has begun.
            with (
                held_signals() as noted,
                (
                    FrameLines(json)
                    if is_shown
                    else FrameFile(file)
                    if ending in FRAME_FILES
                    else can.Logger(str(file))
                ) as writer,
            ):
                while not noted and (left := end - time.monotonic()) > 0.0:
                    try:
                        message = bus.recv(min(left, 0.1))
                    except (can.CanError, OSError, ValueError) as error:  # ValueError: of a closed socket
                        lost = error
                        break
                    if message is None or not _is_held(message, ending):
                        left_out += message is not None
                        continue
                    # BLF has two bytes for a channel, which python-can fills with the last digits of its name.
                    if (channel2int(message.channel) or 0) >= MOST_CHANNELS:
                        message.channel = None
                    writer(message)
                    count += 1
                _await_database(file, writer, count)
        finally:
            if taken is not None:
                signal.signal(signal.SIGINT, taken)
            bus.shutdown()
        if is_shown and lost is None:
            return
        result = {"frames": count, "file": str(file), "left_out": left_out}
        if lost is not None:
            if json:
                print_json({**result, "lost": str(lost)})
            kept = "above" if is_shown else f"in {file}"
            fail(f"the bus was lost: {lost}; the {count} frames received before are {kept}", REFUSED)
        if left_out:
            print(f"drive-env: {ending} has no {NOT_HELD[ending]}: {left_out} frames are left out", file=sys.stderr)
        print_result(result, [f"{count} frames written to {file}"], json)


@frames_app.command()
def replay(
    file: Annotated[
        Path,
        typer.Argument(
            help="File that `frames log`, candump, BUSMASTER, SavvyCAN or another tool wrote; also packed, as .gz."
        ),
    ],
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    speed: Annotated[float, typer.Option(help="Speed factor; 1 is as recorded.")] = 1.0,
    everything: Annotated[
        bool, typer.Option("--all", help="Send the drives' frames, too; only on a bus without these drives.")
    ] = False,
    timeout: Timeout = None,
    json: Json = False,
    dry_run: DryRun = False,
) -> None:
    """Send the recorded frames of a master again, with their timing: NMT, SYNC, SDO requests, RPDOs, its heartbeat.

    Drives execute them as they did then, without a safety envelope: keep the emergency stop at hand. Axes that are
    enabled at the end, also after Ctrl-C or an error, get a quick stop and are switched off at rest. Drives whose
    recorded master set no watchdog watch over this program meanwhile (1016h), and stop when it is killed. --dry-run
    shows the frames.
    """
    with errors_as_exit_codes():
        from drive_env.commands.recorded_frames import ending_of, read_frames
        from drive_env.commands.replayed_motors import ANSWER_TIMEOUT
        from drive_env.fieldbus.description import check_timeout
        from drive_env.master.can.dry_run import show_frame
        from drive_env.master.can.port import Port, open_bus

        _check_format(file, ending_of(file))
        if not file.is_file():
            raise ValueError(f"there is no file {file}")
        if not 0.0 < speed < math.inf:
            raise ValueError(f"--speed {speed:g} must be above 0")
        frames, left_out = read_frames(file, everything=everything)
        if left_out:
            print(f"drive-env: {left_out} frames of CAN FD are left out: drives have classic CAN", file=sys.stderr)
        _check_frames(file, frames, speed)
        if dry_run:
            for frame in frames:
                print(show_frame(frame.arbitration_id, frame.data, frame.dlc if frame.is_remote_frame else None))
            print_result({"frames": len(frames)}, [f"{len(frames)} frames shown"], json)
            return
        patience = ANSWER_TIMEOUT if timeout is None else check_timeout(timeout)
        port = Port(open_bus(interface, channel, **({"bitrate": bitrate} if bitrate else {})))
        try:
            _replay(port, frames, speed, patience, json)
        finally:
            port.close()


def _check_frames(file: Path, frames: list[Any], speed: float) -> None:
    """Raise ValueError for frames that classic CAN does not have, and for waits between stamps that are too long.

    In a log of two buses the stamps may go back a little.
    """
    for number, frame in enumerate(frames, 1):
        size = max(len(frame.data), frame.dlc)
        if size > LONGEST_DATA or frame.dlc < 0 or frame.arbitration_id > HIGHEST_ID:
            raise ValueError(
                f"{file}: frame {number} of a master has the identifier {frame.arbitration_id:X}h and {size} bytes; "
                f"classic CAN has up to {HIGHEST_ID:X}h and {LONGEST_DATA}: take the frame out"
            )
        after = (frame.timestamp - frames[0].timestamp) / speed
        if not -LONGEST <= after <= LONGEST:
            raise ValueError(
                f"{file}: frame {number} of a master has the time stamp {frame.timestamp:g} s, {after:g} s after the "
                f"first at this speed; the longest wait is {LONGEST:g} s: take the frame out, or give a higher --speed"
            )


def _replay(port: Any, frames: list[Any], speed: float, timeout: float, json: bool) -> None:
    """Send frames, stop axes that they leave live, and say so; a signal ends the sending, never the stop."""
    from drive_env.commands.replay_watchdog import ReplayWatchdog
    from drive_env.commands.replayed_motors import ReplayedMotors
    from drive_env.held_signals import held_signals

    motors, watchdog = ReplayedMotors(port, frames, timeout), ReplayWatchdog(port, frames, timeout)
    problem: Exception | None = None
    sent = 0
    with held_signals() as noted:
        motors.check_none_is_live()
        try:
            for warning in watchdog.arm(motors.drives()):
                print(f"drive-env: {warning}", file=sys.stderr)
            motors.listen()
            for frame in _in_time(port, frames, speed, noted):
                port.send(frame.arbitration_id, bytes(frame.data), remote=frame.is_remote_frame, length=frame.dlc)
                sent += 1
        except Exception as error:
            problem = error
        stopped, unproven = motors.stop()
        unproven += watchdog.give_up(() if unproven else motors.drives())
    for axis in stopped:
        print(f"drive-env: {axis}", file=sys.stderr)
    if unproven:
        fail("; ".join([*([] if problem is None else [str(problem)]), *unproven]), REFUSED)
    if problem is not None:
        raise problem
    if noted:
        fail(f"interrupted; {sent} of {len(frames)} frames were sent, and no motor is left enabled", INTERRUPTED)
    result = {"frames": sent, "stopped": [axis._asdict() for axis in stopped]}
    print_result(result, [f"{sent} frames sent"], json)


def _in_time(port: Any, frames: list[Any], speed: float, noted: list[int]) -> Iterator[Any]:
    """Yield each frame when it is due, until a signal is noted."""
    start = time.monotonic()
    for frame in frames:
        due = start + (frame.timestamp - frames[0].timestamp) / speed
        while (left := due - time.monotonic()) > 0.0 and not noted:
            port.receive(min(left, SIGNAL_WAIT))
        port.drain()
        if noted:
            return
        yield frame


def _take_interrupts() -> Any:
    """Let SIGINT end a log also where it is ignored; return the previous handler, None if nothing was changed.

    A shell script starts its background commands with SIGINT ignored (POSIX): a log there would never end.
    """
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) != signal.SIG_IGN:
        return None
    return signal.signal(signal.SIGINT, signal.default_int_handler)


def _check_new(file: Path, ending: str) -> None:
    """Raise ValueError for a file that could not be written."""
    _check_format(file, ending)
    if not file.parent.is_dir():
        raise ValueError(f"there is no folder {file.parent}; choose another file")
    check_free(file)


def _check_format(file: Path, ending: str) -> None:
    if ending not in FORMATS:
        raise ValueError(f"{file}: the ending gives the format, and {ending!r} is not one of {', '.join(FORMATS)}")


def _await_database(file: Path, writer: Any, count: int) -> None:
    """Wait until a database has its frames: python-can (4.6) would leave out those that still wait for its thread."""
    while file.suffix.lower() == ".db" and writer.num_frames < count:
        if not writer._writer_thread.is_alive():
            raise OSError(f"{file}: {writer.num_frames} of {count} frames were written; is the disk full?")
        time.sleep(SIGNAL_WAIT)


def _is_held(message: Any, ending: str) -> bool:
    """Return whether a format has room for a frame; python-can would drop it, or write it as another one."""
    return ending not in NOT_HELD or not (message.is_fd or (message.is_remote_frame and ending == ".trc"))
