"""Entry points of the commands: here, since no other package is likely to be named `drive_env`."""

from __future__ import annotations

import importlib
import os
import select
import signal
import sys
from contextlib import suppress
from typing import Any, NoReturn

from drive_env.own_packages import ForeignPackageError, check_own

USER_ERROR, INTERRUPTED = 2, 130
CLOSED = 141  # as the shell has it of programs that SIGPIPE ends: 128 + 13
# What ends a program from outside: a service that is stopped, a terminal that is closed. What a drive was told must be
# taken back then, too, as after Ctrl-C.
ENDS = ("SIGTERM", "SIGHUP")
METHODS = {"agent": "agents.tuner.auto_method"}  # of `drive-tune auto --by`, outside of `tuning`


def drive_tune() -> None:
    """Run `drive-tune`, if the packages that Python finds are ours."""
    _run("drive-tune", "tuning.commands.cli", "drive_env", "mechanics", "tuning")


def drive_env() -> None:
    """Run `drive-env`, if the packages that Python finds are ours."""
    _run("drive-env", "drive_env.commands.cli", "drive_env", "mechanics")


def drive_agent() -> None:
    """Run `drive-agent`, if the packages that Python finds are ours."""
    _run("drive-agent", "agents.commands.cli", "drive_env", "mechanics", "tuning", "agents")


def import_method(name: str) -> Any:
    """Return the module of a tuning method that a package above `tuning` has, if that package is ours.

    `agents` takes seconds to import, and most runs need none of it.
    """
    module = METHODS[name]
    check_own(module.partition(".")[0])
    return importlib.import_module(module)


def _run(command: str, module: str, *packages: str) -> None:
    for name in ENDS:
        number = getattr(signal, name, None)
        # A program that was started to outlive its terminal (nohup) has it ignored.
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)
    output = _file_of_output()
    try:
        try:
            check_own(*packages)
            importlib.import_module(module).main()
        except ForeignPackageError as error:
            print(f"{command}: {error}", file=sys.stderr)
            sys.exit(USER_ERROR)
        except KeyboardInterrupt:
            print(f"{command}: interrupted", file=sys.stderr)
            sys.exit(INTERRUPTED)
    finally:
        _end_output(command, output)


def _end_output(command: str, output: tuple[int, int] | None) -> None:
    """Write out what was printed; where the reader has gone (`| head -1`), end quietly with CLOSED.

    Python would try once more when it ends, and tell that it failed. By now the drives are closed: what was printed
    into nothing raised where it was printed, and went up through whatever holds them.
    """
    # Where an output broke while they printed, click puts another stream in its place and rich another file.
    closed = sys.stdout is not sys.__stdout__ or _file_of_output() != output
    for stream in (sys.__stdout__, sys.__stderr__):  # typer puts others in their place
        if stream is None:  # a program that was started without it
            continue
        try:
            stream.flush()
        except BrokenPipeError:
            closed = True
            _forget(stream)
        except OSError as error:
            _forget(stream)
            if stream is sys.__stdout__:
                with suppress(OSError):
                    print(f"{command}: what it printed cannot be written: {error.strerror}", file=sys.stderr)
                sys.exit(USER_ERROR)
    if closed:
        sys.exit(CLOSED)


def _file_of_output() -> tuple[int, int] | None:
    """Return device and inode of the output's file, None if it is not a file."""
    try:
        found = os.fstat(1)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def output_is_closed() -> bool:
    """Return whether the reader of our output has gone: a pipe that broke elsewhere is that of a bus."""
    for stream in filter(None, (sys.__stdout__, sys.__stderr__)):
        try:
            stream.flush()
            if hasattr(select, "poll"):  # an output without a buffer has nothing left to flush
                poll = select.poll()
                poll.register(stream.fileno(), select.POLLOUT)
                if any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0)):
                    return True
        except BrokenPipeError:
            return True
        except (OSError, ValueError):  # a stream without a file
            continue
    return False


def _forget(stream: Any) -> None:
    """Discard the content of a stream's buffer, and later writes to it."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


def _interrupt(number: int, frame: Any) -> NoReturn:
    raise KeyboardInterrupt
