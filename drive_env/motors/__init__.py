"""The motors: a TOML file each, with the source of every number; or the user's own, by its file or made in Python.

SI; phase values, amplitude-invariant dq, currents as peak i_q. A file may have the data sheet's form (between two
terminals, per rpm, RMS), which is converted here. Catalogues of block commutation give k_t so that psi_m = k_t /
(sqrt(3) n_p), with which the no-load speed is theirs; the torque constant of peak i_q is then 1.5 n_p psi_m = 0.866
k_t.

A stepper is a hybrid motor of two phases: its holding torque is that of both phases at their rated RMS current, a
current vector of sqrt(2) times that. It grows less than in proportion to the current, which saturates the iron: torque
= n_p psi_m i / sqrt(1 + saturation i^2).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from mechanics.reading.near_names import did_you_mean
from mechanics.reading.untrusted import read_toml

FOLDER = Path(__file__).parent


class MotorError(ValueError):
    """A file that does not describe a motor; the message names the number and the remedy."""


class PullOut(NamedTuple):
    """The torque that a stepper gives at rated current before it falls out of step, over its speed.

    Attributes:
        supply: Supply of the chopper [V].
        speed: Increasing [rad/s], (n,).
        torque: Torque at the shaft [N m], (n,).
    """

    supply: float
    speed: tuple[float, ...]
    torque: tuple[float, ...]


class Motor(NamedTuple):
    """A motor with its encoder.

    `kind` is "pmsm", "dc" with R_s, L and psi_m those of its one winding and n_p = 1, or "stepper", whose rated torque
    is its holding torque, its cogging the detent torque, and its rated speed the one up to which the supply carries the
    rated current.
    """

    name: str
    title: str
    R_s: float  # ohm
    L_d: float  # H
    L_q: float  # H
    psi_m: float  # V s
    n_p: int
    inertia: float  # kg m^2, rotor
    rated_torque: float  # N m
    rated_current: float  # A, peak i_q
    rated_speed: float  # rad/s
    voltage: float  # V
    encoder_counts: int  # per turn, after quadrature
    cogging_torque: float  # N m, amplitude
    cogging_order: int  # periods per turn
    coulomb: float  # N m, bearings
    viscous: float  # N m s/rad
    encoder_line_error: float  # rad, once per turn
    commutation_offset: float  # rad electrical, left after alignment
    sources: tuple[tuple[str, str], ...] = ()  # where each number of its file comes from
    kind: str = "pmsm"
    thermal_time: float = 600.0  # s, winding and housing
    flux_temperature: float = -1.1e-3  # 1/K, of neodymium magnets
    # Wiring of its cable, for which the drive's settings of encoder and halls must make up.
    encoder_direction: int = 0
    hall_polarity: int = 0
    hall_direction: int = 0
    saturation: float = 0.0  # 1/A^2, of a stepper
    pull_out: PullOut | None = None  # of a stepper; None if unknown

    @property
    def torque_constant(self) -> float:
        """Torque per ampere of peak i_q (DC motor: per ampere; stepper: at small current) [N*m/A]."""
        return self._phase_factor * self.n_p * self.psi_m

    def torque(self, current: float) -> float:
        """Return the torque [N m] at this peak current [A], for a stepper at a current vector of this size."""
        return self.torque_constant * current / math.sqrt(1.0 + self.saturation * current * current)

    @property
    def thermal_resistance(self) -> float:
        """Winding to ambient [K/W]: the rated current warms the winding, then of higher resistance, by `RATED_RISE`."""
        return RATED_RISE / ((1.0 + COPPER * RATED_RISE) * self.copper_resistance * self.rated_current**2)

    @property
    def copper_resistance(self) -> float:
        """The winding's losses at 25 degC over the square of its peak current [ohm]."""
        return self._phase_factor * self.R_s

    @property
    def _phase_factor(self) -> float:
        return 1.5 if self.kind == "pmsm" else 1.0  # two phases, or one, add directly


# IEC 60449: up to 120 V of direct current is band I, extra-low voltage; a winding for it is not insulated for band II,
# and one for band II hardly turns on band I.
EXTRA_LOW_VOLTAGE = 120.0
COPPER = 0.00393  # 1/K, relative change of a winding's resistance
RATED_RISE = 80.0  # K, a class of insulation's common limit at 40 degC ambient
RPM = 0.10471975511965977  # rad/s
_SQRT3 = 3.0**0.5

# Ranges of randomisation as multiples of the row's value: unit-to-unit spread and temperature.
RANGES = {
    "R_s": (0.85, 1.4),
    "L_d": (0.85, 1.15),
    "L_q": (0.85, 1.15),
    "L_s": (0.8, 1.2),
    "psi_m": (0.88, 1.05),
    "inertia": (0.9, 1.1),
    "cogging_torque": (0.0, 2.0),
    "coulomb": (0.3, 2.5),
    "viscous": (0.3, 3.0),
    "detent_torque": (0.5, 1.5),
    "encoder_line_error": (-2.0, 2.0),
    "commutation_offset": (-3.0, 3.0),
}


class Number(NamedTuple):
    """A number in a file: unit, meaning, least and greatest, and whether each end is a valid value."""

    unit: str
    meaning: str
    low: float
    high: float = math.inf
    with_low: bool = False


# A file has each quantity once, in the form of its data sheet.
RESISTANCE = ("resistance_phase_ohm", "resistance_line_to_line_ohm", "resistance_ohm")
INDUCTANCE = ("inductance_phase_h", "inductance_line_to_line_h", "inductance_h")
INDUCTANCE_D = ("inductance_d_phase_h", "inductance_d_line_to_line_h")  # each with that of q, instead of INDUCTANCE
INDUCTANCE_Q = ("inductance_q_phase_h", "inductance_q_line_to_line_h")
TORQUE_CONSTANT = (
    "torque_constant_peak", "torque_constant_rms", "torque_constant_line_to_line", "back_emf_line_peak_v_per_krpm",
    "back_emf_line_rms_v_per_krpm", "speed_constant_rpm_per_v", "torque_constant",
)  # fmt: skip
RATED_CURRENT = ("rated_current_peak_a", "rated_current_rms_a")
KINDS = {"pmsm": "brushless", "dc": "brushed", "stepper": "two-phase hybrid stepper"}
OF_DC = ("resistance_ohm", "inductance_h", "torque_constant")  # of a brushed motor, which has no phases
DC_CONSTANT = ("torque_constant", "speed_constant_rpm_per_v")
NUMBERS: dict[str, Number] = {
    "resistance_phase_ohm": Number("ohm", "winding resistance of one phase", 0.0),
    "resistance_line_to_line_ohm": Number("ohm", "winding resistance between two terminals", 0.0),
    "resistance_ohm": Number("ohm", "winding resistance", 0.0),
    "inductance_phase_h": Number("H", "inductance of one phase", 0.0),
    "inductance_line_to_line_h": Number("H", "inductance between two terminals", 0.0),
    "inductance_h": Number("H", "inductance", 0.0),
    "inductance_d_phase_h": Number("H", "inductance of one phase along the magnets' flux, L_d", 0.0),
    "inductance_q_phase_h": Number("H", "inductance of one phase across the magnets' flux, L_q", 0.0),
    "inductance_d_line_to_line_h": Number("H", "L_d between two terminals", 0.0),
    "inductance_q_line_to_line_h": Number("H", "L_q between two terminals", 0.0),
    "torque_constant_peak": Number("N*m/A", "torque per ampere of peak phase current", 0.0),
    "torque_constant_rms": Number("N*m/A", "torque per ampere RMS of phase current", 0.0),
    "torque_constant_line_to_line": Number("N*m/A", "torque constant of block commutation, as catalogues have it", 0.0),
    "back_emf_line_peak_v_per_krpm": Number("V/krpm", "back-EMF, peak between two terminals at 1000 rpm", 0.0),
    "back_emf_line_rms_v_per_krpm": Number("V/krpm", "back-EMF, RMS between two terminals at 1000 rpm", 0.0),
    "speed_constant_rpm_per_v": Number("rpm/V", "speed constant KV, speed without load per volt of supply", 0.0),
    "torque_constant": Number("N*m/A", "torque constant", 0.0),
    "pole_pairs": Number("", "number of pole pairs", 1, 127, True),
    "inertia_kg_m2": Number("kg*m^2", "inertia of the rotor", 0.0),
    "rated_torque_nm": Number("N*m", "rated torque", 0.0),
    "rated_current_peak_a": Number("A", "rated current, peak of the phase", 0.0),
    "rated_current_rms_a": Number("A", "rated current, RMS of the phase", 0.0),
    "rated_speed_rpm": Number("rpm", "rated speed", 0.0),
    "voltage_v": Number("V", "supply voltage", 0.0),
    "encoder_counts": Number("", "encoder counts a turn, four times its lines", 4, 2**24, True),
    "cogging_torque_nm": Number("N*m", "amplitude of the cogging torque", 0.0, math.inf, True),
    "cogging_order": Number("", "periods of the cogging torque a turn", 0, 10_000, True),
    "coulomb_nm": Number("N*m", "dry friction of the bearings", 0.0, math.inf, True),
    "viscous_nm_s": Number("N*m*s/rad", "viscous friction of the bearings", 0.0, math.inf, True),
    "encoder_line_error_rad": Number("rad", "error of the encoder, once a turn", -0.1, 0.1, True),
    "commutation_offset_rad": Number("rad", "electrical angle that alignment leaves", -1.0, 1.0, True),
    "full_steps": Number("", "full steps a turn of a stepper", 4, 4000, True),
    "holding_torque_nm": Number("N*m", "torque of a stepper with both phases at their rated current", 0.0),
    "detent_torque_nm": Number("N*m", "torque of a stepper without current", 0.0, math.inf, True),
    "torque_saturation": Number("1", "share of torque that saturation takes at the rated current", 0.0, 0.5, True),
    "thermal_time_s": Number("s", "thermal time constant of winding and housing", 0.0),
    "encoder_direction": Number("", "1 where the encoder counts backwards", 0, 1, True),
    "hall_polarity": Number("", "1 where the halls' levels are inverted", 0, 1, True),
    "hall_direction": Number("", "1 where the halls come in reverse order", 0, 1, True),
}
WHOLE = (
    "pole_pairs", "encoder_counts", "cogging_order", "encoder_direction", "hall_polarity", "hall_direction",
    "full_steps",
)  # fmt: skip
NEEDED = ("inertia_kg_m2", "rated_torque_nm", "rated_speed_rpm", "voltage_v", "encoder_counts")
# A stepper's numbers: required ones, besides one form of the rated current, and optional ones.
STEPPER_NEEDED = (
    "resistance_phase_ohm", "inductance_phase_h", "full_steps", "holding_torque_nm", "inertia_kg_m2", "voltage_v",
)  # fmt: skip
STEPPER_MAY = (
    "detent_torque_nm", "torque_saturation", "coulomb_nm", "viscous_nm_s", "encoder_counts", "encoder_line_error_rad",
    "encoder_direction", "thermal_time_s",
)  # fmt: skip
OF_STEPPER = ("full_steps", "holding_torque_nm", "detent_torque_nm", "torque_saturation")  # only for steppers
# Values that a stepper's data sheet seldom has. The common table has 125 % of the torque at 125 % of the current, and
# at 150 % at most that. The drag is mostly that of eddy currents, a damping ratio of 0.045 of the rotor's swing in the
# holding torque: this value fits the QSH4218-47-28-040's torque at 1200 rpm in its data sheet.
DETENT_SHARE, SATURATION_SHARE, STEPPER_COULOMB_SHARE, STEPPER_DAMPING = 0.05, 0.05, 0.02, 0.045
# Values that a data sheet seldom has: class values of a rotor similar to the catalogue's.
COGGING_SHARE, COULOMB_SHARE, VISCOUS_SHARE = 0.01, 0.015, 0.005  # of the rated torque, at the rated speed
ENCODER_LINE_ERROR, COMMUTATION_OFFSET = 2e-4, 0.02


def find_motor(motor: str | Path | Motor) -> Motor:
    """Return a motor by its name in the catalogue or the path of a TOML file; a `Motor` unchanged.

    Raises:
        ValueError: For an unknown name, listing the known ones; MotorError for a file that does not describe a motor.
    """
    if isinstance(motor, Motor):
        return motor
    if isinstance(motor, Path) or str(motor).endswith(".toml"):
        return load_motor(Path(motor))
    if motor not in MOTORS:
        raise ValueError(
            f"no motor is named {motor!r}; there are {', '.join(sorted(MOTORS))}{did_you_mean(motor, MOTORS)}; "
            "or give the path of a motor's .toml file"
        )
    return MOTORS[motor]


def load_motor(path: Path) -> Motor:
    """Return the motor that a TOML file describes.

    Raises:
        MotorError: If it cannot be read, lacks a number, or has an impossible one.
    """
    try:
        data = read_toml(path)
    except OSError as error:
        raise MotorError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise MotorError(f"{path} is not a TOML file: {error}") from None
    try:
        return motor_of(path.stem, data)
    except MotorError as error:
        raise MotorError(f"{path}: {error}") from None


def check_kind(kind: object) -> None:
    """Raise MotorError for an unknown kind of motor."""
    if kind not in KINDS:
        meant = ", ".join(f"{name!r} ({what})" for name, what in KINDS.items())
        raise MotorError(f"kind is {kind!r}; it is one of {meant}")


def motor_of(name: str, data: Mapping[str, Any]) -> Motor:
    """Return the motor of a file's tables; MotorError for a missing, unknown or impossible entry."""
    unknown = sorted(set(data) - {"title", "kind", "sources", "numbers", "pull_out"})
    if unknown:
        raise MotorError(f"{unknown[0]!r} is not a key of a motor; there are title, kind, sources, numbers, pull_out")
    kind = data.get("kind", "pmsm")
    check_kind(kind)
    texts, rows = data.get("sources", {}), data.get("numbers", {})
    if not isinstance(texts, Mapping) or not isinstance(rows, Mapping):
        raise MotorError("sources and numbers are tables: [sources], [numbers]")
    values, sources = {}, {}
    for key, row in rows.items():
        values[key], sources[key] = _checked(key, row, texts)
    title = str(data.get("title", name))
    if kind == "stepper":
        curve = _pull_out(data["pull_out"], texts) if "pull_out" in data else None
        return _stepper(name, title, values, sources, curve)
    if "pull_out" in data:
        raise MotorError(f"pull_out: only a stepper falls out of step; kind is {kind!r}")
    return _built(name, title, kind, values, sources)


def _checked(key: str, row: Any, texts: Mapping[str, Any]) -> tuple[float, str]:
    """Return a number and the text of its source."""
    if key not in NUMBERS:
        raise MotorError(
            f"{key!r} is not a number of a motor{did_you_mean(key, NUMBERS)}; there are {', '.join(NUMBERS)}"
        )
    if not (isinstance(row, list) and len(row) == 2 and isinstance(row[1], str)):
        raise MotorError(f'{key} = {row!r}: write the number and where it comes from, {key} = [1.0, "data_sheet"]')
    value, source = row
    known = NUMBERS[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise MotorError(f"{key} = {value!r} is not a number")
    if key in WHOLE and value != int(value):
        raise MotorError(f"{key} = {value!r} must be a whole number")
    if not (known.low <= value if known.with_low else known.low < value) or value > known.high:
        least = "at least" if known.with_low else "above"
        most = "" if math.isinf(known.high) else f" and at most {known.high:g}"
        raise MotorError(f"{key} = {value!r} {known.unit} must be {least} {known.low:g}{most} ({known.meaning})")
    if source not in texts:
        raise MotorError(f'{key}: there is no source {source!r}; describe it under [sources], {source} = "..."')
    return value, str(texts[source])


def _built(name: str, title: str, kind: str, values: Mapping[str, float], sources: Mapping[str, str]) -> Motor:
    """Return the motor of checked numbers, converted to phase values in SI."""
    is_dc = kind == "dc"
    forms = (("resistance_ohm",), ("inductance_h",), DC_CONSTANT) if is_dc else (RESISTANCE, ("pole_pairs",))
    for quantity in (*forms, *((key,) for key in NEEDED)):
        _one_of(quantity, values)
    phases = {*RESISTANCE, *INDUCTANCE, *INDUCTANCE_D, *TORQUE_CONSTANT} - {*OF_DC, *DC_CONSTANT}
    others = phases if is_dc else {*OF_DC}
    wrong = [key for key in values if key in others]
    _refuse(OF_STEPPER, values, "only a stepper has it")
    if wrong:
        other = "a brushed motor has no phases" if is_dc else "of a brushless motor say which"
        near = [key for key in NUMBERS if key[:5] == wrong[0][:5] and key not in (*others, *OF_STEPPER)]
        raise MotorError(f"{wrong[0]}: {other}; there are {', '.join(near)}")
    n_p = 1 if is_dc else int(values["pole_pairs"])
    torque, speed = values["rated_torque_nm"], values["rated_speed_rpm"] * RPM
    k = _torque_constant(kind, values)
    current = _rated_current(values, torque, k)
    if k is None:
        k = torque / current
    halved = 0.5 if "resistance_line_to_line_ohm" in values else 1.0
    R = next(values[key] for key in RESISTANCE if key in values) * halved
    L_d, L_q = _inductances(values)
    line = values.get("torque_constant_line_to_line")
    return Motor(
        name=name,
        title=title,
        R_s=R,
        L_d=L_d,
        L_q=L_q,
        psi_m=k if is_dc else k / (1.5 * n_p) if line is None else line / (_SQRT3 * n_p),
        n_p=n_p,
        inertia=values["inertia_kg_m2"],
        rated_torque=torque,
        rated_current=current,
        rated_speed=speed,
        voltage=values["voltage_v"],
        encoder_counts=int(values["encoder_counts"]),
        # The brushed motors of the catalogue are coreless or skewed: no cogging.
        cogging_torque=values.get("cogging_torque_nm", 0.0 if is_dc else COGGING_SHARE * torque),
        cogging_order=int(values.get("cogging_order", 0 if is_dc else 6 * n_p)),
        coulomb=values.get("coulomb_nm", COULOMB_SHARE * torque),
        viscous=values.get("viscous_nm_s", VISCOUS_SHARE * torque / speed),
        encoder_line_error=values.get("encoder_line_error_rad", ENCODER_LINE_ERROR),
        commutation_offset=values.get("commutation_offset_rad", 0.0 if is_dc else COMMUTATION_OFFSET),
        sources=tuple(sources.items()),
        kind=kind,
        thermal_time=values.get("thermal_time_s", 600.0),
        encoder_direction=int(values.get("encoder_direction", 0)),
        hall_polarity=int(values.get("hall_polarity", 0)),
        hall_direction=int(values.get("hall_direction", 0)),
    )


def _stepper(
    name: str, title: str, values: Mapping[str, float], sources: Mapping[str, str], curve: PullOut | None
) -> Motor:
    """Return a stepper from checked numbers and typical ones for those it lacks; MotorError without a needed one."""
    for key in STEPPER_NEEDED:
        _one_of((key,), values)
    _refuse(
        [key for key in NUMBERS if key not in (*STEPPER_NEEDED, *STEPPER_MAY, *RATED_CURRENT)], values,
        f"not of a stepper, which has {', '.join((*STEPPER_NEEDED, *RATED_CURRENT, *STEPPER_MAY))}",
    )  # fmt: skip
    if not any(key in values for key in RATED_CURRENT):
        raise MotorError(f"{' or '.join(RATED_CURRENT)} is missing")
    steps, torque, inertia = int(values["full_steps"]), values["holding_torque_nm"], values["inertia_kg_m2"]
    if steps % 4:
        raise MotorError(f"full_steps = {steps} must be a multiple of 4: four of them are a period of the current")
    n_p = steps // 4
    current = _rated_current(values, torque, None)
    kept = 1.0 - values.get("torque_saturation", SATURATION_SHARE)
    R, L, psi_m = values["resistance_phase_ohm"], values["inductance_phase_h"], torque / (n_p * current * kept)
    return Motor(
        name=name,
        title=title,
        R_s=R,
        L_d=L,
        L_q=L,
        psi_m=psi_m,
        n_p=n_p,
        inertia=inertia,
        rated_torque=torque,
        rated_current=current,
        rated_speed=_corner(R, L, kept * psi_m, current, values["voltage_v"]) / n_p,
        voltage=values["voltage_v"],
        encoder_counts=int(values.get("encoder_counts", 0)),
        cogging_torque=values.get("detent_torque_nm", DETENT_SHARE * torque),
        cogging_order=steps,
        coulomb=values.get("coulomb_nm", STEPPER_COULOMB_SHARE * torque),
        viscous=values.get("viscous_nm_s", 2.0 * STEPPER_DAMPING * math.sqrt(n_p * torque * inertia)),
        encoder_line_error=values.get("encoder_line_error_rad", ENCODER_LINE_ERROR),
        commutation_offset=0.0,
        sources=tuple(sources.items()),
        kind="stepper",
        thermal_time=values.get("thermal_time_s", 600.0),
        encoder_direction=int(values.get("encoder_direction", 0)),
        saturation=(1.0 / (kept * kept) - 1.0) / current**2,
        pull_out=curve,
    )


def _corner(R: float, L: float, psi_m: float, current: float, supply: float) -> float:
    """Return the electrical speed [rad/s] up to which a supply carries a current vector across the magnets' flux.

    There (R i + w psi)^2 + (w L i)^2 = u^2.
    """
    if R * current >= supply:
        raise MotorError(
            f"voltage_v = {supply:g} V does not even drive {current:g} A through {R:g} ohm; a chopper needs several "
            "times as much"
        )
    a, b = (L * current) ** 2 + psi_m**2, R * current * psi_m
    return (math.sqrt(b * b + a * (supply**2 - (R * current) ** 2)) - b) / a


def _pull_out(row: Any, texts: Mapping[str, Any]) -> PullOut:
    keys = {"source", "supply_v", "speed_rpm", "torque_nm"}
    if not isinstance(row, Mapping) or set(row) != keys:
        raise MotorError(f"pull_out has {', '.join(sorted(keys))}, all of them")
    if row["source"] not in texts:
        raise MotorError(f"pull_out: there is no source {row['source']!r}; describe it under [sources]")
    speed, torque = row["speed_rpm"], row["torque_nm"]
    if not all(isinstance(points, list) for points in (speed, torque)) or len(speed) != len(torque) or not speed:
        raise MotorError("pull_out: speed_rpm and torque_nm are lists of the same length")
    for value in (row["supply_v"], *speed, *torque):
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise MotorError(f"pull_out: {value!r} is not a number of 0 or more")
    if any(after <= before for before, after in itertools.pairwise(speed)):
        raise MotorError(f"pull_out: speed_rpm must increase: {speed}")
    return PullOut(float(row["supply_v"]), tuple(each * RPM for each in speed), tuple(map(float, torque)))


def _refuse(keys: Iterable[str], values: Mapping[str, float], why: str) -> None:
    """Raise MotorError for a number that this kind of motor does not have."""
    for key in keys:
        if key in values:
            raise MotorError(f"{key}: {why}")


def _one_of(quantity: tuple[str, ...], values: Mapping[str, float]) -> str:
    """Return the form in which a quantity is given; raise MotorError unless it is one."""
    given = [key for key in quantity if key in values]
    if len(given) != 1:
        said = (
            f"{' and '.join(given)} are two forms of the same number; keep one"
            if given
            else f"{' or '.join(quantity)} is missing"
        )
        raise MotorError(said)
    return given[0]


def _inductances(values: Mapping[str, float]) -> tuple[float, float]:
    """Return L_d and L_q of a phase [H], which are equal if the file has one inductance."""
    key = _one_of((*INDUCTANCE, *INDUCTANCE_D), values)
    across = key.replace("_d_", "_q_")
    _refuse((each for each in INDUCTANCE_Q if each != across), values, f"does not go with {key}")
    halved = 0.5 if "line_to_line" in key else 1.0
    return halved * values[key], halved * values[_one_of((across,), values)]


def _torque_constant(kind: str, values: Mapping[str, float]) -> float | None:
    """Return torque per ampere of peak current [N*m/A], None if it follows from the rated point."""
    given = [key for key in TORQUE_CONSTANT if key in values]
    if len(given) > 1:
        raise MotorError(f"{' and '.join(given)} are two forms of the same number; keep one")
    if not given:
        return None
    key = given[0]
    value = values[key]
    per_rad = _SQRT3 * 1000 * RPM  # line to line, and 1000 rpm
    return {
        "torque_constant": value,
        "torque_constant_peak": value,
        "torque_constant_rms": value / math.sqrt(2.0),
        "torque_constant_line_to_line": 0.5 * _SQRT3 * value,
        "back_emf_line_peak_v_per_krpm": 1.5 * value / per_rad,
        "back_emf_line_rms_v_per_krpm": 1.5 * math.sqrt(2.0) * value / per_rad,
        "speed_constant_rpm_per_v": (1.0 if kind == "dc" else 0.5 * _SQRT3) / (value * RPM),
    }[key]


def _rated_current(values: Mapping[str, float], torque: float, k: float | None) -> float:
    """Return the rated current, peak [A]: as given, or that of the rated torque by k [N*m/A]; MotorError without k."""
    given = [key for key in RATED_CURRENT if key in values]
    if len(given) > 1:
        raise MotorError(f"{' and '.join(given)} are two forms of the same number; keep one")
    if given:
        return values[given[0]] * (math.sqrt(2.0) if given[0] == "rated_current_rms_a" else 1.0)
    if k is None:
        raise MotorError(f"{' or '.join(TORQUE_CONSTANT)} is missing, or the rated current, from which it follows")
    return torque / k


def is_extra_low(voltage: float) -> bool:
    """Return whether a voltage [V] belongs to the class of 24 to 48 V drives, not to that of drives on mains."""
    return voltage <= EXTRA_LOW_VOLTAGE


def motors_of(kinds: Collection[str], voltage: float | None = None) -> dict[str, Motor]:
    """Return the catalogue's motors of these kinds, and of a voltage's class [V] if given, by name."""
    return {
        name: motor
        for name, motor in MOTORS.items()
        if motor.kind in kinds and (voltage is None or is_extra_low(motor.voltage) == is_extra_low(voltage))
    }


MOTORS: dict[str, Motor] = {path.stem: load_motor(path) for path in sorted(FOLDER.glob("*.toml"))}
