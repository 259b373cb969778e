"""The motors: a TOML file each, with the source of every number; a motor of one's own by its file, or made in Python.

SI; phase values, amplitude-invariant dq, currents as peak i_q. A file may say what a data sheet has (between two
terminals, per rpm, RMS), and is converted here. Catalogues of block commutation give k_t so that psi_m = k_t / (sqrt(3)
n_p), with which the no-load speed is theirs; the torque constant of peak i_q is then 1.5 n_p psi_m = 0.866 k_t.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from mechanics.near_names import did_you_mean
from mechanics.untrusted import read_bytes

FOLDER = Path(__file__).parent


class MotorError(ValueError):
    """A file that describes no motor; the message names the number and the remedy."""


class Motor(NamedTuple):
    """A motor with its encoder: `kind` "pmsm", or "dc" with R_s, L and psi_m those of its one winding and n_p = 1."""

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
    # How its cable is wired, which the drive's settings of encoder and halls must make up for.
    encoder_direction: int = 0
    hall_polarity: int = 0
    hall_direction: int = 0

    @property
    def torque_constant(self) -> float:
        """Torque per ampere of peak i_q, of a DC motor per ampere [N*m/A]."""
        return self._phase_factor * self.n_p * self.psi_m

    @property
    def thermal_resistance(self) -> float:
        """Winding to ambient [K/W]: the rated current warms the winding, then of higher resistance, by `RATED_RISE`."""
        hot = self.R_s * (1.0 + COPPER * RATED_RISE)
        return RATED_RISE / (self._phase_factor * hot * self.rated_current**2)

    @property
    def _phase_factor(self) -> float:
        return 1.0 if self.kind == "dc" else 1.5


COPPER = 0.00393  # 1/K, relative change of a winding's resistance
RATED_RISE = 80.0  # K, a class of insulation's common limit at 40 degC ambient
RPM = 0.10471975511965977  # rad/s
_SQRT3 = 3.0**0.5

# Ranges of randomisation as multiples of the row's value: unit-to-unit spread and temperature.
RANGES = {
    "R_s": (0.85, 1.4),
    "L_d": (0.85, 1.15),
    "L_q": (0.85, 1.15),
    "psi_m": (0.88, 1.05),
    "inertia": (0.9, 1.1),
    "cogging_torque": (0.0, 2.0),
    "coulomb": (0.3, 2.5),
    "viscous": (0.3, 3.0),
    "encoder_line_error": (-2.0, 2.0),
    "commutation_offset": (-3.0, 3.0),
}


class Number(NamedTuple):
    """A number that a file may hold: unit, what it is, least and greatest, and whether that end is a value itself."""

    unit: str
    meaning: str
    low: float
    high: float = math.inf
    with_low: bool = False


# Of one quantity a file has one number, in the form of its data sheet.
RESISTANCE = ("resistance_phase_ohm", "resistance_line_to_line_ohm", "resistance_ohm")
INDUCTANCE = ("inductance_phase_h", "inductance_line_to_line_h", "inductance_h")
TORQUE_CONSTANT = (
    "torque_constant_peak", "torque_constant_rms", "torque_constant_line_to_line", "back_emf_line_peak_v_per_krpm",
    "back_emf_line_rms_v_per_krpm", "torque_constant",
)  # fmt: skip
RATED_CURRENT = ("rated_current_peak_a", "rated_current_rms_a")
OF_DC = ("resistance_ohm", "inductance_h", "torque_constant")  # a brushed motor's, which has no phases
NUMBERS: dict[str, Number] = {
    "resistance_phase_ohm": Number("ohm", "winding resistance of one phase", 0.0),
    "resistance_line_to_line_ohm": Number("ohm", "winding resistance between two terminals", 0.0),
    "resistance_ohm": Number("ohm", "winding resistance", 0.0),
    "inductance_phase_h": Number("H", "inductance of one phase", 0.0),
    "inductance_line_to_line_h": Number("H", "inductance between two terminals", 0.0),
    "inductance_h": Number("H", "inductance", 0.0),
    "torque_constant_peak": Number("N*m/A", "torque per ampere of peak phase current", 0.0),
    "torque_constant_rms": Number("N*m/A", "torque per ampere RMS of phase current", 0.0),
    "torque_constant_line_to_line": Number("N*m/A", "torque constant of block commutation, as catalogues have it", 0.0),
    "back_emf_line_peak_v_per_krpm": Number("V", "back-EMF, peak between two terminals at 1000 rpm", 0.0),
    "back_emf_line_rms_v_per_krpm": Number("V", "back-EMF, RMS between two terminals at 1000 rpm", 0.0),
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
    "thermal_time_s": Number("s", "thermal time constant of winding and housing", 0.0),
    "encoder_direction": Number("", "1 where the encoder counts backwards", 0, 1, True),
    "hall_polarity": Number("", "1 where the halls' levels are inverted", 0, 1, True),
    "hall_direction": Number("", "1 where the halls come in reverse order", 0, 1, True),
}
WHOLE = ("pole_pairs", "encoder_counts", "cogging_order", "encoder_direction", "hall_polarity", "hall_direction")
NEEDED = ("inertia_kg_m2", "rated_torque_nm", "rated_speed_rpm", "voltage_v", "encoder_counts")
# What a data sheet seldom has: class values, of a rotor that is like the catalogue's.
COGGING_SHARE, COULOMB_SHARE, VISCOUS_SHARE = 0.01, 0.015, 0.005  # of the rated torque, at the rated speed
ENCODER_LINE_ERROR, COMMUTATION_OFFSET = 2e-4, 0.02


def find_motor(motor: str | Path | Motor) -> Motor:
    """Return a motor by its name in the catalogue, by the path of a TOML file, or as it is.

    Raises:
        ValueError: For a name that none has, with those there are; MotorError for a file that describes no motor.
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
        MotorError: If it cannot be read, lacks a number, or has one that no motor can have.
    """
    try:
        data = tomllib.loads(read_bytes(path).decode("utf-8"))
    except OSError as error:
        raise MotorError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise MotorError(f"{path} is not a TOML file: {error}") from None
    try:
        return motor_of(path.stem, data)
    except MotorError as error:
        raise MotorError(f"{path}: {error}") from None


def motor_of(name: str, data: Mapping[str, Any]) -> Motor:
    """Return the motor of a file's tables."""
    unknown = sorted(set(data) - {"title", "kind", "sources", "numbers"})
    if unknown:
        raise MotorError(f"{unknown[0]!r} is not a key of a motor; there are title, kind, sources, numbers")
    kind = data.get("kind", "pmsm")
    if kind not in ("pmsm", "dc"):
        raise MotorError(f"kind is {kind!r}; it is 'pmsm' (brushless) or 'dc' (brushed)")
    texts, rows = data.get("sources", {}), data.get("numbers", {})
    if not isinstance(texts, Mapping) or not isinstance(rows, Mapping):
        raise MotorError("sources and numbers are tables: [sources], [numbers]")
    values, sources = {}, {}
    for key, row in rows.items():
        values[key], sources[key] = _checked(key, row, texts)
    return _built(name, str(data.get("title", name)), kind, values, sources)


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
    forms = (RESISTANCE, INDUCTANCE) if kind == "pmsm" else ()
    for quantity in (*forms, *((key,) for key in NEEDED), *(() if kind == "dc" else (("pole_pairs",),))):
        _one_of(quantity, values)
    if kind == "dc":
        for key in OF_DC:
            _one_of((key,), values)
        wrong = [key for key in (*RESISTANCE, *INDUCTANCE, *TORQUE_CONSTANT) if key in values and key not in OF_DC]
    else:
        wrong = [key for key in OF_DC if key in values]
    if wrong:
        other = "a brushed motor has no phases" if kind == "dc" else "of a brushless motor say between what"
        raise MotorError(f"{wrong[0]}: {other}; there are {', '.join(k for k in NUMBERS if k[:5] == wrong[0][:5])}")
    n_p = 1 if kind == "dc" else int(values["pole_pairs"])
    torque, speed = values["rated_torque_nm"], values["rated_speed_rpm"] * RPM
    k = _torque_constant(kind, n_p, values)
    current = _rated_current(values, torque, k, kind)
    if k is None:
        k = torque / current
    halved = 0.5 if "resistance_line_to_line_ohm" in values else 1.0
    R = next(values[key] for key in RESISTANCE if key in values) * halved
    L = next(values[key] for key in INDUCTANCE if key in values)
    L *= 0.5 if "inductance_line_to_line_h" in values else 1.0
    line = values.get("torque_constant_line_to_line")
    psi_m = k if kind == "dc" else k / (1.5 * n_p) if line is None else line / (_SQRT3 * n_p)
    is_dc = kind == "dc"
    return Motor(
        name=name,
        title=title,
        R_s=R,
        L_d=L,
        L_q=L,
        psi_m=psi_m,
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


def _one_of(quantity: tuple[str, ...], values: Mapping[str, float]) -> None:
    """Raise MotorError unless a quantity is given, in one form."""
    given = [key for key in quantity if key in values]
    if len(given) != 1:
        said = (
            f"{' and '.join(given)} are two forms of the same number; keep one"
            if given
            else f"{' or '.join(quantity)} is missing"
        )
        raise MotorError(said)


def _torque_constant(kind: str, n_p: int, values: Mapping[str, float]) -> float | None:
    """Return torque per ampere of peak current [N*m/A], None where it follows from the rated point."""
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
    }[key]


def _rated_current(values: Mapping[str, float], torque: float, k: float | None, kind: str) -> float:
    """Return the rated current, peak [A]: as given, or that of the rated torque."""
    given = [key for key in RATED_CURRENT if key in values]
    if len(given) > 1:
        raise MotorError(f"{' and '.join(given)} are two forms of the same number; keep one")
    if given:
        return values[given[0]] * (math.sqrt(2.0) if given[0] == "rated_current_rms_a" else 1.0)
    if k is None:
        raise MotorError(f"{' or '.join(TORQUE_CONSTANT)} is missing, or the rated current, from which it follows")
    return torque / k


MOTORS: dict[str, Motor] = {path.stem: load_motor(path) for path in sorted(FOLDER.glob("*.toml"))}
