"""`drive-env objects`: what a device has, found by word, without a bus; the EDS itself says what is right."""

from __future__ import annotations

import configparser
import json

import pytest
from typer.testing import CliRunner

from drive_env.commands.cli import app
from drive_env.fieldbus.description import describe

DONE, REFUSED, USER_ERROR = 0, 1, 2


def objects(*arguments):
    result = CliRunner(env={"COLUMNS": "120"}).invoke(app, ["objects", *arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def found(*arguments):
    code, out, _ = objects(*arguments, "--json")
    assert code == DONE
    return {(row["index"], row["sub"]): row for row in json.loads(out)}


@pytest.fixture(scope="module")
def eds():
    parser = configparser.ConfigParser(interpolation=None)
    parser.read_string(describe("tmcm1636", None).dictionary.path.read_text(encoding="utf-8"))
    return parser


def test_all_that_has_a_word_in_its_name_is_found_with_type_and_access(eds):
    rows = found("velocity", "--area", "profile")
    named = {s for s in eds.sections() if s[0] == "6" and len(s) == 4 and "DataType" in eds[s]
             and "velocity" in eds[s]["ParameterName"].lower()}  # fmt: skip
    assert named and named <= {index for index, _ in rows}
    kinds = {2: "INTEGER8", 3: "INTEGER16", 4: "INTEGER32", 5: "UNSIGNED8", 6: "UNSIGNED16", 7: "UNSIGNED32"}
    for index in named:
        row = rows[index, 0]
        assert row["type"] == kinds[int(eds[index]["DataType"], 0)]
        assert row["access"][:2] == eds[index]["AccessType"].lower()[:2]


@pytest.mark.parametrize("word", ["6081", "0x6081", "6081h", "profile velocity", "PROFILE VELOCITY"])
def test_an_object_is_found_as_it_is_written_elsewhere(word):
    assert ("6081", 0) in found(word)


def test_a_unit_finds_what_is_in_it():
    rows = found("mA")
    assert any(row["unit"] == "mA" for row in rows.values())


@pytest.mark.parametrize(
    ("area", "low", "high"),
    [("communication", "1000", "1FFF"), ("manufacturer", "2000", "5FFF"), ("profile", "6000", "9FFF")],
)  # fmt: skip
def test_an_area_has_all_of_its_objects_and_no_others(area, low, high):
    assert set(found("--area", area)) == {key for key in found() if low <= key[0] <= high}


def test_the_table_has_limits_with_their_object():
    code, out, _ = objects("6060")
    (line,) = (line for line in out.splitlines() if line.startswith("6060:00"))
    assert code == DONE and "INTEGER8" in line and "0 to 10" in line


@pytest.mark.parametrize(("arguments", "code", "message"), [
    (["nosuchword"], REFUSED, "no object with 'nosuchword'; try another word, or fewer"),
    (["--area", "profil"], USER_ERROR, "not 'profil'; did you mean"),
    (["--device", "nosuch"], USER_ERROR, "nosuch"),
    (["--eds", "nosuch.eds"], USER_ERROR, "nosuch.eds"),
])  # fmt: skip
def test_a_mistake_is_one_line(arguments, code, message):
    got, out, error = objects(*arguments)
    assert (got, out) == (code, "") and message in error
