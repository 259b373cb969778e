"""The site's pages that are made from data have all of it, and what a page loads from elsewhere is found."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from rigs import ROOT

from agents.shipped import shipped_names
from drive_env.devices import device_names, find_device
from drive_env.envs import ENVIRONMENTS
from drive_env.motors import MOTORS
from drive_env.randomisation.random_machines import shipped
from mechanics.loads import LOADS

MACHINERY = ROOT / "docs" / "machinery"
sys.path.insert(0, str(MACHINERY))
try:  # they import one another by name, as MkDocs has them do
    import agent_pages
    import api_pages
    import command_pages
    import device_pages
    import distribution_pages
    import environment_pages
    import foreign_assets
    import load_pages
    import motor_pages
    import tables
finally:
    sys.path.remove(str(MACHINERY))


@pytest.mark.every(3)
@pytest.mark.parametrize("name", device_names())
def test_a_device_has_a_page_with_all_its_objects_gains_roles_and_emergencies(name):
    device = find_device(name)
    text = device_pages.pages()[f"reference/devices/{name}.md"]
    for entry in device.new_dictionary():
        assert f"| {entry.index:04X}h:{entry.sub:02X} | {entry.name} |" in text
    for row in device.gains.rows:
        assert f"| `{row.name}` | {row.title} |" in text
    for role in device.roles:
        assert f"`Role.{role.name}`" in text
    for row in device.emergencies.values():
        assert f"| {row.code:04X}h |" in text


def test_an_object_says_its_type_limits_and_what_it_takes():
    text = device_pages.pages()["reference/devices/tmcm1636.md"]
    row = next(line for line in text.splitlines() if line.startswith("| 605Ah:00 "))
    assert "1, 2, 5, 6" in row
    row = next(line for line in text.splitlines() if line.startswith("| 1400h:02 "))
    assert "0 to 240, 254, 255" in row
    row = next(line for line in text.splitlines() if line.startswith("| 2704h:00 "))
    assert "u16" in row and "kbit/s" in row and "20 to 1000" in row


def test_every_motor_has_its_numbers_with_their_sources():
    text = motor_pages.pages()["reference/motors.md"]
    for motor in MOTORS.values():
        assert f"## {motor.name} " in text
    section = text.partition("## qbl4208 ")[2].partition("\n## ")[0]
    row = next(line for line in section.splitlines() if "`inertia_kg_m2`" in line)
    assert "4.8e-06" in row and "kg·m²" in row and "values of its class" in row


def test_every_load_has_a_page_with_its_picture_and_parameters():
    made = load_pages.pages()
    for load in LOADS.values():
        text = made[f"reference/loads/{load.name}.md"]
        assert f"assets/loads/{load.name}.webp" in text
        assert (MACHINERY.parent / "assets" / "loads" / f"{load.name}.webp").is_file()
        for parameter in load.parameters:
            assert f"`load.{parameter.name}`" in text


def test_every_environment_has_its_spaces_and_configuration():
    made = environment_pages.pages()
    for module, _ in ENVIRONMENTS.values():
        text = made[f"reference/environments/{module}.md"]
        for heading in ("Action space", "Observation space", "Reward and end", "Info", "Configuration", "Arguments"):
            assert f"## {heading}\n" in text, (module, heading)
        assert "| `num_threads` |" in text and "- `num_envs`: " in text
        assert (MACHINERY.parent / "assets" / "environments" / f"{module}.webp").is_file()


@pytest.mark.slow
def test_the_program_of_the_environments_runs():
    text = environment_pages.pages()["reference/environments/index.md"]
    (program,) = re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr


def test_every_set_of_random_machines_has_its_laws():
    text = distribution_pages.pages()["reference/environments/distributions.md"]
    for name in shipped():
        assert f"## {name}\n" in text
    assert "| `load.mass` | loguniform | 0.3 to 4 | the default |" in text
    assert "| `stage.supply_sinks` | choice | 0, 1, weights 3, 1 |  |" in text
    assert "| `motor.R_s` | normal | 1.05 ± 0.1, cut off at 0.85 to 1.4 | the default |" in text


def test_every_agent_that_ships_has_its_figures():
    text = agent_pages.pages()["reference/agents.md"]
    for name in shipped_names():
        assert f"## {name}\n" in text
    assert "have an Ms within `standard`:" in text


def test_every_command_has_its_options():
    made = command_pages.pages()
    for program, commands in (("drive-env", ("scan", "motor new", "serve")), ("drive-tune", ("auto", "sweep")),
                              ("drive-agent", ("evaluate", "train"))):  # fmt: skip
        for command in commands:
            assert f"## {program} {command}\n" in made[f"reference/commands/{program}.md"]
    text = made["reference/commands/drive-env.md"]
    assert "| `--channel`, `-c` |" in text and "`DRIVE_ENV_CHANNEL`" in text
    assert "| `OBJECT` |" in text


def test_the_python_pages_name_what_exists():
    import importlib

    for _, _, rows in api_pages.PAGES.values():
        for module, members in rows:
            for member in members.split():
                found = getattr(importlib.import_module(module), member)
                assert found.__doc__, f"{module}.{member}"


def test_a_pipe_divides_cells_unless_it_stands_in_code():
    assert tables.cell("a | `b | c`") == "a \\| `b | c`"


@pytest.mark.parametrize(("html", "loaded"), [
    ('<img src="https://example.org/a.png">', ["https://example.org/a.png"]),
    ('<script src="//example.org/a.js"></script>', ["//example.org/a.js"]),
    ('<link rel="stylesheet" href="https://example.org/a.css">', ["https://example.org/a.css"]),
    ('<style>@import "https://example.org/a.css"; p { background: url(//example.org/b) }</style>',
     ["https://example.org/a.css", "//example.org/b"]),
    ('<p style="background: url(https://example.org/b.png)">', ["https://example.org/b.png"]),
    ('<a href="https://example.org">a link</a><link rel="canonical" href="https://example.org/"><img src="a.png">', []),
])  # fmt: skip
def test_what_a_page_loads_from_another_host_is_told(tmp_path, html, loaded):
    (tmp_path / "index.html").write_text(html, encoding="utf-8")
    assert foreign_assets.foreign(tmp_path) == [f"index.html loads {address}" for address in loaded]
