"""Mutation run: change one thing in a file, and see whether the tests that belong to it notice.

    pip install -e ".[test,mutation]" -c constraints.txt
    python tests/mutation.py --count 150 --out runs/mutation.csv

`mutation.toml` says which files are changed and which tests belong to them. Changes are those of Cosmic Ray, at most
one of a line. It works on a copy; here nothing is changed.
"""

from __future__ import annotations

import argparse
import ast
import csv
import fnmatch
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent
LONGEST = 300.0  # s: tests that take longer hang, and have noticed
# Of these no test could see anything: what only a type checker or a reader of warnings sees, checks of lengths, caches.
# Of truth values a product is an "and", a sum an "or". What is identical (None, a member of an enumeration) is equal.
LEFT_OUT = ("RemoveDecorator", "NoOp", "Variable", "BitAnd_Mul", "BitOr_Add", "_Is_Eq", "_IsNot_NotEq")
HARMLESS = ("strict=", "TYPE_CHECKING", "stacklevel=", "pragma: no cover")


@dataclass(frozen=True)
class Row:
    """Files by patterns, but for some, and the tests that belong to them, in the order in which they are run."""

    files: tuple[str, ...]
    tests: tuple[str, ...]
    but: tuple[str, ...] = ()

    def has(self, file: str) -> bool:
        """Return whether a file is one of these."""
        return any(fnmatch.fnmatch(file, p) for p in self.files) and not any(fnmatch.fnmatch(file, p) for p in self.but)


class Mutant(NamedTuple):
    """One change of a file: an operator of Cosmic Ray, the number of its place, and the line."""

    file: str
    line: int
    operator: str
    occurrence: int


class Outcome(NamedTuple):
    """What became of a mutant: the line as it was and as it became, and whether a test noticed."""

    mutant: Mutant
    before: str
    after: str
    caught: bool
    seconds: float


def read_table(path: Path = HERE / "mutation.toml") -> list[Row]:
    """Return the table; the first row that has a file is the file's."""
    table = tomllib.loads(path.read_text(encoding="utf-8"))["row"]
    return [Row(tuple(row["files"]), tuple(row["tests"]), tuple(row.get("but", ()))) for row in table]


def tests_of(file: str, table: Sequence[Row]) -> tuple[str, ...]:
    """Return the tests that belong to a file, those first that name it."""
    tests = next((row.tests for row in table if row.has(file)), ())
    module = file.removesuffix(".py").replace("/", ".")
    named = [name for name in tests if module in (HERE / name).read_text(encoding="utf-8")]
    return (*named, *(name for name in tests if name not in named))


def files_of(table: Sequence[Row], wanted: str = "*") -> list[str]:
    """Return the files that the table has, of those that match a pattern."""
    there = sorted(path.relative_to(REPOSITORY).as_posix() for path in REPOSITORY.glob("*/**/*.py"))
    return [file for file in there if fnmatch.fnmatch(file, wanted) and any(row.has(file) for row in table)]


def mutants_of(file: str) -> Iterator[Mutant]:
    """Yield the changes that a file may suffer."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    source = (REPOSITORY / file).read_text(encoding="utf-8")
    lines, silent = source.splitlines(), _silent(source)
    nodes = list(ast_nodes(get_ast(source)))
    for name in operator_names():
        if any(word in name for word in LEFT_OUT):
            continue
        operator = get_operator(name)()
        places = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, start in enumerate(places):
            line = lines[start[0] - 1]
            if not any(word in line for word in HARMLESS) and not any(a <= start < b for a, b in silent):
                yield Mutant(file, start[0], name, occurrence)


def _silent(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return from where to where nothing is run: annotations; nor anything but a class's making: decorators."""
    found: list[ast.expr] = []
    for node in ast.walk(ast.parse(source)):
        found += [getattr(node, name) for name in ("annotation", "returns") if getattr(node, name, None) is not None]
        found += getattr(node, "decorator_list", [])
    ranges = [((e.lineno, e.col_offset), (e.end_lineno or e.lineno, e.end_col_offset or 0)) for e in found]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef) and node.args.kwonlyargs:
            # The `*` before arguments that go by name is no operator.
            before = [*node.args.args, *node.args.defaults]
            begin = max(((e.end_lineno or 0, e.end_col_offset or 0) for e in before), default=(node.lineno, 0))
            first = node.args.kwonlyargs[0]
            ranges.append((begin, (first.lineno, first.col_offset)))
    return ranges


def sample(files: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Return so many mutants, each of another line: one that has many operators is drawn no more often for that."""
    chance = random.Random(seed)
    by_line: dict[tuple[str, int], list[Mutant]] = {}
    for file in files:
        for mutant in mutants_of(file):
            by_line.setdefault((file, mutant.line), []).append(mutant)
    lines = chance.sample(sorted(by_line), min(count, len(by_line)))
    chosen = (chance.sample(by_line[line], len(by_line[line])) for line in lines)
    return [found for some in chosen if (found := next(filter(_is_python, some), None)) is not None]


def _is_python(mutant: Mutant) -> bool:
    """Return whether a change leaves a file that can be read, without a warning.

    Where it cannot be read every test would notice; `is` for `==` beside a literal is the same, and Python warns of it.
    Cosmic Ray stumbles over exceptions that are named with a dot.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", SyntaxWarning)
        try:
            compile(_changed((REPOSITORY / mutant.file).read_text(encoding="utf-8"), mutant), mutant.file, "exec")
        except (SyntaxError, SyntaxWarning, AttributeError):
            return False
    return True


def _changed(source: str, mutant: Mutant) -> str:
    """Return a file's text with a change."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    changed = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
    assert changed is not None and changed != source, mutant
    return str(changed)


class Copy:
    """A copy of the repository in which files are changed and tests are run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=REPOSITORY, check=True,
            capture_output=True, text=True,
        ).stdout  # fmt: skip
        for name in filter(None, listed.split("\0")):
            if (REPOSITORY / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(REPOSITORY / name, folder / name)

    def passes(self, tests: Sequence[str]) -> bool:
        """Return whether tests pass here; what hangs does not."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *(f"tests/{t}" for t in tests)]
        environment = os.environ | {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"}
        try:
            done = subprocess.run(
                command, cwd=self.folder, env=environment, capture_output=True, timeout=LONGEST, check=False
            )
        except subprocess.TimeoutExpired:
            return False
        return done.returncode == 0

    def try_(self, mutant: Mutant, tests: Sequence[str]) -> Outcome:
        """Return whether tests notice a change; the file is as it was afterwards."""
        path = self.folder / mutant.file
        source = path.read_text(encoding="utf-8")
        changed = _changed(source, mutant)
        before, after = next((a, b) for a, b in zip(source.splitlines(), changed.splitlines(), strict=False) if a != b)
        began = time.monotonic()
        path.write_text(changed, encoding="utf-8")
        try:
            caught = not self.passes(tests)
        finally:
            path.write_text(source, encoding="utf-8")
        return Outcome(mutant, before.strip(), after.strip(), caught, time.monotonic() - began)


def run(mutants: Sequence[Mutant], table: Sequence[Row]) -> Iterator[Outcome]:
    """Yield what becomes of mutants.

    Raises:
        ValueError: If tests of one fail without any change: they would seem to catch all.
    """
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        sound: set[str] = set()
        for mutant in sorted(mutants):
            tests = tests_of(mutant.file, table)
            for test in tests:
                if test not in sound and not copy.passes([test]):
                    raise ValueError(f"tests/{test} fails as the sources are; mend it first")
                sound.add(test)
            yield copy.try_(mutant, tests)


def main() -> None:
    """Run it from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=150, help="mutants")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--of", default="*", help="pattern of the files, as 'drive_env/safety/*'")
    parser.add_argument("--out", type=Path, help="CSV file")
    options = parser.parse_args()
    table = read_table()
    chosen = sample(files_of(table, options.of), options.count, options.seed)
    outcomes: list[Outcome] = []
    for outcome in run(chosen, table):
        outcomes.append(outcome)
        mutant = outcome.mutant
        print(f"{'caught  ' if outcome.caught else 'SURVIVED'} {outcome.seconds:4.0f} s  {mutant.file}:{mutant.line}  "
              f"{outcome.before}  ->  {outcome.after}", flush=True)  # fmt: skip
        if options.out:
            with options.out.open("w", newline="", encoding="utf-8") as file:
                rows = csv.writer(file)
                rows.writerow(("file", "line", "operator", "before", "after", "caught"))
                rows.writerows((o.mutant.file, o.mutant.line, o.mutant.operator, o.before, o.after, o.caught)
                               for o in outcomes)  # fmt: skip
    print(f"{sum(o.caught for o in outcomes)} of {len(outcomes)} caught")


if __name__ == "__main__":
    main()
