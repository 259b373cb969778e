"""Curves of a training from TensorBoard's event files, also while they are written."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

from mechanics.reading.untrusted import MOST_RECORDING, check_size

EVENTS = "events.out.tfevents."
MOST_POINTS = 20_000  # that are read of a curve
MOST_CURVES = 200  # that are read of a folder

Curves = Mapping[str, tuple[list[int], list[float]]]


def read_curves(folder: Path) -> Curves:
    """Read the scalars of a folder's event files as {tag: (steps, values)}.

    A file that is still being written is read up to its last complete event; links, pipes and files above the size
    and number limits are skipped.

    Raises:
        ImportError: If TensorBoard (extra `agents`) is not installed.
    """
    from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader

    found: dict[str, tuple[list[int], list[float]]] = {}
    for path in sorted(folder.rglob(f"{EVENTS}*")):
        try:
            check_size(path, MOST_RECORDING)
        except (OSError, ValueError):
            continue
        if path.is_symlink():
            continue
        for step, tag, value in _scalars(LegacyEventFileLoader(str(path))):
            if tag not in found and len(found) >= MOST_CURVES:
                continue
            steps, values = found.setdefault(tag, ([], []))
            if len(steps) < MOST_POINTS and math.isfinite(value):
                steps.append(step)
                values.append(value)
    return found


def _scalars(loader: object) -> Iterator[tuple[int, str, float]]:
    """Yield step, tag and value of each scalar of a file."""
    events = loader.Load()  # type: ignore[attr-defined]
    while True:
        try:
            event = next(events)
        except StopIteration:
            return
        except Exception:  # a broken file can raise anything; the events before the error are good
            return
        for one in event.summary.value:
            if one.HasField("simple_value"):
                yield int(event.step), str(one.tag), float(one.simple_value)
            elif one.HasField("tensor") and one.tensor.float_val:
                yield int(event.step), str(one.tag), float(one.tensor.float_val[0])
