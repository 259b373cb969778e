"""Pictures and figures of the explanations are those that docs/explanation_pictures.py makes."""

from __future__ import annotations

import importlib.util
import re

import pytest
from rigs import ROOT

DOCS = ROOT / "docs"
PAGES = [*sorted((DOCS / "explanation").glob("*.md")), DOCS / "safety.md"]
LARGEST = 150_000  # bytes of a picture


def load():
    spec = importlib.util.spec_from_file_location("explanation_pictures", DOCS / "explanation_pictures.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PICTURES = load()
NAMES = {*PICTURES.DIAGRAMS, *PICTURES.PLOTS}


def test_every_picture_is_shown_and_every_shown_one_is_made():
    shown = {
        (page.parent / path).resolve()
        for page in PAGES
        for path in re.findall(r"!\[[^]]+\]\(([^)]+)\)", page.read_text())
    }
    assert shown == {(PICTURES.FOLDER / name).resolve() for name in NAMES}
    assert {path.name for path in PICTURES.FOLDER.iterdir()} == NAMES
    assert max(path.stat().st_size for path in shown) < LARGEST


@pytest.mark.parametrize("name", PICTURES.DIAGRAMS)
def test_diagrams_are_current(name):
    assert (PICTURES.FOLDER / name).read_text(encoding="utf-8") == PICTURES.DIAGRAMS[name]()


@pytest.mark.slow
@pytest.mark.parametrize("name", PICTURES.PLOTS)
def test_plots_can_be_made(name, tmp_path):
    PICTURES.make([name], tmp_path)
    assert (tmp_path / name).stat().st_size > 10_000


def test_figures_of_the_worked_example_are_those_of_the_page():
    page = (DOCS / "explanation" / "score.md").read_text(encoding="utf-8")
    page = page.replace("\N{MULTIPLICATION SIGN}", "x").replace("\N{MINUS SIGN}", "-")
    cells = [[cell.strip(" *") for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:1] == "|"]
    rows = {row[0]: row[1:] for row in cells if len(row) == 4}
    found = PICTURES.worked_example()
    digits = {
        "t_s / t_0": ("settling", "{:.2f}"), "E_d / E_0": ("disturbance", "{:.4f}"), "n": ("noise", "{:.2%}"),
        "os": ("overshoot", "{:.2%}"), "J of the machine": ("nominal", "{:.2f}"), "robust cost": ("robust", "{:.2f}"),
        "J, load inertia x 2": ("load inertia x 2", "{:.2f}"),
        "J, load inertia x 0.5": ("load inertia x 0.5", "{:.2f}"),
        "J, stiffness x 0.8": ("stiffness x 0.8", "{:.2f}"), "J, velocity P x 1.5": ("velocity P x 1.5", "{:.2f}"),
        "J, velocity P x 0.67": ("velocity P x 0.67", "{:.2f}"), "performance": ("performance", "{:.2f}"),
        "clearance of the machine, 1 asked for": ("clearance, nominal", "{:.2f}"),
        "least clearance of its variants, 0.4 asked for": ("least clearance", "{:.2f}"),
        "overshoot of a step in csp, 20 % allowed": ("csp overshoot", "{:.0%}"),
        "swing at rest, 5 % allowed": ("swing at rest", "{:.1%}"), "slack": ("slack", "{:.0%}"),
    }  # fmt: skip
    for label, (name, form) in digits.items():
        assert rows[label] == [form.format(one[2][name]).replace("%", " %") for one in found], label
    assert rows["velocity P, I"] == [f"{gains[2]}, {gains[3]}" for _, gains, _ in found]
