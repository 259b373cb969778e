"""Access to the object dictionary: names, types, ranges, states; what is refused changes nothing; units; resets."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.tables import every_row

from drive_env import EmulatedDrives, ObjectAccessError, motion
from drive_env.devices import find_device
from drive_env.dictionary import codec, units
from drive_env.emulator import prepared_record
from drive_env.motors import find_motor

# Abort codes of CiA 301.
READ_ONLY, NO_OBJECT, WRONG_TYPE, NO_SUB = 0x06010002, 0x06020000, 0x06070010, 0x06090011
BAD_VALUE, TOO_HIGH, TOO_LOW, NOT_NOW, NOT_STORED = 0x06090030, 0x06090031, 0x06090032, 0x08000022, 0x08000020

DEVICE = find_device("tmcm1636")
DICTIONARY = DEVICE.new_dictionary()
ENTRIES = list(DICTIONARY)


@pytest.fixture(scope="module")
def shared():
    with EmulatedDrives(load="inertia", num_machines=3, num_threads=1) as made:
        yield made


@pytest.fixture
def drives(shared):
    """Three commissioned drives in switch on disabled."""
    shared.machine.reset()
    return shared


def everything(drives):
    """Return every object of every axis."""
    return {(e.index, e.sub): drives.read((e.index, e.sub)).tolist() for e in ENTRIES}


def state(drives):
    """Return everything that the drives are, to the last bit."""
    return everything(drives), drives.inside.records.tobytes()


def refusal(drives, name, value, **how):
    """Return the error of a write that must be refused and change nothing."""
    before = state(drives)
    with pytest.raises(ObjectAccessError) as refused:
        drives.write(name, value, **how)
    assert state(drives) == before
    return refused.value


# --- what is refused --------------------------------------------------------------------------------------------------
@pytest.mark.every(7)
@pytest.mark.parametrize(
    ("name", "value", "code", "words"),
    [
        (0x9999, 1, NO_OBJECT, ["9999h"]),
        (0x6044, 1, NO_OBJECT, ["6044h"]),  # vl mode: this drive has none
        ((0x2042, 9), 1, NO_SUB, ["2042h", "9", "4"]),
        ((0x6081, 1), 1, NO_SUB, ["6081h", "1"]),
        (0x6041, 1, READ_ONLY, ["6041h:00 Statusword"]),
        (0x6064, 0, READ_ONLY, ["6064h:00 Position actual value"]),
        (0x1008, "x", READ_ONLY, ["1008h"]),
        ((0x2042, 0), 5, READ_ONLY, ["2042h:00"]),
        (0x2003, 45_001, TOO_HIGH, ["2003h:00 Maximum Current", "45001", "45000"]),
        (0x2003, -1, TOO_LOW, ["2003h:00", "-1", "0"]),
        ((0x2042, 1), 65_536, TOO_HIGH, ["2042h:01 Velocity Mode Settings.P_Parameter", "65536", "65535"]),
        (0x6071, 32_768, TOO_HIGH, ["6071h:00", "32768", "32767"]),
        (0x6071, -32_769, TOO_LOW, ["6071h:00", "-32769", "-32768"]),
        (0x607A, 2**31, TOO_HIGH, ["607Ah:00", "2147483648", "2147483647"]),
        (0x6065, 2**31, TOO_HIGH, ["6065h:00", "2147483648", "2147483647"]),  # table 159: 0...2147483647
        (0x6081, -1, TOO_LOW, ["6081h:00", "-1", "0"]),
        (0x605B, 1, TOO_HIGH, ["605Bh:00", "1", "0"]),  # table 120: 0 only
        (0x605C, 0, TOO_LOW, ["605Ch:00", "0", "1"]),  # table 123: 1 only
        (0x605E, 3, TOO_HIGH, ["605Eh:00", "3", "2"]),  # table 129: 2 only
        (0x605A, 3, BAD_VALUE, ["605Ah:00", "3", "1, 2, 5, 6"]),  # table 117
        (0x605A, 0, TOO_LOW, ["605Ah:00", "0", "1"]),
        (0x2050, 2, BAD_VALUE, ["2050h:00 Motor Type", "2", "0, 1, 3"]),
        (0x2056, 0, TOO_LOW, ["2056h:00", "0", "1"]),
        (0x6060, 2, BAD_VALUE, ["6060h:00 Modes of operation", "2", "0, 1, 3"]),
        (0x6060, -1, TOO_LOW, ["6060h:00", "-1"]),
        (0x6060, 0, NOT_NOW, ["6060h:00", "0", "already"]),
        (0x2058, 0, TOO_LOW, ["2058h:00", "0", "1"]),  # no increments per revolution would be no positions
        (0x2058, -65536, TOO_LOW, ["2058h:00", "-65536", "1"]),  # and negative ones no scale of 6081h and 6083h
        (0x60F2, 3, TOO_HIGH, ["60F2h:00", "3", "2"]),  # table 178: reserved
        (0x60F2, 4, TOO_HIGH, ["60F2h:00", "4", "2"]),  # bits 0 and 1 only
        ((0x1010, 1), 0x65766173, NOT_STORED, ["1010h:01"]),
        (0x6081, 1.0, WRONG_TYPE, ["6081h:00 Profile velocity", "1.0", "float"]),
        (0x6081, np.float64(5), WRONG_TYPE, ["6081h:00", "float"]),
        (0x6081, True, WRONG_TYPE, ["6081h:00", "True", "boolean"]),
        (0x6081, "1000", WRONG_TYPE, ["6081h:00", "'1000'", "text"]),
        (0x6081, None, WRONG_TYPE, ["6081h:00", "None"]),
        (0x6081, 1 + 0j, WRONG_TYPE, ["6081h:00", "complex"]),
        (0x6081, [1, 2], WRONG_TYPE, ["6081h:00", "3 axes", "(2,)"]),
        (0x6081, [[1, 2, 3]], WRONG_TYPE, ["6081h:00", "(1, 3)"]),
        (0x6081, [1.5, 2, 3], WRONG_TYPE, ["6081h:00", "float"]),
        (0x6081, [1, [2, 3]], WRONG_TYPE, ["6081h:00"]),
        (0x6081, [1, 2**32, 3], TOO_HIGH, ["6081h:00", "4294967296", "4294967295"]),
        (0x6081, [1, 2, -3], TOO_LOW, ["6081h:00", "-3"]),
        (0x605A, [1, 2, 4], BAD_VALUE, ["605Ah:00", "4"]),
        (0x6060, [1, 3, 0], NOT_NOW, ["6060h:00", "0"]),
    ],
)
def test_a_wrong_write_says_what_is_wrong_and_changes_nothing(drives, name, value, code, words):
    error = refusal(drives, name, value)
    assert error.abort_code == code
    text = str(error)
    assert f"{code >> 16:04X} {code & 0xFFFF:04X}h" in text
    for word in words:
        assert word in text


@pytest.mark.parametrize("words", [(6,), (6, 7), (6, 7, 15)])
def test_2005h_is_written_in_switch_on_disabled_only(drives, words):
    drives.write(0x2005, 1)
    for word in words:
        drives.write(0x6040, word, where=np.array([False, True, False]))
    error = refusal(drives, 0x2005, 3)
    assert error.abort_code == NOT_NOW
    for part in ("2005h:00 Limit Switches", "switch on disabled", "08000022"):
        assert part in str(error).replace("0800 0022h", "08000022")
    assert drives.read(0x2005).tolist() == [1, 1, 1], "always readable"
    drives.write(0x2005, 3, where=np.array([True, False, True]))
    assert drives.read(0x2005).tolist() == [3, 1, 3]


def test_a_mask_that_does_not_fit_is_refused(drives):
    before = state(drives)
    for mask in (np.array([True, False]), np.array([1, 0, 1]), np.ones((1, 3), bool)):
        with pytest.raises(ValueError, match=r"boolean array of shape \(3,\)"):
            drives.write(0x6081, 5, where=mask)
    assert state(drives) == before


GOOD_ROWS = np.arange(4) + 1


@pytest.mark.parametrize(
    ("play", "code", "words"),
    [
        ({0x9999: GOOD_ROWS}, NO_OBJECT, ["9999h"]),
        ({0x6041: GOOD_ROWS}, READ_ONLY, ["6041h:00"]),
        ({0x6071: [1, 2, 3, 40_000]}, TOO_HIGH, ["6071h:00", "40000", "32767"]),
        ({0x6071: [1, -40_000, 3, 4]}, TOO_LOW, ["6071h:00", "-40000", "-32768"]),
        ({0x6071: [[1, 2, 3]] * 3 + [[1, 2, 40_000]]}, TOO_HIGH, ["6071h:00", "40000"]),
        ({0x60FF: [0.5, 1, 2, 3]}, WRONG_TYPE, ["60FFh:00", "float"]),
        ({0x605A: [1, 2, 5, 3]}, BAD_VALUE, ["605Ah:00", "3"]),
        ({0x6060: [0, 1, 3, 4]}, BAD_VALUE, ["6060h:00", "4"]),
        ({0x1008: GOOD_ROWS}, READ_ONLY, ["1008h"]),
        ({0x2058: GOOD_ROWS}, NOT_STORED, ["2058h:00"]),
        ({0x60FF: GOOD_ROWS, 0x6071: [0, 0, 0, 40_000]}, TOO_HIGH, ["6071h:00"]),  # one good, one bad
    ],
)
def test_a_wrong_play_changes_nothing_and_no_time_passes(drives, play, code, words):
    motion.enable(drives, mode="pv")
    before = state(drives)
    with pytest.raises(ObjectAccessError) as refused:
        drives.record([0x6041], duration=0.004, play=play)
    assert refused.value.abort_code == code
    for word in words:
        assert word in str(refused.value)
    assert state(drives) == before


@pytest.mark.parametrize("rows", [[1, 2, 3], np.ones((4, 2), int), np.ones((3, 4), int)])
def test_play_of_the_wrong_shape_says_which_it_takes(drives, rows):
    before = state(drives)
    with pytest.raises(ValueError, match=r"60FFh:00 Target velocity: play takes shape \(4,\) or \(4, 3\)"):
        drives.record([0x6041], duration=0.004, play={0x60FF: rows})
    assert state(drives) == before


@pytest.mark.parametrize(("name", "code"), [(0x9999, NO_OBJECT), ((0x6064, 4), NO_SUB), ("Sttusword", NO_OBJECT)])
def test_recording_what_does_not_exist_changes_nothing(drives, name, code):
    before = state(drives)
    with pytest.raises(ObjectAccessError) as refused:
        drives.record([0x6041, name], duration=0.004, play={0x60FF: GOOD_ROWS})
    assert refused.value.abort_code == code
    assert state(drives) == before


# --- what is played ---------------------------------------------------------------------------------------------------
PLAYABLE = [
    e
    for e in ENTRIES
    if (e.index, e.sub) in DEVICE.bindings
    and e.access == "rw"
    and (e.index, e.sub) not in DEVICE.write_states
    and (e.index, e.sub) not in {(0x2058, 0), (0x6040, 0), (0x6060, 0)}
]


@pytest.fixture
def fresh():
    """Three drives of a test's own: the limits of some ranges are no healthy settings."""
    with EmulatedDrives(load="inertia", num_machines=3, num_threads=1) as made:
        yield made


@pytest.mark.every(7)
@pytest.mark.parametrize("entry", PLAYABLE, ids=lambda e: f"{e.index:04X}:{e.sub}")
def test_every_bound_object_plays_for_all_axes_alike_and_for_each(fresh, entry):
    drives = fresh
    key = entry.index, entry.sub
    values = DEVICE.allowed_values.get(key) or (entry.low, entry.high)
    rows = np.array([values[0], values[-1], values[0]])
    trace = drives.record([key], duration=0.003, play={key: rows})
    assert trace[key].tolist() == [[row] * 3 for row in rows.tolist()], "row k is played, then recorded"
    each = np.array([[values[0], values[-1], values[0]], [values[-1], values[0], values[-1]]])
    trace = drives.record([key], duration=0.002, play={key: each})
    assert trace[key].tolist() == each.tolist()


# --- names ------------------------------------------------------------------------------------------------------------
def test_every_object_is_found_by_each_of_its_names():
    for entry in ENTRIES:
        assert DICTIONARY.find((entry.index, entry.sub)) is entry
        for name in (entry.name, entry.name.upper(), entry.name.lower(), f"  {entry.name} "):
            assert DICTIONARY.find(name) is entry, "a name that two objects share would find the wrong one"
        if entry.sub == 0:
            assert DICTIONARY.find(entry.index) is entry


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("Statusword", (0x6041, 0)),
        ("CONTROLWORD", (0x6040, 0)),
        ("Position actual value", (0x6064, 0)),
        ("velocity ACTUAL value", (0x606C, 0)),
        ("Velocity Mode Settings.P_Parameter", (0x2042, 1)),
        ("velocity mode settings.i_parameter", (0x2042, 2)),
        ("Position Mode Settings.P_Parameter", (0x2043, 1)),
        ("ABN Encoder Settings.Encoder Steps", (0x2080, 2)),
        ("Target velocity", (0x60FF, 0)),
    ],
)
def test_names_are_cias_in_any_case(drives, name, key):
    entry = DICTIONARY.find(name)
    assert (entry.index, entry.sub) == key
    assert (drives.read(name) == drives.read(key)).all()


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("Statsword", "Statusword"),
        ("Target velocty", "Target velocity"),
        ("profile aceleration", "Profile acceleration"),
        ("Velocity Mode Settings.P_Paramter", "Velocity Mode Settings.P_Parameter"),
    ],
)
def test_a_misspelled_name_is_answered_with_the_right_one(drives, wrong, right):
    for access in (lambda: drives.read(wrong), lambda: drives.write(wrong, 1)):
        with pytest.raises(ObjectAccessError, match=repr(wrong)) as refused:
            access()
        assert refused.value.abort_code == NO_OBJECT
        assert f"did you mean {right!r}" in str(refused.value)


def test_a_name_like_no_other_points_to_the_eds(drives):
    with pytest.raises(ObjectAccessError, match="no object is named 'zzz'; see the device EDS"):
        drives.read("zzz")


# --- the whole dictionary ---------------------------------------------------------------------------------------------
def test_every_readable_object_reads(drives):
    for entry in ENTRIES:
        raw = drives.read((entry.index, entry.sub))
        assert raw.shape == (3,)
        if entry.bits is None:
            assert raw.dtype.kind == "U"
            continue
        assert raw.dtype == np.int64
        assert (raw >= entry.low).all()
        assert (raw <= entry.high).all()


# What is measured reads what is, not the manual's default of 0.
LIVE = {
    (0x2101, 0): 1 << 15 | 1 << 8 | 1 << 4,  # table 85: module initialised, stop mode, motor halted
    # The middle of the hall sector at angle 0, 30 degrees of 65536 steps, and half a turn: 2070h:01 is not set yet.
    (0x2104, 0): 5461 - 32768,
    (0x2702, 0): 0b1111,  # limit and home switches that are not connected read active; enabled
    (0x60FD, 0): 0b1111,
    (0x6041, 0): 0x0250,  # switch on disabled, voltage enabled, remote
}


def test_a_drive_as_the_factory_leaves_it_reads_the_manuals_defaults_but_for_what_it_measures():
    with EmulatedDrives(load="inertia", commissioned=False, num_threads=1, ideal=True) as factory:
        found = {(e.index, e.sub): factory.read((e.index, e.sub))[0] for e in ENTRIES if e.bits is not None}
    assert {key: raw for key, raw in found.items() if raw != DICTIONARY.find(key).default} == LIVE


WRITABLE = [e for e in ENTRIES if e.access in ("rw", "wo") and e.bits and (e.index, e.sub) not in DEVICE.unsupported]


def test_the_contract_below_covers_the_dictionary():
    assert len(ENTRIES) > 200
    assert len(WRITABLE) > 120
    assert {(e.index, e.sub) for e in ENTRIES if e.access == "rw"} - {(e.index, e.sub) for e in WRITABLE} <= set(
        DEVICE.unsupported
    )


@pytest.mark.every(7)
@pytest.mark.parametrize("entry", WRITABLE, ids=lambda e: f"{e.index:04X}:{e.sub}")
def test_every_writable_object_takes_its_range_and_reads_back(drives, entry):
    key = entry.index, entry.sub
    values = {entry.low, entry.high, entry.default}
    if key in DEVICE.allowed_values:
        values = set(DEVICE.allowed_values[key])
    values = sorted(values)
    only = np.array([False, True, False])
    others = drives.read(key)[[0, 2]].tolist()
    for value in values:
        if key == (0x6060, 0) and value == drives.read(key)[1]:
            continue  # this drive refuses the same mode twice
        drives.write(key, value, where=only)
        assert int(drives.read(key)[1]) == value
        assert drives.read(key)[[0, 2]].tolist() == others, "only where the mask is true"
    for beyond, code in ((entry.low - 1, TOO_LOW), (entry.high + 1, TOO_HIGH)):
        assert refusal(drives, key, beyond, where=only).abort_code == code


def test_one_value_per_axis(drives):
    drives.write("Profile velocity", [1, 2, 4_294_967_295])
    assert drives.read(0x6081).tolist() == [1, 2, 4_294_967_295]
    drives.write("Profile velocity", np.array([7, 8, 9], np.uint16), where=np.array([True, False, True]))
    assert drives.read(0x6081).tolist() == [7, 2, 9]


def test_a_read_is_a_copy(drives):
    for name in (0x6081, 0x2004, 0x1017):
        raw = drives.read(name)
        raw += 1
        assert (drives.read(name) == raw - 1).all()


# --- units ------------------------------------------------------------------------------------------------------------
def context(scaler=65536.0, **other):
    values = {
        "position_scaler": np.array([scaler]),
        "current_lsb": 100.0 / 32768.0,
        "rated_current": 3.5,
        "velocity_ratio": 2.5,
        "set_point_ratio": 1.0,
        "peak_current": 12.0,
        "nominal_motor_current": 4.0,
        "profile_bits": 16.0,
    }
    values.update(other)
    return units.Context(**{name: values[name] for name in units.Context._fields})


SCALAR_CONTEXT = context()._replace(position_scaler=65536.0)


def code(unit, low=-(2**31), high=2**32 - 1):
    """Return the row of an object in that unit, of that range."""
    row = units.UNITS[unit]
    return codec.Code("field", 0, unit, "", low, high, row.period, row.specials, row.follows_scale)


RANGES = {"1/65536 turn": (-(2**15), 2**15 - 1), "counter": (-(2**31), 2**31 - 1), "position window": (0, 2**32 - 1),
          "position limit": (-(2**31), 2**31 - 1)}  # fmt: skip


@pytest.mark.every(7)
@pytest.mark.parametrize("unit", sorted(units.UNITS))
@settings(max_examples=15, deadline=None, derandomize=True)
@given(data=st.data())
def test_every_unit_makes_the_round_trip(unit, data):
    scaler = data.draw(st.sampled_from([65536.0, 1.0, 4096.0, 1e6, 2147483647.0, -65536.0]))
    low, high = RANGES.get(unit, (-(2**31), 2**32 - 1))
    raw = np.array([data.draw(st.integers(low, high))])
    row = code(unit, low, high)
    factor = row.factor(context(scaler))
    assert (codec.encode(row, codec.decode(row, raw, factor), factor) == raw).all()


@pytest.mark.every(5)
@pytest.mark.parametrize("unit", sorted(name for name, row in units.UNITS.items() if not row.period))
@settings(max_examples=10, deadline=None, derandomize=True)
@given(value=st.floats(-1e12, 1e12))
def test_what_is_encoded_is_rounded_and_saturates(unit, value):
    row = code(unit, -1000, 2000)
    factor = row.factor(context())
    one = float(np.ravel(factor)[0])
    raw = int(codec.encode(row, np.array([value]), factor)[0])
    assert -1000 <= raw <= 2000
    if abs(value) < 900 * abs(one):
        assert abs(raw * one - value) <= 0.5000001 * abs(one)
    elif value > 2001 * one:
        assert raw == 2000
    elif value < -1001 * one:
        assert raw == -1000


@pytest.mark.every(12)
@pytest.mark.parametrize("unit", sorted(units.UNITS))
@settings(max_examples=30, deadline=None, derandomize=True)
@given(data=st.data())
def test_arrays_single_values_and_compiled_code_read_a_row_alike(unit, data):
    low, high = RANGES.get(unit, (-(2**31), 2**31 - 1))
    row, factor = code(unit, low, high), code(unit).factor(SCALAR_CONTEXT)
    raw = data.draw(st.one_of(st.integers(low, high), st.sampled_from([low, high])))
    si = codec.decode_one(row, raw, factor)
    assert codec.decode(row, np.array([raw]), factor).tolist() == [si]
    values = np.zeros((1, 1, 1))
    decoding = codec.compiled_rows([row], decoded=True)
    assert prepared_record.from_od(np.array([[raw]]), np.array([factor]), decoding[0], values, 0)
    assert values[0, 0, 0] == si
    for value in (si, data.draw(st.sampled_from([math.inf, -math.inf, math.nan]) | st.floats(-1e200, 1e200))):
        if row.period and 2**52 < abs(value / factor) < math.inf:
            continue  # where a double has no units any more
        found = codec.encode_one(row, value, factor)
        assert codec.encode(row, np.array([value]), factor).tolist() == [found]
        compiled = np.zeros((1, 1, 1), np.int64)
        rows = codec.compiled_rows([row], decoded=False)
        prepared_record.to_od(np.array([[[value]]]), np.array([[factor]]), rows, compiled)
        assert compiled[0, 0, 0] == found


@every_row(
    ("unit", "raw", "si"),
    [  # by hand
        ("mA", 3500, 3.5),
        ("ms", 20, 0.020),
        ("inc", 65536, 2.0 * np.pi),
        ("pps", 32768, np.pi),
        ("pps^2", -65536, -2.0 * np.pi),
        ("rpm", 60, 2.0 * np.pi),
        ("1/65536 rev", 16384, np.pi / 2.0),
        ("I", 65536, 1.0),
        ("current P", 25600, 1.0),  # 100 LSB of duty per LSB of current: full duty per 1/100 of 100 A
        ("velocity P", 256, 100.0 / 32768.0 * 30.0 / np.pi),  # one LSB of current per rpm
        ("position P", 4096, 2.0 * np.pi / 60.0 * 65536.0 / (2.0 * np.pi)),  # one rpm per 1/65536 revolution
        ("1/1000 rated", 500, 1.75),  # of 3.5 A
        ("velocity unit", 24, 2.0 * np.pi),  # 24 units of 2.5 rpm
        ("velocity unit/s", 24, 2.0 * np.pi),
        ("1/32767 M-Ipeak", -32767, -12.0),
        ("mV", 1500, 1.5),
        ("0.1V", 240, 24.0),
        ("raw", 7, 7.0),
        ("position window", 0xFFFFFFFF, np.inf),  # switched off
        ("position window", 65536, 2.0 * np.pi),
        ("position limit", 2**31 - 1, np.inf),
        ("position limit", -(2**31), -np.inf),
        ("position limit", -65536, -2.0 * np.pi),
    ],
)
def test_units_by_hand(unit, raw, si):
    row = code(unit)
    assert float(np.ravel(codec.decode(row, np.array([raw]), row.factor(context())))[0]) == pytest.approx(si, rel=1e-12)


def test_an_angle_wraps_at_half_a_turn():
    row = code("1/65536 turn", -32768, 32767)
    turn = codec.encode(row, np.array([0.0, np.pi - 1e-6, np.pi + 1e-3, -np.pi / 2, 5 * np.pi]), row.factor(context()))
    assert turn.tolist() == [0, -32768, -32758, -16384, -32768]


def test_a_position_is_counted_on_past_the_end_of_its_type():
    row = code("counter", -(2**31), 2**31 - 1)
    turns = np.array([32767.0, 32768.0, -32768.5])
    assert codec.encode(row, turns * 2.0 * np.pi, row.factor(context())).tolist() == [
        32767 * 65536, -(2**31), 2**31 - 32768
    ]  # fmt: skip


def test_a_scale_of_0_scales_nothing():
    assert code("inc").factor(units.Context(0.0, 1.0)) == np.inf


def test_what_is_no_number_reads_as_zero():
    row = code("mA", -10, 10)
    assert codec.encode(row, np.array([np.nan]), row.factor(context())).tolist() == [0]


# --- stored values ----------------------------------------------------------------------------------------------------
CHANGES = {0x6081: 12_345, 0x2003: 1_000, (0x2042, 1): 7, 0x2058: 4096, 0x6067: 3, 0x2057: 1, 0x2004: 55, 0x605A: 6}


@pytest.mark.parametrize("restart", ["reset_node", "power_cycle"])
def test_a_restart_restores_stored_values(drives, restart):
    before = everything(drives)
    for name, value in CHANGES.items():
        drives.write(name, value)
    motion.enable(drives, mode="pv")
    drives.write(0x60FF, 1_000)
    drives.advance(0.05)
    some = np.array([True, False, True])
    if restart == "reset_node":
        drives.reset_node(where=some)
    else:
        drives.machine.power_cycle(where=some)
    after = everything(drives)
    # Values that are measured differ; all that is written must be as stored on the axes that restarted.
    for entry in ENTRIES:
        key = entry.index, entry.sub
        if entry.access == "rw":
            assert [after[key][0], after[key][2]] == [before[key][0], before[key][2]], entry.label
    for name, value in CHANGES.items():
        assert int(drives.read(name)[1]) == value, "the axis between goes on"
    status = drives.read(0x6041) & 0x6F
    assert status[1] == 0x27
    assert (status[[0, 2]] & 0x4F == 0x40).all()
    assert drives.read(0x6061).tolist() == [0, 3, 0]
    assert drives.read(0x6064)[[0, 2]].tolist() == [0, 0]


def test_a_preset_is_what_its_file_says(drives):
    preset = DEVICE.preset(find_motor("qbl4208"))
    assert preset["Motor Type"] == 3
    for name, value in preset.items():
        assert (drives.read(name) == value).all(), name
    assert drives.read("Limit switches").tolist() == [3, 3, 3], "this load has none"
