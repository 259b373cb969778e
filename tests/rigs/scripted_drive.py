"""A small CiA 402 drive behind a python-can bus, all in the caller's thread: what the master is tested against.

It is written from CiA 301 and knows nothing of the emulator, so that a mistake in both would have to be made twice.
"""

import struct
from collections import deque

import can

ABORT = 0x80


class ScriptedDrive:
    """A node that answers SDO, takes RPDOs at SYNC or at once, and samples TPDOs at SYNC.

    `values` maps (index, sub) to (integer or text, size in bytes), `refusals` to an abort code for writes; `silent` are
    objects that it does not answer about.
    """

    def __init__(self, node=1, values=None, axes=1):
        self.node = node
        self.values = {
            (0x1000, 0): (0xFFFC0192, 4),
            (0x1008, 0): ("TMCM-1636", 9),
            (0x1014, 0): (0x80 + node, 4),
            (0x1016, 1): (0, 4),
            (0x1017, 0): (0, 2),
            (0x1018, 1): (0x286, 4),
            (0x1018, 2): (1636, 4),
            (0x1029, 1): (0, 1),
            (0x2003, 0): (7000, 4),
        }
        for axis in range(axes):
            self._add_axis(0x800 * axis)
        for k in range(4):
            self._add_pdo(0x1400, 0x1600, k, 0x200 + 0x100 * k + node, 255, [0x60400010])
            self._add_pdo(0x1800, 0x1A00, k, 0x180 + 0x100 * k + node, 255 if k < 2 else 1, [0x60410010])
        self.values.update(values or {})
        self.refusals = {}
        self.silent = set()
        self.latched = []
        self.operational = False
        self.syncs = 0
        self.motion = lambda drive: None  # called at each SYNC, after the samples
        self.segments = b""
        self.target = (0, 0)
        self.log = []

    def _add_axis(self, offset):
        sizes = {0x6040: 2, 0x6041: 2, 0x6060: 1, 0x6061: 1, 0x6062: 4, 0x6064: 4, 0x6065: 4, 0x606C: 4, 0x6071: 2}
        sizes |= {0x6077: 2, 0x607A: 4, 0x6081: 4, 0x60FF: 4}
        for index, size in sizes.items():
            self.values[index + offset, 0] = (0, size)
        self.values[0x6041 + offset, 0] = (0x0240, 2)
        self.values[0x6065 + offset, 0] = (0xFFFFFFFF, 4)
        self.values[0x607D + offset, 1] = (-(2**31), 4)
        self.values[0x607D + offset, 2] = (2**31 - 1, 4)

    def _add_pdo(self, communication, mapping, k, can_id, kind, entries):
        self.values[communication + k, 1] = (0x40000000 | can_id, 4)
        self.values[communication + k, 2] = (kind, 1)
        self.values[mapping + k, 0] = (len(entries), 1)
        for sub in range(1, 4):
            self.values[mapping + k, sub] = (entries[sub - 1] if sub <= len(entries) else 0, 4)

    def get(self, index, sub=0):
        return self.values[index, sub][0]

    def set(self, index, value, sub=0):
        size = self.values[index, sub][1]
        self.values[index, sub] = (value, size)
        base = index % 0x800
        if index >= 0x6000 and base == 0x40:
            states = {0x06: 0x0221, 0x07: 0x0233, 0x0F: 0x0637, 0x02: 0x0240, 0x00: 0x0240, 0x80: 0x0240}
            self.set(index + 1, states.get(value & 0x8F, 0x0240) | (0x1000 if value & 0x10 else 0))
        if index >= 0x6000 and base == 0x60:
            self.set(index + 1, value)

    def receive(self, can_id, data, remote):
        """Return the frames that this frame sets off."""
        if can_id == 0x600 + self.node and len(data) == 8:
            return self._sdo(data)
        if can_id == 0x000 and data[1] in (0, self.node):
            self.operational = data[0] == 0x01 or (self.operational and data[0] not in (0x02, 0x80, 0x81))
            return [(0x700 + self.node, b"\0")] if data[0] == 0x81 else []
        if can_id == 0x080 and self.operational:
            return self._sync()
        for k in range(4):
            cob_id = self.get(0x1400 + k, 1)
            if self.operational and not cob_id >> 31 and cob_id & 0x7FF == can_id:
                self.latched.append((k, data)) if self.get(0x1400 + k, 2) <= 240 else self._take(k, data)
        return []

    def _members(self, mapping, k):
        for sub in range(1, self.get(mapping + k, 0) + 1):
            entry = self.get(mapping + k, sub)
            yield entry >> 16, entry >> 8 & 0xFF, (entry & 0xFF) // 8

    def _take(self, k, data):
        for index, sub, size in self._members(0x1600, k):
            signed = index % 0x800 not in (0x40,)
            self.set(index, int.from_bytes(data[:size], "little", signed=signed), sub)
            data = data[size:]

    def _sync(self):
        self.syncs += 1
        latched, self.latched = self.latched, []
        for k, data in latched:
            self._take(k, data)
        frames = []
        for k in range(4):
            cob_id = self.get(0x1800 + k, 1)
            if not cob_id >> 31 and self.get(0x1800 + k, 2) <= 240:
                data = b""
                for index, sub, size in self._members(0x1A00, k):
                    data += (self.get(index, sub) % 2 ** (8 * size)).to_bytes(size, "little")
                frames.append((cob_id & 0x7FF, data))
        self.motion(self)
        return frames

    def _sdo(self, data):
        command, index, sub = struct.unpack_from("<BHB", data)
        answer = 0x580 + self.node
        if (index, sub) in self.silent:
            return []
        if command in (0x60, 0x70):  # next segment
            part, self.segments = self.segments[:7], self.segments[7:]
            last = 0 if self.segments else 1
            return [(answer, bytes([command & 0x10 | (7 - len(part)) << 1 | last]) + part.ljust(7, b"\0"))]
        if command == ABORT:
            return []
        if command & 0xE0 == 0:  # segment of a download
            self.segments += data[1 : 8 - (command >> 1 & 7)]
            if command & 1:
                self.set(self.target[0], int.from_bytes(self.segments, "little"), self.target[1])
            return [(answer, bytes([0x20 | command & 0x10]) + bytes(7))]
        if (index, sub) not in self.values:
            return [(answer, struct.pack("<BHBL", ABORT, index, sub, 0x06020000))]
        value, size = self.values[index, sub]
        if command == 0x40:
            raw = value.encode() if isinstance(value, str) else (value % 2 ** (8 * size)).to_bytes(size, "little")
            if len(raw) > 4:
                self.segments = raw
                return [(answer, struct.pack("<BHBL", 0x41, index, sub, len(raw)))]
            return [(answer, struct.pack("<BHB", 0x43 | (4 - size) << 2, index, sub) + raw.ljust(4, b"\0"))]
        if (index, sub) in self.refusals:
            return [(answer, struct.pack("<BHBL", ABORT, index, sub, self.refusals[index, sub]))]
        length = int.from_bytes(data[4:], "little") if command == 0x21 else 4 - (command >> 2 & 3)
        if length != size:
            return [(answer, struct.pack("<BHBL", ABORT, index, sub, 0x06070010))]
        if command == 0x21:
            self.segments, self.target = b"", (index, sub)
            return [(answer, struct.pack("<BHB4x", 0x60, index, sub))]
        signed = index >= 0x6000 and index % 0x800 not in (0x40, 0x65, 0x81)
        self.set(index, int.from_bytes(data[4 : 4 + length], "little", signed=signed), sub)
        return [(answer, struct.pack("<BHB4x", 0x60, index, sub))]


class ScriptedBus(can.BusABC):
    """A python-can bus with scripted drives at its other end; `log` holds what the master sent."""

    def __init__(self, *drives):
        super().__init__(channel="scripted")
        self.drives = drives
        self.log = []
        self.waiting = deque()

    def send(self, msg, timeout=None):
        self.log.append((msg.arbitration_id, bytes(msg.data), msg.is_remote_frame))
        for drive in self.drives:
            for can_id, data in drive.receive(msg.arbitration_id, bytes(msg.data), msg.is_remote_frame):
                self.push(can_id, data)

    def push(self, can_id, data):
        """Have the master receive a frame."""
        self.waiting.append(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))

    def sent(self, can_id):
        """Return the data of what the master sent under an identifier."""
        return [data for other, data, _ in self.log if other == can_id]

    def _recv_internal(self, timeout):
        if self.waiting:
            return self.waiting.popleft(), True
        if timeout:
            import time

            time.sleep(min(timeout, 0.001))
        return None, True

    def fileno(self):
        raise NotImplementedError
