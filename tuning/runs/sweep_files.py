"""The files of a sweep: its table, pictures, settings and inputs."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

from drive_env.whole_file import write_picture, write_table, write_whole
from tuning.runs import plots, provenance
from tuning.runs.inputs import write_inputs
from tuning.runs.sweep import SweepResult

ROWS = 65_536  # of results.csv that are written at a time


def save_sweep(result: SweepResult, folder: str | Path) -> Path:
    """Write results.csv, heatmap.png, best_response.png, settings.toml and inputs/ into a new folder and return it.

    The files are complete or absent: they are written to a partial folder, which is then renamed.

    Raises:
        FileExistsError: If the folder is not empty.
        OSError: If it cannot be written.
    """
    with provenance.new_folder(folder) as partial:
        _write_csv(result, partial / "results.csv")
        for name, figure in (("heatmap", plots.heat_map(result)), ("best_response", plots.best_response(result))):
            write_picture(partial / f"{name}.png", figure, figure.dpi)
        write_inputs(partial, result.experiment.inputs())
        settings = result.experiment.to_toml(provenance.versions())
        write_whole(partial / "settings.toml", provenance.HEADER + settings)
    return Path(folder)


def _write_csv(result: SweepResult, path: Path) -> None:
    # Python writes floats with all significant digits, and also inf and nan: nothing is lost.
    columns = [column.astype(int) if column.dtype == bool else column for column in result.columns.values()]
    rows = (
        row
        for first in range(0, len(result.order), ROWS)  # a million rows as Python's numbers take 600 MB
        for row in zip(*(column[first : first + ROWS].tolist() for column in columns), strict=True)
    )
    write_table(path, chain([list(result.columns)], rows), lineterminator="\n")
