"""`drive-env model`: drives for a model's joints; or a model's deviation from a log, and machines that fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from drive_env.commands.options import DeviceName, Json, check_free, errors_as_exit_codes, print_json
from drive_env.commands.tables import print_lines
from drive_env.default_device import DEFAULT_DEVICE

if TYPE_CHECKING:
    from drive_env.dictionary.entries import ObjectDictionary
    from drive_env.trials.replay import LogDifference, LogFit

LEAST = 16  # least number of machines of a fit
MOVE_TIME = 2.0  # s


def model(
    load: Annotated[
        str, typer.Argument(help="Model: the path of an MJCF or URDF file; with --log also the name of a load.")
    ],
    log: Annotated[
        Path | None, typer.Option(help="Log of a move from rest, as `scope` writes it (CSV), to compare with.")
    ] = None,
    joint: Annotated[
        list[str] | None,
        typer.Option(
            "--joint",
            "-j",
            help="Joint to drive; may be repeated.",
            show_default="those of the file's actuators, or all",
        ),
    ] = None,
    move_time: Annotated[
        float, typer.Option(help="Time for a move of each joint over its range, a turn or 1 m at most [s].")
    ] = MOVE_TIME,
    device: DeviceName = DEFAULT_DEVICE,
    motor: Annotated[
        str | None,
        typer.Option(
            help="Motor: a name of the catalogue, or the path of a TOML file.",
            show_default="the smallest that suffices; with --log the device's usual one",
        ),
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="Parameters of the real drive, as `parameters backup` writes them (TOML).")
    ] = None,
    fit: Annotated[
        list[str] | None,
        typer.Option(
            "--fit",
            "-f",
            help="Parameter to fit to the log: load.inertia, motor.coulomb, ...; may be repeated. '?' lists the "
            "load's parameters.",
        ),
    ] = None,
    distributions: Annotated[
        str | None,
        typer.Option(
            help="Set of distributions (a name, or a TOML file) from which machines are drawn for the fit.",
            show_default="the load's",
        ),
    ] = None,
    machines: Annotated[int, typer.Option(help=f"Number of machines in a round of a fit, {LEAST} or more.")] = 64,
    rounds: Annotated[int, typer.Option(help="Rounds of a fit.")] = 4,
    seed: Annotated[int, typer.Option(help="Seed of a fit, and of the machines' noise.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            help="New folder for the model with its gears, to serve; with --fit, new file for the fitted set "
            "of distributions (TOML)."
        ),
    ] = None,
    json: Json = False,
) -> None:
    """Print which joints of a model drives can turn, and with which motor and gears; or compare a model with a log.

    Inertia, range and holding torque of each joint, the motor and the gear with their margins, and why a joint can have
    no drive. --out writes the model with these gears, for `serve`, `drive-tune auto` and environments.

    With --log, repeat the recorded move on the emulated machine and print the deviation of its response from the log.
    With --fit the parameters are drawn from their distributions until machines respond like the log; --out writes their
    range as a set of distributions for environments.
    """
    with errors_as_exit_codes():
        if log is None:
            _of_log_alone(settings=settings, fit=fit, distributions=distributions)
            _propose(load, device, motor, joint or [], move_time, out, json)
            return
        if joint:
            raise ValueError(f"--joint {joint[0]} is for a proposal; leave it out, or --log {log}")
        _check(fit, machines, rounds, out)
        from drive_env.trials.replay import read_log

        recorded = read_log(log)
        # The compiler is imported only from here on: mistakes above are reported at once.
        from drive_env.emulator.emulated_drives import EmulatedDrives
        from drive_env.master.parameter_files import load_parameters
        from drive_env.randomisation.random_machines import Distributions
        from drive_env.trials.replay import compare as differences
        from drive_env.trials.replay import fit as fitted
        from drive_env.trials.replay import fittable, replay
        from drive_env.whole_file import write_whole

        laws = Distributions.load(distributions or load) if fit else None
        if laws is not None and "?" in (fit or ()):
            names = fittable(laws)
            print_json({"parameters": names}) if json else print_lines([f"{load} has {', '.join(names)}"])
            return
        with EmulatedDrives(device, load, motor, machines if fit else 1, seed) as drives:
            dictionary = drives.device.new_dictionary()
            given = None if settings is None else load_parameters(settings, dictionary)
            report = differences(recorded, replay(drives, recorded, given), drives.num_machines)
            found = None
            if laws is not None and fit:
                found = fitted(drives, recorded, laws, fit, settings=given, rounds=rounds, seed=seed)
        if found is not None and out is not None:
            write_whole(out, found.to_toml())
        if json:
            print_json(_as_json(report, dictionary, found, out))
        else:
            _print(report, dictionary, found, out)


def _of_log_alone(**options: object) -> None:
    for name, value in options.items():
        if value is not None:
            raise ValueError(f"--{name} is for the comparison with a log; name it with --log, or leave --{name} out")


def _propose(
    load: str, device: str, motor: str | None, joints: Sequence[str], move_time: float, out: Path | None, json: bool
) -> None:
    from drive_env.commands.model_proposal import print_proposal, print_proposal_json, propose
    from drive_env.devices import find_device
    from drive_env.motors import find_motor
    from mechanics.load import Load
    from mechanics.loads import LOADS, MODEL_ENDINGS

    if load in LOADS:
        raise ValueError(f"{load} has its joints and gears; give the file of a model, or a log of its move with --log")
    if not load.endswith(MODEL_ENDINGS):
        raise ValueError(f"{load} is no model: give an MJCF or URDF file, which ends with {', '.join(MODEL_ENDINGS)}")
    of_drive, row = find_device(device), Load(Path(load))
    motors = list(of_drive.motors.values())
    if motor is not None:
        motors = [find_motor(motor)]
        of_drive.check_motor(motors[0])
    found, proposal = propose(row, of_drive, motors, joints, move_time, out)
    if json:
        print_proposal_json(found, proposal, out)
    else:
        print_proposal(row, of_drive, found, proposal, move_time, out)


def _check(fit: list[str] | None, machines: int, rounds: int, out: Path | None) -> None:
    """Raise ValueError for impossible options, before anything is computed."""
    if out is not None and not fit:
        raise ValueError("--out is for the fitted distributions; name the parameters to fit with --fit")
    if fit and machines < LEAST:
        raise ValueError(f"--machines {machines} is too few for a fit; give {LEAST} or more")
    if rounds < 1:
        raise ValueError(f"--rounds {rounds} must be 1 or more")
    if out is not None and not out.absolute().parent.is_dir():
        raise ValueError(f"the folder {out.parent} does not exist; create it")
    if out is not None:
        check_free(out, "choose another --out")


def _print(
    report: Mapping[Any, LogDifference], dictionary: ObjectDictionary, found: LogFit | None, out: Path | None
) -> None:
    for key, row in report.items():
        late = float(row.shift[0]) * 1e3
        how = "in time" if abs(late) < 0.05 else f"{abs(late):.1f} ms {'late' if late > 0.0 else 'early'}"
        print(
            f"{dictionary.find(key).label}: deviation {100.0 * row.nrmse[0]:.2f} % of its range (RMS); {how}, "
            f"{100.0 * row.shifted[0]:.2f} % with the shift removed"
        )
    if found is None:
        return
    print(
        f"fitted: {100.0 * found.distance[0]:.2f} % on average with the best machine, {100.0 * found.nominal:.2f} % "
        f"with the nominal one; {len(found.distance)} machines respond alike"
    )
    for name, values in found.accepted.items():
        unseen = "" if found.is_seen(name) else ": the log does not determine it"
        print(f"{name}: best {values[0]:.4g}, {values.min():.4g} to {values.max():.4g}{unseen}")
    if out is not None:
        print(f"distributions written to {out}")


def _as_json(
    report: Mapping[Any, LogDifference], dictionary: ObjectDictionary, found: LogFit | None, out: Path | None
) -> dict[str, Any]:
    told: dict[str, Any] = {
        "differences": {
            dictionary.find(key).label: {
                "nrmse": float(row.nrmse[0]),
                "shift_s": float(row.shift[0]),
                "nrmse_shifted": float(row.shifted[0]),
            }
            for key, row in report.items()
        }
    }
    if found is not None:
        told["fit"] = {
            "nominal": found.nominal,
            "best": float(found.distance[0]),
            "machines": len(found.distance),
            "parameters": {
                name: {
                    "best": float(values[0]),
                    "low": float(values.min()),
                    "high": float(values.max()),
                    "seen": found.is_seen(name),
                }
                for name, values in found.accepted.items()
            },
            "file": None if out is None else str(out),
        }
    return told
