"""A variant of the TMCM-1636 with other quirks."""

from __future__ import annotations

import json

from drive_env import EmulatedDrives


def variant(tmp_path, quirks):
    path = tmp_path / "quirky.toml"
    rows = "".join(f"{key} = {json.dumps(value)}\n" for key, value in quirks.items())
    path.write_text(f'title = "Quirky"\nvariant_of = "tmcm1636"\n[quirks]\n{rows}', encoding="utf-8")
    return str(path)


def build(tmp_path, **quirks):
    return EmulatedDrives(variant(tmp_path, {"refuses_same_mode": False} | quirks), "inertia", num_threads=1, seed=1)
