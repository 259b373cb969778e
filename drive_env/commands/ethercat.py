"""`drive-env ethercat`: network namespaces for a try of EtherCAT on one machine."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from drive_env.commands.options import USER_ERROR, fail

ethercat_app = typer.Typer(no_args_is_help=True, help="EtherCAT on one machine, for test and simulation.")


@ethercat_app.callback()
def ethercat() -> None:
    """EtherCAT on one machine, for test and simulation."""


@ethercat_app.command("namespace")
def namespace(
    remove: Annotated[bool, typer.Option("--remove", help="Remove the namespaces and their cable.")] = False,
) -> None:
    """Make two network namespaces with a virtual cable: one for emulated drives, one for a master (Linux, root)."""
    from drive_env.ethercat.namespaces import Namespaces

    spaces = Namespaces()
    try:
        if remove:
            print("drive-env: removed" if spaces.remove() else "drive-env: there was none")
            return
        spaces.make()
    except OSError as error:
        fail(error, USER_ERROR)
    print(f"drive-env: {spaces.slave} with {spaces.slave_interface}, {spaces.master} with {spaces.master_interface}")
    print(
        f"sudo ip netns exec {spaces.slave} drive-env serve tmcm3313 --load portal --interface ethercat "
        f"--channel {spaces.slave_interface}"
    )
    print(f"sudo ip netns exec {spaces.master} python your_master.py    # on {spaces.master_interface}")
    sys.stdout.flush()
