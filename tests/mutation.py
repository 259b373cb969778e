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
import functools
import importlib
import os
import random
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent
LONGEST = 60  # s of work: tests that take longer hang, and have noticed
PATIENCE = 600.0  # s until tests that wait, and do nothing, hang
LIBRARIES = ("numpy", "numba", "mujoco", "scipy.optimize", "scipy.signal", "canopen", "can", "gymnasium", "hypothesis")
OURS = ("drive_env", "mechanics", "tuning", "agents", "research", "conftest")
# Of these no test could see anything: what only a type checker or a reader of warnings sees, checks of lengths, caches.
# Of truth values a product is an "and", a sum an "or".
LEFT_OUT = ("RemoveDecorator", "NoOp", "Variable", "BitAnd_Mul", "BitOr_Add")
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
    """What became of a mutant: the line as it was and as it became, and which file of tests noticed, if one did."""

    mutant: Mutant
    before: str
    after: str
    by: str | None
    seconds: float

    @property
    def caught(self) -> bool:
        """Whether a test noticed."""
        return self.by is not None


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


def mutants_of(file: str, line: int | None = None) -> Iterator[Mutant]:
    """Yield the changes that a file may suffer, or one line of it."""
    from cosmic_ray.plugins import get_operator

    text, nodes, silent = _read(file)
    near = [node for node in nodes if line is None or node.start_pos[0] <= line <= node.end_pos[0]]
    for name in _operator_names():
        operator = get_operator(name)()
        if not any(line in (None, start[0]) for node in near for start, _ in operator.mutation_positions(node)):
            continue
        places = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, start in enumerate(places):
            harmless = any(word in text[start[0] - 1] for word in HARMLESS)
            if line in (None, start[0]) and not harmless and not any(a <= start < b for a, b in silent):
                yield Mutant(file, start[0], name, occurrence)


@functools.cache
def _operator_names() -> tuple[str, ...]:
    from cosmic_ray.plugins import operator_names

    return tuple(name for name in operator_names() if not any(word in name for word in LEFT_OUT))


@functools.cache
def _read(file: str) -> tuple[list[str], list[Any], list[tuple[tuple[int, int], tuple[int, int]]]]:
    """Return a file's lines, the nodes of its syntax tree, and where nothing is run."""
    from cosmic_ray.ast import ast_nodes, get_ast

    source = (REPOSITORY / file).read_text(encoding="utf-8")
    return source.splitlines(), list(ast_nodes(get_ast(source))), _silent(source)


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
    """Return so many mutants, each of another line: one that has many operators is drawn no more often for that.

    Rooms take turns (`room_of`), so that a small sample has some of each. A line is drawn of all lines of its room, and
    another one where there is nothing to change in it.
    """
    chance = random.Random(seed)
    rooms: dict[str, list[tuple[str, int]]] = {}
    for file in sorted(files):
        length = len((REPOSITORY / file).read_text(encoding="utf-8").splitlines())
        rooms.setdefault(room_of(file), []).extend((file, line) for line in range(1, length + 1))
    for lines in rooms.values():
        chance.shuffle(lines)
    waiting = sorted(rooms)
    chance.shuffle(waiting)
    found: list[Mutant] = []
    while waiting and len(found) < count:
        for room in list(waiting):
            mutant = _next_mutant(rooms[room], chance)
            if mutant is None:
                waiting.remove(room)
            elif len(found) < count:
                found.append(mutant)
    return found


def room_of(file: str) -> str:
    """Return a file's room: the folder in `drive_env/`, or a package, whose rooms are small, as a whole."""
    package, *folders = file.split("/")[:-1]
    return f"{package}/{folders[0]}" if package == "drive_env" and folders else package


def _next_mutant(lines: list[tuple[str, int]], chance: random.Random) -> Mutant | None:
    """Return a mutant of the next line that has one, and take the lines up to it away; None where none is left."""
    while lines:
        file, line = lines.pop()
        of_line = list(mutants_of(file, line))
        for mutant in chance.sample(of_line, len(of_line)):
            if _is_python(mutant):
                return mutant
    return None


def _is_python(mutant: Mutant) -> bool:
    """Return whether a change leaves a file that can be read, without a warning.

    Where it cannot be read every test would notice; `is` for `==` beside a literal is the same, and Python warns of it.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error", SyntaxWarning)
        try:
            compile(_changed((REPOSITORY / mutant.file).read_text(encoding="utf-8"), mutant), mutant.file, "exec")
        except (SyntaxError, SyntaxWarning, AttributeError):  # Cosmic Ray's own for "except package.SomeError"
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
                shutil.copy2(REPOSITORY / name, folder / name)
        # Compiled once for all: Python takes what was compiled of a file with this time and length.
        for there in filter(Path.is_dir, {(REPOSITORY / name).parent / "__pycache__" for name in listed.split("\0")}):
            shutil.copytree(there, folder / there.relative_to(REPOSITORY))

    def first_failure(self, tests: Sequence[str]) -> str | None:
        """Return which of some test files is the first that fails; None if all pass.

        Those that hang, or cannot even begin, fail as a whole: the first of them is named.

        They run in a child that has the libraries already: importing them takes longer than most of the tests.
        """
        for name in LIBRARIES:
            importlib.import_module(name)
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            self._run_in_child(tests, writing)
        os.close(writing)
        with open(reading, encoding="utf-8") as pipe:
            ended = select.select([pipe], [], [], PATIENCE)[0]
            if not ended:
                os.kill(child, signal.SIGKILL)
            said = pipe.read()
        _, status = os.waitpid(child, 0)
        if ended and os.waitstatus_to_exitcode(status) == 0:
            return None
        return next((name for name in tests if name in said), tests[0])

    def _run_in_child(self, tests: Sequence[str], told: int) -> NoReturn:
        """Run tests in this process, tell which file failed, and end it with their exit code."""
        code = 1
        try:
            # Other processes may need the computer, too: what hangs is told by what it has done.
            done = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
            resource.setrlimit(resource.RLIMIT_CPU, (round(done) + LONGEST, resource.RLIM_INFINITY))
            os.chdir(self.folder)
            os.environ |= {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"}
            sys.dont_write_bytecode = True
            # What is changed must be imported anew, and from the copy.
            for name in [name for name in sys.modules if name.split(".")[0] in OURS]:
                del sys.modules[name]
            elsewhere = [p for p in sys.path if Path(p or ".").resolve() not in (HERE, REPOSITORY)]
            sys.path[:] = [str(self.folder), *elsewhere]
            with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
                os.dup2(nowhere.fileno(), 1)
                os.dup2(nowhere.fileno(), 2)
                arguments = ["-x", "-q", "-p", "no:cacheprovider", *(f"tests/{t}" for t in tests)]
                code = int(pytest.main(arguments, plugins=[_Teller(told)]))
        finally:
            os._exit(code)

    def try_(self, mutant: Mutant, tests: Sequence[str]) -> Outcome:
        """Return whether tests notice a change; the file is as it was afterwards."""
        path = self.folder / mutant.file
        source = path.read_text(encoding="utf-8")
        changed = _changed(source, mutant)
        before, after = next((a, b) for a, b in zip(source.splitlines(), changed.splitlines(), strict=False) if a != b)
        began = time.monotonic()
        for compiled in path.parent.glob(f"__pycache__/{path.stem}.*"):
            compiled.unlink()
        path.write_text(changed, encoding="utf-8")
        try:
            by = self.first_failure(tests)
        finally:
            path.write_text(source, encoding="utf-8")
        return Outcome(mutant, before.strip(), after.strip(), by, time.monotonic() - began)


class _Teller:
    """Plugin of pytest that writes where a test failed, or a file could not be read, to a file descriptor."""

    def __init__(self, told: int) -> None:
        self._told = told

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Tell of a test that failed."""
        if report.failed:
            os.write(self._told, report.nodeid.encode())

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Tell of a file that could not be read."""
        if report.failed:
            os.write(self._told, report.nodeid.encode())


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
            outcome = copy.try_(mutant, tests)
            if outcome.by is not None and outcome.by not in sound:
                if copy.first_failure([outcome.by]) is not None:
                    raise ValueError(f"tests/{outcome.by} fails as the sources are; mend it first")
                sound.add(outcome.by)
            yield outcome


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
