"""The page Dictionary: objects by area, index or name; live values; writes, comparisons, backup and restore."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from nicegui import ui
from nicegui.events import GenericEventArguments, UploadEventArguments

from drive_env import cia402
from drive_env.cia402 import Key
from drive_env.dictionary import search
from drive_env.dictionary.entries import Entry
from drive_env.master.parameters import Difference
from drive_env.studio import dictionary_jobs as jobs
from drive_env.studio import motion_jobs
from drive_env.studio.page import StudioPage
from drive_env.studio.sentences import sentence
from drive_env.studio.session import Session
from drive_env.studio.visitor import Visitor

ROWS = 40  # rows per page of the list
READ = 0.5  # s between two readings of visible objects
MOST_READ = 16  # objects in one reading, so that other jobs do not wait long
FAVOURITES = "favourites"
ALL = "all"


def build(session: Session, visitor: Visitor) -> None:
    """Build the page."""
    DictionaryPanel(session, visitor).build()


class DictionaryPanel:
    """The controls of one page's dictionary.

    Args:
        session: The drives.
        visitor: The page.
    """

    def __init__(self, session: Session, visitor: Visitor) -> None:
        self._session = session
        self._visitor = visitor
        self._known = session.description
        self._axis = visitor.axis
        self._entries: list[Entry] = list(self._known.dictionary)
        self._chosen: list[Entry] = self._entries
        self._first = 0
        self._visible: list[Key] = []
        self._next = 0  # index of the visible object that is read next
        self._rows: dict[Key, ui.label] = {}
        self._is_reading = False

    @property
    def _scale(self) -> Any:
        return self._session.scales[self._axis]

    def build(self) -> None:
        """Build the page."""
        with ui.element("div").classes("studio-dictionary"):
            self._find_card()
            with ui.card().classes("studio-card studio-list"):
                self._list_head = ui.row().classes("studio-buttons")
                self._list = ui.element("div").classes("studio-rows").props('role="table" aria-label="Objects"')
            with ui.element("div").classes("studio-stack"):
                self._compare_card()
                self._backup_card()
        ui.on("dictionary_visible", self._take_visible)
        self._draw()
        ui.timer(READ, self._read_visible)

    # --- search and tree ------------------------------------------------------------------------------------------
    def _find_card(self) -> None:
        with ui.card().classes("studio-card"):
            ui.label("Find").classes("studio-heading")
            self._search = ui.input("Index, name or unit", placeholder="6064 or velocity").props(
                "dense outlined clearable data-test=search debounce=250"
            )
            self._search.classes("w-full").on_value_change(self._choose)
            areas = {ALL: "all", FAVOURITES: "favourites"} | {name: name for name in search.AREAS}
            self._area = ui.toggle(areas, value=ALL, on_change=self._choose).props("no-caps unelevated dense")
            self._area.classes("studio-toggle")
            with ui.expansion("Tree", icon="account_tree").classes("w-full"), ui.element("div").classes("studio-tree"):
                ui.tree(self._nodes(), label_key="label", on_select=lambda event: self._select(event.value)).props(
                    "dense"
                )

    def _nodes(self) -> list[dict[str, Any]]:
        """Return the nodes of the tree: areas, then objects."""
        nodes = []
        for name, (title, _) in search.AREAS.items():
            objects = {e.index: e for e in reversed(self._entries) if search.area_of(e.index) == name}
            children = [
                {"id": f"{index:04X}", "label": f"{index:04X}h {entry.name.partition('.')[0]}"}
                for index, entry in sorted(objects.items())
            ]
            nodes.append({"id": name, "label": f"{title}: {len(children)} objects", "children": children})
        return nodes

    def _select(self, node: str | None) -> None:
        if node in search.AREAS:
            self._area.set_value(node)
        elif node:
            self._area.set_value(ALL)
            self._search.set_value(node.lower())

    def _choose(self) -> None:
        entries: Sequence[Entry] = self._entries
        area = self._area.value
        if area == FAVOURITES:
            entries = [e for e in entries if (e.index, e.sub) in self._session.workspace.favourites]
        elif area != ALL:
            entries = [e for e in entries if search.area_of(e.index) == area]
        self._chosen = search.searched(entries, self._search.value or "")
        self._first = 0
        self._draw()

    # --- the list -------------------------------------------------------------------------------------------------
    def _draw(self) -> None:
        shown = self._chosen[self._first : self._first + ROWS]
        self._rows = {}
        self._visible, self._next = [], 0
        self._list_head.clear()
        with self._list_head:
            count = len(self._chosen)
            last = min(count, self._first + ROWS)
            ui.label(f"{self._first + 1 if count else 0} to {last} of {count} objects").classes("studio-hint")
            ui.space()
            for icon, step, name in (("chevron_left", -ROWS, "Before"), ("chevron_right", ROWS, "Next")):
                button = ui.button(icon=icon, on_click=lambda _, by=step: self._turn(by)).props(
                    f'flat dense aria-label="{name} {ROWS} objects"'
                )
                button.set_enabled(0 <= self._first + step < count)
        self._list.clear()
        with self._list:
            for entry in shown:
                self._row(entry)
        self._visitor.client.run_javascript("studioDictionary.observe()")  # the pressed button may have been removed

    def _turn(self, by: int) -> None:
        self._first = max(0, self._first + by)
        self._draw()

    def _row(self, entry: Entry) -> None:
        key = (entry.index, entry.sub)
        name = f"{entry.index:04X}:{entry.sub:02X}"
        with ui.element("div").classes("studio-row").props(f'role="row" data-key={name}'):
            is_favourite = key in self._session.workspace.favourites
            star = ui.button(icon="star" if is_favourite else "star_outline", on_click=lambda: self._toggle(key))
            star.props(f'flat dense round size=sm aria-label="Favourite {entry.label}"')
            with ui.element("div").classes("what"):
                ui.label(f"{entry.index:04X}h:{entry.sub:02X}").classes("index")
                ui.label(entry.name).classes("name")
            self._rows[key] = ui.label("…").classes("value").props(f"data-value={name}")
            can = "w" in entry.access and cia402.of_first_axis(entry.index) != cia402.CONTROLWORD
            if can and entry.bits is not None:
                ui.button("Set", on_click=lambda: self._dialog(entry)).props(
                    f'flat dense no-caps data-set={name} aria-label="Set {entry.label}"'
                )
            else:
                ui.label("read only" if entry.access in ("ro", "const") else "").classes("studio-hint")

    def _take_visible(self, event: GenericEventArguments) -> None:
        self._visible = [_key(text) for text in event.args]
        self._next = 0

    def _toggle(self, key: Key) -> None:
        """Add an object to the favourites, or remove it."""
        self._visitor.keep(lambda: self._session.workspace.toggle_favourite(key))
        if self._area.value == FAVOURITES:
            self._choose()
        else:
            self._draw()

    async def _read_visible(self) -> None:
        """Read the visible objects, some at a time."""
        visible = [key for key in self._visible if key in self._rows]
        if self._is_reading or not visible or self._session.job is not None or self._session.state != "open":
            return
        self._is_reading = True
        try:
            first = self._next % len(visible)
            most = max(4, MOST_READ // max(1, self._session.num_axes))  # each is read for every axis
            keys = (visible + visible)[first : first + min(most, len(visible))]
            self._next = first + len(keys)
            entries = [self._known.dictionary.find(key) for key in keys]
            job = jobs.values_of(entries, self._axis, self._scale)
            found = await self._visitor.do(job, "Read what is visible", quiet=True)
            for key, value in (found or {}).items():
                if key in self._rows:
                    self._rows[key].set_text(value.text)
        finally:
            self._is_reading = False

    # --- writing --------------------------------------------------------------------------------------------------
    def _dialog(self, entry: Entry) -> None:
        name = f"{entry.index:04X}:{entry.sub:02X}"
        limits = "" if entry.low is None else f"; from {entry.low} to {entry.high}"
        with ui.dialog() as dialog, ui.card().classes("studio-card studio-dialog"):
            ui.label(entry.label).classes("studio-heading")
            now = self._rows[entry.index, entry.sub].text if (entry.index, entry.sub) in self._rows else "…"
            ui.label(f"Now {now}").classes("studio-label")
            unit = f"an integer in {entry.unit}, or a quantity with its unit" if entry.unit else "an integer, also 0x…"
            ui.label(f"It takes {unit}{limits}.").classes("studio-hint")
            field = ui.input(f"New value{f' [{entry.unit}]' if entry.unit else ''}").props(
                f"outlined autofocus data-test=value-{name.replace(':', '-')}"
            )
            field.classes("w-full")
            told = ui.label("").classes("studio-hint").props('role="status"')
            state = self._visitor.state
            if state is not None and state.is_live:
                ui.label("▲ The axis is enabled, and reacts at once.").classes("studio-strong")
            with ui.row().classes("studio-buttons"):
                send = ui.button("Write").props("unelevated no-caps data-test=write")
                ui.button("Cancel", on_click=dialog.close).props("flat no-caps")
            send.set_enabled(False)

        def look() -> jobs.Checked | None:
            try:
                found = jobs.checked(entry, field.value or "", self._scale)
            except Exception as error:
                told.set_text(sentence(error) if field.value else "")
                send.set_enabled(False)
                return None
            told.set_text(f"That is {found.text}.")
            send.set_enabled(True)
            return found

        async def write() -> None:
            found = look()
            if found is None:
                return
            self._note_motion(entry, found.raw)
            back = await self._visitor.do(jobs.write(entry, found.raw, self._axis), f"Write {entry.label}")
            if back is None:
                return
            dialog.close()
            kind = "done" if back == found.raw else "warning"
            reads = jobs.shown(entry, back, self._scale)
            self._visitor.say(f"{entry.label} reads back {reads}", kind)

        field.on_value_change(look)
        field.on("keydown.enter", write)
        send.on_click(write)
        dialog.on("hide", dialog.delete)
        dialog.open()

    def _note_motion(self, entry: Entry, raw: int) -> None:
        """Tie a target that turns an axis without end to this page: the axis stops if the page is closed or silent."""
        if cia402.of_first_axis(entry.index) not in jobs.ON_AND_ON:
            return
        presence, axes = self._session.presence, motion_jobs.masks_of(self._session.num_axes, self._axis)
        presence.end_of_page(self._visitor.id, axes)
        if raw:
            presence.begin(self._visitor.id, axes, held=False)

    # --- comparing ------------------------------------------------------------------------------------------------
    def _compare_card(self) -> None:
        with ui.card().classes("studio-card"):
            ui.label("Compare the axis").classes("studio-heading")
            with ui.row().classes("studio-buttons"):
                ui.button("With factory", on_click=self._with_factory).props("outline no-caps data-test=factory")
                ui.button("With stored", on_click=self._with_stored).props("outline no-caps data-test=stored")
            ui.label(
                "Factory: what the EDS says. Stored: as at the start of the studio, or when it stored last; a drive "
                "shows what it has stored only after a restart."
            ).classes("studio-hint")
            self._upload("With a file (TOML of a backup)", self._with_file, "compare-file")

    def _upload(self, label: str, handler: Any, name: str) -> None:
        upload = ui.upload(label=label, auto_upload=True, max_file_size=2_000_000, on_upload=handler)
        upload.props(f'accept=".toml" flat bordered data-test={name}').classes("w-full studio-upload")

    async def _with_factory(self) -> None:
        await self._compare("factory values", jobs.factory(self._known))

    async def _with_stored(self) -> None:
        wanted = self._session.stored.get(self._axis)
        if wanted is None:
            self._visitor.say("the values of the start are still being read; try again in a moment", "warning")
            return
        await self._compare("stored values", wanted)

    async def _with_file(self, event: UploadEventArguments) -> None:
        content = await event.file.read()
        try:
            wanted = jobs.read_file(content, event.file.name, self._known)
        except Exception as error:
            self._visitor.say(sentence(error), "error")
            return
        await self._compare(event.file.name, wanted)

    async def _compare(self, name: str, wanted: dict[Key, int]) -> None:
        found = await self._visitor.do(jobs.differences(self._known, wanted, self._axis), f"Compare with {name}")
        if found is not None:
            self._show_differences(f"{len(found)} of {len(wanted)} parameters differ from {name}", found, name)

    def _show_differences(self, title: str, found: Sequence[Difference], name: str) -> None:
        rows = [
            {
                "object": one.entry.label,
                "drive": "absent" if one.found is None else jobs.shown(one.entry, one.found, self._scale),
                "wanted": jobs.shown(one.entry, one.wanted, self._scale),
            }
            for one in found
        ]
        columns = [
            {"name": key, "label": label, "field": key, "align": "left"}
            for key, label in (("object", "Object"), ("drive", "Drive"), ("wanted", name))
        ]
        with ui.dialog() as dialog, ui.card().classes("studio-card studio-dialog is-wide"):
            ui.label(title).classes("studio-heading").props("data-test=differences")
            if rows:
                ui.table(columns=columns, rows=rows, row_key="object", pagination=20).classes("w-full").props(
                    "flat dense wrap-cells"
                )
            ui.button("Close", on_click=dialog.close).props("flat no-caps data-test=close-differences")
        dialog.on("hide", dialog.delete)
        dialog.open()

    # --- backup, restore, store -----------------------------------------------------------------------------------
    def _backup_card(self) -> None:
        with ui.card().classes("studio-card"):
            ui.label("Backup and restore").classes("studio-heading")
            with ui.row().classes("studio-buttons"):
                ui.button("Backup", icon="download", on_click=self._backup).props("outline no-caps data-test=backup")
                ui.button("Store in the drive", icon="save", on_click=self._store).props(
                    "outline no-caps data-test=store"
                )
            ui.label(
                "Restore writes all of a file or none: what was written is read back, and taken back if one fails. "
                "The axis must be disabled."
            ).classes("studio-hint")
            with ui.row().classes("studio-buttons"):
                self._unchecked = ui.checkbox("A file that was changed").tooltip("Accept it in spite of its check sum")
                self._other = ui.checkbox("Of another drive").tooltip("Accept a file that was read from another drive")
            self._upload("Restore a file (TOML of a backup)", self._restore, "restore-file")

    async def _backup(self) -> None:
        text = await self._visitor.do(jobs.backup(self._known, self._axis), "Backup")
        if text is not None:
            name = f"{self._known.name}-axis{self._axis}-{time.strftime('%Y%m%d-%H%M%S')}.toml"
            ui.download(text.encode(), name)

    async def _store(self) -> None:
        title = "Store the parameters"
        done = await self._visitor.do(lambda drives: (jobs.store(self._axis)(drives), True)[1], title)
        if done:
            self._visitor.say("the drive keeps its parameters from now on", "done")

    async def _restore(self, event: UploadEventArguments) -> None:
        content, name = await event.file.read(), event.file.name
        job = jobs.restore(
            self._known, content, name, self._axis, unchecked=self._unchecked.value, other_drive=self._other.value
        )
        changes = await self._visitor.do(job, f"Restore {name}")
        if changes is not None:
            self._show_differences(f"{len(changes)} parameters were written from {name}", changes, name)


def _key(text: str) -> Key:
    index, _, sub = str(text).partition(":")
    return int(index, 16), int(sub, 16)


page = StudioPage("/dictionary", "Dictionary", "menu_book", 30, build)
