"""docs/messages.md has a row for each message that needs an explanation; each row names a message of the code."""

from __future__ import annotations

import ast
import fnmatch
import importlib.util
import re
from functools import cache
from typing import NamedTuple

from sources import ROOT, nodes_of

from drive_env.dictionary import aborts

PACKAGES = ("drive_env", "mechanics", "tuning", "agents")
# What is said without being raised: verdicts of certificates, reasons of identification, what the envelope tells.
SAID = (
    "tuning/auto/*.py",
    "tuning/identify/*.py",
    "tuning/response/*.py",
    "drive_env/safety/*.py",
    "tuning/stop_causes.py",
)
PASSED_ON = {"ObjectAccessError", "KeyboardInterrupt", "NotImplementedError", "typer.Exit"}  # these may carry no text
TELLING = r"(^|\.)_?fail$|^warnings\.warn$|logger\.(warning|error)$"
FEWEST_LETTERS = 5  # of a pattern, or it would fit anything


class Message(NamedTuple):
    """A text of the code, with … for each value."""

    place: str
    error: str
    text: str


def load_page():
    spec = importlib.util.spec_from_file_location("messages_page", ROOT / "docs" / "messages_page.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


PAGE = load_page()
DATA = PAGE.load()
ROWS = [row for topic in DATA["topic"] for row in topic["message"]]
PATTERNS = [text for row in ROWS for text in row.get("says", ()) if not text.startswith("abort code ")]
ABORTS = [text for row in ROWS for text in row.get("says", ()) if text.startswith("abort code ")]


# --- what the code says -----------------------------------------------------------------------------------------------
def text_of(node):
    """Return the text of an expression with … for each value, "" for none."""
    match node:
        case ast.Constant(value=str(text)):
            return re.sub(r"%[0-9.]*[a-zA-Z]", "…", text)
        case ast.JoinedStr(values=values):
            return "".join(v.value if isinstance(v, ast.Constant) else "…" for v in values)
        case ast.BinOp(op=ast.Add()):
            return (text_of(node.left) or "…") + (text_of(node.right) or "…")
        case ast.IfExp():
            return text_of(node.body) or text_of(node.orelse)
    return ""


@cache
def modules():
    return {
        str(path.relative_to(ROOT)): nodes_of(path.read_text(encoding="utf-8"))
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
    }


@cache
def raised():
    """Return every message that is raised with a text of its own."""
    found = []
    for place, nodes in modules().items():
        for node in nodes:
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                texts = [text for one in node.exc.args if (text := text_of(one)) and re.search(r"[a-z]{3}", text)]
                error = ast.unparse(node.exc.func).rsplit(".", 1)[-1]
                found += [Message(f"{place}:{node.lineno}", error, text) for text in texts]
    return found


@cache
def told():
    """Return every text by which a command ends, as USER_ERROR with exit code 2, and warnings and errors of a log."""
    return [
        Message(f"{place}:{node.lineno}", is_mistake(node) * "USER_ERROR", text)
        for place, nodes in modules().items()
        for node in nodes
        if isinstance(node, ast.Call) and node.args and re.search(TELLING, ast.unparse(node.func))
        if re.search(r"[a-z]{3}", text := text_of(node.args[0]))
    ]


def is_mistake(call):
    """Return whether a call ends a command for a mistake of its user."""
    name = ast.unparse(call.func)
    return name.endswith("fail") and (len(call.args) == 1 or ast.unparse(call.args[1]) == "USER_ERROR")


def literals(nodes):
    """Return the texts of a module that are no docstrings and no assertions, with … for each value."""
    docstrings = {id(n.value) for n in nodes if isinstance(n, ast.Expr)}
    docstrings |= {id(n.msg) for n in nodes if isinstance(n, ast.Assert)}
    inner = {id(v) for n in nodes if isinstance(n, ast.JoinedStr) for v in n.values}
    others = docstrings | inner
    for node in nodes:
        if id(node) not in others and isinstance(node, ast.Constant | ast.JoinedStr) and text_of(node):
            yield node.lineno, text_of(node)


@cache
def said():
    """Return what verdicts, identification and envelope say: texts of four words or more."""
    own = {message.text for message in raised()}
    return [
        Message(f"{place}:{line}", "", text)
        for place, nodes in modules().items()
        if any(fnmatch.fnmatch(place, one) for one in SAID) and "/model/" not in place
        for line, text in literals(nodes)
        if len(re.findall(r"[A-Za-z]{2,}", text)) >= 4 and " " in text.strip() and text not in own
    ]


@cache
def everything():
    """Return every text of the code."""
    return "\n".join(text for nodes in modules().values() for _, text in literals(nodes))


# --- patterns ---------------------------------------------------------------------------------------------------------
@cache
def expression(pattern):
    """Return a pattern of the page as a regular expression: its … stands for anything on one line."""
    return re.compile(r"[^\n]*?".join(re.escape(part) for part in pattern.strip("… ").split("…")))


@cache
def longest_part(pattern):
    return max(pattern.strip("… ").split("…"), key=len)


def fits(pattern, text):
    return longest_part(pattern) in text and bool(expression(pattern).search(text))  # the first is quick to say no


def has_a_row(text):
    return any(fits(pattern, text) for pattern in PATTERNS)


@cache
def classes_of(error):
    """Return the name of an error and of all classes that it derives from, as far as they are ours."""
    bases = {
        ast.unparse(base)
        for nodes in modules().values()
        for node in nodes
        if isinstance(node, ast.ClassDef) and node.name == error
        for base in node.bases
    }
    return {error}.union(*map(classes_of, bases))


def family_of(message):
    for family in DATA["family"]:
        if classes_of(message.error) & set(family.get("errors", ())):
            return family["title"]
        if any(fits(text, message.text) for text in family.get("texts", ())):
            return family["title"]
    return None


def without_a_row(messages):
    return [f"{m.place} {m.error}: {m.text}" for m in messages if not has_a_row(m.text) and family_of(m) is None]


# --- the page has what the code says ----------------------------------------------------------------------------------
def test_every_message_that_is_raised_has_a_row_or_a_family():
    messages = [message for message in raised() if message.error not in PASSED_ON]
    assert len(messages) > 500
    assert without_a_row(messages) == []


def test_every_end_of_a_command_and_every_warning_has_a_row_or_a_family():
    assert len(told()) > 40
    assert without_a_row(told()) == []


def test_every_refusal_of_a_dictionary_has_a_row():
    messages = [message for message in raised() if message.error == "ObjectAccessError"]
    assert len(messages) > 30
    assert [f"{m.place}: {m.text}" for m in messages if not has_a_row(m.text)] == []


def test_every_verdict_and_every_stop_has_a_row_or_a_family():
    assert len(said()) > 100
    assert without_a_row(said()) == []


def test_every_emergency_of_every_device_has_a_row():
    rows = {row["emcy"] for row in ROWS if "emcy" in row}
    told = PAGE.emergencies()
    assert {"tmcm1636", "tmcm6212", "tmcm3313"} <= told.keys()
    assert rows == {name for table in told.values() for name in table}


def test_an_emergency_says_which_drives_send_it_and_with_which_codes():
    page = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
    rows = {cells[1]: cells for line in page.splitlines() if len(cells := line.strip("| ").split(" | ")) == 5}
    assert rows["stall"][0] == "3230h"  # TMCM-3313 manual, table 380
    assert rows["stall"][2] == "tmcm3313, tmcm6212"
    assert rows["hall error"][2] == "tmcm1636"  # a stepper has no halls
    trinamic = "tmcm1636, tmcm3313, tmcm6212"  # the amplifiers on mains have names of their own
    assert rows["open load a, open load b"][::2][:2] == ["1000h", trinamic]
    assert rows["following error"][::2][:2] == ["8611h", trinamic]
    assert rows["contouring"][::2][:2] == ["8612h", "tgz_d"]
    assert rows["overcurrent high side, overcurrent bridge a, overcurrent bridge b"][0] == "2310h, 2312h, 2311h"


def test_one_emergency_has_one_code_on_every_device():
    codes = {(name, row["code"]) for table in PAGE.emergencies().values() for name, row in table.items()}
    assert len(codes) == len(dict(codes))


def test_every_abort_code_has_a_row():
    codes = {value for name, value in vars(aborts).items() if name.isupper()}
    assert {int(text.removeprefix("abort code ").rstrip("h").replace(" ", ""), 16) for text in ABORTS} == codes
    assert len(ABORTS) == len(codes)


# --- the code has what the page says ----------------------------------------------------------------------------------
def test_every_row_is_still_said():
    patterns = PATTERNS + [text for one in DATA["family"] for text in one.get("texts", ())]
    assert [p for p in patterns if len(re.findall("[A-Za-z]", p)) < FEWEST_LETTERS] == []  # they would fit anything
    assert [p for p in patterns if not fits(p, everything())] == []


def test_no_pattern_stands_twice():
    assert sorted(set(PATTERNS)) == sorted(PATTERNS)


def test_rows_are_whole():
    for row in ROWS:
        if "same" in row:
            assert any(other.get("emcy") == row["same"] and "same" not in other for other in ROWS)
        else:
            assert row["cause"].endswith((".", "?")), row
            assert row["remedy"].strip(), row
            assert "emcy" in row or (row["says"] and row["from"]), row


def test_the_page_is_current():
    assert (ROOT / "docs" / "messages.md").read_text(encoding="utf-8") == PAGE.page(), "python docs/messages_page.py"


# --- the test itself --------------------------------------------------------------------------------------------------
def test_a_message_that_is_new_is_found():
    new = Message("drive_env/commands/new.py:1", "BusError", "the frobnicator … has no grommet")
    assert without_a_row([new]) != []
    assert not expression("cannot open interface …").search("cannot close the interface x")
