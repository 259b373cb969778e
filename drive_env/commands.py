"""Entry points of the commands: here, since `drive_env` alone is a name that nobody else uses."""

from __future__ import annotations

import importlib
import signal
import sys
from typing import Any, NoReturn

from drive_env.own_packages import ForeignPackageError, check_own

USER_ERROR, INTERRUPTED = 2, 130
# What ends a program from outside: a service that is stopped, a terminal that is closed. What a drive was told must be
# taken back then, too, as after Ctrl-C.
ENDS = ("SIGTERM", "SIGHUP")


def drive_tune() -> None:
    """Run `drive-tune`, if the packages that Python finds are ours."""
    _run("drive-tune", "tuning.cli", "drive_env", "mechanics", "tuning")


def drive_env() -> None:
    """Run `drive-env`, if the packages that Python finds are ours."""
    _run("drive-env", "drive_env.cli", "drive_env", "mechanics")


def drive_agent() -> None:
    """Run `drive-agent`, if the packages that Python finds are ours."""
    _run("drive-agent", "agents.cli", "drive_env", "mechanics", "tuning", "agents")


def _run(command: str, module: str, *packages: str) -> None:
    for name in ENDS:
        number = getattr(signal, name, None)
        # A program that was started to outlive its terminal (nohup) has it ignored.
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)
    try:
        check_own(*packages)
        importlib.import_module(module).main()
    except ForeignPackageError as error:
        print(f"{command}: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    except KeyboardInterrupt:
        print(f"{command}: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)


def _interrupt(number: int, frame: Any) -> NoReturn:
    raise KeyboardInterrupt
