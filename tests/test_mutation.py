"""The mutation run: its table, what it changes, and a small sample of it."""

from __future__ import annotations

import mutation
import pytest
from rigs.thinning import part

TABLE = mutation.read_table()
QUICK = ["drive_env/safety/oscillation.py", "tuning/fallback_gains.py", "tuning/identify/confidence.py"]


def test_every_row_has_files_of_its_own_and_tests_that_are_there():
    first = {next(row.files for row in TABLE if row.has(file)) for file in mutation.files_of(TABLE)}
    assert [row.files for row in TABLE if row.files not in first] == []
    assert [row.files for row in TABLE if not row.tests] == []
    assert [name for row in TABLE for name in row.tests if not (mutation.HERE / name).is_file()] == []


def test_tests_that_name_a_file_come_first():
    table = [
        mutation.Row(("tuning/*",), ("safety/test_swings.py", "master/test_fallback_gains.py"), ("tuning/auto/*",))
    ]
    assert mutation.tests_of("tuning/target.py", table) == ("safety/test_swings.py", "master/test_fallback_gains.py")
    assert mutation.tests_of("tuning/auto/design.py", table) == ()
    named = [mutation.Row(("tuning/*",), ("safety/test_swings.py", "master/test_fallback_gains.py"))]
    assert mutation.tests_of("tuning/fallback_gains.py", named) == (
        "master/test_fallback_gains.py",
        "safety/test_swings.py",
    )


def test_what_is_only_read_by_a_type_checker_is_left_alone():
    source = "@frozen(True)\ndef f(a: int | None = 1) -> int | None:\n    b: int | None = a + 1\n    return b\n"
    silent = mutation._silent(source)
    assert [any(first <= place < last for first, last in silent) for place in [(1, 8), (2, 13), (2, 31), (3, 11)]] == [
        True
    ] * 4
    assert not any(first <= place < last for first, last in silent for place in [(2, 22), (3, 22), (4, 11)])


@pytest.mark.slow
def test_a_sample_is_the_same_for_a_seed_and_has_a_line_once():
    pytest.importorskip("cosmic_ray", reason="install the extra 'mutation'")
    found = mutation.sample(QUICK, 20, 3)
    assert found == mutation.sample(QUICK, 20, 3) != mutation.sample(QUICK, 20, 4)
    assert len({(mutant.file, mutant.line) for mutant in found}) == 20


def test_a_change_that_python_cannot_read_is_none(monkeypatch):
    """The `*` of arguments by name looks like a product to Cosmic Ray."""
    pytest.importorskip("cosmic_ray", reason="install the extra 'mutation'")
    file = "drive_env/safety/oscillation.py"
    source = (mutation.REPOSITORY / file).read_text(encoding="utf-8")
    everything = list(mutation.mutants_of(file))
    readable = [mutant for mutant in everything if mutation._is_python(mutant)]
    assert 0 < len(readable) < len(everything)
    for mutant in readable:
        compile(mutation._changed(source, mutant), file, "exec")
    assert set(mutation.sample([file], 1000, 0)) <= set(readable)


@pytest.mark.slow
def test_a_sample_of_changes_is_noticed():
    pytest.importorskip("cosmic_ray", reason="install the extra 'mutation'")
    many = part(20, 5)
    outcomes = list(mutation.run(mutation.sample(QUICK, many, 0), TABLE))
    survived = [f"{o.mutant.file}:{o.mutant.line} {o.before} -> {o.after}" for o in outcomes if not o.caught]
    assert len(survived) <= max(many // 10, 1), "\n".join(survived)


def test_tests_that_fail_as_it_is_are_no_judges(monkeypatch):
    monkeypatch.setattr(mutation.Copy, "passes", lambda self, tests: False)
    mutant = mutation.Mutant("tuning/fallback_gains.py", 1, "core/NumberReplacer", 0)
    with pytest.raises(
        ValueError, match=r"tests/master/test_fallback_gains.py fails as the sources are; mend it first"
    ):
        next(mutation.run([mutant], TABLE))
