"""Find assets that pages of a built site load from another host; there may be none.

python docs/machinery/foreign_assets.py SITE

Links that a reader may follow are no assets: scripts, styles, pictures, films, fonts and frames are.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

LOADING = {  # element -> attributes whose address the browser loads by itself
    "script": ("src",), "img": ("src", "srcset"), "video": ("src", "poster"), "audio": ("src",),
    "source": ("src", "srcset"), "iframe": ("src",), "embed": ("src",), "object": ("data",), "link": ("href",),
    "track": ("src",),
}  # fmt: skip
HINTS = {"canonical", "prev", "next", "alternate", "license"}  # links that name and load nothing
FOREIGN = re.compile(r"^\s*(?:https?:)?//", re.I)
IN_STYLES = re.compile(r"(?:url\(|@import\s+)\s*[\"']?((?:https?:)?//[^\"')\s]+)", re.I)


class _Assets(HTMLParser):
    """Collects the addresses that a page loads from another host."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self._in_style = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self._in_style = tag == "style"
        if tag == "link" and HINTS & set(values.get("rel", "").split()):
            return
        if "mermaid" in values.get("class", "").split():  # the theme's script fetches what draws it
            self.found.append("mermaid (draw the diagram as a picture instead)")
        self.found += [values[name] for name in LOADING.get(tag, ()) if FOREIGN.match(values.get(name, ""))]
        self.found += IN_STYLES.findall(values.get("style", ""))

    def handle_data(self, data: str) -> None:
        if self._in_style:
            self.found += IN_STYLES.findall(data)


def foreign(site: Path) -> list[str]:
    """Return a line for each address of another host that a page or style of a site loads."""
    lines = []
    for page in sorted(site.rglob("*.html")):
        parser = _Assets()
        parser.feed(page.read_text(encoding="utf-8"))
        lines += [f"{page.relative_to(site)} loads {address}" for address in parser.found]
    for style in sorted(site.rglob("*.css")):
        addresses = IN_STYLES.findall(style.read_text(encoding="utf-8"))
        lines += [f"{style.relative_to(site)} loads {address}" for address in addresses]
    return lines


def main() -> None:
    """Print the assets that are loaded from another host; exit code 1 if there are any, or without a site."""
    site = Path(sys.argv[1])
    if not (site / "index.html").is_file():
        sys.exit(f"{site} holds no site (no index.html); build it with mkdocs build --site-dir {site}")
    lines = foreign(site)
    print("\n".join(lines) or f"{site}: nothing is loaded from another host")
    sys.exit(1 if lines else 0)


if __name__ == "__main__":
    main()
