"""`drive-env log` and `drive-env replay`: the frames of a bus in a file, and back."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from drive_env.tools.options import (
    REFUSED,
    Bitrate,
    Channel,
    DryRun,
    Interface,
    Json,
    check_free,
    check_time,
    errors_as_exit_codes,
    fail,
    print_json,
)

MOST_CHANNELS = 0xFFFF
FORMATS = (".log", ".blf", ".asc", ".csv", ".db", ".trc")


def log(
    file: Annotated[
        Path, typer.Argument(help="New file; .log is candump's format, .blf Vector's, also .asc .csv .trc.")
    ],
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    duration: Annotated[float | None, typer.Option(help="End after this time [s]; else by Ctrl-C.")] = None,
    json: Json = False,
) -> None:
    """Write every frame of the bus to a file; nothing is sent. Where the bus is lost, what came until then is kept."""
    with errors_as_exit_codes():
        import can
        from can.util import channel2int

        from drive_env.master.port import open_bus

        _check_format(file)
        check_time("--duration", duration)
        if not file.parent.is_dir():
            raise ValueError(f"there is no folder {file.parent}; choose another file")
        check_free(file)
        bus = open_bus(interface, channel, **({"bitrate": bitrate} if bitrate else {}))
        count = 0
        lost: Exception | None = None
        end = time.monotonic() + (float("inf") if duration is None else duration)
        try:
            with can.Logger(str(file)) as writer:
                try:
                    while (left := end - time.monotonic()) > 0.0:
                        try:
                            message = bus.recv(min(left, 0.1))
                        except (can.CanError, OSError, ValueError) as error:  # ValueError: of a closed socket
                            lost = error
                            break
                        if message is not None:
                            # BLF has two bytes for a channel, which python-can fills with the last digits of its name.
                            if (channel2int(message.channel) or 0) >= MOST_CHANNELS:
                                message.channel = None
                            writer(message)
                            count += 1
                except KeyboardInterrupt:
                    pass  # the usual end: the file is complete
        finally:
            bus.shutdown()
        if lost is not None:
            if json:
                print_json({"frames": count, "file": str(file), "lost": str(lost)})
            fail(f"the bus was lost: {lost}; the {count} frames that came until then are in {file}", REFUSED)
        _say(f"{count} frames written to {file}", {"frames": count, "file": str(file)}, json)


def replay(
    file: Annotated[Path, typer.Argument(help="File that `log`, candump or another tool wrote.")],
    interface: Interface = None,
    channel: Channel = None,
    bitrate: Bitrate = None,
    speed: Annotated[float, typer.Option(help="How many times as fast as it was recorded.")] = 1.0,
    everything: Annotated[
        bool, typer.Option("--all", help="Send the drives' frames, too; only onto a bus without these drives.")
    ] = False,
    json: Json = False,
    dry_run: DryRun = False,
) -> None:
    """Send the recorded frames of a master again, in their time: NMT, SYNC, SDO requests, RPDOs, its heartbeat.

    Drives obey them as they did then, and no envelope watches: keep the emergency stop at hand. --dry-run shows them.
    """
    with errors_as_exit_codes():
        import can

        from drive_env.master.dry_run import show_frame
        from drive_env.master.port import Port, open_bus

        _check_format(file)
        if not file.is_file():
            raise ValueError(f"there is no file {file}")
        if not speed > 0.0:
            raise ValueError(f"--speed {speed:g} must be above 0")
        try:
            with can.LogReader(str(file)) as reader:
                frames = [frame for frame in reader if everything or _is_from_a_master(frame)]
        except OSError:
            raise
        except Exception as error:  # each format's reader raises what the broken place leads to
            raise ValueError(f"{file} cannot be read as {file.suffix}: {error}; is it complete?") from error
        frames = [f for f in frames if not (f.is_extended_id or f.is_error_frame)]
        if dry_run:
            for frame in frames:
                print(show_frame(frame.arbitration_id, bytes(frame.data), frame.is_remote_frame))
        else:
            port = Port(open_bus(interface, channel, **({"bitrate": bitrate} if bitrate else {})))
            try:
                _send(port, frames, speed)
            finally:
                port.close()
        _say(f"{len(frames)} frames {'shown' if dry_run else 'sent'}", {"frames": len(frames)}, json)


def _send(port: Any, frames: list[Any], speed: float) -> None:
    start = time.monotonic()
    for frame in frames:
        due = start + (frame.timestamp - frames[0].timestamp) / speed
        while (left := due - time.monotonic()) > 0.0:
            port.receive(left)
        port.drain()
        port.send(frame.arbitration_id, bytes(frame.data), remote=frame.is_remote_frame, length=frame.dlc)


def _is_from_a_master(frame: Any) -> bool:
    """Return whether the predefined connection set has a master send this identifier."""
    from drive_env.canopen.frames import ERROR_CONTROL, NMT, RPDO, SDO_REQUEST, SYNC
    from drive_env.master.lifeline import MASTER

    can_id = frame.arbitration_id
    if frame.is_remote_frame or can_id in (NMT, SYNC, ERROR_CONTROL + MASTER):
        return True
    return any(base < can_id < base + 0x80 for base in (*RPDO, SDO_REQUEST))


def _check_format(file: Path) -> None:
    if file.suffix.lower() not in FORMATS:
        raise ValueError(f"{file}: the ending says the format, and {file.suffix!r} is none of {', '.join(FORMATS)}")


def _say(text: str, value: dict[str, Any], json: bool) -> None:
    if json:
        print_json(value)
    else:
        print(text)
