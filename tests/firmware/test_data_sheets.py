"""Data sheets typed as they are printed, against figures by hand; units, contradictions, texts that are no quantity."""

from __future__ import annotations

import math
import re

import pytest
from rigs.tables import every_row
from typer.testing import CliRunner

from drive_env.commands.cli import app
from drive_env.motors import MOTORS, NUMBERS, load_motor
from drive_env.motors.data_sheet import UNITS, read_number
from drive_env.motors.plausibility import CHECKS, doubts

# Motor, kind, numbers as its sheet prints them, what the sheet lacks (chosen here), and by hand: R and L_q of a phase,
# torque per ampere of peak i_q, inertia, pole pairs. sqrt(3)/2 = 0.8660254, sqrt(2) = 1.4142136, 30/pi = 9.5492966.
SHEETS = {
    # maxon catalogue, page of the EC 45 flat of 43.5 mm, column of 24 V: 0.573/2, 0.301/2, 0.0404 * 0.8660254.
    "maxon EC 45 flat, 70 W": ("pmsm", {
        "resistance_line_to_line": "0.573 Ω", "inductance_line_to_line": "0.301 mH",
        "torque_constant_line_to_line": "40.4 mNm/A", "inertia": "181 gcm²", "rated_torque": "134 mNm",
        "rated_current_peak": "3.29 A", "rated_speed": "4750 rpm", "voltage": "24 V"},
        {"pole_pairs": "8", "encoder_counts": "1024 lines"}, (0.2865, 1.505e-4, 0.03498743, 1.81e-5, 8)),
    # The same family by its speed constant, part 339285 in public code: 9.5492966/380 * 0.8660254.
    "maxon EC 45 flat, 50 W": ("pmsm", {
        "resistance_line_to_line": "0.464 Ohm", "inductance_line_to_line": "0,322 mH", "speed_constant": "380 rpm/V",
        "inertia": "135 g·cm²"},
        {"pole_pairs": "16 poles", "encoder_counts": "4096", "rated_torque": "84 mNm", "rated_speed": "5000 rpm",
         "voltage": "18 V"}, (0.232, 1.61e-4, 0.02176297, 1.35e-5, 8)),
    # Faulhaber, manual of the 2232 BX4 with IE3, column of 24 V, speed of its rated torque: 0.0314 * 0.8660254.
    "Faulhaber 2232 024 BX4": ("pmsm", {
        "resistance_line_to_line": "12.4 Ω", "inductance_line_to_line": "440 µH",
        "torque_constant_line_to_line": "31.40 mNm/A", "inertia": "5.2 gcm²", "rated_torque": "13 mNm",
        "rated_current_peak": "0.50 A", "rated_speed": "5 000 rpm", "voltage": "24 V", "pole_pairs": "2"},
        {"encoder_counts": "256 lines"}, (6.2, 2.2e-4, 0.02719320, 5.2e-7, 2)),
    # Beckhoff AM8122-0FH1: name plate (object 9009h) in public configurations, torque of the AM8000's manual; its
    # torque constant is per ampere RMS, the winding's data between two terminals: 0.2/1.4142136.
    "Beckhoff AM8122": ("pmsm", {
        "resistance_line_to_line": "1500 mOhm", "inductance_line_to_line": "3.3 mH", "torque_constant_rms": "200 mNm/A",
        "rated_current": "4650 mA rms", "rated_torque": "0.80 Nm", "inertia": "330 g cm^2", "pole_pairs": "3"},
        {"voltage": "48 V", "rated_speed": "2000 min⁻¹", "encoder_counts": "8192"},
        (0.75, 1.65e-3, 0.1414214, 3.3e-5, 3)),
    # Heidenhain, SRP 5000, chapter 11.2: 20 poles; 0.668/1.4142136. Its motor constant of 0.181 N m/sqrt(W) is
    # 0.668/sqrt(1.5 * 9.06), so that the resistance is between two terminals.
    "Heidenhain SRP 5000": ("pmsm", {
        "resistance_line_to_line": "9.06 Ω", "inductance_line_to_line": "2.42 mH", "torque_constant": "0.668 Nm/Arms",
        "rated_current": "0.688 Arms", "rated_torque": "0.385 Nm", "rated_speed": "300 rpm", "voltage": "DC 48 V",
        "pole_pairs": "20 poles"},
        {"inertia": "1 kgcm2", "encoder_counts": "8192"}, (4.53, 1.21e-3, 0.4723473, 1e-4, 10)),
    # Teknic M-2310P-LN-04K, public motor files: 1.5 * 4.64/(1.7320508 * 104.71976); 0.001 oz-in-s^2 is 7.0615518e-6.
    "Teknic M-2310P": ("pmsm", {
        "resistance_line_to_line": "0.72 ohms", "inductance_line_to_line": "0.40 mH", "back_emf": "4.64 Vpeak/krpm",
        "inertia": "0.001 oz-in-s^2", "rated_torque": "38.6 oz-in", "rated_speed": "6000 RPM", "voltage": "40 VDC",
        "pole_pairs": "4", "encoder_counts": "1000 lines", "viscous": "0.0391 oz-in/krpm"},
        {}, (0.36, 2e-4, 0.03837249, 7.0615518e-6, 4)),
    # EMRAX 228 MV, data sheet 5.4 in public code: L_d and L_q; 0.61/1.4142136.
    "EMRAX 228 MV": ("pmsm", {
        "resistance_phase": "7 mΩ", "inductance_d_phase": "76 µH", "inductance_q_phase": "79 µH",
        "torque_constant": "0.61 Nm/A rms", "inertia": "0.0383 kg·m²", "rated_torque": "112 Nm",
        "rated_speed": "6500 RPM", "voltage": "520 V", "pole_pairs": "10"},
        {"encoder_counts": "4096"}, (0.007, 7.9e-5, 0.4313352, 0.0383, 10)),
    # T-Motor U8 V2, KV 150, in public code from the maker's page: 9.5492966/150 * 0.8660254.
    "T-Motor U8 KV150": ("pmsm", {
        "resistance_line_to_line": "86 mΩ", "inductance_line_to_line": "40 uH", "speed_constant": "150 KV",
        "pole_pairs": "42 poles"},
        {"inertia": "1.5 kgcm2", "rated_torque": "1 N·m", "rated_speed": "3 krpm", "voltage": "36 V",
         "encoder_counts": "8192"}, (0.043, 2e-5, 0.05513289, 1.5e-4, 21)),
    # maxon RE 65, part 353297, 48 V.
    "maxon RE 65": ("dc", {
        "resistance": "0.365 Ω ±10 %", "inductance": "0.161 mH", "torque_constant": "123 mNm/A", "inertia": "1340 gcm²",
        "rated_torque": "800 mNm", "rated_current_peak": "6.8 A", "rated_speed": "3420 rpm", "voltage": "48 V"},
        {"encoder_counts": "500 lines"}, (0.365, 1.61e-4, 0.123, 1.34e-4, 1)),
    # Trinamic QSH5718-51-28-101, manual of 2023, table 2.1: 1.01/(2.8 * 1.4142136 * 0.95), 5 % lost to saturation.
    "Trinamic QSH5718-51": ("stepper", {
        "resistance_phase": "0.83 Ω", "inductance_phase": "2.2 mH", "full_steps": "1.8°", "holding_torque": "101 Ncm",
        "detent_torque": "0,035 Nm", "rated_current": "2.8 A rms", "inertia": "275\u00d710⁻⁷ kg·m²"},
        {"voltage": "30 V"}, (0.83, 2.2e-3, 0.2684879, 2.75e-5, 50)),
}  # fmt: skip


def new(file, kind, numbers, *words):
    options = [word for name, value in numbers.items() for word in ("-n", f"{name}={value}")]
    return CliRunner().invoke(app, ["motor", "new", str(file), "--kind", kind, "--source", "sheet", *options, *words])


@every_row(("sheet",), [(name,) for name in SHEETS])
def test_a_data_sheet_typed_as_printed_is_the_motor_that_one_computes_by_hand(sheet, tmp_path_factory):
    kind, numbers, chosen, expected = SHEETS[sheet]
    file = tmp_path_factory.mktemp("sheet") / "own.toml"
    done = new(file, kind, numbers | chosen)
    assert done.exit_code == 0, done.output
    motor = load_motor(file)
    assert (motor.R_s, motor.L_q, motor.torque_constant, motor.inertia, motor.n_p) == pytest.approx(expected, rel=1e-6)
    for name, printed in numbers.items():
        assert printed.isdigit() or f": {printed}\n" in file.read_text(), name


def test_a_kind_that_there_is_not_is_named_before_numbers_are_asked_for(tmp_path):
    found = new(tmp_path / "own.toml", "bldc", {})
    assert found.exit_code == 2 and "kind is 'bldc'; it is one of 'pmsm' (brushless)" in found.output


def test_an_absolute_encoder_has_bits():
    assert read_number("encoder_counts", "20 bit") == ("encoder_counts", 2**20)
    assert read_number("encoder_counts", "17-Bit") == ("encoder_counts", 131_072)


def test_l_d_and_l_q_are_two_inductances(tmp_path):
    kind, numbers, chosen, _ = SHEETS["EMRAX 228 MV"]
    assert "0.007 ohm, 0.076 and 0.079 mH" in new(tmp_path / "own.toml", kind, numbers | chosen).output
    assert load_motor(tmp_path / "own.toml").L_d == pytest.approx(7.6e-5)
    lone = {name: value for name, value in numbers.items() if name != "inductance_q_phase"}
    assert "inductance_q_phase_h is missing" in new(tmp_path / "lone.toml", kind, lone | chosen).output
    both = numbers | chosen | {"inductance_phase": "76 uH"}
    assert "two forms of the same number" in new(tmp_path / "both.toml", kind, both).output


def test_a_sheets_three_constants_are_the_same_motor(tmp_path):
    """Faulhaber prints torque constant, back-EMF and speed constant of the 2232 024 BX4, each to three digits."""
    kind, numbers, chosen, expected = SHEETS["Faulhaber 2232 024 BX4"]
    rest = {name: text for name, text in (numbers | chosen).items() if name != "torque_constant_line_to_line"}
    for number, (name, printed) in enumerate((("back_emf_line_peak", "3.288 mV/rpm"), ("speed_constant", "304 rpm/V"))):
        file = tmp_path / f"own{number}.toml"
        assert new(file, kind, rest | {name: printed}).exit_code == 0
        assert load_motor(file).torque_constant == pytest.approx(expected[2], rel=1e-3)


# Units a kg m^2, as public converters have them.
@every_row(
    ("unit", "per_si"),
    [
        ("kg-cm^2", 1e4), ("g-cm^2", 1e7), ("g-mm^2", 1e9), ("kgf-cm-s^2", 10.19716213), ("oz-in^2", 54674.74983),
        ("oz-in-s^2", 141.6119312), ("lb-ft^2", 23.730360404), ("lb-ft-s^2", 0.737562142), ("lb-in^2", 3417.171898209),
        ("lb-in-s2", 8.850745703),
    ],
)  # fmt: skip
def test_units_of_inertia(unit, per_si):
    assert read_number("inertia", f"{per_si} {unit}") == ("inertia_kg_m2", pytest.approx(1.0, rel=1e-7))


@every_row(
    ("name", "printed", "key", "value"),
    [
        ("rated_torque", "1.5 kgf·cm", "rated_torque_nm", 0.1470998),
        ("rated_torque", "2 lb-in", "rated_torque_nm", 0.2259697),
        ("torque_constant_rms", "8.5 oz-in/A", "torque_constant_rms", 0.06002319),
        ("back_emf_line_rms", "25.5 mVmin", "back_emf_line_rms_v_per_krpm", 25.5),
        ("back_emf", "0.397 Vrms/(rad/s)", "back_emf_line_rms_v_per_krpm", 41.57374),
        ("back_emf", "39 Veff/1000 min-1", "back_emf_line_rms_v_per_krpm", 39.0),
        ("speed_constant", "11 rad/(V·s)", "speed_constant_rpm_per_v", 105.0423),
        ("rated_current", "3 Apk", "rated_current_peak_a", 3.0),
        ("rated_speed", "3000 1/min", "rated_speed_rpm", 3000.0),
        ("voltage", "400 V AC", "voltage_v", 565.6854),
        ("thermal_time", "20 min", "thermal_time_s", 1200.0),
        ("commutation_offset", "2°", "commutation_offset_rad", 0.03490659),
        ("torque_saturation", "5 %", "torque_saturation", 0.05),
        ("inertia_kg_m2", "4.8e-6", "inertia_kg_m2", 4.8e-6),
        ("rated_speed", "10'700 rpm", "rated_speed_rpm", 10700.0),
        ("resistance phase", "1.2 kOhm", "resistance_phase_ohm", 1200.0),
    ],
)  # fmt: skip
def test_a_number_as_printed(name, printed, key, value):
    assert read_number(name, printed) == (key, pytest.approx(value, rel=1e-6))


def test_every_unit_of_a_file_is_its_own():
    for key, row in NUMBERS.items():
        if row.unit not in ("", "1"):
            assert read_number(key, f"2.5 {row.unit}") == (key, 2.5)
    assert {row.unit for row in NUMBERS.values()} - {""} == set(UNITS)


@every_row(
    ("name", "printed", "message"),
    [
        ("inertia", "44", r"inertia = '44' has no unit; understood are kgm2, .*gcm2.*; inertia_kg_m2 is in kg\*m\^2"),
        ("inertia", "44 gcm", r"unknown unit; did you mean 'gcm2'.*; understood are kgm2"),
        ("resistance_phase", "2 MOhm", "unknown unit"),
        ("rated_speed", "10,700 rpm", r"is the comma a decimal point\? write 10700 or 10.700"),
        ("rated_torque", "1.234,5 Nm", "is not a number"),
        ("rated_torque", "much", "is not a number; write it as 4.8e-6, or with its unit"),
        ("rated_current", "9 A", "rated_current: say which, rated_current_peak_a or rated_current_rms_a"),
        ("rated_current_peak", "9 Arms", "the unit says rms, the name does not"),
        ("encoder_counts", "1024 ppr", "unknown unit.*; understood are counts, lines"),
        ("hall_polarity", "1 V", "it has none"),
        ("inertai", "44 gcm2", "'inertai' is not a number of a motor; did you mean 'inertia'"),
    ],
)
def test_what_is_typed_wrongly_is_told_with_what_is_understood(name, printed, message):
    with pytest.raises(ValueError, match=message):
        read_number(name, printed)


# A motor of 0.207 N m and 91 mNm/A.
SMALL = {"resistance_line_to_line": "0.72 ohm", "inductance_line_to_line": "1.13 mH", "torque_constant_rms": "91 mNm/A",
         "rated_current": "2.3 Arms", "rated_torque": "0.207 Nm", "rated_speed": "3000 rpm", "voltage": "48 V",
         "inertia": "44 gcm2", "pole_pairs": "4", "encoder_counts": "4096"}  # fmt: skip


@every_row(
    ("change", "message"),
    [
        ({}, None),
        ({"rated_current": "9 Arms"}, "over the rated torque of 0.207 N.m is 3.96, .*RMS or peak"),
        (
            {"rated_speed": "9000 rpm"},
            "rated speed 9000 rpm over the 6169 rpm that 48 V give without load is 1.46.*voltage_v",
        ),
        ({"rated_speed": "3000 rad/s"}, "rated speed 28648 rpm"),
        ({"inertia": "44 kg·m²"}, "mechanical time constant .*the inertia in gcm2 or kgcm2"),
        ({"inductance_line_to_line": "1.13 H"}, "electrical time constant .*the inductance in mH or uH"),
        ({"inductance_line_to_line": "1.13 uH"}, "electrical time constant"),
        ({"resistance_line_to_line": "720 ohm"}, "electrical time constant .*the resistance in ohm or mohm"),
        ({"pole_pairs": "100"}, "electrical frequency without load is 1.03e.04 Hz.*pole pairs, not poles"),
        ({"torque_constant_rms": "91 Nm/A"}, "over the rated torque"),
    ],
)
def test_numbers_that_contradict_each_other_are_refused_with_what_is_likely_wrong(change, message, tmp_path_factory):
    file = tmp_path_factory.mktemp("small") / "own.toml"
    done = new(file, "pmsm", SMALL | change)
    if message is None:
        assert done.exit_code == 0, done.output
        return
    assert done.exit_code == 2, done.output
    assert re.search(message, done.output), done.output
    assert "nothing was written (--unchecked keeps numbers that are right)" in done.output
    assert not file.exists()
    assert new(file, "pmsm", SMALL | change, "--unchecked").exit_code == 0
    assert doubts(load_motor(file))


def test_at_a_terminal_contradictions_are_asked_about(tmp_path, monkeypatch):
    monkeypatch.setattr("drive_env.commands.motor._is_answered", lambda: True)
    numbers = [word for name, text in SMALL.items() for word in ("-n", f"{name}={text}")]
    words = ["motor", "new", str(tmp_path / "own.toml"), "--kind", "pmsm", "--source", "s", *numbers]
    words += ["-n", "rated_current=9 Arms"]
    assert CliRunner().invoke(app, words, input="n\n").exit_code == 2
    assert not (tmp_path / "own.toml").exists()
    done = CliRunner().invoke(app, words, input="y\n")
    assert done.exit_code == 0, done.output
    assert load_motor(tmp_path / "own.toml").rated_current == pytest.approx(9.0 * math.sqrt(2.0))


def test_no_motor_of_the_catalogue_is_doubted_and_each_bound_is_within_a_factor_of_what_its_source_tells():
    assert {name: doubts(motor) for name, motor in MOTORS.items() if doubts(motor)} == {}
    for check in CHECKS:
        least, most = (float(figure) for figure in re.findall(r"([\d.]+)(?: ms| Hz)? \(", check.source))
        assert check.low <= least <= check.low * 8.0 and most <= check.high <= most * 30.0, check.meaning
