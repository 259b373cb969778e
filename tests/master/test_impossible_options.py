"""Options, logs and EDS files that cannot be: a line and exit code 2, never a traceback, never gigabytes."""

import re
import resource
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from agents.commands.cli import app as agent_app
from drive_env import EmulatedDrives
from drive_env.bus.faults import Faults
from drive_env.commands.cli import app as env_app
from drive_env.devices import find_device
from drive_env.dictionary.drive_eds import KINDS
from drive_env.fieldbus.description import check_timeout, describe
from drive_env.trials.replay import read_log
from tuning.commands.cli import app as tune_app
from tuning.target import emulated

HUGE = "1" + "0" * 29
APPS = {"drive-env": env_app, "drive-tune": tune_app, "drive-agent": agent_app}
COMMANDS = [
    *(
        ("drive-tune", (command, "--travel", travel), "rad is impossible|must contain 0|must be LOW:HIGH")
        for command in ("auto", "identify", "response", "rules")
        for travel in ("-1e300:1e300", f"-{HUGE}:{HUGE}", "nan:nan", "-1:1e300")
    ),
    ("drive-tune", ("auto", "--by", "agent", "--trials", HUGE), "--trials .* and 10000 at most"),
    *(
        ("drive-tune", (command, option, number), rf"{option} must be (1 or more|65536 at most), not {number}")
        for command, option in (("identify", "--machines"), ("response", "--machines"), ("rules", "--machines"),
                                ("auto", "--machines"))
        for number in ("1000000000", HUGE, "0", "-1")
    ),
    ("drive-tune", ("auto", "--by", "tpe", "--searches", "1000000000"), "--searches must be .* and 10000 at most"),
    ("drive-env", ("scan", "--timeout", "1e300"), "--timeout 1e.300 s must be above 0 s, and"),
    ("drive-env", ("get", "6041", "--timeout", "1e300", "--interface", "virtual"), "1e.300 s is impossible"),
    ("drive-env", ("frames", "log", "a.log", "--duration", "1e300"), "--duration 1e.300 s must be above 0 s, and"),
    ("drive-env", ("frames", "replay", "r.log", "--speed", "inf"), "--speed inf must be above 0"),
    ("drive-env", ("frames", "replay", "r.log", "--speed", "nan"), "--speed nan must be above 0"),
]  # fmt: skip


@pytest.fixture
def memory():
    """A process that may take 1 GB more than it has now."""
    if sys.platform != "linux":
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_DATA)
    status = Path("/proc/self/status").read_text()
    used = int(re.search(r"VmData:\s+(\d+)", status)[1]) * 1024
    resource.setrlimit(resource.RLIMIT_DATA, (used + 1_000_000_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_DATA, before)


@pytest.mark.every(7)
@pytest.mark.parametrize(("name", "arguments", "told"), COMMANDS, ids=lambda value: "" if value is None else str(value))
def test_an_option_that_cannot_be_ends_with_a_line(name, arguments, told, tmp_path, monkeypatch, memory):
    monkeypatch.chdir(tmp_path)
    Path("r.log").write_text("(1.0) can0 601#4041600000000000\n")
    found = CliRunner().invoke(APPS[name], list(arguments))
    assert found.exit_code == 2, (found.output, found.exception)
    assert isinstance(found.exception, SystemExit)
    assert re.search(told, found.output) and found.output.strip().count("\n") == 0


def test_python_says_the_same(memory):
    with pytest.raises(ValueError, match="num_machines must be 65536 at most, not 1000000000"):
        EmulatedDrives(num_machines=1_000_000_000)
    with pytest.raises(ValueError, match=r"a travel of -1e\+300 to 1e\+300 rad is impossible"):
        emulated(load="inertia", travel=(-1e300, 1e300))
    for timeout in (1e300, float("inf"), float("nan"), 0.0):
        with pytest.raises(ValueError, match=r"a time-out of .* s is impossible; give one above 0 s"):
            check_timeout(timeout)
    for delay in (1e300, float("inf"), float("nan"), -1.0):
        with pytest.raises(ValueError, match=r"delay_max = .* must be a time of 0 s or more, 3600 s at most"):
            Faults(delay=1.0, delay_max=delay)


def test_a_free_axis_is_still_free():
    with emulated(load="inertia", travel=(-float("inf"), float("inf"))) as target:
        assert target.num_axes == 1


# --- stamps -----------------------------------------------------------------------------------------------------------
@pytest.mark.every(10)
@pytest.mark.parametrize("stamp", ["1e300", "-1e300", "99999999999.0", "nan", "inf"])
@pytest.mark.parametrize("ending", [".log", ".csv"])
def test_a_replay_waits_for_no_stamp_that_never_comes(stamp, ending, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = Path(f"frames{ending}")
    if ending == ".log":
        file.write_text(f"(1.0) can0 601#4041600000000000\n({stamp}) can0 601#4041600000000000\n")
    else:
        head = "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
        file.write_text(f"{head}1.0,0x601,0,0,0,8,QEFgAAAAAAA=\n{stamp},0x601,0,0,0,8,QEFgAAAAAAA=\n")
    for more in (("--dry-run",), ()):
        found = CliRunner().invoke(env_app, ["frames", "replay", str(file), "-i", "virtual", "-c", "x", *more])
        assert found.exit_code == 2, (found.output, found.exception)
        assert isinstance(found.exception, SystemExit) and "Traceback" not in found.output
        assert found.output.strip().count("\n") == 0


@pytest.mark.slow
def test_a_replay_goes_at_the_pace_of_its_stamps(files_read_here, tmp_path):
    file = tmp_path / "frames.log"
    file.write_text("(1e6) can0 601#4041600000000000\n(1000000.01) can0 601#4041600000000000\n")
    found = CliRunner().invoke(env_app, ["frames", "replay", str(file), "--interface", "virtual", "--channel", "x"])
    assert found.exit_code == 0 and "2 frames sent" in found.output


def move(*rows):
    return "t [s],6064h:00 Position actual value [inc]\n" + "".join(f"{t},{value}\n" for t, value in rows)


REGULAR = [(f"{k / 1000:.3f}", k) for k in range(20)]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (move(*REGULAR[:-1], ("1e300", 1)), r"line 21 has the time 1e\+300 s; times must lie within"),
        (move(("-1e300", 1), *REGULAR[1:]), r"line 2 has the time -1e\+300 s"),
        (move(*REGULAR[:-1], ("nan", 1)), "line 21 has the time nan s"),
        (move(*REGULAR[:-1], ("inf", 1)), "line 21 has the time inf s"),
        (move(*REGULAR[:-1], ("0.019", 10**30)), "every line needs a time and 1 whole numbers"),
        (move(*REGULAR[:-1], ("0.019", "nan")), "every line needs a time and 1 whole numbers"),
        (move(*REGULAR) + "\n", "every line needs a time|values each"),
        (move(*REGULAR[:-1]) + '"' + "x" * 200_000 + '",1\n', "is not CSV: field larger"),
    ],
)
def test_a_recorded_move_has_times_and_integers(text, told, tmp_path):
    (tmp_path / "move.csv").write_text(text)
    with pytest.raises(ValueError, match=told):
        read_log(tmp_path / "move.csv")


def test_a_recorded_move_that_is_no_text(tmp_path):
    (tmp_path / "move.csv").write_bytes(b"t [s],\xff\xfe\n")
    with pytest.raises(ValueError, match=r"move\.csv is not a text file; give the CSV"):
        read_log(tmp_path / "move.csv")


# --- EDS --------------------------------------------------------------------------------------------------------------
def retyped(path, index, kind):
    """The EDS of the TMCM-1636 with another data type of an object."""
    text = find_device("tmcm1636").eds.read_text(encoding="utf-8")
    text, count = re.subn(rf"(?ms)^(\[{index:X}\]\s.*?^DataType=)0x[0-9A-Fa-f]+", rf"\g<1>{kind}", text, count=1)
    assert count == 1
    path.write_text(text)
    return path


@pytest.mark.every(12)
@pytest.mark.parametrize("kind", ["0x000F", "0x0009", "0x0008", "0x0011", "0x001B", "0x0005"])
@pytest.mark.parametrize("index", [index for index, _ in KINDS if index != 0x605A])
def test_an_eds_whose_objects_are_of_another_kind_is_refused(index, kind, tmp_path):
    if kind == "0x0005" and index not in (0x6040, 0x6041, 0x6064, 0x607A):
        pytest.skip("long enough")
    path = retyped(tmp_path / "own.eds", index, kind)
    with pytest.raises(ValueError, match=rf"own\.eds, line \d+: {index:04X}h .* is .* it cannot be driven"):
        describe(None, path)


def test_a_command_tells_of_such_an_eds(tmp_path):
    path = retyped(tmp_path / "own.eds", 0x6041, "0x000F")
    found = CliRunner().invoke(env_app, ["get", "6041", "--eds", str(path), "--interface", "virtual"])
    assert found.exit_code == 2 and "6041h Statusword is of no integer type (000Fh)" in found.output


def test_the_eds_that_ships_is_none_of_these():
    assert describe(None, find_device("tmcm1636").eds).num_axes == 1
