"""A node on a wire that plays transcripts: what a master sends (rx) and what the node must answer (tx).

    rx 605  40 41 60 00 00 00 00 00   # the node receives
    tx 585  4B 41 60 00 .. 02 00 00   # and sends; `..` is any byte
    rx 705  RTR                       # a remote frame
    wait 100 ms                       # communication cycles pass

After every rx and wait the node must have sent the frames that follow as tx, in this order, and no others.
"""

from __future__ import annotations

from drive_env.canopen.frames import Frame
from drive_env.canopen.node import Node

CYCLE = 0.001


def parse(identifier: str, rest: str) -> Frame:
    if rest == "RTR":
        return Frame(int(identifier, 16), b"", True, 1)
    return Frame(int(identifier, 16), bytes.fromhex(rest))


def matches(frame: Frame, expected: str) -> bool:
    """Return whether a frame is as a tx line says."""
    identifier, _, rest = expected.partition(" ")
    if frame.rtr or frame.can_id != int(identifier, 16):
        return False
    wanted = rest.split()
    found = frame.data.hex(" ").upper().split()
    return len(found) == len(wanted) and all(w in ("..", f) for w, f in zip(wanted, found, strict=True))


class Wire:
    """A node that has booted, the drives behind it, and the time."""

    def __init__(self, drives, node_id=5, store=None, first_axis=0, bit_rate=None):
        self.drives = drives
        self.now = 0.0
        self.sent: list[Frame] = []
        self.node = Node(node_id, drives, first_axis, send=self.sent.append, store=store, bit_rate=bit_rate)
        self.node.power_on(self.now)
        assert [str(frame) for frame in self.sent] == [f"{0x700 + self.node.node_id:03X}  00"], "the boot-up message"
        self.sent.clear()

    def wait(self, cycles: int) -> None:
        """Let communication cycles pass."""
        for _ in range(cycles):
            self.node.before_cycle(self.now)
            self.drives.advance(CYCLE)
            self.now += CYCLE
            self.node.after_cycle(self.now)

    def receive(self, can_id: int, text: str = "") -> list[Frame]:
        """Hand a frame to the node; return what it sends at once."""
        self.node.receive(Frame(can_id, bytes.fromhex(text)), self.now)
        return self.take()

    def take(self) -> list[Frame]:
        """Return and forget what the node has sent."""
        frames, self.sent[:] = list(self.sent), []
        return frames

    def play(self, transcript: str) -> None:
        lines = [line.split("#")[0].strip() for line in transcript.splitlines()]
        lines = [line for line in lines if line]
        k = 0
        while k < len(lines):
            event = lines[k]
            kind, _, rest = event.partition(" ")
            if kind == "rx":
                identifier, _, content = rest.strip().partition(" ")
                self.node.receive(parse(identifier, content.strip()), self.now)
            elif kind == "wait":
                self.wait(int(rest.split()[0]))
            else:
                raise ValueError(f"a transcript cannot begin a step with {event!r}")
            k += 1
            expected = []
            while k < len(lines) and lines[k].startswith("tx"):
                expected.append(" ".join(lines[k].split()[1:]))
                k += 1
            sent = self.take()
            good = len(sent) == len(expected) and all(map(matches, sent, expected))
            assert good, f"after {event!r}\nsent     {[str(f) for f in sent]}\nexpected {expected}"

    def value(self, index: int, sub: int = 0):
        """Return an object as the node's dictionary has it."""
        return self.node.dictionary.port(index, sub).read()

    # --- what many tests need beforehand --------------------------------------------------------------------------
    def start(self) -> None:
        """Make the node operational; what it sends on that occasion is forgotten."""
        self.node.receive(Frame(0, bytes([1, self.node.node_id])), self.now)
        self.wait(1)
        self.take()

    def download(self, index: int, sub: int, raw: int, size: int) -> int:
        """Write an object by expedited SDO; return 0, or the abort code."""
        data = raw.to_bytes(size, "little", signed=raw < 0)
        head = bytes([0x23 | (4 - size) << 2]) + index.to_bytes(2, "little") + bytes([sub])
        self.node.receive(Frame(0x600 + self.node.node_id, head + data + bytes(4 - size)), self.now)
        (answer,) = self.take()
        assert answer.data[1:4] == head[1:4], "the multiplexor of the request"
        return int.from_bytes(answer.data[4:8], "little") if answer.data[0] == 0x80 else 0

    def enable(self) -> None:
        """Take the drives to operation enabled in pv, by SDO."""
        if self.value(0x6060) != 3:
            assert self.download(0x6060, 0, 3, 1) == 0
        for word in (6, 7, 15):
            assert self.download(0x6040, 0, word, 2) == 0
        assert self.value(0x6041) & 0x6F == 0x27
