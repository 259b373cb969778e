"""The modelled wire: length of frames, arbitration, what a bus can carry, faults by seed."""

import math
import random
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drive_env.bus.bits import broken_frame_bits, crc15, frame_bits
from drive_env.bus.faults import Faults
from drive_env.bus.wire import Wire
from drive_env.canopen.frames import Frame

SYNC = Frame(0x080)


def bits_by_hand(frame, extended=False):
    """ISO 11898-1 as a string of bits: every field written down, divided by the polynomial, stuffed one by one."""
    length = frame.dlc if frame.rtr else len(frame.data)
    if extended:
        text = f"{frame.can_id >> 18:011b}" + "11" + f"{frame.can_id & 0x3FFFF:018b}" + f"{frame.rtr:b}" + "00"
    else:
        text = f"{frame.can_id:011b}" + f"{frame.rtr:b}" + "00"
    text = "0" + text + f"{length:04b}" + "".join(f"{byte:08b}" for byte in frame.data)
    register = [int(bit) for bit in text] + [0] * 15
    polynomial = [1, 1, 0, 0, 0, 1, 0, 1, 1, 0, 0, 1, 1, 0, 0, 1]  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1
    for k in range(len(text)):
        if register[k]:
            for j, coefficient in enumerate(polynomial):
                register[k + j] ^= coefficient
    text += "".join(map(str, register[-15:]))
    stuffed = ""
    for bit in text:
        stuffed += bit
        if stuffed[-5:] == bit * 5 and len(stuffed) >= 5:
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed) + len("1011111111111")  # CRC delimiter, acknowledge, end of frame, intermission


def frames(max_id):
    data = st.builds(lambda i, data: Frame(i, data), st.integers(0, max_id), st.binary(max_size=8))
    remote = st.builds(lambda i, n: Frame(i, b"", rtr=True, dlc=n), st.integers(0, max_id), st.integers(0, 8))
    return data | remote


def drain(wire, until=math.inf):
    """What the bus carries until then, in time."""
    result = []
    while (event := wire.next_event()) <= until and event < math.inf:
        if (ended := wire.take(event)) is not None:
            result.append(ended)
    return result


# --- length ---------------------------------------------------------------------------------------------------------
def test_crc_has_the_check_value_of_its_catalogue():
    assert crc15(b"123456789") == 0x059E  # CRC-15/CAN


@pytest.mark.parametrize(("frame", "bits"), [
    (Frame(0x080), 51),  # by hand: 47 bits, and 0000 0|1 in the identifier and the fields behind it
    (Frame(0x555, bytes.fromhex("55" * 8)), 111),  # alternating: no stuffing in header and data
])  # fmt: skip
def test_known_frames(frame, bits):
    assert bits_by_hand(frame) == frame_bits(frame)
    assert abs(frame_bits(frame) - bits) <= 4  # their CRC may need a few of its own


@given(frames(0x7FF))
def test_standard_frames_are_as_long_as_by_hand(frame):
    assert frame_bits(frame) == bits_by_hand(frame)


@given(frames(0x1FFFFFFF))
def test_extended_frames_are_as_long_as_by_hand(frame):
    assert frame_bits(frame, True) == bits_by_hand(frame, extended=True)


@given(st.integers(0, 0x7FF), st.binary(min_size=8, max_size=8))
def test_eight_bytes_take_111_to_135_bits(can_id, data):
    assert 111 <= frame_bits(Frame(can_id, data)) <= 135


def test_a_broken_frame_ends_in_an_error_frame_instead_of_end_of_frame():
    frame = Frame(0x181, b"\x01\x02")
    assert broken_frame_bits(frame) == frame_bits(frame) - 7 + 6 + 8


# --- arbitration ----------------------------------------------------------------------------------------------------
def test_the_lowest_identifier_of_those_that_wait_goes_first():
    wire = Wire()
    wire.send(Frame(0x700), "first", 0.0)
    wire.take(0.0)  # the bus was idle: it begins
    for can_id in (0x601, 0x080, 0x181, 0x000):
        wire.send(Frame(can_id), can_id, 1e-6)
    assert [ended.frame.can_id for ended in drain(wire)] == [0x700, 0x000, 0x080, 0x181, 0x601]


def test_data_goes_before_remote_and_standard_before_extended():
    wire = Wire()
    wire.send(Frame(0x123 << 18, b""), "extended", 0.0, extended=True)
    wire.send(Frame(0x123, rtr=True, dlc=0), "remote", 0.0)
    wire.send(Frame(0x123), "data", 0.0)
    wire.send(Frame(0x122 << 18 | 0x3FFFF), "lower extended", 0.0, extended=True)
    assert [ended.sender for ended in drain(wire)] == ["lower extended", "data", "remote", "extended"]


def test_frames_of_one_sender_keep_their_order_whatever_their_identifiers():
    wire = Wire()
    for can_id in (0x700, 0x080, 0x601):
        wire.send(Frame(can_id), "adapter", 0.0)
    wire.send(Frame(0x100), "other", 0.0)
    assert [ended.frame.can_id for ended in drain(wire)] == [0x100, 0x700, 0x080, 0x601]


def test_a_frame_that_comes_while_the_bus_is_busy_waits_for_its_end():
    wire = Wire(500_000)
    wire.send(Frame(0x700, bytes(8)), "a", 0.0)
    first = frame_bits(Frame(0x700, bytes(8))) / 500_000
    assert wire.take(first - 1e-6) is None
    wire.send(SYNC, "b", first - 1e-6)
    ends = [ended.end for ended in drain(wire)]
    assert ends == pytest.approx([first, first + frame_bits(SYNC) / 500_000])


def test_a_controller_that_leaves_takes_along_what_it_had_to_send():
    wire = Wire()
    wire.send(Frame(0x100), "gone", 0.0)
    assert wire.take(0.0) is None  # it is on the wire
    wire.send(Frame(0x101), "gone", 0.0)
    wire.send(Frame(0x102), "other", 0.0)
    wire.forget("gone")
    wire.forget("never there")
    assert [ended.frame.can_id for ended in drain(wire)] == [0x100, 0x102]
    assert (wire.waiting("gone"), wire.next_event(), wire.statistics.lost) == (0, math.inf, 1)


# --- what a bus can carry -------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_one_mbit_carries_about_8000_frames_per_second_and_no_more():
    wire, numbers = Wire(), random.Random(1)
    for k in range(12_000):
        wire.send(Frame(0x181, numbers.randbytes(8)), k % 3, 0.0)
    carried = len(drain(wire, until=1.0))
    assert 7_900 < carried < 9_000
    assert wire.statistics.load(wire.bit_rate, 1.0) == pytest.approx(1.0, abs=1e-3)
    assert wire.statistics.frames + sum(wire.waiting(k) for k in range(3)) in (12_000, 12_000 + 1)


def test_a_bus_that_is_not_full_delays_and_loses_nothing():
    wire, numbers = Wire(), random.Random(2)
    sent = sorted((numbers.random(), numbers.randrange(4), k) for k in range(7_000))
    received = []
    for when, sender, k in sent:
        received += drain(wire, until=when)
        wire.send(Frame(0x180 + sender, k.to_bytes(8, "big")), sender, when)
    received += drain(wire)
    assert len(received) == 7_000
    for sender in range(4):
        own = [int.from_bytes(ended.frame.data, "big") for ended in received if ended.sender == sender]
        assert own == [k for _, s, k in sent if s == sender]
    assert all(a.end < b.end for a, b in pairwise(received))


def test_an_instant_wire_keeps_the_order_and_counts_the_bits():
    wire = Wire(instant=True)
    wire.send(Frame(0x700), "a", 1.0)
    wire.send(SYNC, "b", 1.0)
    assert [(ended.frame.can_id, ended.end) for ended in drain(wire, 1.0)] == [(0x080, 1.0), (0x700, 1.0)]
    assert wire.statistics.bits == frame_bits(SYNC) + frame_bits(Frame(0x700))


# --- faults ---------------------------------------------------------------------------------------------------------
def disturbed(seed=0, count=2_000, **faults):
    """Frames numbered 0 to count-1 of one sender, one per 0.2 ms, on a disturbed wire: their fates."""
    wire = Wire(faults=Faults(**faults), seed=seed)
    result = []
    for k in range(count):
        result += drain(wire, until=k * 2e-4)
        wire.send(Frame(0x181, k.to_bytes(2, "big")), "a", k * 2e-4)
    return result + drain(wire), wire


def numbers_received(fates):
    return [int.from_bytes(ended.frame.data, "big") for ended in fates if ended.outcome == "received"]


def test_dropped_frames_take_their_time_and_reach_nobody():
    fates, wire = disturbed(drop=0.1)
    counts = Counter(ended.outcome for ended in fates)
    assert counts["lost"] == wire.statistics.lost == pytest.approx(200, abs=50)
    assert counts["received"] == 2_000 - counts["lost"]
    assert numbers_received(fates) == sorted(numbers_received(fates))


def test_delayed_frames_come_later_and_in_order():
    fates, _ = disturbed(delay=0.01, delay_max=0.004)
    assert numbers_received(fates) == list(range(2_000))
    late = [ended.end - int.from_bytes(ended.frame.data, "big") * 2e-4 for ended in fates]
    assert 0.002 < max(late) < 0.006
    assert sorted(late)[1_000] < 0.0002


def test_duplicated_frames_come_twice():
    fates, _ = disturbed(duplicate=0.1)
    counts = Counter(numbers_received(fates))
    assert len(counts) == 2_000
    assert Counter(counts.values())[2] == pytest.approx(200, abs=50)


def test_reordered_frames_change_places_with_the_next():
    fates, _ = disturbed(reorder=0.1)
    order = numbers_received(fates)
    assert sorted(order) == list(range(2_000))
    swapped = sum(a > b for a, b in pairwise(order))
    assert swapped == pytest.approx(190, abs=50)


def test_a_frame_that_nothing_overtakes_goes_after_a_millisecond():
    wire = Wire(faults=Faults(reorder=1.0))
    wire.send(SYNC, "a", 0.0)
    assert drain(wire, 0.0009) == []
    assert [ended.end for ended in drain(wire)] == pytest.approx([0.001 + frame_bits(SYNC) * 1e-6])


def test_an_overtaken_frame_follows_at_once():
    wire = Wire(faults=Faults(reorder=1.0, only=(0x700,)))
    wire.send(Frame(0x700), "a", 0.0)
    wire.send(SYNC, "a", 0.0001)
    fates = drain(wire)
    assert [ended.frame.can_id for ended in fates] == [0x080, 0x700]
    assert fates[1].end - fates[0].end == pytest.approx(frame_bits(Frame(0x700)) * 1e-6)


def test_a_delayed_frame_does_not_hold_up_other_senders():
    wire = Wire(faults=Faults(delay=1.0, only=(0x080,)), seed=1)
    wire.send(SYNC, "delayed", 0.0)
    wire.send(Frame(0x700), "b", 0.0)
    fates = drain(wire)
    assert [ended.frame.can_id for ended in fates] == [0x700, 0x080]
    assert fates[0].end == pytest.approx(frame_bits(Frame(0x700)) * 1e-6)


def test_corrupted_frames_are_sent_again_and_nothing_is_lost():
    fates, wire = disturbed(corrupt=0.08)
    assert numbers_received(fates) == list(range(2_000))
    errors = [ended for ended in fates if ended.outcome == "error"]
    assert len(errors) == wire.statistics.errors == pytest.approx(174, abs=45)
    assert wire.statistics.bus_offs == 0


def test_a_frame_that_never_passes_takes_its_sender_to_bus_off():
    # ISO 11898-1: the transmit error counter grows by 8; 128 is error passive, 256 bus-off; back after 128 x 11 bits.
    wire = Wire(faults=Faults(corrupt=1.0, only=(0x181,)))
    for _ in range(3):
        wire.send(Frame(0x181), "a", 0.0)
    fates = drain(wire)
    assert [ended.outcome for ended in fates] == ["error"] * 15 + ["error passive"] + ["error"] * 15 + ["bus off"]
    assert wire.waiting("a") == 0
    off = fates[-1].end
    wire.send(SYNC, "a", off)
    assert [ended.end for ended in drain(wire)] == pytest.approx([off + 1408e-6 + frame_bits(SYNC) * 1e-6])


def test_the_error_counter_falls_with_every_frame_that_passes():
    wire = Wire(faults=Faults(corrupt=0.1), seed=3)  # +8 once in ten, -1 in the others: it stays low
    for k in range(5_000):
        wire.send(SYNC, "a", k * 1e-3)
        drain(wire, k * 1e-3)
    assert wire.statistics.bus_offs == 0


def test_undetected_corruption_changes_data_only():
    fates, wire = disturbed(corrupt_undetected=0.1)
    changed = [k for k, ended in enumerate(fates) if ended.frame.data != k.to_bytes(2, "big")]
    assert len(changed) == pytest.approx(200, abs=50)
    for k in changed:
        assert 1 <= (int.from_bytes(fates[k].frame.data, "big") ^ k).bit_count() <= 3
    assert {ended.frame.can_id for ended in fates} == {0x181}
    assert wire.statistics.errors == 0


ALL = {"drop": 0.1, "delay": 0.1, "duplicate": 0.1, "reorder": 0.1, "corrupt": 0.1, "corrupt_undetected": 0.1}


def test_the_same_seed_disturbs_in_the_same_way():
    assert disturbed(seed=5, **ALL)[0] == disturbed(seed=5, **ALL)[0]
    assert disturbed(seed=5, **ALL)[0] != disturbed(seed=6, **ALL)[0]


def test_faults_meet_only_the_identifiers_that_they_are_for():
    wire = Wire(faults=Faults(drop=1.0, only=(0x581,)))
    for can_id in (0x581, 0x582, 0x601):
        wire.send(Frame(can_id), "a", 0.0)
    assert [ended.outcome for ended in drain(wire)] == ["lost", "received", "received"]


@pytest.mark.parametrize(("faults", "message"), [
    ({"drop": 1.5}, "drop = 1.5 must be a share of all frames, 0 to 1"),
    ({"corrupt": -0.1}, "corrupt = -0.1"),
    ({"delay": math.nan}, "delay = nan"),
    ({"delay_max": -1.0}, "delay_max = -1.0 must be a time of 0 s or more"),
])  # fmt: skip
def test_impossible_faults_are_refused(faults, message):
    with pytest.raises(ValueError, match=message):
        Faults(**faults)


def test_a_bit_rate_is_above_zero():
    with pytest.raises(ValueError, match="bit_rate must be above 0 bit/s, not 0"):
        Wire(0)
