"""The users' settings on the pages, optionally stored in a file: scope and jog speed of axes, units, favourites."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary.quantities import SHOWN
from drive_env.fieldbus.description import Description
from drive_env.studio.scope_trigger import EDGES, ScopeTrigger
from drive_env.studio.scope_view import MODES, MOST_CHANNELS, WINDOWS
from drive_env.whole_file import write_whole
from mechanics.reading.untrusted import read_toml

FORMAT = 1
CHANNELS = (cia402.POSITION_ACTUAL, cia402.VELOCITY_ACTUAL, cia402.TORQUE_ACTUAL)
OF_VL = (cia402.VL_VELOCITY_DEMAND, cia402.VL_VELOCITY_ACTUAL)  # for drives without any of `CHANNELS`
# Units that can be chosen, by dimension; other dimensions have their usual unit.
CHOICES = {"angle": ("rev", "deg", "rad"), "speed": ("rpm", "rev/s", "rad/s", "deg/s"), "current": ("A", "mA")}
UNITS_TEXT = "; ".join(f"{dimension}: {', '.join(units)}" for dimension, units in CHOICES.items())


@dataclass(frozen=True)
class AxisSettings:
    """The settings of an axis.

    Attributes:
        jog_speed: As typed.
        channels: Objects on the scope.
        window: Duration of a recording [s].
        mode: A name of `scope_view.MODES`.
        edge: A name of `scope_trigger.EDGES`.
        source: Object of an edge.
        level: As typed, with its unit.
        before: Share of the recording before the trigger.
    """

    jog_speed: str = "60 rpm"
    channels: tuple[Key, ...] = ()
    window: float = 2.0
    mode: str = "roll"
    edge: str = "rising"
    source: Key = (cia402.VELOCITY_ACTUAL, 0)
    level: str = "30 rpm"
    before: float = 0.1


class Workspace:
    """The settings of each axis, and those common to all axes.

    Args:
        description: Description of the device.
        file: TOML file from which they are read and to which changes are written; None keeps them only while the studio
            runs. A missing file is created with the first change.

    Raises:
        ValueError: For a file that is not a workspace of this device.
        OSError: If it cannot be read.

    Attributes:
        units: Displayed unit of each dimension.
        favourites: Objects that the page Dictionary lists as favourites.
    """

    def __init__(self, description: Description, file: Path | None = None) -> None:
        self._description = description
        self._file = file
        self._axes: dict[int, AxisSettings] = {}
        self.units = dict(SHOWN)
        self.favourites: tuple[Key, ...] = ()
        if file is not None and file.exists():
            data = _read(file, description)
            with _line_named(file):
                self._axes = {int(k): _settings(table, description) for k, table in data.get("axis", {}).items()}
                self.units |= _units(data.get("units", {}))
                self.favourites = tuple(object_key(name) for name in data.get("favourites", []))
                _check_objects(self.favourites, description)

    @property
    def usual_channels(self) -> tuple[Key, ...]:
        """The default objects of a scope: position, velocity and current, or those that a drive has."""
        there = [(index, 0) for index in (*CHANNELS, *OF_VL) if self._description.has((index, 0))]
        return tuple(key for key in there if key[0] in CHANNELS) or tuple(there)

    def of(self, axis: int) -> AxisSettings:
        """Return the settings of an axis."""
        known, usual = self._description, self.usual_channels
        source = (cia402.VELOCITY_ACTUAL, 0)
        return self._axes.get(axis) or AxisSettings(
            channels=usual, source=source if known.has(source) or not usual else usual[-1]
        )

    def change(self, axis: int, **changes: Any) -> None:
        """Change settings of an axis, named as in `AxisSettings`; OSError if the file cannot be written."""
        self._axes[axis] = replace(self.of(axis), **changes)
        self._save()

    def show_in(self, dimension: str, unit: str) -> None:
        """Set the displayed unit of a dimension; errors as in `change`."""
        self.units |= _units({dimension: unit})
        self._save()

    def toggle_favourite(self, key: Key) -> None:
        """Add an object to the favourites, or remove it; errors as in `change`."""
        kept = tuple(one for one in self.favourites if one != key)
        self.favourites = kept if key in self.favourites else (*kept, key)
        self._save()

    def _save(self) -> None:
        if self._file is not None:
            write_whole(self._file, self._toml())

    def _toml(self) -> str:
        lines = [f"format = {FORMAT}", f"device = {json.dumps(self._description.name)}"]
        lines.append(f"favourites = {json.dumps([object_name(key) for key in self.favourites])}")
        lines += ["", "[units]", *(f"{name} = {json.dumps(self.units[name])}" for name in CHOICES)]
        for axis, one in sorted(self._axes.items()):
            lines += ["", f"[axis.{axis}]"]
            for name, value in vars(one).items():
                lines.append(f"{name} = {json.dumps(_written(value))}")
        return "\n".join(lines) + "\n"


def object_name(key: Key) -> str:
    """Format an object as on the pages and in the file: 606C:00."""
    return f"{key[0]:04X}:{key[1]:02X}"


def object_key(name: str) -> Key:
    """Parse the name of an object; ValueError if it is invalid."""
    index, _, sub = name.partition(":")
    return int(index, 16), int(sub, 16)


def _written(value: Any) -> Any:
    """Convert a setting to its form in the file."""
    if not isinstance(value, tuple):
        return value
    return object_name(value) if value and isinstance(value[0], int) else [object_name(key) for key in value]


def _read(file: Path, description: Description) -> dict[str, Any]:
    try:
        data = read_toml(file)
    except ValueError as error:
        raise ValueError(f"{file} is not TOML: {error}; give a file that the studio wrote, or a new name") from None
    if data.get("format") != FORMAT or not isinstance(data.get("axis", {}), dict):
        raise ValueError(f"{file} is not a workspace of the studio; give a file that it wrote, or a new name")
    if data.get("device") != description.name:
        raise ValueError(f"{file} is of {data.get('device')}, and this is {description.name}; give another file")
    return data


@contextmanager
def _line_named(file: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, TypeError, AttributeError, KeyError) as error:
        raise ValueError(f"{file}: {error}; mend the line, or give a new name") from None


def _units(table: Mapping[str, str]) -> dict[str, str]:
    """Check the unit of each dimension; ValueError for one that cannot be chosen."""
    for dimension, unit in table.items():
        if unit not in CHOICES.get(dimension, ()):
            raise ValueError(f"units: {dimension} = {unit!r} is not one of {UNITS_TEXT}")
    return dict(table)


def _check_objects(keys: Iterable[Key], description: Description) -> None:
    for key in keys:
        if not description.has(key):
            raise ValueError(f"{description.name} has no object {object_name(key)}")


def _settings(table: Mapping[str, Any], description: Description) -> AxisSettings:
    missing = {one.name for one in fields(AxisSettings)} ^ set(table)
    if missing:
        raise ValueError(f"these keys are missing, or are not known: {', '.join(sorted(missing))}")
    channels = tuple(object_key(name) for name in table["channels"])
    found = AxisSettings(
        **{**table, "channels": channels, "source": object_key(table["source"]), "window": float(table["window"])}
    )
    _check_objects((*channels, found.source), description)
    for name, value, known in (
        ("mode", found.mode, MODES),
        ("edge", found.edge, EDGES),
        ("window", found.window, WINDOWS),
    ):
        if value not in known:
            raise ValueError(f"{name} = {value!r} is not one of {', '.join(map(str, known))}")
    if len(channels) > MOST_CHANNELS:
        raise ValueError(f"{len(channels)} channels are too many; the scope shows {MOST_CHANNELS}")
    if not 0.0 <= found.before <= 0.9:
        raise ValueError(f"before = {found.before} must be 0 to 0.9")
    if not isinstance(found.jog_speed, str) or not isinstance(found.level, str):
        raise ValueError("jog_speed and level are texts with a unit")
    return found


def trigger_of(settings: AxisSettings, axis: int, level: float) -> ScopeTrigger:
    """Return the trigger in the settings; a change of state and a fault use the statusword.

    Args:
        settings: Settings of the axis.
        axis: Number of the axis.
        level: Raw level of an edge.
    """
    has_level = settings.edge in ("rising", "falling")
    return ScopeTrigger(settings.edge, axis, settings.source if has_level else (cia402.STATUSWORD, 0), level)
