"""Hooks of MkDocs while it builds the site: the pages that are made from the packages' data, and their entries.

A page of the reference is never written by hand where a table of the packages has its facts: it is made anew in every
build, so that it cannot say what the code does not. Nothing here needs the network.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import agent_pages
import api_pages
import command_pages
import device_pages
import distribution_pages
import environment_pages
import load_pages
import motor_pages
import page_blocks
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import drive_env.faults.page

ROOT = Path(__file__).resolve().parent.parent.parent
# Pages that lie at the root of the repository, where people and tools look for them.
COPIED = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
MAKERS = (
    device_pages, motor_pages, load_pages, environment_pages, distribution_pages, agent_pages, command_pages, api_pages,
)  # fmt: skip


def pages() -> dict[str, str]:
    """Return the text of every page that is made, by its path in the site, in the order of the navigation."""
    made = {name: (ROOT / source).read_text(encoding="utf-8") for name, source in COPIED.items()}
    for maker in MAKERS:
        made |= maker.pages()
    return made


def expanded(entries: list[Any], known: list[str]) -> list[Any]:
    """Return navigation entries with each `folder/*` replaced by the pages right in it that no entry names."""
    named = set(_named(entries))

    def expand(entry: Any) -> list[Any]:
        if isinstance(entry, dict):
            ((title, value),) = entry.items()
            inner = _flat(value) if isinstance(value, list) else value
            return [{title: inner}] if inner else []  # a section without pages is left out
        if isinstance(entry, str) and entry.endswith("/*"):
            folder = entry[:-1]
            return [page for page in known if page.rpartition("/")[0] + "/" == folder and page not in named]
        return [entry]

    def _flat(some: list[Any]) -> list[Any]:
        return [one for entry in some for one in expand(entry)]

    return _flat(entries)


def _named(entries: list[Any]) -> list[str]:
    found: list[str] = []
    for entry in entries:
        values = list(entry.values()) if isinstance(entry, dict) else [entry]
        for value in values:
            found += _named(value) if isinstance(value, list) else [value]
    return found


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Make the pages, and complete the navigation with them."""
    made = pages()
    written = sorted(str(path.relative_to(config.docs_dir)) for path in Path(config.docs_dir).rglob("*.md"))
    config.extra["made"] = made
    config.nav = expanded(config.nav or [], [*made, *written])
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made.

    Raises:
        ValueError: Where one of them is written by hand, too, or docs/faults.md is not what its table makes.
    """
    for name, text in config.extra["made"].items():
        if files.get_file_from_path(name) is not None:
            raise ValueError(f"docs/{name} is made by docs/machinery while the site is built; remove the file")
        files.append(File.generated(config, name, content=text))
    faults = ROOT / "docs" / "faults.md"
    if faults.read_text(encoding="utf-8") != drive_env.faults.page.page():
        raise ValueError(f"{faults} is out of date; write it anew with python -m drive_env.faults.page {faults}")
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Add below a page that is written by hand where its commands and programs were tested."""
    written = Path(config.docs_dir) / page.file.src_uri
    tested = page_blocks.where_tested(written) if written in page_blocks.pages() else ""
    return f"{markdown}\n\n{tested}\n" if tested else markdown
