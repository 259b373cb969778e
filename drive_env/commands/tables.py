"""Tables and lines of all commands, readable in a terminal of 80 characters: no cell is cut, no word is broken."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:
    from rich.table import Table

GAP = 2  # characters between two columns


class Column(NamedTuple):
    """A column: its title, which may have several lines, and how its cells are set."""

    title: str
    # figure: right-aligned; name: left-aligned; text: left-aligned, on several lines if it is long
    kind: Literal["figure", "name", "text"] = "figure"


def print_table(columns: Sequence[Column], rows: Iterable[Sequence[str]], title: str = "") -> None:
    """Print a table; one that is wider than the terminal as several, each with the first column."""
    from rich.console import Console

    console = Console()
    if title:
        print_lines([title])
    for table in tables(columns, list(rows), console.width):
        console.print(table)
        console.print()


def tables(columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int) -> list[Table]:
    """Return a table of at most `width` characters, or several; each has the first column."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    narrow, wide = _widths(columns, rows)
    found = []
    for group in _groups(narrow, width):
        cut = _cut({k: wide[k] for k in group}, narrow, width)
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), pad_edge=False)
        for k in group:
            column = columns[k]
            side: Literal["right", "left"] = "right" if column.kind == "figure" else "left"
            table.add_column(Text(column.title), justify=side, width=cut[k], overflow="fold")
        for row in rows:
            table.add_row(*(Text(row[k]) for k in group))
        found.append(table)
    return found


def print_names(lists: Mapping[str, Mapping[str, str]]) -> None:
    """Print names with their meanings, under titles."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    for title, rows in lists.items():
        table = Table(title=title, title_justify="left", box=None, show_header=False, pad_edge=False)
        table.add_column(no_wrap=True)
        table.add_column()
        for name, meaning in rows.items():
            table.add_row(Text(name), Text(meaning))
        console.print(table)
        console.print()


def print_text(text: str) -> None:
    """Print the text of a file unchanged.

    Raises:
        OSError: If it cannot be written, with the name of the output and the remedy.
    """
    try:
        print(text, end="", flush=True)
    except BrokenPipeError:  # the reader has closed the pipe: not an error
        raise
    except OSError as error:
        raise OSError(error.errno, f"{error.strerror}; print to where there is room", "standard output") from error


def print_lines(lines: Iterable[str]) -> None:
    """Print lines; long ones are wrapped on a terminal, but not in a file or pipe."""
    width = terminal_width()
    for line in lines:
        indent = " " * (len(line) - len(line.lstrip()) + GAP)
        print(
            line
            if width is None
            else textwrap.fill(line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
        )
    sys.stdout.flush()


def terminal_width() -> int | None:
    """Return the terminal's characters per line; None if the output is not a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def _widths(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> tuple[list[int], list[int]]:
    """Return each column's least width without broken words, and its preferred width."""
    from rich.cells import cell_len

    narrow, wide = [], []
    for k, column in enumerate(columns):
        cells = [*column.title.split("\n"), *(row[k] for row in rows)]
        wide.append(max(map(cell_len, cells)))
        words = [word for cell in cells for word in cell.split()] if column.kind == "text" else cells
        narrow.append(max(map(cell_len, words), default=0))
    return narrow, wide


def _groups(narrow: Sequence[int], width: int) -> list[list[int]]:
    """Return groups of columns that fit side by side, each with the first column."""
    groups = [[0]]
    for k in range(1, len(narrow)):
        taken = sum(narrow[j] + GAP for j in groups[-1]) + narrow[k]
        if taken > width and len(groups[-1]) > 1:
            groups.append([0])
        groups[-1].append(k)
    return groups


def _cut(widths: dict[int, int], narrow: Sequence[int], width: int) -> dict[int, int]:
    """Return widths that fit side by side: the widest column that can shrink is reduced first."""
    cut = dict(widths)
    while sum(cut.values()) + GAP * (len(cut) - 1) > width:
        able = [k for k in cut if cut[k] > narrow[k]]
        if not able:
            break
        cut[max(able, key=lambda k: cut[k])] -= 1
    return cut
