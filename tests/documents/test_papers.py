"""What the papers name exists: files and folders, in backticks, of README, CONTRIBUTING and docs."""

from __future__ import annotations

import re

from rigs import ROOT
from rigs.tables import every_row

PAPERS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
ROOMS = ("drive_env", "mechanics", "tuning", "agents", "research", "benchmarks", "tests", "examples", "docs")


def named(text):
    """Return the paths that a text names: from the root, or of a file that one room holds."""
    for found in re.findall(r"`([\w./-]+)`", text):
        if "/" in found and (found.split("/")[0] in ROOMS or found.endswith((".py", ".toml", ".md"))):
            yield found


@every_row("paper", PAPERS)
def test_every_file_that_a_paper_names_exists(paper):
    missing = []
    for name in named(paper.read_text(encoding="utf-8")):
        places = [ROOT / name, *(ROOT / room / name for room in ROOMS), paper.parent / name]
        if not any(place.exists() for place in places):
            missing.append(name)
    assert missing == []


def test_what_the_walks_through_the_house_pass_is_in_the_files_that_they_name():
    walk = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    found = re.findall(r"`([\w/]+\.py)`\s+`([\w.]+)`", walk)
    assert len(found) > 15
    for file, name in found:
        text = next(p for p in (ROOT / file, ROOT / "drive_env" / file) if p.is_file()).read_text(encoding="utf-8")
        for part in name.split("."):
            assert re.search(rf"^\s*(?:class|def|async def) {part}\b|^{part}\b.*=", text, re.MULTILINE), (file, name)


def test_the_map_is_two_pages():
    assert len((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines()) <= 110


def test_every_decision_is_in_the_index():
    folder = ROOT / "docs" / "decisions"
    index = (folder / "README.md").read_text(encoding="utf-8")
    assert {path.name for path in folder.glob("*.md")} - {"README.md"} == set(re.findall(r"\]\((\S+\.md)\)", index))


def test_every_file_with_a_placeholder_is_in_the_maintainers_list():
    listed = (
        (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Placeholders")[2].partition("\n## ")[0]
    )
    files = [path for path in ROOT.iterdir() if path.suffix in (".md", ".toml", ".yml", ".cff", ".txt")]
    found = {path.name for path in files if "example.org" in path.read_text(encoding="utf-8")} - {"CONTRIBUTING.md"}
    assert found and all(f"`{name}`" in listed for name in found), found
