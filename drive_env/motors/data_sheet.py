"""Numbers of a motor as data sheets print them (`44 gcm2`, `91 mNm/A`, `0,207 Nm`, `9 Arms`), in the units of a file.

Pound and inch are those of the international agreement of 1959, kgf, ozf and lbf those at the standard gravity of
9.80665 m/s^2. An ounce is a force in torques and in oz-in-s^2, a mass in oz-in^2.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import product

from drive_env.motors import NUMBERS, RPM, WHOLE
from mechanics.reading.near_names import did_you_mean

_INCH, _POUND, _GRAVITY = 0.0254, 0.45359237, 9.80665  # m, kg, m/s^2
_LB_IN = _POUND * _GRAVITY * _INCH  # N m


def _per(above: Mapping[str, float], below: Mapping[str, float]) -> dict[str, float]:
    """Return every unit of one table per every unit of another."""
    return {f"{a}/{b}": one / other for (a, one), (b, other) in product(above.items(), below.items())}


_TORQUE = {
    "Nm": 1.0, "mNm": 1e-3, "uNm": 1e-6, "Ncm": 1e-2, "kgcm": 1e-2 * _GRAVITY, "kgfcm": 1e-2 * _GRAVITY,
    "gcm": 1e-5 * _GRAVITY, "gfcm": 1e-5 * _GRAVITY, "ozin": _LB_IN / 16.0, "ozfin": _LB_IN / 16.0, "lbin": _LB_IN,
    "lbfin": _LB_IN, "inlb": _LB_IN, "lbft": 12.0 * _LB_IN, "ftlb": 12.0 * _LB_IN,
}  # fmt: skip
_SPEED = {"rpm": 1.0, "krpm": 1e3, "1/min": 1.0, "min1": 1.0, "r/min": 1.0, "rad/s": 1.0 / RPM}
_KRPM = {"1000rpm": 1.0, "1000min1": 1.0} | {name: 1e-3 * factor for name, factor in _SPEED.items()}
_CURRENT, _VOLTAGE = {"A": 1.0, "mA": 1e-3}, {"V": 1.0, "mV": 1e-3}
# For each unit of a file the units of data sheets, without spaces, dots, hyphens and brackets.
UNITS: dict[str, dict[str, float]] = {
    "ohm": {"ohm": 1.0, "ohms": 1.0, "mohm": 1e-3, "kohm": 1e3},
    "H": {"H": 1.0, "mH": 1e-3, "uH": 1e-6},
    "N*m": _TORQUE,
    "kg*m^2": {
        "kgm2": 1.0, "gm2": 1e-3, "kgcm2": 1e-4, "kgmm2": 1e-6, "gcm2": 1e-7, "gmm2": 1e-9, "Nms2": 1.0,
        "kgfcms2": 1e-2 * _GRAVITY, "ozin2": _POUND / 16.0 * _INCH**2, "ozins2": _LB_IN / 16.0,
        "lbin2": _POUND * _INCH**2, "lbins2": _LB_IN, "lbft2": _POUND * (12.0 * _INCH) ** 2, "lbfts2": 12.0 * _LB_IN,
    },
    "N*m/A": _per(_TORQUE, _CURRENT) | {"Vs": 1.0, "Vs/rad": 1.0, "V/rad/s": 1.0},
    "V/krpm": _per(_VOLTAGE, _KRPM) | {"mVmin": 1.0, "Vs": 1e3 * RPM, "Vs/rad": 1e3 * RPM},
    "rpm/V": _per(_SPEED, _VOLTAGE) | {"KV": 1.0, "rad/Vs": 1.0 / RPM},
    "A": _CURRENT,
    "rpm": _SPEED,
    "V": _VOLTAGE | {"VDC": 1.0, "VAC": 2.0**0.5},  # a DC link on mains has the peak of their voltage
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": RPM / 6.0},
    "N*m*s/rad": _per(_TORQUE, {name: factor * RPM for name, factor in _SPEED.items()}) | {"Nms/rad": 1.0, "Nms": 1.0},
    "1": {"%": 1e-2},
}  # fmt: skip
COUNTED = {
    "pole_pairs": {"polepairs": 1.0, "poles": 0.5},
    "encoder_counts": {"counts": 1.0, "lines": 4.0, "bit": 1.0},  # of bits the value is raised before
    "full_steps": {"steps": 1.0},
}
_SUFFIX = re.compile("_(ohm|h|a|v|s|rad|rpm|nm|nm_s|kg_m2|v_per_krpm|rpm_per_v)$")
SHORT = {_SUFFIX.sub("", key): key for key in NUMBERS}  # names without the unit, which then comes with the value
_FORMS = {"rms": ("rms", "eff"), "peak": ("peak", "pk")}
_FORM = re.compile("(?<=[AV])(rms|eff|peak|pk)")
_PLAIN = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻\u2212\u03bc\u00b5\u2019\u00d7", "0123456789--uu'x")
_VALUE = re.compile(r"([-+]?\d[\d.,]*(?:e[-+]?\d+)?)\s*(?:[x·*]\s*10\^?([-+]?\d+))?\s*(\D.*)?")
_TOLERANCE = re.compile(r"(?:±|\+/-)\s*[\d.,]+\s*%")


def read_number(name: str, text: str) -> tuple[str, float]:
    """Return the name and value in a motor's file of a number as printed in a data sheet.

    Args:
        name: The number's name in a file, `inertia_kg_m2`, for which the value's unit is optional; or without the unit,
            `inertia`. If the unit has RMS or peak (`9 Arms`) the name need not: `rated_current`.
        text: Value and unit. A comma is a decimal point.

    Raises:
        ValueError: For an unknown name or unit, listing the known ones, or a value that is not a number.
    """
    plain = text.strip().removeprefix("DC ").translate(_PLAIN)
    plain = re.sub("[\u03a9\u2126]", "ohm", plain).replace("°", "deg")
    plain = _TOLERANCE.sub("", plain).strip()
    plain = re.sub(r"(?<=\d)[ \u2009\u202f'](?=\d{3}(?!\d))", "", plain)  # groups of thousands
    match = _VALUE.fullmatch(plain)
    if match is None:
        raise ValueError(f"{name} = {text!r} is not a number; write it as 4.8e-6, or with its unit as 48 gcm2")
    digits, power, printed = match[1], match[2] or "0", re.sub(r"[\s.·⋅∙*^()\[\]-]", "", match[3] or "")
    unit = _FORM.sub("", printed)
    key = _key(name.strip().replace(" ", "_"), "".join(_FORM.findall(printed)))
    value = _decimal(name, digits) * 10.0 ** int(power)
    if key == "encoder_counts" and unit.casefold() == "bit":
        value = 2.0 ** min(value, 64.0)
    if not unit:
        if NUMBERS[key].unit and name != key:
            raise ValueError(f"{name} = {text!r} has no unit; {_understood(key)}; {key} is in {NUMBERS[key].unit}")
    elif key == "full_steps" and unit == "deg":
        value = 360.0 / value
    else:
        value = float(f"{value * _factor(key, unit, text):.12g}")  # not 2.9999999999999997e-05
    return key, round(value) if key in WHOLE and abs(value - round(value)) < 1e-9 * abs(value) else value


def _key(name: str, form: str) -> str:
    """Return the file's name for a name without unit, RMS or peak, which are in the value's unit."""
    forms = [kind for kind, spelled in _FORMS.items() if form in spelled]
    known = NUMBERS.keys() | SHORT.keys()
    fitting = [key for short, key in SHORT.items() if _is_form_of(short, name)]
    if forms:
        fitting = [key for key in fitting if forms[0] in key.split("_")]
        if len(fitting) == 1:
            return fitting[0]
        raise ValueError(f"{name}: the unit says {forms[0]}, the name does not")
    if name in known:
        return SHORT.get(name, name)
    if fitting:
        raise ValueError(f"{name}: say which, {' or '.join(fitting)}")
    raise ValueError(f"{name!r} is not a number of a motor{did_you_mean(name, known)}; --list shows them")


def _is_form_of(short: str, name: str) -> bool:
    """Return whether a number is one of a name's forms: rated_current_rms of rated_current, and of itself."""
    return SHORT[short] == name or short == name or short.startswith(f"{name}_")


def _decimal(name: str, digits: str) -> float:
    """Return a number with a decimal point or comma; one that could be a group of thousands is an error."""
    if re.fullmatch(r"[-+]?[1-9]\d{0,2},\d{3}", digits):
        raise ValueError(f"{name} = {digits}: is the comma a decimal point? write {digits.replace(',', '')} or "
                         f"{digits.replace(',', '.')}")  # fmt: skip
    try:
        return float(digits.replace(",", "."))
    except ValueError:
        raise ValueError(f"{name} = {digits!r} is not a number; write it as 4.8e-6") from None


def _factor(key: str, unit: str, text: str) -> float:
    """Return the unit's factor; case does not matter, except for M, which is not milli."""
    known = COUNTED.get(key) or UNITS.get(NUMBERS[key].unit, {})
    folded = {name.casefold(): factor for name, factor in known.items()}
    if unit in known:
        return known[unit]
    if unit.casefold() in folded and not unit.startswith("M"):
        return folded[unit.casefold()]
    raise ValueError(f"{key} = {text!r}: unknown unit{did_you_mean(unit, known)}; {_understood(key)}")


def _understood(key: str) -> str:
    known = COUNTED.get(key) or UNITS.get(NUMBERS[key].unit, {})
    return f"understood are {', '.join(known)}" if known else "it has none"
