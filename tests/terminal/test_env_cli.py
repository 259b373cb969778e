"""The command `drive-env` on emulated drives behind the virtual bus: what it prints, writes and returns."""

from __future__ import annotations

import csv
import json
import re
import socket
import subprocess
import sys
import threading
import time
import uuid
from contextlib import contextmanager, suppress

import can
import canopen
import pytest
from typer.testing import CliRunner

from drive_env import CanDrives, EmulatedDrives, motion
from drive_env.bus.can_port import CanPort
from drive_env.bus.server import Server
from drive_env.bus.world import World
from drive_env.commands import scan
from drive_env.commands.cli import GROUPS, PANELS, app
from drive_env.commands.monitor import spark_line
from drive_env.devices import find_device
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.drives.limits import Limits
from drive_env.fieldbus.errors import BusError, NoAnswerError
from drive_env.trials.replay import command_of, read_log

DONE, REFUSED, USER_ERROR, INTERRUPTED = 0, 1, 2, 130


@pytest.fixture(scope="module")
def shared():
    """A commissioned drive as node 1 and one with factory values as node 2, in real time."""
    world = World(lockstep=False)
    machines = [EmulatedDrives(load="inertia", commissioned=known, num_threads=1) for known in (True, False)]
    for node, machine in enumerate(machines, 1):
        world.add(machine, [node])
    channel = str(uuid.uuid4())
    with Server(world, CanPort(can.Bus(interface="virtual", channel=channel))):
        yield channel, machines
    world.close()


@pytest.fixture
def run(shared, monkeypatch):
    """Run the command on that bus; returns exit code and output, standard error besides."""
    monkeypatch.setenv("DRIVE_ENV_INTERFACE", "virtual")
    monkeypatch.setenv("DRIVE_ENV_CHANNEL", shared[0])
    monkeypatch.setenv("DRIVE_ENV_TIMEOUT", "20")  # a busy computer may stand still for seconds

    def call(*arguments):
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        return result.exit_code, result.stdout, result.stderr

    return call


# --- scan, get, set -----------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_scan_finds_and_names_the_nodes(run):
    code, out, _ = run("scan", "--last", 10, "--timeout", 1)
    assert code == DONE
    assert out.splitlines()[0] == (
        "node 1  tmcm1636  TMCM-1636  hardware 1.0  software 1.09  vendor 286h  product 664h  revision 10009h  CiA 402"
    )
    code, out, _ = run("scan", "--json", "--last", 10, "--timeout", 1)
    assert [(row["node"], row["device"], row["vendor"]) for row in json.loads(out)] == [
        (1, "tmcm1636", 0x286),
        (2, "tmcm1636", 0x286),
    ]


def test_a_node_that_boots_while_it_is_scanned_is_found_and_said_to_be_in_no_state():
    """A boot-up message is an event (CiA 301): a heartbeat tells a state."""
    sent = []

    class Port:
        def __init__(self):
            self.handlers = {}

        def subscribe(self, can_id, handler):
            self.handlers[can_id] = handler

        def send(self, can_id, data):
            if can_id == 0x600 + 2 and not sent:
                sent.append(can_id)
                self.handlers[0x701](b"\0")
                self.handlers[0x702](b"\x05")
                self.handlers[0x702](b"\0")

        def wait(self, done, timeout):
            pass

    assert scan._find(Port(), 1, 3, 0.1) == {(1, "", 0), (2, "operational", 0)}


class SilentPort:
    """A port at which nothing is heard."""

    def subscribe(self, can_id, handler):
        pass


def test_scan_names_every_device_that_a_node_may_be(monkeypatch, capsys):
    """A TGZ-S tells 1000h and 1018h of a TGZ-D."""
    identity = {(0x1000, 0): 0xFFFF0192, (0x1018, 1): 0, (0x1018, 2): 0x54475A44, (0x1018, 3): 0x10000}
    said = find_device("tgz_s").new_dictionary()
    assert all(said.find(key).default == value for key, value in identity.items())

    def read(client, index, sub, what, timeout):
        if (index, sub) not in identity:
            raise ObjectAccessError(0x06020000, "no")
        return identity[index, sub].to_bytes(4, "little")

    monkeypatch.setattr("drive_env.master.can.sdo.SdoClient.read", read)
    scan._print([scan._look(SilentPort(), 3, "", 1, 0.3)], 0.3)
    assert capsys.readouterr().out.startswith("node 3  tgz_d or tgz_d_2026 or tgz_s  vendor 0h")


@pytest.mark.parametrize(
    ("silent", "state", "line"),
    [
        ({0x1000}, "", "node 3  no answer to 1000h:00 within 0.3 s; try a longer --timeout"),
        ({0x1000}, "operational", "node 3  no answer to 1000h:00 within 0.3 s; try a longer --timeout (operational)"),
        ({0x1000}, "stopped", "node 3  no SDO answer (stopped)"),
        (
            {0x1008, 0x100A},
            "operational",
            "node 3  unknown device; give its EDS with --eds  CiA 402  operational  "
            "no answer to 1008h:00, 100Ah:00 within 0.3 s; try a longer --timeout",
        ),
        (set(), "", "node 3  unknown device; give its EDS with --eds  CiA 402"),
    ],
)
def test_scan_shows_a_time_out_as_a_time_out(monkeypatch, capsys, silent, state, line):
    """An object that a node lacks is refused at once: silence is something else."""

    def read(client, index, sub, what, timeout):
        if index in silent:
            raise NoAnswerError("node 3 did not answer")
        if index != 0x1000:
            raise ObjectAccessError(0x0602_0000, what)
        return (402).to_bytes(4, "little")

    monkeypatch.setattr("drive_env.master.can.sdo.SdoClient.read", read)
    scan._print([scan._look(SilentPort(), 3, state, 0, 0.3)], 0.3)
    assert capsys.readouterr().out == line + "\n"


def test_scan_of_an_empty_range_is_told(run):
    code, _, error = run("scan", "--first", 50, "--last", 52, "--timeout", 0.05)
    assert (code, "no node of 50 to 52 answered" in error) == (REFUSED, True), error
    assert run("scan", "--first", 5, "--last", 2)[0] == USER_ERROR


@pytest.mark.parametrize("name", ["6081", "0x6081", "6081h", "6081:0", "profile velocity", "Profile Velocity"])
def test_get_by_index_or_name(run, name):
    code, out, _ = run("get", name)
    assert (code, out) == (DONE, "node 1  6081h:00 Profile velocity = 2184533 pps (2000 rpm)\n")


def test_get_raw_several_nodes_texts_and_json(run):
    assert run("get", "--raw", "6081", "1008")[1].splitlines() == [
        "node 1  6081h:00 Profile velocity = 2184533",
        "node 1  1008h:00 Manufacturer device name = TMCM-1636",
    ]
    assert run("get", "-n", 1, "-n", 2, "2003")[1].splitlines()[1] == "node 2  2003h:00 Maximum Current = 0 mA (0 A)"
    rows = json.loads(run("get", "607D:2", "--json")[1])
    assert [rows[0][key] for key in ("node", "index", "sub", "raw")] == [1, "607D", 2, 2**31 - 1]


@pytest.mark.every(7)
@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["get", "Statuswort"], USER_ERROR, "did you mean 'Statusword'"),
        (["get", "1234"], USER_ERROR, "object 1234h does not exist"),
        (["get", "6041", "-n", "9", "--timeout", "0.05"], REFUSED, "node 9 did not answer"),
        (["get", "6041", "-n", "9", "--timeout", "0.05"], REFUSED, "a slow object takes a longer --timeout"),
        (["get", "6041", "-n", "200"], USER_ERROR, "nodes are different numbers of 1 to 127"),
        (["get", "6041", "--device", "nonsense"], USER_ERROR, "no device is named 'nonsense'"),
        (["get", "6041", "--eds", "missing.eds"], USER_ERROR, "there is no EDS at missing.eds"),
        (["get", "6041", "-i", "nonsense"], USER_ERROR, "cannot open interface 'nonsense'"),
        (["set", "6041", "1"], USER_ERROR, "can only be read"),
        (["set", "2003", "46 A"], USER_ERROR, "cannot be 46000; its highest is 45000"),
        (["set", "605A", "3"], REFUSED, "node 1 refused the write of 3 to 605Ah:00"),
        (["set", "6081", "1 A"], USER_ERROR, "it takes pps"),
        (["jog", "0"], USER_ERROR, "a speed of 0 does not move the axis"),
        (["set", "6081", "1e400 rpm"], USER_ERROR, "'1e400 rpm' is beyond any number; 6081h:00 Profile velocity takes"),
        (["set", "6081", "1e308 rev/s"], USER_ERROR, "is beyond any number"),
        (["set", "6081", "1 rpm", "--raw"], USER_ERROR, "'1 rpm' is not an integer for 6081h:00 Profile velocity"),
        (["get", "6041", "--timeout", "nan"], USER_ERROR, "a time-out of nan s is impossible"),
        (["get", "6041", "--timeout", "0"], USER_ERROR, "a time-out of 0 s is impossible"),
        (
            ["get", "6041", "-i", "slcan", "-c", "socket://127.0.0.1:1", "--bitrate", "3"],
            USER_ERROR,
            "not one of slcan's",
        ),
        (["scan", "--timeout", "nan"], USER_ERROR, "--timeout nan s must be above 0 s"),
        (["jog", "10 rpm", "--max-current", "-5"], USER_ERROR, "--max-current -5 must be above 0 A; leave it out for"),
        (["jog", "10 rpm", "--for", "-1"], USER_ERROR, "must be at least 0.001 s"),
        (["jog", "1e9 rpm"], USER_ERROR, "60FFh:00 Target velocity cannot be"),
        (["jog", "10 rpm", "--by", "1e9 rev"], USER_ERROR, "607Ah:00 Target position cannot be"),
        (["jog", "10 rpm", "-n", "2"], USER_ERROR, "profile acceleration 6083h is 0"),
        (["scope", "2003"], USER_ERROR, "2003h:00 Maximum Current cannot be recorded"),
        (["scope", "--trigger", "whenever"], USER_ERROR, "is not a condition"),
        (["scope", "--period", "0.0015"], USER_ERROR, "not a whole number of milliseconds"),
        (["scope", "--duration", "0.0004"], USER_ERROR, "--duration 0.0004 s is not a whole number of milliseconds"),
        (["scope", "--out", "nowhere/file"], USER_ERROR, "there is no folder nowhere"),
        (["parameters", "diff", "missing.toml"], USER_ERROR, "there is no file missing.toml; write one with"),
        (["parameters", "commission", "nonsense"], USER_ERROR, "no motor is named 'nonsense'; there are am3033_e"),
        (["frames", "log", "frames.xyz"], USER_ERROR, "'.xyz' is not one of .log, .blf"),
        (["frames", "replay", "missing.log"], USER_ERROR, "there is no file missing.log"),
        (["frames", "log", "frames.log", "--duration", "nan"], USER_ERROR, "--duration nan s must be above 0 s"),
        (["monitor", "--period", "0"], USER_ERROR, "must be above 0 s"),
        (["monitor", "--duration", "nan"], USER_ERROR, "--duration nan s must be above 0 s"),
    ],
)
def test_what_goes_wrong_ends_with_one_line_and_its_code(run, arguments, code, text):
    got, _, error = run(*arguments)
    assert got == code, error
    assert text in error
    assert error.startswith("drive-env: ")
    assert error.count("\n") == 1


def test_set_writes_with_units_and_reads_back(run, shared):
    assert run("set", "6081", "1200 rpm") == (DONE, "node 1  6081h:00 Profile velocity = 1310720 pps (1200 rpm)\n", "")
    assert shared[1][0].read(0x6081) == [1_310_720]
    assert run("set", "--raw", "6081", "2184533")[1] == "node 1  6081h:00 Profile velocity = 2184533\n"
    assert run("set", "60FF", "--", "-1000")[1].startswith("node 1  60FFh:00 Target velocity = -1000 pps")


def test_a_service_takes_its_signature(run):
    assert run("set", "2706", "0x65766173")[::2] == (DONE, "")
    assert run("set", "1010:3", "0x65766173")[::2] == (DONE, "")
    code, _, error = run("set", "1010:3", "5")
    assert (code, "node 1 refused the write of 5 to 1010h:03" in error) == (REFUSED, True), error


def test_a_dry_run_reads_what_is_says_what_would_be_and_changes_nothing(run, shared):
    machine = shared[1][0]
    before = {name: machine.read(name).tolist() for name in (0x6040, 0x6060, 0x6064, 0x6081, 0x60FF)}
    code, out, _ = run("set", "6081", "4660", "--dry-run")
    assert code == DONE
    assert "6081h:00 Profile velocity is 2184533 pps" in out
    assert "4660 pps" in out and "would be written (dry run: nothing was written)" in out
    assert run("set", "6081", "-1", "--dry-run")[0] == USER_ERROR
    assert json.loads(run("set", "6081", "4660", "--dry-run", "--json")[1])[0] | {"node": 0} == {
        "node": 0, "object": "6081h:00", "is": 2_184_533, "would be": 4660,
    }  # fmt: skip
    code, out, _ = run("jog", "60 rpm", "--for", "2", "--dry-run")
    assert code == DONE
    assert (
        "would be enabled, turn for 2 s at 65536 pps (60 rpm), and be switched off again (dry run: nothing was done)"
        in out
    )
    assert "at 60 pps (0.0549316 rpm) (if 60 rpm are meant, write '60 rpm')" in run("jog", "60", "--dry-run")[1]
    assert "moved" not in out
    assert {name: machine.read(name).tolist() for name in before} == before


@pytest.mark.parametrize(
    ("arguments", "name", "remedy"),
    [
        (["parameters", "backup", "was.toml"], "was.toml", "choose another file"),
        (["frames", "log", "was.asc", "--duration", "0.1"], "was.asc", "choose another file"),
        (["scope", "--duration", "0.01", "--out", "was"], "was.csv", "choose another --out"),
        (["scope", "--duration", "0.01", "--out", "was"], "was.png", "choose another --out"),
        (["render", "--load", "inertia", "--out", "was.gif"], "was.gif", "choose another --out"),
        (
            ["model", "two_mass", "--log", "log.csv", "--fit", "load.inertia", "--out", "was.toml"],
            "was.toml",
            "choose another --out",
        ),
    ],
)
def test_no_command_replaces_a_file(run, tmp_path, monkeypatch, arguments, name, remedy):
    """A second backup after a change would replace the only copy of what the drive had."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / name
    file.write_text("the only copy", encoding="utf-8")
    code, _, error = run(*arguments)
    assert (code, error) == (USER_ERROR, f"drive-env: {name} exists already, and files are not overwritten; {remedy}\n")
    assert file.read_text(encoding="utf-8") == "the only copy"
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_picture_is_no_log_to_compare_with(run, tmp_path):
    path = tmp_path / "scope.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    code, _, error = run("model", "two_mass", "--log", path)
    assert (code, error) == (
        USER_ERROR, f"drive-env: {path} is not a text file; give the CSV that drive-env scope writes\n",
    )  # fmt: skip


# --- parameters ---------------------------------------------------------------------------------------------------
def test_backup_diff_restore(run, shared, tmp_path):
    file = tmp_path / "drive.toml"
    code, out, _ = run("parameters", "backup", file)
    assert code == DONE
    assert re.fullmatch(r"\d+ parameters of node 1 written to .*\n", out)
    text = file.read_text()
    assert '"6081:00" = 2184533  # Profile velocity [pps]' in text
    assert '"6040:00"' not in text  # a command
    assert run("parameters", "diff", file)[0] == DONE
    run("set", "6081", "1000")
    run("set", "2042:1", "500")
    code, out, _ = run("parameters", "diff", file, "--json")
    assert code == REFUSED
    assert {row["object"]: (row["found"], row["wanted"]) for row in json.loads(out)} == {
        "2042h:01 Velocity Mode Settings.P_Parameter": (500, 445),
        "6081h:00 Profile velocity": (1000, 2184533),
    }
    code, out, _ = run("parameters", "restore", file, "--yes")
    assert code == DONE
    assert "2 written, " in out
    assert shared[1][0].read(0x6081) == [2_184_533]
    assert run("parameters", "diff", file)[0] == DONE


def test_diff_of_two_files(run, tmp_path):
    one, two = tmp_path / "one.toml", tmp_path / "two.toml"
    one.write_text('[parameters]\n"6081:00" = 5\n"6083:00" = 7\n')
    two.write_text('[parameters]\n"6081:00" = 6\n"6083:00" = 7\n')
    code, out, _ = run("parameters", "diff", one, two)
    assert code == REFUSED
    assert "6081h:00 Profile velocity" in out
    assert "6083h" not in out
    assert run("parameters", "diff", one, one)[0] == DONE


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "is not TOML"),
        ("[other]\n", "has no table [parameters]"),
        ('[parameters]\n"velocity" = 3\n', "'velocity' is not an index:sub-index"),
        ('[parameters]\n"6041:00" = 3\n', "can only be read"),
        ('[parameters]\n"2003:00" = 99999\n', "its highest is 45000"),
        ('[parameters]\n"2003:00" = 1.5\n', "takes integers"),
    ],
)
def test_a_file_that_is_no_parameters_is_told(run, tmp_path, text, message):
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    code, _, error = run("parameters", "restore", file, "--yes")
    assert (code, message in error) == (USER_ERROR, True)


def test_restore_is_all_or_nothing(run, shared, tmp_path):
    """605Ah knows 1, 2, 5 and 6 only: what was written before it is taken back."""
    file = tmp_path / "bad.toml"
    file.write_text('[parameters]\n"6081:00" = 77\n"605A:00" = 3\n"6083:00" = 99\n')
    code, _, error = run("parameters", "restore", file, "--unchecked", "--yes")
    assert code == REFUSED
    assert "node 1 refused the write of 3 to 605Ah:00" in error
    assert "everything was taken back, the drive is as it was" in error
    assert shared[1][0].read(0x6081) == [2_184_533]


def test_restore_remaps_pdos_in_the_order_that_a_drive_wants(run, tmp_path):
    before, file = tmp_path / "before.toml", tmp_path / "pdos.toml"
    run("parameters", "backup", before)
    file.write_text(
        '[parameters]\n"1A00:00" = 2\n"1A00:01" = 0x60640020\n"1A00:02" = 0x60410010\n"1800:01" = 0x40000191\n'
        '"1800:02" = 1\n"1A03:00" = 0\n"1803:01" = 0xC0000481\n"1600:00" = 2\n"1600:02" = 0x60FF0020\n'
    )
    code, _, error = run("parameters", "restore", file, "--unchecked", "--yes")
    assert code == DONE, error
    assert run("get", "--raw", "1400:1")[1].endswith(f"= {0x40000201}\n")  # not in the file, and on again
    assert run("parameters", "diff", file)[0] == DONE
    code, _, error = run("parameters", "restore", before, "--yes")
    assert code == DONE, error
    assert run("parameters", "diff", before)[0] == DONE


def test_an_enabled_axis_is_not_restored(run, shared, tmp_path):
    file = tmp_path / "one.toml"
    file.write_text('[parameters]\n"6081:00" = 77\n')
    for word in (6, 7, 15):
        shared[1][0].write("Controlword", word)
    try:
        code, _, error = run("parameters", "restore", file, "--unchecked", "--yes")
        assert (code, "the axis is enabled" in error) == (REFUSED, True)
    finally:
        run("set", "6040", 0)


def test_nobody_to_ask_changes_nothing(run, shared, tmp_path):
    file = tmp_path / "one.toml"
    file.write_text('[parameters]\n"6081:00" = 77\n')
    code, _, error = run("parameters", "restore", file, "--unchecked")
    assert code == USER_ERROR
    assert re.fullmatch(
        r"drive-env: Write \d+ parameters to node 1\? There is no terminal to ask; confirm with "
        r"--yes\n",
        error,
    )
    assert shared[1][0].read(0x6081) == [2_184_533]


def test_commission_makes_a_bare_drive_turn(run, shared):
    assert "qbl4208" in run("parameters", "commission", "?")[1].split()
    code, out, _ = run("parameters", "commission", "qbl4208", "-n", 2, "--yes")
    assert code == DONE
    assert "2050h:00 Motor Type" in out
    run("set", "2005", "3", "-n", 2)  # no limit switches
    code, out, error = run("jog", "300 rpm", "--by", "0.5 rev", "-n", 2, "--json")
    assert code == DONE, error
    assert abs(json.loads(out)["moved"] - 32768) < 1000


# --- motion and frames --------------------------------------------------------------------------------------------
def test_jog_turns_back_and_reports(run):
    code, out, error = run("jog", "--for", "0.2", "--", "-200 rpm")
    assert code == DONE, error
    turns = float(re.search(r"moved by -\d+ inc \((-\d+\.\d+) rev\)", out)[1])
    assert -3.0 < turns < -0.4  # half a turn and the braking, or more on a busy computer


def test_a_watchdog_of_another_program_stays_while_its_axis_is_enabled(run, shared):
    channel, (machine, _) = shared
    bus = can.Bus(interface="virtual", channel=channel)
    with CanDrives(bus=bus, timeout=20, safety=Limits(silence=20.0, stall=30.0)) as drives:
        motion.enable(drives, "pv")
        heartbeat = drives.description.dictionary.find((0x1016, 1))
        watched = int(drives.read_raw(heartbeat, 0))
        assert watched >> 16 & 0x7F and watched & 0xFFFF == 20_000
        for name in ("1016:01", "1029:01", "100C"):
            code, out, error = run("set", name, 0, "--yes")
            assert (code, out) == (REFUSED, ""), error
            assert "node 1 (" in error and "is part of what stops it when its master dies" in error
        assert int(drives.read_raw(heartbeat, 0)) == watched
        motion.disable(drives)
    bus.shutdown()
    assert int(machine.read(0x6041)[0]) & 0x4F == 0x40


def test_jog_holds_its_current_and_a_drive_that_cannot_follow_ends_it(run, shared):
    """The limit is lent to the drive: 40 mA do not turn the rotor.

    Who notices it first is chance on a busy computer: the envelope, if samples come in time that show how the current
    swings; the drive; the command while it waits, or at the end of the way.
    """
    code, out, error = run("jog", "3000 rpm", "--for", "0.5", "--max-current", "40 mA")
    assert code == REFUSED, error
    assert re.search(r"in fault|emergency|quick-stopped|hardly moved|did not reach", error), error
    assert abs(float(re.search(r"moved by -?\d+ inc \((\S+) rev\)", out)[1])) < 0.25  # of 25 revolutions
    assert "Limits(" not in error
    assert shared[1][0].read(0x6041)[0] & 0x6F != 0x27
    assert shared[1][0].read(0x2003)[0] == 7000  # its own again
    run("set", "6040", "0x80")


def test_monitor_draws_the_last_readings_between_their_least_and_their_greatest(run):
    code, out, _ = run("monitor", "6041", "6064", "--plot", "--duration", 0.2, "--period", 0.02)
    line = next(one for one in reversed(out.splitlines()) if one.startswith("6064h ▁"))
    assert code == 0 and line.endswith(" rev)") and not any(one.startswith("6041h ▁") for one in out.splitlines())
    assert spark_line([0, 10, 35, 70, -70, 70]) == "▄▅▆█▁█"  # by hand: seven steps of 20
    assert spark_line([7, 7]) == "▁▁"
    assert "leave one of them out" in run("monitor", "--plot", "--json")[2]


def test_monitor_shows_values_and_state(run):
    code, out, _ = run("monitor", "--duration", 0.05, "--period", 0.02)
    assert code == DONE
    assert "switch on disabled" in out
    lines = run("monitor", "6041", "6064", "--json", "--duration", 0.1, "--period", 0.02)[1].splitlines()
    assert len(lines) >= 2
    first = json.loads(lines[0])
    assert set(first) == {"t", "6041:00", "6064:00", "emergencies", "current at its limit at rest"}
    assert first["current at its limit at rest"] == [False]


def test_scope_writes_a_table_and_a_picture(run, tmp_path):
    out = tmp_path / "trace"
    code, _, error = run("scope", "6041", "6064", "--duration", 0.05, "--period", 0.002, "--out", out)
    assert code == DONE, error
    rows = list(csv.reader(out.with_suffix(".csv").open()))
    assert rows[0] == ["t [s]", "6041h:00 Statusword", "6064h:00 Position actual value [inc]"]
    assert [row[0] for row in rows[1:4]] == ["0.000", "0.002", "0.004"]
    assert len(rows) == 1 + 25
    assert out.with_suffix(".png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


@pytest.mark.slow
def test_scope_waits_for_its_trigger(run, shared, tmp_path):
    out = tmp_path / "edge"
    code, _, error = run("scope", "6064", "--trigger", "606C > 100 rpm", "--wait", 0.2, "--out", out)
    assert (code, "did not fire within 0.2 s" in error) == (REFUSED, True), error
    recorded = threading.Event()

    def now_and_then():  # again and again: nobody knows when the scope begins to look
        while not recorded.wait(0.5):
            shared[1][0].write("Target velocity", 77)
            recorded.wait(0.5)
            shared[1][0].write("Target velocity", 0)

    other = threading.Thread(target=now_and_then)
    other.start()
    arguments = ["--trigger", "60FF == 77", "--wait", 20, "--before", 0.01, "--duration", 0.02, "--out", out]
    code, _, error = run("scope", "60FF", *arguments)
    recorded.set()
    other.join()
    assert code == DONE, error
    rows = list(csv.reader(out.with_suffix(".csv").open()))[1:]
    assert len(rows) == 30
    assert [row[1] for row in rows if float(row[0]) < 0.0] == [rows[0][1]] * 10
    assert {row[1] for row in rows if float(row[0]) >= 0.0} == {"77"}


# What other masters send: a command of NMT (start), SYNC, an SDO request (read 6041h), and an RPDO of node 1.
FOREIGN = {
    "an NMT command (000h)": (0x000, "01 01"),
    "a SYNC (080h)": (0x080, ""),
    "an SDO request to node 1 (601h)": (0x601, "40 41 60 00 00 00 00 00"),
    "an RPDO of node 1 (301h)": (0x301, "00 00 00 00"),
}
# TPDO 2 off, 6064h in place of what is mapped first, and on again: of equal length, and all wrong.
REMAPPING = (
    "23 01 18 01 81 02 00 80", "2F 01 1A 00 00 00 00 00", "23 01 1A 01 20 00 64 60", "2F 01 1A 00 01 00 00 00",
    "23 01 18 01 81 02 00 00",
)  # fmt: skip


@contextmanager
def other_master(channel, frames, after=0.0):
    """A master of its own on the bus, that sends frames again and again."""
    over = threading.Event()
    with can.Bus(interface="virtual", channel=channel) as bus:

        def send():
            over.wait(after)
            while not over.is_set():
                for can_id, data in frames:
                    bus.send(can.Message(arbitration_id=can_id, data=bytes.fromhex(data), is_extended_id=False))
                    over.wait(0.01)

        thread = threading.Thread(target=send)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


def mappings(channel):
    """Return what node 1's TPDOs are, read by a client that is none of ours."""
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel)
    try:
        client = network.add_node(1, canopen.ObjectDictionary()).sdo
        client.RESPONSE_TIMEOUT = 20.0

        def upload(index, sub):
            for _ in range(20):  # answers to the other master may still be under way
                with suppress(canopen.SdoCommunicationError):
                    return client.upload(index, sub)
            raise AssertionError(f"{index:04X}h:{sub:02X} has no answer of its own")

        found = []
        for number in range(4):
            found.append(upload(0x1800 + number, 1))
            count = upload(0x1A00 + number, 0)[0]
            found += [upload(0x1A00 + number, k) for k in range(count + 1)]
        return found
    finally:
        network.disconnect()


@pytest.mark.every(4)
@pytest.mark.parametrize("what", FOREIGN)
def test_scope_is_refused_where_another_master_commands_the_drive(run, shared, tmp_path, what):
    before = mappings(shared[0])
    with other_master(shared[0], [FOREIGN[what]]):
        code, _, error = run("scope", "6064", "--duration", 0.1, "--out", tmp_path / "trace")
    assert (code, f"another master commands the bus: {what}" in error) == (REFUSED, True), error
    assert list(tmp_path.iterdir()) == []
    assert mappings(shared[0]) == before


@pytest.mark.slow
def test_scope_ends_where_another_master_begins_and_no_sample_is_wrong(run, shared, tmp_path):
    channel, (drives, _) = shared
    drives.write("Target velocity", 78)
    before, out = mappings(channel), tmp_path / "trace"
    with other_master(channel, [(0x601, frame) for frame in REMAPPING], after=2.0):
        code, _, error = run("scope", "60FF", "606C", "6077", "--duration", 60, "--out", out)
    assert code == REFUSED and "another master commands the bus: an SDO request to node 1 (601h)" in error
    rows = list(csv.reader(out.with_suffix(".csv").open()))[1:]
    assert rows and {row[1] for row in rows} == {"78"}
    assert max(abs(int(row[2])) for row in rows) < 1000  # a speed at rest, no position
    after = mappings(channel)
    assert after[:1] == before[:1] and after[-4:] == before[-4:]  # what nobody else has touched is as it was


@pytest.mark.slow
def test_what_scope_writes_by_default_compare_takes(run, tmp_path):
    code, _, error = run("scope", "--duration", 0.1, "--out", tmp_path / "trace")
    assert code == DONE, error
    log = read_log(tmp_path / "trace.csv")
    assert {index for index, _ in log.objects} == {0x6062, 0x6064, 0x606C, 0x60FF, 0x6077}
    assert command_of(log)[0] in ((0x6062, 0), (0x60FF, 0))


def breaks_off(monkeypatch, error, after):
    """Have the recording of a scope break off after so many pieces."""
    record = CanDrives.record
    calls = iter(range(after))

    def broken(self, *arguments):
        if next(calls, None) is None:
            raise error
        return record(self, *arguments)

    monkeypatch.setattr(CanDrives, "record", broken)


@pytest.mark.every(2)
@pytest.mark.parametrize(
    ("error", "code", "says"),
    [(KeyboardInterrupt(), INTERRUPTED, "interrupted"), (BusError("the bus is gone"), REFUSED, "the bus is gone")],
)
def test_scope_keeps_what_came_before_it_was_broken_off(run, tmp_path, monkeypatch, error, code, says):
    breaks_off(monkeypatch, error, 2)
    out = tmp_path / "trace"
    got, text, told = run("scope", "6064", "--duration", 10, "--out", out, "--json")
    files = f"{out}.csv and {out}.png"
    assert (got, told) == (code, f"drive-env: {says}; the 500 samples received before are in {files}\n")
    assert [json.loads(text)[key] for key in ("samples", "complete")] == [500, False]
    rows = list(csv.reader(out.with_suffix(".csv").open()))
    assert len(rows) == 1 + 500 and rows[-1][0] == "0.499"
    assert out.with_suffix(".png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_scope_writes_nothing_where_nothing_came(run, tmp_path, monkeypatch):
    breaks_off(monkeypatch, KeyboardInterrupt(), 0)
    assert run("scope", "--out", tmp_path / "trace") == (INTERRUPTED, "", "drive-env: interrupted\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ["asc", "log"])
def test_a_log_of_a_bus_that_is_lost_keeps_what_came(run, tmp_path, ending):
    """The emulator, or the adapter, ends while its frames are logged."""
    listening = socket.create_server(("127.0.0.1", 0))
    port, file = listening.getsockname()[1], tmp_path / f"dead.{ending}"

    def serve_three_frames():
        connection, _ = listening.accept()
        with connection:
            connection.sendall(b"t701105\r" * 3)

    server = threading.Thread(target=serve_three_frames)
    server.start()
    code, out, error = run("frames", "log", file, "-i", "slcan", "-c", f"socket://127.0.0.1:{port}")
    server.join()
    listening.close()
    assert (code, out, error.count("\n")) == (REFUSED, "", 1)
    assert error.startswith("drive-env: the bus was lost: ")
    assert error.endswith(f"; the 3 frames received before are in {file}\n")
    with can.LogReader(str(file)) as frames:
        assert [frame.arbitration_id for frame in frames] == [0x701] * 3


@pytest.mark.parametrize("ending", ["log", "blf", "asc"])
def test_a_channel_whose_name_ends_in_a_large_number_is_logged(tmp_path, monkeypatch, ending):
    class Bus:
        def __init__(self):
            self.left = [can.Message(arbitration_id=0x181, data=b"\1\2", channel="0cac0e67637", is_extended_id=False)]

        def recv(self, timeout):
            return self.left.pop() if self.left else time.sleep(timeout)

        def shutdown(self):
            pass

    monkeypatch.setattr("drive_env.master.can.port.open_bus", lambda *_, **__: Bus())
    file = tmp_path / f"session.{ending}"
    done = CliRunner().invoke(app, ["frames", "log", str(file), "--duration", "0.1"])
    assert done.exit_code == 0, done.exception
    with can.LogReader(str(file)) as reader:
        assert [(one.arbitration_id, bytes(one.data)) for one in reader] == [(0x181, b"\1\2")]


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["log", "blf"])
def test_a_logged_session_replays_the_masters_frames(run, shared, tmp_path, ending):
    file = tmp_path / f"session.{ending}"
    timer = threading.Timer(0.3, lambda: run("set", "6081", "3333"))
    timer.start()
    code, out, _ = run("frames", "log", file, "--duration", 3)
    timer.join()
    assert code == DONE
    assert re.match(r"\d+ frames written", out)
    run("set", "6081", "2184533")
    shown = run("frames", "replay", file, "--dry-run")[1]
    assert "601   [8]  23 81 60 00 05 0D 00 00" in shown
    assert "581" not in shown  # the drive's answers are its own
    code, _, error = run("frames", "replay", file, "--speed", 10)
    assert code == DONE, error
    run("get", "6041")  # the drive has answered the last request
    assert shared[1][0].read(0x6081) == [3333]
    run("set", "6081", "2184533")


@pytest.mark.every(3)
@pytest.mark.parametrize("ending", ["log", "blf", "db"])
def test_a_broken_log_is_told(files_read_here, run, tmp_path, ending):
    path = tmp_path / f"broken.{ending}"
    path.write_text("rubbish\n", encoding="utf-8")
    code, _, error = run("frames", "replay", path)
    assert code == USER_ERROR, error
    assert f"broken.{ending} cannot be read as .{ending}: " in error


# --- help ---------------------------------------------------------------------------------------------------------
COMMANDS = [[name] for commands in PANELS.values() for name, _ in commands]
COMMANDS += [[name, *more] for groups in GROUPS.values() for name, group in groups
             for more in ([], *([row.name or row.callback.__name__] for row in group.registered_commands))]  # fmt: skip


@pytest.mark.every(7)
@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_explains_itself(command):
    result = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "200"})
    assert result.exit_code == DONE
    assert "--help" in result.stdout


def test_help_is_quick_to_import():
    code = (
        "import sys, drive_env.commands.cli; sys.exit(any(name in sys.modules for name in ('numba', 'mujoco', 'can')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
