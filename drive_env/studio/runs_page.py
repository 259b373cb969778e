"""The page Runs: results of tuners, sweeps and trainings in `runs/`; reports, pictures, films, comparisons."""

from __future__ import annotations

import os

from fastapi import FastAPI
from fastapi.responses import FileResponse, PlainTextResponse, Response
from nicegui import run, ui

from drive_env.studio.page import StudioPage
from drive_env.studio.parts import studio_parts
from drive_env.studio.runs_compare import compare, figures_of
from drive_env.studio.runs_folder import (
    POLICY,
    ROUTE,
    RUNS,
    Run,
    RunFile,
    certificate_of,
    confined,
    find_run,
    list_runs,
    media_type,
    settings_of,
    text_of,
    url_of,
)
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor

REFRESH = 3.0  # s between two readings of the folder
EXTRA = "Learning curves need TensorBoard: pip install 'drive-env[agents]'"
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-cache",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "SAMEORIGIN",  # the page Runs shows reports in frames
}


def attach(web: FastAPI, session: Session) -> None:
    """Add the route for files of runs to the web application."""

    @web.get(ROUTE + "{path:path}")
    def file(path: str) -> Response:
        try:
            found = confined(path, RUNS)
        except ValueError:
            found = None
        if found is None or not found.is_file() or not os.access(found, os.R_OK):
            return PlainTextResponse("There is no such file of a run.", 404, HEADERS)
        return FileResponse(found, media_type=media_type(found), headers=HEADERS)


def build(session: Session, visitor: Visitor) -> None:
    """Build the page."""
    ui.add_head_html('<link rel="stylesheet" href="/studio/assets/pages.css">')
    request = visitor.client.request
    RunsPanel(visitor, "" if request is None else request.query_params.get("run", "")).build()


class RunsPanel:
    """The controls of one page's runs.

    Args:
        visitor: The page.
        chosen: Name of the run to show first; "" selects the newest.
    """

    def __init__(self, visitor: Visitor, chosen: str) -> None:
        self._visitor = visitor
        self._chosen, self._other = chosen, ""
        self._known: list[tuple[str, float, int]] | None = None  # None before the first reading

    def build(self) -> None:
        """Build the page."""
        with ui.element("div").classes("studio-runs"):
            with ui.card().classes("studio-card card-runs"):
                ui.label("Runs").classes("studio-heading").props('role="heading" aria-level="2"')
                ui.label(f"In {RUNS.resolve()}").classes("studio-hint")
                self._find = ui.input("Find by name", on_change=self._look).props("dense outlined clearable")
                self._find.props("data-test=find-run").classes("w-full")
                self._list = ui.element("div").classes("studio-run-list")
            with ui.element("div").classes("studio-stack"):
                self._detail = ui.card().classes("studio-card card-run")
        ui.timer(REFRESH, self._look, immediate=True)

    async def _look(self) -> None:
        """Read the folder, and show its changes."""
        found = await run.io_bound(list_runs, RUNS)
        wanted = str(self._find.value or "").lower()
        runs = [one for one in found or [] if wanted in one.name.lower()]
        known = [(one.name, one.changed, len(one.files)) for one in runs]
        if known == self._known:
            return
        is_first = not self._known
        before = {name: (changed, count) for name, changed, count in self._known or ()}
        self._known = known
        if not self._chosen and runs:
            self._chosen = runs[0].name
        self._draw_list(runs)
        now = {one.name: (one.changed, len(one.files)) for one in runs}
        if is_first or before.get(self._chosen) != now.get(self._chosen):
            self._draw()

    def _draw_list(self, runs: list[Run]) -> None:
        self._list.clear()
        with self._list:
            if not runs:
                ui.label("None yet. Tune an axis, or run drive-tune or drive-agent in this folder.").classes(
                    "studio-hint"
                )
            for one in runs:
                button = ui.button(on_click=lambda one=one: self._choose(one.name)).props("flat no-caps dense")
                button.classes("w-full is-here" if one.name == self._chosen else "w-full")
                button.props["data-run"] = one.name
                if one.name == self._chosen:
                    button.props('aria-current="true"')
                with button, ui.element("div").classes("studio-run-name"):
                    ui.label(one.name)
                    ui.html(f"<small>{one.when}, {_what(one)}</small>", sanitize=False)

    async def _choose(self, name: str) -> None:
        self._chosen = name
        self._known = None
        await self._look()

    def _draw(self) -> None:
        self._detail.clear()
        chosen = find_run(self._chosen, RUNS) if self._chosen else None
        with self._detail:
            if chosen is None:
                ui.label("No run is chosen.").classes("studio-hint")
                return
            ui.label(chosen.name).classes("studio-heading").props('role="heading" aria-level="2" data-test=run-name')
            self._comparison(chosen)
            if self._other and (other := find_run(self._other, RUNS)) is not None:
                _show_comparison(chosen, other)
                return
            _show_run(chosen)

    def _comparison(self, shown: Run) -> None:
        names = [name for name, *_ in self._known or () if name != shown.name]
        others = {"": "none", **{name: name for name in names}}
        if self._other not in others:
            self._other = ""
        chosen = ui.select(others, value=self._other, label="Compare with", with_input=True).props("dense outlined")
        chosen.classes("w-full").props("data-test=compare-with")

        def change() -> None:
            self._other = str(chosen.value or "")
            self._draw()

        chosen.on_value_change(change)


def _what(run: Run) -> str:
    """Summarise a run's files in a few words."""
    found = [
        f"{len(run.of(kind))} {kind}{'s' * (len(run.of(kind)) > 1)}"
        for kind in ("report", "picture", "film")
        if run.of(kind)
    ]
    if run.has_events:
        found.append("learning curves")
    return ", ".join(found) or f"{len(run.files)} file{'s' * (len(run.files) != 1)}"


def _show_run(run: Run) -> None:
    if run.has_events:
        parts = studio_parts("/runs")
        for part in parts:
            part.build(confined(run.name, RUNS))
        if not parts:
            ui.label(EXTRA).classes("studio-hint")
    figures = figures_of(certificate_of(run))
    if figures:
        with ui.expansion("Certificate in figures", value=not run.of("report")).classes("w-full"):
            _rows(("", ""), [(name, value) for name, value in figures.items()])
    for report in run.of("report"):
        _report(run, report)
    _gallery(run, [*run.of("picture"), *run.of("film")])
    if settings := settings_of(run):
        with ui.expansion("Settings", value=False).classes("w-full"):
            _rows(("", ""), list(settings.items()))
    if files := [*run.of("text"), *run.of("other")]:
        with ui.expansion(f"Files ({len(files)})", value=not run.of("report")).classes("w-full"):
            for file in files:
                _file(run, file)


def _report(run: Run, file: RunFile) -> None:
    """Show a report in a frame without permission to run scripts."""
    address = url_of(run.name, file.path)
    ui.link(f"{file.path or run.name} in a tab of its own", address, new_tab=True).classes("studio-open")
    frame = ui.element("iframe").classes("studio-report")
    frame.props["sandbox"] = ""  # no script, no form
    frame.props["src"], frame.props["title"] = address, f"Report {file.path or run.name}"
    frame.props("data-test=report")


def _gallery(run: Run, files: list[RunFile]) -> None:
    if not files:
        return
    with ui.element("div").classes("studio-gallery"):
        for file in files:
            address, name = url_of(run.name, file.path), file.path or run.name
            with ui.element("figure"):
                if file.kind == "film":
                    film = ui.element("video").props("controls muted loop data-test=film")
                    film.props["src"], film.props["aria-label"] = address, name
                else:
                    picture = ui.element("img").props("loading=lazy data-test=picture")
                    picture.props["src"], picture.props["alt"] = address, name
                with ui.element("figcaption"):
                    ui.link(name, address, new_tab=True)


def _file(run: Run, file: RunFile) -> None:
    address, name = url_of(run.name, file.path), file.path or run.name
    if file.kind != "text":
        ui.link(f"{name} ({_size(file.size)})", address, new_tab=True).classes("studio-open")
        return
    with ui.expansion(f"{name} ({_size(file.size)})").classes("w-full") as box:
        text = ui.element("pre").classes("studio-text")

    def fill() -> None:
        if box.value and not text.default_slot.children:
            try:
                content = text_of(confined(f"{run.name}/{file.path}" if file.path else run.name, RUNS))
            except (OSError, ValueError) as error:
                content = str(error)
            with text:
                ui.label(content)

    box.on_value_change(fill)


def _size(count: int) -> str:
    return f"{count} B" if count < 1000 else f"{count / 1e3:.0f} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"


def _show_comparison(one: Run, other: Run) -> None:
    rows = compare(one, other)
    differ = sum(row[3] for row in rows)
    ui.label(f"{differ} of {len(rows)} figures and settings differ" if rows else "No figures to compare").classes(
        "studio-strong"
    ).props("data-test=differences")
    if rows:
        _rows(("", one.name, other.name), [(f"{'≠' if d else '='} {name}", a, b) for name, a, b, d in rows])
    with ui.element("div").classes("studio-pair"):
        for run in (one, other):
            with ui.column().classes("w-full"):
                ui.label(run.name).classes("studio-label")
                for report in run.of("report")[:1]:
                    _report(run, report)
                _gallery(run, [*run.of("picture"), *run.of("film")])


def _rows(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    with ui.element("div").classes("studio-scroll w-full"), ui.element("table").classes("studio-table is-text"):
        if any(head):
            with ui.element("thead"), ui.element("tr"):
                for text in head:
                    with ui.element("th"):
                        ui.label(text)
        with ui.element("tbody"):
            for first, *others in rows:
                with ui.element("tr"):
                    with ui.element("th"):
                        ui.label(first)
                    for text in others:
                        with ui.element("td").classes("text"):
                            ui.label(text)


page = StudioPage("/runs", "Runs", "folder_open", 60, build, attach=attach)
