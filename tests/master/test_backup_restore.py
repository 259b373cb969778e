"""`drive-env parameters restore` writes a whole file, of this drive, without commands; what it says is proven."""

from __future__ import annotations

import json
import re

import pytest
from rigs.scripted_drive import ScriptedBus, ScriptedDrive
from rigs.served_drives import node
from rigs.served_drives import parameters as parameters_by
from typer.testing import CliRunner

from drive_env import CanDrives, motion
from drive_env.commands.cli import app
from drive_env.devices import find_device
from drive_env.fieldbus.description import CIA_402
from drive_env.master import parameters
from drive_env.master.parameters import CommandObjectError, command, restorable, write_all_or_none

DONE, REFUSED, USER_ERROR = 0, 1, 2
PROFILE_VELOCITY = 0x6081
SPEED = 2184533


@pytest.fixture
def drive(monkeypatch):
    """A drive with a serial number, at the other end of every bus that a command opens."""
    made = ScriptedDrive(values={(0x1018, 3): (0x10009, 4), (0x1018, 4): (4711, 4), (0x6081, 0): (SPEED, 4),
                                 (0x6083, 0): (7, 4), (0x6065, 0): (1000, 4), (0x2058, 0): (65536, 4)})  # fmt: skip
    made.buses = []

    def opened(*_, **__):
        made.buses.append(ScriptedBus(made))
        return made.buses[-1]

    monkeypatch.setattr("drive_env.master.can_drives.open_bus", opened)
    monkeypatch.setattr("drive_env.master.can.port.open_bus", opened)
    return made


def run(*arguments):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def writes(drive):
    """Return the objects that were written over SDO, and every frame that is no SDO request."""
    found = []
    for bus in drive.buses:
        for can_id, data, _ in bus.log:
            if can_id != 0x601:
                found.append((can_id, data))
            elif data[0] & 0xE0 == 0x20:
                found.append(f"{int.from_bytes(data[1:3], 'little'):04X}")
    return found


@pytest.fixture
def file(drive, tmp_path):
    path = tmp_path / "drive.toml"
    code, _, error = run("parameters", "backup", path)
    assert code == DONE, error
    drive.set(PROFILE_VELOCITY, 1000)
    drive.buses.clear()
    return path


def test_a_backup_says_of_which_drive_it_is_when_and_ends_with_its_check_sum(file):
    lines = file.read_text(encoding="utf-8").splitlines()
    assert re.fullmatch(r'read = "\d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC"', lines[2])
    assert lines[lines.index("[identity]") + 1 :][:8] == [
        'device = "tmcm1636"', "node = 1", 'name = "TMCM-1636"', "vendor = 646", "product = 1636", "revision = 65545",
        "serial = 4711", "axis = 0",
    ]  # fmt: skip
    assert lines[-2] == "[check]" and re.fullmatch(r'sha256 = "[0-9a-f]{64}"', lines[-1])
    assert [path.name for path in file.parent.iterdir()] == ["drive.toml"]


def test_a_file_of_this_drive_is_restored_and_proven_by_another_connection(drive, file):
    code, out, error = run("parameters", "restore", file, "--yes")
    assert code == DONE, error
    assert re.search(
        r"^1 written, \d+ verified by a second reading; not stored: lost at the next reset", out, re.MULTILINE
    )
    assert drive.get(PROFILE_VELOCITY) == SPEED
    assert writes(drive) == ["6081"]
    _, second = drive.buses
    assert second.sent(0x601) and not [data for data in second.sent(0x601) if data[0] & 0xE0 == 0x20]


@pytest.mark.parametrize("arguments", [("--yes",), ("--dry-run",), ("--yes", "--json")])
def test_what_is_never_restored_is_told_where_it_differs(drive, tmp_path, arguments):
    drive.values[0x2705, 0] = (1, 4)
    drive.set(PROFILE_VELOCITY, SPEED)
    path = tmp_path / "drive.toml"
    assert run("parameters", "backup", path)[0] == DONE
    drive.set(0x2705, 6)
    drive.buses.clear()
    code, _, error = run("parameters", "restore", path, *arguments)
    assert code == DONE, error
    assert "drive-env: note: 2705h:00 Node ID is 6, not 1: addresses are not restored" in error
    assert writes(drive) == [] and drive.get(0x2705) == 6


def test_a_writer_is_not_believed(drive, file, monkeypatch):
    monkeypatch.setattr(parameters, "write_all_or_none", lambda drives, wanted, axis: [])
    code, out, error = run("parameters", "restore", file, "--yes")
    assert (code, "verified" in out) == (REFUSED, False), error
    assert error == (
        f"drive-env: node 1 does not have the values that were written, by a second reading: 6081h:00 Profile "
        f"velocity is "
        f"1000, not {SPEED}; is another master writing to it? Look with "
        "`drive-env parameters diff`, then restore again\n"
    )


@pytest.mark.parametrize(
    ("spoil", "words", "unchecked"),
    [
        (lambda text: text.replace(f"= {SPEED} ", "= 50 "), "was changed since it was written", DONE),
        (lambda text: text.replace("serial = 4711", "serial = 4712"), "was changed since it was written", USER_ERROR),
        (lambda text: text[: text.index('"6083')], "is incomplete: it ends before its check sum", USER_ERROR),
        (lambda text: text[: text.index('"6083') + 4], "is not TOML, or incomplete", USER_ERROR),
        (lambda text: text[: text.index("[check]")].replace("format = 2\n", ""), "has no check sum", DONE),
        (lambda text: text.replace("# Profile velocity", "# the user's own words").replace("\n", "\r\n"), "", DONE),
    ],
    ids=[
        "a value",
        "the serial number",
        "torn between lines",
        "torn in a line",
        "an old one",
        "comments and line ends",
    ],
)
def test_a_file_that_is_not_as_it_was_written_is_refused_by_name(drive, file, spoil, words, unchecked):
    file.write_bytes(spoil(file.read_text(encoding="utf-8")).encode())
    code, _, error = run("parameters", "restore", file, "--yes")
    if words:
        assert (code, error.startswith(f"drive-env: {file} {words}"), error.count("\n")) == (USER_ERROR, True, 1)
        assert (drive.get(PROFILE_VELOCITY), writes(drive)) == (1000, [])
    else:
        assert (code, drive.get(PROFILE_VELOCITY)) == (DONE, SPEED)
    assert run("parameters", "restore", file, "--yes", "--unchecked")[0] == unchecked


def test_a_difference_is_shown_also_of_a_file_that_was_changed_and_it_is_said(drive, file):
    file.write_text(file.read_text(encoding="utf-8").replace(f"= {SPEED} ", "= 50 "), encoding="utf-8")
    code, out, error = run("parameters", "diff", file, "--json")
    assert [row["wanted"] for row in json.loads(out)] == [50]
    assert (code, error.startswith(f"drive-env: note: {file} was changed since it was written")) == (REFUSED, True)


def test_a_parameter_that_one_of_two_files_lacks_is_absent_there(file, tmp_path):
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    less = tmp_path / "less.toml"
    less.write_text("".join(line for line in lines if not line.startswith('"6081:00"')), encoding="utf-8")
    for pair, texts in ((file, less), ("absent", f"{SPEED} pps")), ((less, file), (f"{SPEED} pps", "absent")):
        code, out, _ = run("parameters", "diff", *pair, "--json")
        assert code == REFUSED
        assert [(row["found text"], row["wanted text"]) for row in json.loads(out)] == [texts]


def test_another_drive_is_refused_unless_it_is_said(drive, file):
    drive.values[0x1018, 4] = (4712, 4)
    code, _, error = run("parameters", "restore", file, "--yes")
    assert (code, writes(drive)) == (USER_ERROR, [])
    assert error == (
        f"drive-env: {file} is of another drive: it was read from serial number 4711, and here is 4712. Nothing was "
        "written; if it is meant for this drive all the same, say --other-drive\n"
    )
    assert run("parameters", "restore", file, "--yes", "--other-drive")[0] == DONE
    assert drive.get(PROFILE_VELOCITY) == SPEED


def test_another_product_is_refused_also_where_the_description_takes_any(drive, file, tmp_path):
    from drive_env.devices import find_device

    eds = tmp_path / "any.eds"
    eds.write_text(find_device("tmcm1636").eds.read_text(encoding="cp1252").replace("DefaultValue=1636", ""), "cp1252")
    drive.values[0x1018, 2] = (6212, 4)
    code, _, error = run("parameters", "restore", file, "--yes", "--eds", eds)
    assert (code, writes(drive)) == (USER_ERROR, [])
    assert "product code 664h, and here is 1844h" in error


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('"5FFF:00" = 1', "5FFFh (bootloader: a service)"),
        ('"6040:00" = 15', "6040h (controlword: a command)"),
        ('"2703:01" = 1', "2703h (digital outputs: a command)"),
        ('"1010:01" = 1702257011', "1010h (store: a service)"),
    ],
)
def test_commands_and_services_of_a_file_are_refused_before_anything_is_written(drive, tmp_path, line, words):
    file = tmp_path / "orders.toml"
    file.write_text(f'[parameters]\n"6081:00" = 5\n{line}\n"6083:00" = 9\n', encoding="utf-8")
    code, _, error = run("parameters", "restore", file, "--yes", "--unchecked", "--other-drive")
    assert (code, drive.buses) == (USER_ERROR, [])
    assert (
        error
        == f"drive-env: {file} holds objects that are not parameters: {words}. Nothing was written; take them out\n"
    )


def test_nor_does_a_program_write_them_among_parameters(drive):
    with (
        ScriptedBus(drive) as bus,
        CanDrives(bus=bus, safety=False) as drives,
        pytest.raises(CommandObjectError, match=r"6040h \(controlword: a command\)"),
    ):
        write_all_or_none(drives, {(0x6081, 0): 5, (0x6040, 0): 15})
    assert (drive.get(PROFILE_VELOCITY), drive.get(0x6040)) == (SPEED, 0)


def test_of_another_maker_s_drive_the_same_numbers_are_parameters():
    """2703h to 2706h and 5FFFh are what the TMCM-1636 has made of them."""
    ours, theirs = find_device("tmcm1636").master, CIA_402
    for index in (0x2703, 0x2706, 0x5FFF):
        assert command(index, ours) and not command(index, theirs)
    values = {(0x2704, 0): 1, (0x2705, 0): 2, (0x6081, 0): 3}
    assert restorable(values, ours) == {(0x6081, 0): 3}
    assert restorable(values, theirs) == values


@pytest.mark.parametrize("arguments", [("restore", "drive.toml"), ("commission", "qbl4208")], ids=lambda a: a[0])
def test_a_dry_run_says_what_would_be_written_and_that_nothing_was(drive, file, monkeypatch, arguments):
    monkeypatch.chdir(file.parent)
    for index, size in ((0x2050, 1), (0x2055, 1)):
        drive.values[index, 0] = (0, size)
    code, out, error = run("parameters", *arguments, "--dry-run", "--store")
    assert code == DONE, error
    said = out.splitlines()[-1]
    assert re.fullmatch(r"\d+ parameters would be written to node 1, and stored \(dry run: nothing was written\)", said)
    assert "verified" not in out
    assert (writes(drive), drive.get(PROFILE_VELOCITY)) == ([], 1000)
    told = json.loads(run("parameters", *arguments, "--dry-run", "--json")[1])
    assert (len(told["would change"]), told["written"]) == (int(said.split()[0]), 0)
    drive.set(0x6041, 0x0627)
    code, _, error = run("parameters", *arguments, "--dry-run")
    assert (code, "the axis is enabled" in error) == (REFUSED, True)


@pytest.mark.parametrize("status", [0x0627, 0x0607, 0x060F])
def test_an_axis_that_may_turn_is_not_restored(drive, file, status):
    """Operation enabled; quick stop active; fault reaction active."""
    drive.set(0x6041, status)
    code, _, error = run("parameters", "restore", file, "--yes")
    assert (code, "the axis is enabled" in error, writes(drive)) == (REFUSED, True, [])


def test_what_is_read_while_an_axis_is_enabled_is_the_drives_own():
    """Neither our process data nor our watchdog (1016h), which are given back at the end."""
    with node(lockstep=False) as (_, bus):
        own = parameters_by(bus)
        with CanDrives(interface="slcan", channel=bus[3]) as drives:
            motion.enable(drives, mode="pp")
            drives.record([0x6064, 0x606C, 0x6077], 0.005)
            heartbeat, mapped = (drives.description.dictionary.find(key) for key in ((0x1016, 1), (0x1A00, 1)))
            assert parameters.read_parameters(drives) == own
            assert drives.read_raw(heartbeat, 0) != own[0x1016, 1] and drives.read_raw(mapped, 0) != own[0x1A00, 1]
        assert parameters_by(bus) == own
