"""The part of the page Runs that draws learning curves of a training, also while it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nicegui import run, ui

from agents.studio.event_curves import Curves, read_curves
from drive_env.studio import charts
from drive_env.studio.parts import StudioPart

REFRESH = 5.0  # s between two readings of a running training
FIRST = ("rollout/ep_rew_mean", "rollout/return", "eval/mean_reward", "return")


def first_tag(tags: list[str]) -> str | None:
    """Return the tag of the curve shown first: an episode's return if there is one, else the first; None without."""
    return next((tag for tag in FIRST if tag in tags), tags[0] if tags else None)


def curve_chart(curves: Curves, tags: list[str]) -> dict[str, Any]:
    """Return the options of a chart with one panel per curve."""
    panels = [charts.ChartPanel(tag) for tag in tags]
    lines = [charts.ChartLine(tag, *curves[tag], panel=k, colour=k) for k, tag in enumerate(tags)]
    return charts.options(panels or [charts.ChartPanel("")], "steps of all environments", lines)


def build(folder: Path) -> None:
    """Add the learning curves of a run's folder to the page."""
    ui.label("Learning curves").classes("studio-heading").props('role="heading" aria-level="3"')
    chosen = ui.select([], multiple=True, label="Curves").props("dense outlined use-chips data-test=curve-tags")
    chosen.classes("w-full")
    picture = charts.chart("Learning curves of the training over its steps", "curves-chart")
    told = ui.label("").classes("studio-hint").props("data-test=curves-told")
    kept: dict[str, Any] = {}

    def draw() -> None:
        tags = [tag for tag in (chosen.value or []) if tag in kept]
        charts.show(picture, curve_chart(kept, tags[:4]))

    async def look() -> None:
        try:
            found = await run.io_bound(read_curves, folder)
        except ImportError:
            told.set_text("Learning curves need TensorBoard: pip install 'drive-env[agents]'")
            timer.deactivate()
            return
        if found is None or found == kept:
            return
        kept.clear()
        kept.update(found)
        tags = sorted(found)
        before = [tag for tag in (chosen.value or []) if tag in found]
        first = first_tag(tags)
        chosen.set_options(tags, value=before or ([first] if first else []))
        last = max((steps[-1] for steps, _ in found.values() if steps), default=0)
        told.set_text(f"{len(tags)} curves up to step {last:,}; looked at again every {REFRESH:g} s")
        draw()

    chosen.on_value_change(draw)
    timer = ui.timer(REFRESH, look, immediate=True)


part = StudioPart("/runs", 10, build)
