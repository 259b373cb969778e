"""The progress of a training: a CSV that grows by rows, and is truncated when a run is resumed."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drive_env.whole_file import naming
from mechanics.reading.untrusted import MOST_RECORDING, read_text


class TrainingTable:
    """Rows of a CSV; the first one has the columns' names.

    Args:
        path: The file; its content is deleted, except rows up to `keep`.
        keep: Number of steps up to which a resumed run's rows are kept.
    """

    def __init__(self, path: Path, keep: int = 0) -> None:
        self._path = path
        rows = []
        if keep and path.is_file():
            text = io.StringIO(read_text(path, MOST_RECORDING))
            rows = [row for row in csv.DictReader(text) if int(row["timesteps"]) <= keep]
        self._columns: list[str] = []
        path.unlink(missing_ok=True)
        for row in rows:
            self.add(row)

    def add(self, row: Mapping[str, Any]) -> None:
        """Append a row; it is on the disk when this returns."""
        first = not self._columns
        if first:
            self._columns = list(row)
        with naming(self._path), self._path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns, restval="", extrasaction="ignore")
            if first:
                writer.writeheader()
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
