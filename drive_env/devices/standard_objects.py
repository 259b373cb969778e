"""Objects of CiA 402 that this emulator gives an effect, and the substitutes for those that a drive lacks.

They are data, as a device's own are: `standard.toml`. A row of `STANDARD` binds an object of the standard to a field of
the drive record; its unit is one of `dictionary/units.py`, or the name of a quantity that each drive counts in its own
unit: velocity, acceleration, torque.
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
# Numbers of 6098h that homing knows (firmware/common/modes/hm.py).
HOMING_METHODS = (*range(1, 15), *range(17, 31), 33, 34, 35, 37)
HOMING_HERE = (35, 37)  # which need no switch
# Values of 605Ah that the automaton knows (firmware/common/fsa.py).
QUICK_STOP_OPTIONS = (1, 2, 5, 6)
# Objects whose value the emulator shows or obeys by itself, without a field of the record.
BY_THEMSELVES = (cia402.ERROR_CODE, cia402.SUPPORTED_MODES)


class OwnObject(NamedTuple):
    """An object of the emulator's own, where a drive has none.

    Attributes:
        name, kind: Its name and its type, one of variants.py.
        field, unit: The field that it is, and in which unit.
        why: What the EDS lacks.
        role: The part that it plays; "" for none.
        modes: Modes of operation that need it; empty: every drive does.
        unless: A field that does the same where an object has it; "" for none.
    """

    name: str
    kind: str
    field: str
    unit: str = "raw"
    why: str = ""
    role: str = ""
    modes: Sequence[int] = ()
    unless: str = ""


_DATA = read_toml(Path(__file__).parent / "standard.toml")
STANDARD = tuple(Binding(*parse_key(text), **row) for text, row in _DATA["bindings"].items())
WITHOUT_EFFECT: dict[int, str] = {int(index, 16): why for index, why in _DATA["without_effect"].items()}
GAINS, MOTOR, NEEDED = (
    tuple(OwnObject(name, **row) for name, row in _DATA["own"][table].items()) for table in ("gains", "motor", "needed")
)
