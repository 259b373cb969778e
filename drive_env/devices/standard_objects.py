"""Objects of CiA 402 that have an effect in this emulator, and substitutes for those that a drive lacks.

They are data in `standard.toml`. A row of `STANDARD` binds an object of the standard to a field of the drive record;
its unit is one of `dictionary/units.py`, or the name of a quantity that has a unit of the drive: velocity,
acceleration, torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from drive_env import cia402
from drive_env.devices.variants import parse_key
from drive_env.dictionary.bindings import Binding
from mechanics.reading.untrusted import read_toml

TORQUE = "torque"
# Values of 6098h that are implemented (firmware/common/modes/hm.py).
HOMING_METHODS = (*range(1, 15), *range(17, 31), 33, 34, 35, 37)
HOMING_HERE = (35, 37)  # which need no switch
# Values of 605Ah that are implemented (firmware/common/fsa.py).
QUICK_STOP_OPTIONS = (1, 2, 5, 6)
# Objects that the emulator shows or obeys without a field of the record.
BY_THEMSELVES = (cia402.ERROR_CODE, cia402.SUPPORTED_MODES)


class OwnObject(NamedTuple):
    """An object of the emulator's own, for a drive that lacks one.

    Attributes:
        name, kind: Its name and its type, one of variants.py.
        field, unit: Its field, and the unit.
        why: What the EDS lacks.
        role: Its role; "" if it has none.
        modes: Modes of operation that need it; empty: every drive needs it.
        unless: A field that serves the same purpose if an object has it; "" if no field does.
        access: "rw", or "ro" for a measured value.
    """

    name: str
    kind: str
    field: str
    unit: str = "raw"
    why: str = ""
    role: str = ""
    modes: Sequence[int] = ()
    unless: str = ""
    access: str = "rw"


_DATA = read_toml(Path(__file__).parent / "standard.toml")
STANDARD = tuple(Binding(*parse_key(text), **row) for text, row in _DATA["bindings"].items())
WITHOUT_EFFECT: dict[int, str] = {int(index, 16): why for index, why in _DATA["without_effect"].items()}
GAINS, MOTOR, NEEDED = (
    tuple(OwnObject(name, **row) for name, row in _DATA["own"][table].items()) for table in ("gains", "motor", "needed")
)
