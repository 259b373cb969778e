"""What users read is plain English: no word of `words.toml` in strings, docstrings, README, docs and the changelog."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterable, Iterator

import pytest
from sources import ROOT, nodes_of

TABLE = tomllib.loads((ROOT / "tests/house/words.toml").read_text(encoding="utf-8"))
WORDS = {key: re.compile(rf"(?<!\w)(?:{key})(?!\w)", re.IGNORECASE) for key in TABLE["words"]}
ANY_WORD = re.compile("|".join(f"(?:{one.pattern})" for one in WORDS.values()), re.IGNORECASE)
PACKAGES = ("drive_env", "mechanics", "tuning", "agents", "research", "benchmarks", "examples")
SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RIDDLES = {re.compile(rf"(?<!\w)(?:{key})(?!\w)", re.IGNORECASE): better for key, better in TABLE["riddles"].items()}
COMMENT = re.compile(r"(?:^|  )# (.*)")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def texts(source: str, *, private: bool = False) -> Iterator[tuple[int, str]]:
    """Yield line and text of strings with a space, which people read; of `private` docstrings if asked for."""
    nodes = nodes_of(source)
    hidden = {
        id(node.body[0].value)
        for node in nodes
        if not private
        and isinstance(node, DOCUMENTED)
        and getattr(node, "name", "").startswith("_")
        and isinstance(node.body[0], ast.Expr)
    }
    for node in nodes:
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


def riddles(found: Iterable[tuple[int, str]], place: str) -> list[str]:
    """Return the riddles in lines of text, each with its place and the better form."""
    if any(place.startswith(room) for room in TABLE["except"]["riddles"]):
        return []
    return [
        f"{place}:{line}: {m.group()!r} should be: {better}"
        for line, text in found
        for pattern, better in RIDDLES.items()
        if (m := pattern.search(text))
    ]


def written(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of everything in a source that people read: strings, docstrings, comments."""
    yield from texts(source, private=True)
    yield from ((n, one[1]) for n, line in enumerate(source.splitlines(), 1) if (one := COMMENT.search(line)))


def newest(changelog: str) -> str:
    """Return the newest section of a changelog."""
    return re.split(r"^## ", changelog, flags=re.MULTILINE)[1]


def test_sources_pages_and_newest_changes_are_plain_english():
    found = []
    for path in SOURCES:
        place, source = str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
        found += [row for n, text in texts(source) for row in stop_words(text, f"{place}:{n}")]
        found += riddles(written(source), place)
    for path in PAGES:  # but the glossary's row of "lane"
        for n, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            found += stop_words(text, f"{path.name}:{n}") if "| lane |" not in text else []
    data = [path for package in PACKAGES for path in (ROOT / package).rglob("*.toml")]
    pages = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")]
    for path in (*data, *pages, *ROOT.glob("docs/**/*.md")):
        lines = path.read_text(encoding="utf-8").splitlines()
        found += riddles(enumerate(lines, 1), str(path.relative_to(ROOT)))
    changes = newest((ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    found += stop_words(" ".join(changes.split()), "CHANGELOG.md")
    assert not found, "\n".join(found)
    assert len(SOURCES) > 400 and len(PAGES) > 5


@pytest.mark.parametrize(("source", "found"), [
    ('def _f():\n    """Return what it makes of them."""', True),
    ("x = 1  # whoever writes it\n# it is none of ours", True),
    ('raise ValueError("there is none of that name")', False),
    ('"""Return the axis, None where it `is None`."""', False),
])  # fmt: skip
def test_a_riddle_is_found(source, found):
    assert bool(riddles(written(source), "drive_env/bus/hub.py")) == found
    assert not riddles(written(source), "mechanics/stepping.py")


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
