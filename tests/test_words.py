"""What users read is plain English: no word of `words.toml` in strings, docstrings, README, docs and the changelog."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TABLE = tomllib.loads((ROOT / "tests/words.toml").read_text(encoding="utf-8"))
WORDS = {key: re.compile(rf"(?<!\w)(?:{key})(?!\w)", re.IGNORECASE) for key in TABLE["words"]}
ANY_WORD = re.compile("|".join(f"(?:{one.pattern})" for one in WORDS.values()), re.IGNORECASE)
PACKAGES = ("drive_env", "mechanics", "tuning", "agents", "research", "benchmarks", "examples")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of the strings with a space, which people read, and of docstrings but those of privates."""
    tree = ast.parse(source)
    hidden = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, DOCUMENTED)
        and getattr(node, "name", "").startswith("_")
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in hidden:
            text = " ".join(node.value.split())
            if " " in text:
                yield node.lineno, text


def stop_words(text: str, place: str = "") -> list[str]:
    """Return what to write instead of the stop words in a text, with where it stands."""
    if not ANY_WORD.search(text):
        return []
    exempt = {word for word, rooms in TABLE["except"].items() for room in rooms if place.startswith(room)}
    found = [(word, pattern.search(text)) for word, pattern in WORDS.items() if word not in exempt]
    return [f"{place}: {m.group()!r} should be: {TABLE['words'][word]}" for word, m in found if m]


def newest(changelog: str) -> str:
    """Return the newest section of a changelog."""
    return re.split(r"^## ", changelog, flags=re.MULTILINE)[1]


def test_sources_pages_and_newest_changes_are_plain_english():
    found = []
    for path in SOURCES:
        place = str(path.relative_to(ROOT))
        found += [
            row for n, text in texts(path.read_text(encoding="utf-8")) for row in stop_words(text, f"{place}:{n}")
        ]
    for path in PAGES:  # but the glossary's row of "lane"
        for n, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            found += stop_words(text, f"{path.name}:{n}") if "| lane |" not in text else []
    changes = newest((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    found += stop_words(" ".join(changes.split()), "CHANGELOG.md")
    assert not found, "\n".join(found)
    assert len(SOURCES) > 400 and len(PAGES) > 5


@pytest.mark.parametrize(("source", "found"), [
    ('"""Return hidden\n    J."""', True),
    ('def f():\n    """Return what is told of it."""', True),
    ('def _f():\n    """Return what is told of it."""', False),
    ('raise ValueError(f"{x} lanes of {y}")', True),
    ('NAME = "lanes"', False),  # a key, which nobody reads as a sentence
    ('print("10 % is still")', True),
    ('print("environments")', False),
])  # fmt: skip
def test_a_stop_word_is_found(source, found):
    assert bool([row for _, text in texts(source) for row in stop_words(text)]) == found


def test_a_lane_of_a_kernel_is_one():
    assert not stop_words("eight lanes of a block", "drive_env/firmware/cycle.py")
    assert stop_words("eight lanes of a block", "drive_env/envs/tracking.py")
