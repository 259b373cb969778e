"""The proposal of `drive-env model`: motor and gears for a file's joints, printed, and written as a model to run."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drive_env.commands.options import print_json
from drive_env.commands.tables import Column, print_lines, print_table

if TYPE_CHECKING:
    from drive_env.devices import Device
    from drive_env.emulator.sizing import DriveProposal
    from drive_env.motors import Motor
    from mechanics.joint_loads import JointLoad
    from mechanics.load import Load

UNITS = {"hinge": ("rad", "N*m", "kg*m^2"), "slide": ("m", "N", "kg")}
COLUMNS = (
    Column("joint", "name"),
    Column("range"),
    Column("inertia"),
    Column("holding"),
    Column("friction"),
    Column("gear"),
    Column("inertia\nat the rotor\n[kg*m^2]"),
    Column("times the\nrotor's"),
    Column("torque\nmargin"),
    Column("speed\nmargin"),
    Column("encoder\nmargin"),
)


def propose(
    load: Load, device: Device, motors: Iterable[Motor], joints: Sequence[str], move_time: float, out: Path | None
) -> tuple[list[JointLoad], DriveProposal]:
    """Return the loads of a file's joints and the drives proposed for them; write these if a folder is given.

    Raises:
        ValueError: As `joint_loads` and `write_model`, if no joint can have a drive, or for a folder that exists.
    """
    from drive_env.emulator.sizing import MARGIN, propose_drives
    from mechanics.joint_loads import joint_loads

    if not 0.0 < move_time < math.inf:
        raise ValueError(f"--move-time {move_time:g} s must be above 0 s")
    if out is not None and out.exists():
        raise ValueError(f"{out} exists already, and is not overwritten; choose another folder with --out")
    found = joint_loads(load, joints)
    refused = [f"{row.name or 'a joint'}: {row.refusal}" for row in found if row.refusal]
    driven = [row for row in found if not row.refusal]
    if not driven:
        raise ValueError(f"{load.mjcf} has no joint that a drive can turn; {'; '.join(refused) or 'it has no joint'}")
    for name in joints:
        if name not in [row.name for row in driven]:
            raise ValueError(next(text for text in refused if text.startswith(f"{name}: ")))
    proposal = propose_drives(driven, device, motors, move_time)
    if out is not None:
        worst = min(zip(proposal.axes, driven, strict=True), key=lambda pair: pair[0].least_margin)
        if not proposal.fits:
            raise ValueError(
                f"no motor of {device.name} moves every joint of {load.mjcf} with a margin of {MARGIN:g}: "
                f"{proposal.motor.name} has {_margins(worst[0])} at {worst[1].name}; give a longer --move-time, "
                "another --device or --motor, or fewer joints with --joint"
            )
        write_model(load, {row.name: axis.gear for row, axis in zip(driven, proposal.axes, strict=True)}, out)
    return found, proposal


def write_model(load: Load, gears: dict[str, float], out: Path) -> Path:
    """Write a model with driven joints and the files that it includes into a new folder; return the model.

    Raises:
        ValueError: If it is not a load, e.g. has a free joint.
        OSError: If it cannot be written; the folder is then not there.
    """
    from drive_env.whole_file import write_whole
    from mechanics.loads import find_load
    from mechanics.model import with_motors
    from mechanics.model_files import files_of_model
    from mechanics.reading.untrusted import MOST_RECORDING, read_bytes

    text, root = with_motors(load, gears), load.mjcf.parent
    path = out / f"{load.mjcf.stem}.xml"
    try:
        for file in files_of_model(load.mjcf):
            if file.suffix not in (".xml", ".mjcf", ".urdf"):  # included MJCF is in the text already
                write_whole(out / os.path.relpath(os.path.normpath(file), root), read_bytes(file, MOST_RECORDING))
        write_whole(path, text)
        find_load(path)
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)  # an existing folder would be refused the next time
        raise
    return path


def print_proposal(
    load: Load, device: Device, found: Sequence[JointLoad], proposal: DriveProposal, move_time: float, out: Path | None
) -> None:
    """Print the proposal as a table, with joints that cannot be driven and why, and how to run the written model."""
    from drive_env.emulator.sizing import MARGIN, demand

    motor = proposal.motor
    driven = [row for row in found if not row.refusal]
    rows = []
    for row, axis in zip(driven, proposal.axes, strict=True):
        way, force, inertia = UNITS[row.kind]
        rows.append((
            row.name,
            "none" if math.isinf(row.travel.high) else f"{_span(*row.travel)} {way}",
            f"{_span(*row.inertia)} {inertia}",
            f"{_span(*row.holding)} {force}",
            f"{row.friction + row.damping * demand(row, move_time).speed:.3g} {force}",
            f"{axis.gear:.4g}" + ("" if row.kind == "hinge" else f" rad/m ({2e3 * math.pi / axis.gear:.3g} mm/turn)"),
            f"{axis.inertia:.3g}",
            f"{axis.inertia_ratio:.2g}",
            f"{axis.torque_margin:.3g}",
            f"{axis.speed_margin:.3g}",
            f"{axis.encoder_margin:.3g}",
        ))  # fmt: skip
    print_table(COLUMNS, rows)
    print_lines(f"{row.name or '(no name)'}: no drive: {row.refusal}" for row in found if row.refusal)
    says = "the smallest that moves" if proposal.fits else f"which lacks least of a margin of {MARGIN:g} to move"
    print_lines([
        f"motor {motor.name} ({motor.title}) on {device.name}, {says} every joint over its range, a turn or 1 m "
        f"at most, in {move_time:g} s",
        "inertia: at the joint, the others held, without armature; holding: against gravity and springs; both "
        "least...most over the poses; friction: at the speed of the move",
    ])  # fmt: skip
    if out is not None:
        nodes = " ".join(f"-n {k + 1}" for k in range(-(-len(driven) // device.num_axes)))
        path = out / f"{load.mjcf.stem}.xml"
        print_lines([
            f"written to {path}; serve it: drive-env serve {device.name} --load {path} --motor {motor.name} {nodes}",
            f"tune it: drive-tune auto --device {device.name} --load {path} --motor {motor.name} --out tuned",
        ])  # fmt: skip


def print_proposal_json(found: Sequence[JointLoad], proposal: DriveProposal, out: Path | None) -> None:
    """Print the proposal as JSON, in SI units."""
    axes = iter(proposal.axes)
    told: list[dict[str, Any]] = []
    for row in found:
        one: dict[str, Any] = {"joint": row.name, "kind": row.kind}
        if row.refusal:
            told.append(one | {"refusal": row.refusal})
            continue
        limited = not math.isinf(row.travel.high)
        told.append(one | {
            "range": list(row.travel) if limited else None, "inertia": list(row.inertia),
            "holding": list(row.holding), "friction": row.friction, "damping": row.damping, **next(axes)._asdict(),
        })  # fmt: skip
    print_json({
        "motor": proposal.motor.name, "fits": proposal.fits, "joints": told,
        "folder": None if out is None else str(out),
    })  # fmt: skip


def _span(low: float, high: float) -> str:
    return f"{low:.3g}...{high:.3g}" if f"{low:.3g}" != f"{high:.3g}" else f"{high:.3g}"


def _margins(axis: Any) -> str:
    return (
        f"{axis.torque_margin:.2g} of torque, {axis.speed_margin:.2g} of speed, {axis.encoder_margin:.2g} of the "
        f"encoder's resolution and {axis.inertia_ratio:.2g} times its rotor's inertia"
    )
