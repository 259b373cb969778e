"""Frames by which another master is told: NMT, SYNC, SDO requests and RPDOs of the nodes that matter."""

import pytest

from drive_env.master.can.other_masters import OtherMasters, OtherMastersError


class Port:
    """A port on which frames are said to have come."""

    def __init__(self):
        self.subscribers = {}

    def subscribe(self, can_id, callback):
        self.subscribers[can_id] = callback

    def wait(self, condition, seconds):
        self.waited = (condition(), seconds)


@pytest.mark.parametrize(("can_id", "said"), [
    (0x000, "an NMT command (000h)"),
    (0x080, "a SYNC (080h)"),
    (0x605, "an SDO request to node 5 (605h)"),
    (0x67F, "an SDO request to node 127 (67Fh)"),
    (0x205, "an RPDO of node 5 (205h)"),
    (0x305, "an RPDO of node 5 (305h)"),
    (0x405, "an RPDO of node 5 (405h)"),
    (0x505, "an RPDO of node 5 (505h)"),
    (0x57F, "an RPDO of node 127 (57Fh)"),
])  # fmt: skip
def test_what_only_a_master_sends_is_told_in_words(can_id, said):
    port = Port()
    others = OtherMasters(port, [5, 127])
    others.check()
    port.subscribers[can_id](b"")
    assert others.heard == said
    port.subscribers[0x080](b"")
    assert others.heard == said, "what came first"
    with pytest.raises(OtherMastersError) as refused:
        others.listen(0.2)
    assert f"another master commands the bus: {said} came that is not ours" in str(refused.value)
    assert port.waited == (True, 0.2)


def test_what_drives_send_and_what_goes_to_others_is_no_sign_of_a_master():
    port = Port()
    OtherMasters(port, [5])
    assert sorted(port.subscribers) == [0x000, 0x080, 0x205, 0x305, 0x405, 0x505, 0x605]
