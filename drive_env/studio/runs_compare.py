"""Compares two runs: the entries of their settings and certificates, and the differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from drive_env.studio.runs_folder import Run, certificate_of, settings_of

MOST_ROWS = 200
SHOWN = 6  # digits


def compare(one: Run, other: Run) -> list[tuple[str, str, str, bool]]:
    """Return rows of name, both values, and whether they differ; the certificates first."""
    rows = []
    for mine, theirs in (
        (figures_of(certificate_of(one)), figures_of(certificate_of(other))),
        (settings_of(one), settings_of(other)),
    ):
        for name in dict.fromkeys((*mine, *theirs)):
            a, b = mine.get(name, "-"), theirs.get(name, "-")
            rows.append((name, a, b, a != b))
    return rows[:MOST_ROWS]


def figures_of(certificate: Mapping[str, Any]) -> dict[str, str]:
    """Return the figures in a certificate's JSON by name: verdicts, gains, margins, steps."""
    found: dict[str, str] = {}
    for name in ("tuner", "device", "motor", "machine", "supply", "seed", "created"):
        if name in certificate:
            found[name] = text(certificate[name])
    axes = certificate.get("axes")
    for axis in axes if isinstance(axes, list) else ():
        if isinstance(axis, Mapping):
            head = f"axis {axis.get('axis', len(found))}: " if len(certificate["axes"]) > 1 else ""
            found |= {head + name: value for name, value in _axis(axis).items()}
    return found


def _axis(axis: Mapping[str, Any]) -> dict[str, str]:
    found = {"verdict": verdict_of(axis)}
    for name in ("before", "after", "reason", "hardware_seconds", "aborts"):
        if name in axis:
            found[name.replace("_", " ")] = text(axis[name])
    for kind in ("frequency_responses", "steps"):
        for row in axis.get(kind) or ():
            if isinstance(row, Mapping) and row.get("tuned"):
                figures = row.get("margins") or row.get("figures") or {}
                found |= {f"{row.get('name')}: {name}": text(value) for name, value in figures.items()}
    for name, value in (axis.get("figures") or {}).items():
        found[str(name)] = text(value)
    return found


def verdict_of(axis: Mapping[str, Any]) -> str:
    """Return the verdict of an axis in a certificate."""
    if "verdict" in axis:
        return str(axis["verdict"])
    if not axis.get("accepted"):
        return "rejected"
    return "accepted with reservations" if axis.get("reservations") else "accepted"


def text(value: Any) -> str:
    """Format a value of a file for display."""
    if value is None:
        return "not measured"
    if isinstance(value, float):
        return f"{value:.{SHOWN}g}"
    if isinstance(value, list | tuple):
        return ", ".join(text(one) for one in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {text(one)}" for name, one in value.items())
    return str(value)
