"""README and the site's pages, followed as a reader would: each command and program as it stands, in order."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import shutil
from pathlib import Path

import pytest
import typer
from docs_pages import compare, follow, port_is_free
from page_blocks import DOCS, ROOT, SHELL, SNIPPET, Block, blocks, pages, where_tested
from rigs.tables import every_row

PROGRAMS = {"drive-env": "drive_env.commands.cli", "drive-tune": "tuning.commands.cli",
            "drive-agent": "agents.commands.cli"}  # fmt: skip
# Pages that are followed within 10 s; the others are slow.
QUICK = {"docs/how-to/wireshark.md"}
TRAINS = re.compile(r"stable_baselines3|drive-agent (train|search|export)|own_reward|own_load|curriculum\.py")
OLD_WORDS = (
    "hidden J",
    "fitted rule",
    "not seen",
    "is told",
    "5 % is still",
    "tripped in the probe",
    "found, at 100 %",
)


RECIPES = DOCS / "how-to/recipes.md"  # each of its sections stands for itself: it may need what is not installed


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


PAGES = [page for page in pages() if any(block.is_done for block in blocks(page))]
HOW_TO = sorted((DOCS / "how-to").glob("*.md"))
WRITTEN_HERE = [*HOW_TO, *sorted((DOCS / "tutorials").glob("*.md"))]


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name(page), marks=() if name(page) in QUICK else pytest.mark.slow)
        for page in PAGES
        if page != RECIPES
    ],
)
def test_a_page_can_be_followed(page, tmp_path):
    text = "".join(block.text for block in blocks(page))
    if "drive-env serve" in text and not port_is_free():
        pytest.skip("the port of `drive-env serve` is taken")
    if TRAINS.search(text):
        pytest.importorskip("stable_baselines3")
    follow(page, tmp_path)


def recipes() -> dict[str, str]:
    """Return the text of each section of the page by its title."""
    _, *sections = re.split(r"^## ", RECIPES.read_text(encoding="utf-8"), flags=re.M)
    return {section.partition("\n")[0]: f"# {section}" for section in sections}


@pytest.mark.slow
@pytest.mark.parametrize("recipe", recipes())
def test_a_recipe_can_be_followed(recipe, tmp_path):
    text = recipes()[recipe]
    pytest.importorskip("stable_baselines3")
    for needed in re.findall(r"[\w.]+", "".join(re.findall(r"<!-- needs: (.*?) -->", text))):
        if needed != "CLEANRL_SOURCE":
            pytest.importorskip(needed)
        elif needed in os.environ:
            shutil.copytree(os.environ[needed], tmp_path / "cleanrl")
        else:
            pytest.skip("CLEANRL_SOURCE is no folder of CleanRL's repository")
    page = tmp_path / "recipe.md"
    page.write_text(text, encoding="utf-8")
    follow(page, tmp_path)


def test_quick_pages_are_there():
    assert {name(page) for page in PAGES} >= QUICK


def test_a_page_says_below_it_which_of_its_blocks_are_run(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```bash\ntrue\n```\n<!-- not run: needs root -->\n```bash\ntrue\n```\n```text\n1\n```\n")
    assert "1 of its 2 blocks" in where_tested(page) and "(not run: needs root)" in where_tested(page)
    page.write_text("```python\n1\n```\n")
    assert "run all its blocks" in where_tested(page) and "not run" not in where_tested(page)
    page.write_text("```toml\na = 1\n```\n")
    assert where_tested(page) == ""


def test_what_is_not_run_says_why():
    left = [f"{name(page)}:{block.line}: {block.marks['not run']}"
            for page in PAGES for block in blocks(page) if "not run" in block.marks]  # fmt: skip
    print("\n".join(left))
    assert all(len(line.partition(": ")[2].split()) >= 2 for line in left), left


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_a_script_that_is_shown_is_run_on_its_page(page):
    commands = [command for block in blocks(page) if block.language in SHELL and "not run" not in block.marks
                for command in block.commands()]  # fmt: skip
    for block in blocks(page):
        if block.only_script.endswith(".py") and "not run" not in block.marks:
            assert any(block.only_script in command for command in commands), block.only_script


def test_every_example_is_on_a_page():
    shown = {path for page in PAGES for path in SNIPPET.findall(page.read_text(encoding="utf-8"))}
    there = {f"examples/{path.name}" for path in (ROOT / "examples").glob("*.py")}
    assert there - shown == set()


# --- commands and options ---------------------------------------------------------------------------------------------
def commands_of(program: str) -> dict[str, set[str]]:
    """Return the options of each command of a program, those of all under ''."""
    group = typer.main.get_command(importlib.import_module(PROGRAMS[program]).app)
    found = {"": {"--help", "-h"} | options_of(group)}

    def walk(group, before):
        for key, command in group.commands.items():
            if command.hidden:  # an old name
                continue
            if hasattr(command, "commands"):
                walk(command, f"{before}{key} ")
            else:
                found[before + key] = options_of(command) | {"--help", "-h"}

    walk(group, "")
    return found


def options_of(command) -> set[str]:
    return {one for parameter in command.params if str(getattr(parameter, "param_type_name", "")) == "option"
            for one in (*parameter.opts, *parameter.secondary_opts)}  # fmt: skip


@pytest.fixture(scope="module")
def every_command():
    return {program: commands_of(program) for program in PROGRAMS}


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_command_has_its_section(program, every_command):
    text = (DOCS / "how-to" / f"{program}.md").read_text(encoding="utf-8")
    headings = re.findall(r"^#+ `(.+?)`", text, re.M)
    assert set(headings) == {command for command in every_command[program] if command}
    for command in headings:
        assert re.search(rf"^ *(?!#).*{program} {command}\b", text, re.M), f"no example of {command}"


def said(page: Path):
    """Yield the lines of a page on which one of our programs is called, without comments."""
    for block in blocks(page):
        if block.language in SHELL:
            for command in block.commands():
                for line in command.splitlines():
                    yield re.split(r"\s#", line)[0]
    for line in re.findall(r"`((?:drive-env|drive-tune|drive-agent) [^`\n]+)`", page.read_text(encoding="utf-8")):
        yield line


@every_row("page", PAGES)
def test_every_command_and_option_of_a_page_exists(page, every_command):
    for line in said(page):
        for program, rest in re.findall(r"\b(drive-env|drive-tune|drive-agent)((?: [^|&;]+)?)", line):
            try:
                words = shlex.split(rest.replace("…", "x"))
            except ValueError:
                words = rest.split()
            commands = every_command[program]
            given = [word for word in words if not word.startswith("-")]
            called = next((c for c in (" ".join(given[:2]), *given[:1]) if c in commands), "")
            if given and not called and re.fullmatch(r"[a-z-]+", given[0]):
                assert given[0] in ("motor",), f"{program} has no command {given[0]}: {line}"
            if "--" in words:
                words = words[: words.index("--")]
            for word in words:
                if re.match(r"--?[a-zA-Z]", word):
                    option = word.partition("=")[0]
                    known = commands[called] | commands[""]
                    assert option in known, f"{program} {called} has no option {option}: {line}"


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_option_that_a_how_to_names_exists(program, every_command):
    """In running text, too, each within the section of its command."""
    text = (DOCS / "how-to" / f"{program}.md").read_text(encoding="utf-8")
    for section in re.split(r"^(?=##+ )", text, flags=re.M):
        heading = re.match(r"##+ `(.+?)`", section)
        known = every_command[program][""] | (
            every_command[program][heading[1]] if heading else set().union(*every_command[program].values())
        )
        for option in re.findall(r"`(--[a-z][a-z-]+)", section):
            assert option in known, f"{heading and heading[1]}: {option}"


@every_row("page", WRITTEN_HERE)
def test_words_that_stopped_readers_are_gone(page):
    text = re.sub(r"^```text.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)  # programs' own words
    assert not [word for word in OLD_WORDS if word in text]


# --- the reader of pages itself ---------------------------------------------------------------------------------------
PAGE = """
```bash
echo one \\
  two
cat <<END
# 3
END
```

```text
one two
# 4
```

<!-- exits: 3 -->
```console
$ export WORD=kept
$ (exit 3)
not compared
```

```toml title="folder/a.toml"
a = 1
```

=== "A tab"

    ```bash
    grep -c a folder/a.toml && echo $WORD
    ```

    <!-- exact -->
    ```text
    ...
    kept
    ```

```python
number = 2
```

```python
print(number + 1)
```

<!-- exact -->
```text
3
```

<!-- not run: no such thing -->
```bash
false
```
"""


def test_a_page_is_followed_as_it_stands(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(PAGE)  # 4 is as good as 3: figures may differ
    (left,) = follow(page, tmp_path)
    assert left[1] == "no such thing"


UNTRUE = {
    "another word": ("one two\n# 4", "one three\n# 4"),
    "a line too many": ("one two\n# 4", "one two\n# 4\nmore"),
    "another exit code": ("exits: 3", "exits: 0"),
    "other text after dots": ("kept\n    ```\n\n```python", "lost\n    ```\n\n```python"),
    "another figure that is exact": ("\n3\n", "\n4\n"),
    "a name that there is not": ("number + 1", "nothing + 1"),
    "a command that fails": ("echo one", "echo one; false"),
    "no mark": ("not run: no such thing", "run"),
}


@pytest.mark.parametrize(("of", "to"), UNTRUE.values(), ids=UNTRUE)
def test_a_page_that_is_not_true_fails(of, to, tmp_path):
    page = tmp_path / "page.md"
    assert of in PAGE
    page.write_text(PAGE.replace(of, to))
    with pytest.raises(AssertionError):
        follow(page, tmp_path)


def test_what_is_printed_is_compared_line_by_line():
    block = Block("text", "", "value 3.5\n...\nlast 1\n", {}, 1, 0, 0, "")
    compare(block, ["value 4.75", "between", "last 10"])
    for printed in (["value 4.75 V", "last 10"], ["value 1", "between"], ["value 1", "last 1", "more"]):
        with pytest.raises(AssertionError):
            compare(block, printed)


def test_running_a_page_writes_what_it_prints(tmp_path):
    page = tmp_path / "page.md"
    page.write_text('=== "A"\n\n    ```bash\n    echo new\n    ```\n\n    ```text\n    old\n    ```\n')
    follow(page, tmp_path, write=True)
    assert "    new\n    ```" in page.read_text()
