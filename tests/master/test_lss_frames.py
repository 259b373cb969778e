"""The master of the layer setting services as frames (CiA 305), over a bus of this test."""

from __future__ import annotations

import pytest

from drive_env.canopen.lss import LssIdentity
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.master.can import lss
from drive_env.master.can.lss import (
    LssError,
    LssMaster,
    await_node,
    identity_of,
    is_taken,
    parse_identity,
    row_of,
    show,
)

IDENTITY = LssIdentity(0x286, 0x664, 0x10009, 5)
REQUEST, RESPONSE = 0x7E5, 0x7E4


class Bus:
    """A bus that answers what it is told to; time passes by waiting alone."""

    def __init__(self, *answers):
        self.answers = [bytes.fromhex(one) if one else None for one in answers]
        self.sent, self.waits, self.now, self.late = [], [], 0.0, []

    def subscribe(self, can_id, handler):
        assert can_id == RESPONSE
        self.handler = handler

    def drain(self):
        for one in self.late:
            self.handler(one)
        self.late.clear()

    def send(self, can_id, data):
        assert can_id == REQUEST and len(data) == 8
        self.sent.append(data.rstrip(b"\0").hex(" ").upper())
        self.last = data

    def answer(self, data):
        return self.answers.pop(0) if self.answers else None

    def wait(self, done, timeout):
        self.waits.append(timeout)
        if done():
            assert timeout != 0.005, "what comes late is waited for, whatever came"
            return True
        found = self.answer(self.last)
        if found is not None:
            self.handler(found)
        return done()


class Slaves(Bus):
    """Slaves without a node-ID, which answer FastScan (CiA 305, 3.9.6)."""

    def __init__(self, *identities):
        super().__init__()
        self.identities, self.part, self.steps = list(identities), {}, 0

    def answer(self, data):
        if data[0] != 0x51:
            return None
        self.steps += 1
        number, bit, part, following = int.from_bytes(data[1:5], "little"), data[5], data[6], data[7]
        heard = False
        for one in self.identities:
            if bit == 0x80:
                self.part[one], heard = 0, True
            elif self.part.get(one) == part and (one[part] >> bit) == (number >> bit):
                self.part[one], heard = following, True
                if part == 3 and bit == 0 and following == 0:
                    self.found = one
        return bytes.fromhex("4F 00 00 00 00 00 00 00") if heard else None


# --- which slave ------------------------------------------------------------------------------------------------------
def test_all_slaves_are_switched_at_once():
    bus = Bus()
    LssMaster(bus).switch_all(configuration=True)
    LssMaster(bus).switch_all(configuration=False)
    assert bus.sent == ["04 01", "04"] and bus.waits == []


def test_a_slave_is_selected_by_its_identity():
    bus = Bus("44")
    with pytest.raises(
        LssError, match=r"^no LSS slave has the identity 286:664:10009:5; look with `drive-env lss scan`"
    ):
        LssMaster(bus).select(IDENTITY)
    bus = Bus("44 00 00 00 00 00 00 00")
    LssMaster(bus, 0.25).select(IDENTITY)
    assert bus.sent == ["40 86 02", "41 64 06", "42 09 00 01", "43 05"] and bus.waits == [0.25]


def test_in_configuration_all_wait_at_first_and_whatever_happens_at_last():
    bus = Bus()
    with pytest.raises(KeyError), LssMaster(bus).configuring():
        assert bus.sent == ["04"]
        raise KeyError
    assert bus.sent == ["04", "04"]


@pytest.mark.parametrize("identity", [IDENTITY, (0, 0, 0, 0), (0xFFFFFFFF,) * 4, (1, 0x80000000, 2, 0x40000001)])
def test_a_scan_finds_a_slave_bit_by_bit(identity):
    bus = Slaves(LssIdentity(*identity))
    assert LssMaster(bus, 0.1).fastscan() == identity
    assert bus.found == identity and len(bus.sent) == 1 + 4 * 33
    assert bus.sent[0] == "51 00 00 00 00 80", "is there anybody?"
    assert bus.waits.count(0.005) == sum(answered_steps(identity)), "answers of several come one after the other"


def answered_steps(identity):
    """Yield how many steps are answered: the first, each bit that is 0, and the last of each part."""
    yield 1
    for number in identity:
        yield 32 - number.bit_count() + 1


def test_a_bus_without_slaves_is_scanned_in_one_step():
    bus = Slaves()
    assert LssMaster(bus, 0.1).fastscan() is None
    assert bus.sent == ["51 00 00 00 00 80"] and bus.waits == [0.1]
    assert list(LssMaster(bus).scan()) == []


def test_a_scan_goes_on_until_nobody_is_left_and_ends_after_127():
    bus = Slaves(IDENTITY, IDENTITY._replace(serial=6))
    found = []
    for one in LssMaster(bus).scan():
        bus.identities.remove(one)
        found.append(one.serial)
    assert sorted(found) == [5, 6]
    master = LssMaster(Bus())
    master.fastscan = lambda: IDENTITY
    assert sum(1 for _ in master.scan()) == 127


def test_a_slave_that_answers_at_first_and_not_at_last_is_told():
    for steps in (1, 33, 34, 100):
        bus = Slaves(IDENTITY)
        answer = bus.answer
        bus.answer = lambda data, bus=bus, answer=answer, steps=steps: answer(data) if bus.steps < steps else None
        with pytest.raises(
            LssError, match=r"^a slave stopped answering within a scan; slaves are slow, or frames are lo"
        ):
            LssMaster(bus).fastscan()


# --- what it is asked, and told ---------------------------------------------------------------------------------------
def test_the_slave_in_configuration_tells_its_identity_and_its_node_id():
    bus = Bus("5A 86 02 00 00 77 77 77", "5B 64 06 00 00 00 00 00", "5C 09 00 01 00 00 00 00",
              "5D 05 00 00 00 00 00 00",
              "5E FF 07 00 00 00 00 00")  # fmt: skip
    master = LssMaster(bus)
    assert master.identity() == IDENTITY and master.node_id() == 255
    assert bus.sent == ["5A", "5B", "5C", "5D", "5E"] and bus.waits == [0.1] * 5


@pytest.mark.parametrize(
    "answer", ["5F 05 00 00 00 00 00 00", "5E 05 00 00 00 00 00", "5E 05 00 00 00 00 00 00 00", None]
)
def test_an_answer_of_another_service_or_length_is_none(answer):
    with pytest.raises(
        LssError, match=r"^no LSS slave in configuration answered service 5Eh within 0.1 s; check power "
    ):
        LssMaster(Bus(answer)).node_id()


def test_an_answer_that_came_before_the_request_is_none():
    bus = Bus("5E 07 00 00 00 00 00 00")
    bus.late = [bytes.fromhex("5E 05 00 00 00 00 00 00")]
    assert LssMaster(bus).node_id() == 7


def test_a_node_id_is_given():
    bus = Bus("11 00 00 00 00 00 00 00", "11 01 02 00 00 00 00 00")
    master = LssMaster(bus)
    master.configure_node_id(9)
    with pytest.raises(LssError, match=r"^the node refuses the node-ID 128 \(error 1, 2\); choose 1 to 127$"):
        master.configure_node_id(128)
    assert bus.sent == ["11 09", "11 80"]


@pytest.mark.parametrize(("rate", "row"), [(1_000_000, 0), (800_000, 1), (500_000, 2), (250_000, 3), (125_000, 4),
                                           (50_000, 6), (20_000, 7), (10_000, 8)])  # fmt: skip
def test_a_bit_rate_is_given_by_its_row(rate, row):
    bus = Bus("13 00 00 00 00 00 00 00", "13 01 02 00 00 00 00 00")
    LssMaster(bus).configure_bit_rate(rate)
    assert bus.sent == [f"13 00 {row:02X}" if row else "13"] and row_of(rate) == row
    with pytest.raises(LssError, match=rf"^the node refuses {rate} bit/s \(error 1, 2\); choose one that its manual"):
        LssMaster(bus).configure_bit_rate(rate)


def test_a_bit_rate_that_there_is_not_is_told_with_those_that_there_are():
    with pytest.raises(
        ValueError, match=r"^123456 bit/s is no bit rate of LSS; there are 1000000, 800000, 500000, 250000"
    ):
        row_of(123_456)


@pytest.mark.parametrize(("delay", "row"), [(0.1, "15 64"), (0.0256, "15 1A"), (60.0, "15 60 EA")])
def test_a_bit_rate_is_activated_after_milliseconds(delay, row):
    bus = Bus()
    LssMaster(bus).activate_bit_rate(delay)
    assert bus.sent == [row] and bus.waits == []


@pytest.mark.parametrize(("answer", "why"), [
    ("17 01 00", "it cannot store"), ("17 02 00", "its memory failed"), ("17 FF 07", "error 255, 7"),
])  # fmt: skip
def test_what_is_not_stored_is_told(answer, why):
    bus = Bus(f"{answer} 00 00 00 00 00")
    with pytest.raises(
        LssError, match=f"^the node has not stored its node-ID and bit rate: {why}; they last until power"
    ):
        LssMaster(bus).store(2.0)
    assert bus.waits == [2.0] and bus.sent == ["17"]


def test_what_is_stored_may_take_its_time():
    LssMaster(Bus("17 00 00 00 00 00 00 00")).store(2.0)
    with pytest.raises(LssError, match="answered service 17h within 2 s"):
        LssMaster(Bus()).store(2.0)


def test_in_a_dry_run_everything_succeeds():
    bus = Bus()
    master = LssMaster(bus, is_dry=True)
    master.select(IDENTITY)
    master.configure_node_id(9)
    master.store(1.0)
    assert master.node_id() == 0 and bus.waits == []


# --- nodes that have a node-ID ----------------------------------------------------------------------------------------
class Nodes(dict):
    """Node-ID -> what 1018h has, or the error that an answer is."""

    def __init__(self, clock):
        super().__init__()
        self.clock, self.asked = clock, []


class Clock:
    """Time that passes by questions alone."""

    def __init__(self):
        self.now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def nodes(monkeypatch):
    """The nodes of a bus; each question takes 0.25 s."""
    clock = Clock()
    found = Nodes(clock)

    class Client:
        def __init__(self, port, node):
            self.node = node

        def read(self, index, sub, label, timeout):
            clock.now += 0.25
            found.asked.append((self.node, index, sub, label, timeout))
            there = found.get(self.node)
            if there is None:
                raise NoAnswerError("nobody")
            if isinstance(there, Exception):
                raise there
            if sub > len(there):
                raise lss.ObjectAccessError(0x06090011, "none")
            return there[sub - 1].to_bytes(4, "little") + b"\xff" if sub else bytes(4)

    monkeypatch.setattr(lss, "SdoClient", Client)
    monkeypatch.setattr(lss, "time", clock)
    return found


def test_the_identity_of_a_node_is_its_1018h(nodes):
    nodes[5] = IDENTITY
    assert identity_of(None, 5, 0.4) == IDENTITY
    assert nodes.asked == [(5, 0x1018, sub, f"1018h:{sub:02X}", 0.4) for sub in (1, 2, 3, 4)]
    nodes[5] = IDENTITY[:3]
    assert identity_of(None, 5, 0.4) == IDENTITY._replace(serial=0), "what a device lacks is 0"
    with pytest.raises(NoAnswerError):
        identity_of(None, 6, 0.4)


def test_a_node_id_is_taken_where_somebody_answers_whatever(nodes):
    nodes.update({5: IDENTITY, 6: lss.ObjectAccessError(0x06020000, "none"), 7: BusError("wrongly")})
    assert [is_taken(None, node, 0.4) for node in (5, 6, 7, 8)] == [True, True, True, False]
    assert nodes.asked[0] == (5, 0x1000, 0, "1000h:00", 0.4)


def test_a_node_is_waited_for_until_it_answers_under_its_new_node_id(nodes):
    nodes[9] = IDENTITY
    await_node(None, IDENTITY, 9, 5, 1.0)
    assert len(nodes.asked) == 4 and {one[0] for one in nodes.asked} == {9}
    assert nodes.asked[0][-1] == 0.3
    nodes[9] = IDENTITY._replace(serial=6)
    with pytest.raises(LssError, match=r"^the node 286:664:10009:5 took the node-ID 9, and does not answer under it "
                       "within 1 s; switch it off and on, and look with `drive-env scan`$"):  # fmt: skip
        await_node(None, IDENTITY, 9, 5, 1.0)
    del nodes[9]
    begun = nodes.clock.now
    with pytest.raises(LssError):
        await_node(None, IDENTITY, 9, 5, 1.0)
    assert nodes.clock.now - begun == 1.25, "at 1.0 s the time is not over"


def test_a_node_whose_node_id_is_taken_away_is_waited_for_until_it_is_silent(nodes):
    await_node(None, IDENTITY, 255, 5, 1.0)
    await_node(None, IDENTITY, 255, None, 1.0)
    assert nodes.asked == [(5, 0x1000, 0, "1000h:00", 0.3)]
    nodes[5] = IDENTITY
    with pytest.raises(LssError, match=r"^the node 286:664:10009:5 took the node-ID 255, and after 1 s it still "
                       "answers under 5; switch it off and on$"):  # fmt: skip
        await_node(None, IDENTITY, 255, 5, 1.0)


# --- as text ----------------------------------------------------------------------------------------------------------
def test_an_identity_is_read_as_it_is_shown():
    assert show(IDENTITY) == "286:664:10009:5"
    assert parse_identity("286:664:10009:5") == parse_identity("0x286:0x664:0x10009:0x5") == IDENTITY
    assert parse_identity("0:FFFFFFFF:0:0") == (0, 0xFFFFFFFF, 0, 0)


@pytest.mark.parametrize("text", ["1:2:3", "1:2:3:4:5", "1:2:3:x", "1:2:3:100000000", "1:2:3:-1", ""])
def test_what_is_no_identity_is_told(text):
    with pytest.raises(ValueError, match="is no identity; it is vendor, product, revision and serial number"):
        parse_identity(text)
