"""The command `drive-env`: it assembles the commands of this folder, one file per command or family."""

from __future__ import annotations

from drive_env.commands.compiling import compile_kernels
from drive_env.commands.ethercat import ethercat_app
from drive_env.commands.export import export_app
from drive_env.commands.fault import fault
from drive_env.commands.faults import faults
from drive_env.commands.frames import frames_app
from drive_env.commands.get import get, set_object
from drive_env.commands.home import home
from drive_env.commands.jog import jog
from drive_env.commands.lss import lss_app
from drive_env.commands.model import model
from drive_env.commands.monitor import monitor
from drive_env.commands.motor import motor_app
from drive_env.commands.move import move
from drive_env.commands.names import list_names
from drive_env.commands.new import new_from_eds
from drive_env.commands.objects import objects
from drive_env.commands.parameters import parameters_app
from drive_env.commands.program import Program, Quiet, Verbose, Version, say_as_much
from drive_env.commands.render import render
from drive_env.commands.scan import scan
from drive_env.commands.scope import scope
from drive_env.commands.serve import serve
from drive_env.commands.signed_values import SignedValues
from drive_env.commands.studio import studio

app = Program("drive-env")

PANELS = {
    "A page for drives": (("studio", studio),),
    "Drives on a bus": (
        ("scan", scan),
        ("get", get),
        ("set", set_object),
        ("faults", faults),
        ("monitor", monitor),
        ("scope", scope),
        ("jog", jog),
        ("move", move),
        ("home", home),
    ),
    "This installation": (
        ("list", list_names),
        ("objects", objects),
        ("new", new_from_eds),
        ("compile", compile_kernels),
    ),
    "Emulated drives": (("serve", serve), ("fault", fault), ("render", render), ("model", model)),
}
GROUPS = {
    "Drives on a bus": (("parameters", parameters_app), ("frames", frames_app), ("lss", lss_app)),
    "This installation": (("export", export_app), ("motor", motor_app)),
    "Emulated drives": (("ethercat", ethercat_app),),
}
for panel, commands in PANELS.items():
    for name, function in commands:
        app.command(name, cls=SignedValues, rich_help_panel=panel)(function)
for panel, groups in GROUPS.items():
    for name, group in groups:
        app.add_typer(group, name=name, rich_help_panel=panel)
app.moved({old: f"drive-env parameters {old}" for old in ("backup", "diff", "restore", "commission")})
app.moved({old: f"drive-env frames {old}" for old in ("log", "replay")})
app.moved({"check-model": "drive-env model LOAD --log LOG"})
app.moved({old: f"drive-env export {old} FILE --device DEVICE" for old in ("eds", "esi")})


@app.callback()
def drive_env(version: Version = False, quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Servo drives on CAN, real and emulated.

    Interface, channel and time-out may be set by DRIVE_ENV_INTERFACE, DRIVE_ENV_CHANNEL and DRIVE_ENV_TIMEOUT, and the
    token of a hub that needs one by DRIVE_ENV_TOKEN. Exit codes: 0 done, 1 error of the drive or the bus (or a
    difference), 2 a mistake in the command, 130 Ctrl-C, 141 the output was closed.
    """
    say_as_much(quiet, verbose)


main = app.run
