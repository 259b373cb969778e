"""The fenced blocks of README and of the site's pages: what a reader types, and what is printed for it.

tests/docs_pages.py follows them and says how they are written.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
DOCS = ROOT / "docs"
SHELL = ("bash", "sh", "console", "")
FENCE = re.compile(r"^(?P<indent> *)```(?P<info>[^`\n]*)\n(?P<text>.*?)^(?P=indent)``` *$", re.M | re.S)
MARK = re.compile(r"<!--\s*(?P<key>not run|exits|exact)\s*(?::\s*(?P<value>(?:(?!-->).)*?))?\s*-->\s*\Z", re.S)
SNIPPET = re.compile(r'^-+8<-+ "(?P<path>[^"]+)" *$', re.M)


@dataclass(frozen=True)
class Block:
    """A fenced block of a page."""

    language: str
    title: str
    text: str  # without its indentation, snippets put in
    marks: dict[str, str]
    line: int
    start: int  # of its text in the page
    end: int
    indent: str
    only_script: str = ""  # the script of `examples/` that it is nothing but

    @property
    def is_done(self) -> bool:
        """Whether a reader would do something with it."""
        return self.language == "python" or self.language in SHELL

    def commands(self) -> list[str]:
        """Return the commands of a block of the shell, each as it is typed."""
        lines = self.text.splitlines()
        if self.language == "console":
            lines = [line[2:] for line in lines if line.startswith(("$ ", "> "))]
        found: list[str] = []
        held: list[str] = []
        until = ""
        for line in lines:
            held.append(line)
            if until:
                if line.strip() != until:
                    continue
                until = ""
            elif here := re.search(r"<<-?\s*['\"]?(\w+)", line):
                until = here.group(1)
                continue
            elif line.rstrip().endswith("\\"):
                continue
            command = "\n".join(held)
            held = []
            if command.strip() and not command.strip().startswith("#"):
                found.append(command)
        return found


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page in their order."""
    whole = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(whole):
        info = match["info"].strip()
        language = re.match(r"[\w+-]*", info).group(0)
        title = re.search(r'title="([^"]+)"', info)
        text = re.sub(rf"^{match['indent']}", "", match["text"], flags=re.M)
        scripts = SNIPPET.findall(text)
        only = scripts[0] if scripts and not SNIPPET.sub("", text).strip() else ""
        text = SNIPPET.sub(lambda snippet: (ROOT / snippet["path"]).read_text(encoding="utf-8"), text)
        marks, before = {}, whole[: match.start()]
        while mark := MARK.search(before):
            marks[mark["key"]] = mark["value"] or ""
            before = before[: mark.start()]
        found.append(Block(language, title[1] if title else "", text, marks, whole.count("\n", 0, match.start()) + 1,
                           match.start("text"), match.end("text"), match["indent"], only))  # fmt: skip
    return found


def pages() -> list[Path]:
    """Return README and the pages of the site, without decisions, which have nothing to type."""
    return [ROOT / "README.md", *sorted(page for page in DOCS.rglob("*.md") if "decisions" not in page.parts)]


def where_tested(page: Path) -> str:
    """Return the line below a page that says which of its commands and programs the tests run, "" where it has none."""
    done = [block for block in blocks(page) if block.is_done]
    left = Counter(block.marks["not run"] for block in done if "not run" in block.marks)
    if not done:
        return ""
    count = f"{len(done) - left.total()} of its {len(done)}" if left else "all its"
    reasons = "; ".join(f"{reason} ({number})" if number > 1 else reason for reason, number in left.items())
    return (
        f"*Where this page was tested: on Linux, with emulated drives; the tests run {count} blocks of commands and "
        f"programs{f' (not run: {reasons})' if reasons else ''}. Nothing here was tried on a real drive.*"
    )
