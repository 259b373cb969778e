"""Entry points of the commands: here, since `drive_env` alone is a name that nobody else uses."""

from __future__ import annotations

import sys

from drive_env.own_packages import ForeignPackageError, check_own

USER_ERROR = 2


def drive_tune() -> None:
    """Run `drive-tune`, if the packages that Python finds are ours."""
    try:
        check_own("drive_env", "mechanics", "tuning")
    except ForeignPackageError as error:
        print(f"drive-tune: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    from tuning.cli import main

    main()


def drive_env() -> None:
    """Run `drive-env`, if the package that Python finds is ours."""
    try:
        check_own("drive_env", "mechanics")
    except ForeignPackageError as error:
        print(f"drive-env: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    from drive_env.cli import main

    main()


def drive_agent() -> None:
    """Run `drive-agent`, if the packages that Python finds are ours."""
    try:
        check_own("drive_env", "mechanics", "tuning", "agents")
    except ForeignPackageError as error:
        print(f"drive-agent: {error}", file=sys.stderr)
        sys.exit(USER_ERROR)
    from agents.cli import main

    main()
