"""Quantities as people write them, and the integers that a drive has instead: every unit, and what is none."""

from __future__ import annotations

import math

import numpy as np
import pytest
from rigs.held_objects import HeldObjects
from rigs.tables import every_row

from drive_env.dictionary.entries import Entry
from drive_env.dictionary.quantities import (
    UNITS,
    AxisScale,
    find_unit,
    follows_scale,
    in_unit,
    integers,
    is_quantity,
    parse,
    parse_raw,
    scales_of,
    show,
)
from drive_env.dictionary.roles import Role

TURN = 1000.0  # increments


def entry(unit, low=-(2**31), high=2**31 - 1):
    return Entry(0x6081, 0, "a quantity", 32, "rw", low, high, 0, unit, True, True)


@every_row(
    ("unit", "dimension", "value"),
    [
        ("rev", "angle", 1.0), ("deg", "angle", 1 / 360), ("rad", "angle", 1 / (2 * math.pi)),
        ("1/65536 rev", "angle", 1 / 65536), ("rev/s", "speed", 1.0), ("rpm", "speed", 1 / 60),
        ("rad/s", "speed", 1 / (2 * math.pi)), ("deg/s", "speed", 1 / 360), ("rev/s^2", "acceleration", 1.0),
        ("rpm/s", "acceleration", 1 / 60), ("rad/s^2", "acceleration", 1 / (2 * math.pi)), ("A", "current", 1.0),
        ("mA", "current", 0.001), ("V", "voltage", 1.0), ("0.1V", "voltage", 0.1), ("s", "time", 1.0),
        ("ms", "time", 0.001), ("10ms", "time", 0.01), ("100us", "time", 0.0001), ("us", "time", 1e-6),
        ("512 clocks", "time", 32e-6),  # of 16 MHz
        ("1/2^32 rev", "angle", 2**-32),
    ],
)  # fmt: skip
def test_every_unit_is_so_much_of_its_dimensions_own(unit, dimension, value):
    found = find_unit(unit, None)
    assert found.dimension == dimension and found.factor == pytest.approx(value, rel=1e-15)
    assert UNITS[unit] == find_unit(unit, TURN)


def test_increments_follow_the_scale_and_are_no_unit_where_it_is_not_known():
    for name, dimension in (("inc", "angle"), ("pps", "speed"), ("pps^2", "acceleration")):
        assert find_unit(name, TURN) == (dimension, 1 / TURN)
        assert find_unit(name, None) is None and find_unit(name, 0.0) is None
    assert find_unit("furlong", TURN) is None and find_unit("10 furlong", TURN) is None


def test_a_multiple_of_a_unit_is_one():
    assert find_unit("10 rpm", None) == ("speed", pytest.approx(10 / 60))
    assert find_unit("10 pps", TURN) == ("speed", pytest.approx(10 / TURN))


@every_row(
    ("text", "unit", "raw"),
    [
        ("17", "pps", 17), ("-17", "pps", -17), ("0x10", "pps", 16), ("0b101", "pps", 5), (" 5 ", "pps", 5),
        ("1e3", "pps", 1000), ("17 pps", "pps", 17), ("17.0 pps", "pps", 17), (".5e1 pps", "pps", 5),
        ("0.5 rev/s", "pps", 500), ("+30 rpm", "pps", 500), ("-360 deg/s", "pps", -1000), ("60rpm", "pps", 1000),
        ("0.0004 rev/s", "pps", 0), ("0.0016 rev/s", "pps", 2), ("0.25 A", "mA", 250), ("250 mA", "A", None),
        ("24 V", "0.1V", 240), ("20 ms", "s", 0), ("2 s", "10ms", 200), ("7", "", 7), ("7.0", "", 7),
    ],
)  # fmt: skip
def test_what_is_written_becomes_the_drives_integer(text, unit, raw):
    assert parse(text, entry(unit), TURN) == (0 if raw is None else raw)


@pytest.mark.parametrize(
    ("text", "unit", "increments", "message"),
    [
        ("fast", "pps", TURN, "'fast' is not a number for 6081h:00 a quantity; give an integer, or a number and a"),
        ("", "pps", TURN, "'' is not a number"),
        ("0x", "pps", TURN, "0 is not a quantity in 'x'|is not a quantity in 'x'"),
        ("1.5", "pps", TURN, "takes integers in pps; 1.5 is not one, choose 2"),
        ("1.5", "", TURN, "takes integers; 1.5 is not one, choose 2"),
        ("1e999", "pps", TURN, "'1e999' is beyond any number; .* takes -2147483648 to 2147483647 in pps"),
        ("1e308 rev/s", "pps", TURN, "'1e308 rev/s' is beyond any number"),
        ("3 A", "pps", TURN, "is not a quantity in 'A'; it takes pps, rev/s, rpm, rad/s, deg/s$"),
        ("3 rpm", "mA", TURN, "is not a quantity in 'rpm'; it takes mA"),
        ("3 rpm", "", TURN, "has no unit that rpm could be turned into; give its integer"),
        ("3 rpm", "pps", None, "has no unit that rpm could be turned into"),
        ("3 knots", "pps", TURN, "is not a quantity in 'knots'"),
    ],
)
def test_what_is_no_quantity_is_told(text, unit, increments, message):
    with pytest.raises(ValueError, match=message):
        parse(text, entry(unit), increments)


@pytest.mark.parametrize(("value", "found"), [
    ("3 rpm", True), ("3rpm", True), ("-0.5 rev", True), ("3", False), ("3.5", False), ("0x10", False),
    (" 0X10 ", False), ("0b1", False), ("0o7", False), ("fast", False), ("", False), (3, False), (None, False),
])  # fmt: skip
def test_whether_a_text_is_a_number_and_a_unit(value, found):
    assert is_quantity(value) is found


def test_each_axis_has_its_own_scale_and_the_others_none():
    scale = [TURN, None, 2 * TURN]
    where = np.array([True, False, True])
    assert integers("0.5 rev/s", entry("pps"), scale, where).tolist() == [500, 0, 1000]
    with pytest.raises(ValueError, match="has no unit"):
        integers("0.5 rev/s", entry("pps"), scale)
    with pytest.raises(
        ValueError, match=r"'1e30 rev/s' is beyond any number; .* takes -2147483648 to 2147483647 in pps"
    ):
        integers("1e30 rev/s", entry("pps"), [TURN])


def test_integers_in_a_unit():
    raw = np.array([[500, 500], [1000, -1000]])
    np.testing.assert_allclose(in_unit(raw, entry("pps"), "rpm", [TURN, 2 * TURN]), [[30, 15], [60, -30]])
    found = in_unit(raw, entry("pps"), "".join(("p", "ps")), [None, None])  # as it is read from somewhere
    assert found.dtype == float and found.tolist() == raw.tolist()


def test_an_integer_by_itself():
    assert parse_raw("0x3E8", entry("pps")) == 1000
    with pytest.raises(ValueError, match="'1 rpm' is not an integer for 6081h:00 a quantity; --raw takes integers"):
        parse_raw("1 rpm", entry("pps"))


@pytest.mark.parametrize(("raw", "unit", "increments", "text"), [
    (500, "pps", TURN, "500 pps (30 rpm)"), (500, "inc", TURN, "500 inc (0.5 rev)"), (-7, "A", TURN, "-7 A"),
    (1500, "mA", TURN, "1500 mA (1.5 A)"), (500, "pps", None, "500 pps"), (5, "", TURN, "5"),
    (240, "0.1V", TURN, "240 0.1V (24 V)"), (1, "rpm", TURN, "1 rpm"), (500, "pps^2", TURN, "500 pps^2 (0.5 rev/s^2)"),
])  # fmt: skip
def test_an_integer_is_shown_with_its_unit_and_as_people_say_it(raw, unit, increments, text):
    assert show(raw, entry(unit), increments) == text


# Numerator 3 over divisor 1000 (6094h): a velocity unit is 0.003 rpm. M-Ipeak is 8 A, M-Inull 2 A.
OF_ITS_OWN = AxisScale(TURN, 3 / 1000, 8.0, 2.0)


@pytest.mark.parametrize(("text", "unit", "raw"), [
    ("30 rpm", "velocity unit", 10_000), ("0.5 rev/s", "velocity unit", 10_000), ("-3 rpm", "velocity unit", -1000),
    ("600 rpm/s", "velocity unit/s", 200_000), ("1 rev/s^2", "velocity unit/s", 20_000),
    ("8 A", "1/32767 M-Ipeak", 32_767), ("-2 A", "1/32767 M-Ipeak", -8192),
    ("-1 A", "1/1000 of M-Inull", -500), ("3 A", "1/1000 M-Inull", 1500), ("17", "velocity unit", 17),
])  # fmt: skip
def test_a_velocity_unit_and_a_part_of_the_peak_current_follow_their_own_scales(text, unit, raw):
    assert parse(text, entry(unit), OF_ITS_OWN) == raw
    if " " in text:
        with pytest.raises(ValueError, match=r"has no unit that .* could be turned into"):
            parse(text, entry(unit), TURN)


def test_a_target_of_vl_follows_both_of_its_factors():
    """604Ch: a velocity unit is 60 rpm; 604Bh: a target counts tenths of it."""
    scale = AxisScale(TURN, 60.0, set_point=0.1)
    assert (
        parse("300 rpm", entry("set-point unit"), scale) == 50 and parse("300 rpm", entry("velocity unit"), scale) == 5
    )
    for unknown in (AxisScale(TURN, 60.0), AxisScale(TURN, set_point=0.1), TURN):
        with pytest.raises(ValueError, match="has no unit that rpm could be turned into"):
            parse("300 rpm", entry("set-point unit"), unknown)


def test_what_has_a_scale_of_its_own_is_shown_with_it():
    assert show(10_000, entry("velocity unit"), OF_ITS_OWN) == "10000 velocity unit (30 rpm)"
    assert show(20_000, entry("velocity unit/s"), OF_ITS_OWN) == "20000 velocity unit/s (1 rev/s^2)"
    assert show(32_767, entry("1/32767 M-Ipeak"), OF_ITS_OWN) == "32767 1/32767 M-Ipeak (8 A)"
    assert show(int.from_bytes(b"TGZ-", "little"), entry("chars"), OF_ITS_OWN) == "760891220 chars ('TGZ-')"
    assert show(0, entry("chars"), OF_ITS_OWN) == "0 chars ('')"


def test_four_characters_are_written_as_a_text():
    for text, found in (("AM30", b"AM30"), ("2a", b"2a  "), ("'12'", b"12  "), ("''", b"    "), ("0x2041", b"A \0\0")):
        assert parse(text, entry("chars"), OF_ITS_OWN).to_bytes(4, "little") == found
    for text in ("AM3041", "\u03a9"):
        with pytest.raises(ValueError, match=r"not a text of up to four Latin-1 characters .* next register"):
            parse(text, entry("chars"), OF_ITS_OWN)


@pytest.mark.parametrize(("values", "roles", "expected"), [
    ({}, {}, [None, None]), ({(0x608F, 1): (4096, 0)}, {}, [4096.0, None]),
    ({(0x2058, 0): (65536, 1)}, {Role.POSITION_SCALE: (0x2058, 0)}, [65536.0, 1.0]),
    (
        {(0x6094, 1): (1, 7), (0x6094, 2): (1000, 2), (0x2107, 0): (4000, 8000), (0x2106, 0): (1000, 3000)},
        {
            Role.VELOCITY_NUMERATOR: (0x6094, 1), Role.VELOCITY_DIVISOR: (0x6094, 2), Role.PEAK_CURRENT: (0x2107, 0),
            Role.NOMINAL_CURRENT: (0x2106, 0),
        },
        [(None, 0.001, 4.0, 1.0, None), (None, 3.5, 8.0, 3.0, None)],
    ),
])  # fmt: skip
def test_units_follow_what_the_drive_says_of_each_axis(values, roles, expected):
    drives = HeldObjects(values, 2)
    drives.description.dictionary.roles.update(roles)
    drives.read = lambda name: np.array(drives.values[roles.get(name, name)])
    assert scales_of(drives, drives.description.dictionary) == expected


@pytest.mark.parametrize(("unit", "follows"), [
    ("inc", True), ("pps", True), ("pps^2", True), ("velocity unit", True), ("velocity unit/s", True),
    ("1/32767 M-Ipeak", True), ("1/1000 of M-Inull", True), ("10 pps", True), ("rpm", False), ("mA", False),
    ("", False), ("0.1 rpm", False),
])  # fmt: skip
def test_which_units_follow_a_scale_that_the_drive_is_asked_for(unit, follows):
    assert follows_scale(unit) is follows
