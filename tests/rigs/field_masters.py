"""Masters in the field: what each writes in Pre-Op, what its images carry, and how it enables.

Facts of public sources: IgH's master (fsm_pdo.c, fsm_pdo_entry.c, fsm_slave_config.c), ICube's ethercat_driver_ros2
(its EPOS3 and SV660N configurations, generic_ec_cia402_drive.cpp), start-up lists of TwinCAT as PSI's ecmccfg has them
and an ENI of two IS620N, a configuration of CODESYS with SoftMotion and XINJE DP3C. Each is put to three axes at 800h,
with the objects that the TMCM-3313 has in place of those that it has not.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

AXES = 3
ENABLED, HAS_STATE = 0x27, 0x6F


class Startup(NamedTuple):
    """A start-up.

    Attributes:
        writes: Rows of index, sub-index and value, each with as many bytes as it has pairs of digits; `*` is complete
            access, its first value the number of entries with 16 bits.
        outputs: Of one axis, as `struct` has them.
        commanded: What these are.
        inputs: Of one axis.
        shown: What these are.
        has_sync0: Whether its clocks run.
    """

    writes: str
    outputs: str
    commanded: tuple[str, ...]
    inputs: str
    shown: tuple[str, ...]
    has_sync0: bool

    def rows(self):
        """Return index, sub-index, None for complete access, and data of each write."""
        for line in self.writes.strip().splitlines():
            place, *values = line.partition("#")[0].split()
            index, sub = place.split(":")
            data = b"".join(bytes.fromhex(value)[::-1] for value in values)
            yield int(index, 16), None if sub == "*" else int(sub, 16), data

    @property
    def sizes(self):
        """Return the lengths of both images [bytes]."""
        return tuple(struct.calcsize("<" + layout * AXES) for layout in (self.outputs, self.inputs))

    def pack(self, axes):
        """Return the outputs of axes, each a mapping of what is commanded."""
        values = [axis[name] for axis in axes for name in self.commanded]
        return struct.pack("<" + self.outputs * AXES, *values)

    def unpack(self, data):
        """Return the fields of the input image, axis by axis."""
        values = struct.unpack("<" + self.inputs * AXES, data)
        width = len(self.shown)
        return [dict(zip(self.shown, values[k : k + width], strict=True)) for k in range(0, len(values), width)]


# The slave's `sdo` before all; then sync manager by sync manager the mapping, with the assignment still there, and the
# assignment (ec_fsm_pdo_conf_action_next_sync).
ICUBE = Startup(
    """
    60C2:01 01
    60C2:02 FD
    1600:00 00
    1600:01 60400010
    1600:02 607A0020
    1600:03 60600008
    1600:04 68400010
    1600:05 687A0020
    1600:06 68600008
    1600:07 70400010
    1600:08 707A0020
    1600:09 70600008
    1600:00 09
    1C12:00 00
    1C12:01 1600
    1C12:00 01
    1A00:00 00
    1A00:01 60410010
    1A00:02 60640020
    1A00:03 60610008
    1A00:04 68410010
    1A00:05 68640020
    1A00:06 68610008
    1A00:07 70410010
    1A00:08 70640020
    1A00:09 70610008
    1A00:00 09
    1C13:00 00
    1C13:01 1A00
    1C13:00 01
    """,
    "Hib", ("word", "target", "mode"), "Hib", ("word", "position", "mode"), True,
)  # fmt: skip

# Both assignments away, the inputs' mapping before the outputs', the assignments, then the user's rows.
TWINCAT = Startup(
    """
    1C12:00 00
    1C13:00 00
    1A00:00 00
    1A00:01 60410010
    1A00:02 60640020
    1A00:03 00000010
    1A00:04 68410010
    1A00:05 68640020
    1A00:06 00000010
    1A00:07 70410010
    1A00:08 70640020
    1A00:09 00000010
    1A00:00 09
    1600:00 00
    1600:01 60400010
    1600:02 607A0020
    1600:03 60B10020
    1600:04 68400010
    1600:05 687A0020
    1600:06 68B10020
    1600:07 70400010
    1600:08 707A0020
    1600:09 70B10020
    1600:00 09
    1C12:01 1600
    1C12:00 01
    1C13:01 1A00
    1C13:00 01
    6060:00 08
    6860:00 08
    7060:00 08
    """,
    "Hii", ("word", "target", "speed"), "Hi2x", ("word", "position"), True,
)  # fmt: skip

# Mode and interpolation time from the device's description; a gap where its drive has a touch probe (60B8h). No public
# source tells in which order it writes the rest: here with complete access and the mapping first, as SOEM's issue 530.
CODESYS = Startup(
    """
    6060:00 08
    60C2:01 01
    60C2:02 FD
    6860:00 08
    68C2:01 01
    68C2:02 FD
    7060:00 08
    70C2:01 01
    70C2:02 FD
    1600:*  0009 60400010 607A0020 00000010 68400010 687A0020 00000010 70400010 707A0020 00000010
    1A00:*  0009 60410010 60610008 60640020 68410010 68610008 68640020 70410010 70610008 70640020
    1C12:*  0001 1600
    1C13:*  0001 1A00
    """,
    "Hi2x", ("word", "target"), "Hbi", ("word", "mode", "position"), True,
)  # fmt: skip

STARTUPS = {"ICube on IgH": ICUBE, "TwinCAT": TWINCAT, "CODESYS": CODESYS}


class FieldAxis:
    """One axis as its master commands it: enabled as soon as its slave is in Op, and then moved from where it is.

    Args:
        step: How far it moves in each cycle [inc].
        cycles: For how many.
    """

    def __init__(self, step, cycles):
        self.step, self.cycles = step, cycles
        self.enabled = 0  # cycles since
        self.start = None  # where it was then
        self.now = {"word": 0, "target": 0, "speed": 0, "mode": 8}  # what is sent

    def take(self, shown):
        """Learn what a cycle's inputs show, and decide what the next outputs command."""
        state, word = shown["word"] & HAS_STATE, self.now["word"]
        self.shown = shown
        if state == ENABLED:
            self.start = shown["position"] if self.start is None else self.start
            self.enabled += 1
        elif shown["word"] & 0x4F == 0x40:
            word = word & 0x7E | 0x06
        elif state == 0x21:
            word = word & 0x77 | 0x07
        elif state == 0x23:
            word = word & 0x7F | 0x0F
        elif shown["word"] & 0x4F == 0x08:
            word |= 0x80
        # ICube's driver sends no target until the drive shows a mode, and then where the axis is until it is enabled.
        target = shown["position"] if shown.get("mode", 8) else self.now["target"]
        if self.start is not None:
            target = self.start + min(self.enabled, self.cycles) * self.step
        self.now |= {"word": word, "target": target}
