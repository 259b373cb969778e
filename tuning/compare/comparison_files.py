"""The files of a comparison: tables as CSV, a picture, and the settings that repeat it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from drive_env.whole_file import write_table, write_whole
from tuning.compare.against_best import RivalRow, all_rivals
from tuning.compare.comparison import Comparison, MachineRow, TunerRow
from tuning.compare.comparison_picture import draw
from tuning.runs.inputs import as_kept, inputs_in, table_of, write_inputs
from tuning.toml_tables import toml


def save(comparison: Comparison, folder: Path, settings: Mapping[str, Any]) -> None:
    """Write tuners.csv, rivals.csv, machines.csv, comparison.png, settings.toml and inputs/ into an existing folder."""
    _write_csv(folder / "tuners.csv", comparison.tuners, TunerRow)
    _write_csv(folder / "rivals.csv", all_rivals(comparison), RivalRow)
    _write_csv(folder / "machines.csv", comparison.rows, MachineRow)
    write_inputs(folder, inputs_in(settings))
    write_whole(folder / "settings.toml", settings_text(settings))
    draw(comparison, folder / "comparison.png")


def settings_text(settings: Mapping[str, Any]) -> str:
    """Return settings as TOML, with the hashes of the user's files; settings that are None are omitted."""
    lines = [f"{name} = {toml(as_kept(value))}" for name, value in settings.items() if value is not None]
    return "\n".join([*lines, *table_of(inputs_in(settings))]) + "\n"


def _write_csv(path: Path, rows: Sequence[Any], kind: type) -> None:
    names = [field.name for field in fields(kind)]
    # A mapping becomes one column per key; the keys of the first row count.
    table = [_columns({name: getattr(row, name) for name in names}) for row in rows]
    write_table(path, [table[0] if table else names, *([_cell(value) for value in row.values()] for row in table)])


def _columns(row: Mapping[str, Any]) -> dict[str, Any]:
    """Replace the mappings of a row by their entries."""
    found: dict[str, Any] = {}
    for name, value in row.items():
        found |= value if isinstance(value, Mapping) else {name: value}
    return found


def _cell(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value
