"""Identifiers of PDOs that a node's further axes borrow from the nodes after it: whether one of these is there."""

from __future__ import annotations

import pytest

from drive_env.fieldbus.errors import BusError
from drive_env.master.can.borrowed_identifiers import LOOK, BorrowedIdentifiers


class Bus:
    """A bus with some nodes that answer an SDO upload of 1000h, told by what waits on it."""

    def __init__(self, *there):
        self.there, self.handlers, self.sent, self.waited, self.subscribed = there, {}, [], [], []

    def subscribe(self, can_id, handler):
        if handler is None:
            del self.handlers[can_id]
        else:
            self.handlers[can_id] = handler
            self.subscribed.append(can_id)

    def send(self, can_id, data):
        assert 0x580 + can_id - 0x600 in self.handlers, "who asks before listening may miss the answer"
        self.sent.append((can_id, data))

    def wait(self, done, timeout):
        self.waited.append(timeout)
        for can_id, _ in self.sent:
            if can_id - 0x600 in self.there:
                self.handlers[can_id - 0x80](bytes.fromhex("43 00 10 00 92 01 02 00"))
        return done()


def test_an_axis_has_the_identifiers_of_the_node_after_its_own():
    """CiA 301, 7.2.4.3.5: an upload request, rx 6xx 40 00 10 00 00 00 00 00; nobody answers."""
    bus = Bus(5, 9)
    borrowed = BorrowedIdentifiers(bus, (5,), 3)
    assert [borrowed.node_of(5, axis) for axis in (1, 2)] == [6, 7]
    assert bus.sent == [(0x606, bytes.fromhex("4000100000000000")), (0x607, bytes.fromhex("4000100000000000"))]
    assert bus.waited == [LOOK], "asked for once, not for every axis"
    assert bus.subscribed == [0x586, 0x587] and bus.handlers == {}


def test_each_of_our_nodes_is_looked_after():
    bus = Bus()
    borrowed = BorrowedIdentifiers(bus, (5, 8), 2)
    assert (borrowed.node_of(5, 1), borrowed.node_of(8, 1)) == (6, 9)
    assert [can_id for can_id, _ in bus.sent] == [0x606, 0x609]


@pytest.mark.parametrize(
    ("there", "ours", "said"),
    [
        ((6,), (5,), r"identifiers of nodes 6 to 7, and node 6 is there: give the nodes other IDs"),
        ((7,), (5,), r"and node 7 is there"),
        ((7, 6), (5,), r"and node 6, 7 is there"),
        ((), (5, 6), r"and node 6 is there"),
        ((6,), (5, 7), r"and node 6, 7 is there"),
        ((8,), (5, 7), r"and node 7 is there"),
    ],
)
def test_a_node_that_is_there_is_named_and_nobody_listens_any_more(there, ours, said):
    bus = Bus(*there)
    with pytest.raises(BusError, match=r"node 5 has 3 axes, whose PDOs would borrow the " + ".*" + said):
        BorrowedIdentifiers(bus, ours, 3).node_of(5, 1)
    assert bus.handlers == {}
    assert {can_id for can_id, _ in bus.sent}.isdisjoint({0x600 + node for node in ours}), "of ours we know it"


def test_a_node_that_was_refused_is_looked_for_again():
    """Its ID may have been changed meanwhile."""
    bus = Bus(6)
    borrowed = BorrowedIdentifiers(bus, (5,), 2)
    with pytest.raises(BusError):
        borrowed.node_of(5, 1)
    bus.there = ()
    assert borrowed.node_of(5, 1) == 6


def test_the_highest_node_is_127():
    assert BorrowedIdentifiers(Bus(), (125,), 3).node_of(125, 2) == 127
    bus = Bus()
    said = r"node 126 has 3 axes, .* nodes 127 to 128: the highest node-ID is 127; give the nodes other IDs, or"
    with pytest.raises(BusError, match=said):
        BorrowedIdentifiers(bus, (126,), 3).node_of(126, 1)
    assert bus.sent == []
