"""`drive-env serve` as a user meets it: what it prints, how it ends, what it says to mistakes; the TOML of a bus."""

import errno
import json
import re
import signal
import socket
import stat
import subprocess
import sys
import time
import tomllib
from contextlib import contextmanager

import can
import pytest
import typer
from rigs.served_drives import ROOT, command, environment, served
from typer.testing import CliRunner

from drive_env.bus.config import Bus, BusConfigError, Machine, build_world, load_bus
from drive_env.bus.fault_control import ask
from drive_env.bus.faults import Faults
from drive_env.bus.hub import Hub
from drive_env.canopen.frames import Frame
from drive_env.commands.serve import serve
from drive_env.fieldbus.errors import OpenError
from drive_env.master.can.port import open_bus
from drive_env.master.can_drives import CanDrives
from drive_env.master.open_drives import open_drives
from drive_env.motors import MOTORS

EXAMPLE = ROOT / "examples" / "bus.toml"


def run_serve(*arguments, cwd):
    return subprocess.run(
        command(*arguments), cwd=cwd, env=environment(), capture_output=True, text=True, timeout=120, check=False
    )


# --- serving --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_it_prints_two_lines_that_join_the_bus(tmp_path):
    with served("tmcm1636", "--load", "belt", "--node", 5, "--lockstep", "--stats", cwd=tmp_path) as (process, channel):
        lines = f'import can\nbus = can.Bus(interface="slcan", channel="{channel}", sleep_after_open=0)'
        names = {"can": can}
        exec(lines, names)
        with names["bus"] as bus:
            assert bus.get_version(5.0) == (10, 13)
            bus.send(can.Message(arbitration_id=0x000, data=b"\x82\x05", is_extended_id=False))  # reset communication
            boot_up = bus.recv(5.0)
            assert (boot_up.arbitration_id, bytes(boot_up.data)) == (0x705, b"\x00")
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=30)
    assert process.returncode == 0
    assert errors == ""
    assert output.splitlines()[-1] == "drive-env: stopped"
    assert re.search(r"\d+ frames in 0\.000 s of the drives' time, 0 error frames, 0 lost", output)


@pytest.mark.slow
def test_a_token_is_made_printed_and_asked_for(tmp_path, monkeypatch):
    monkeypatch.delenv("DRIVE_ENV_TOKEN", raising=False)
    with served("--token", "auto", "--lockstep", cwd=tmp_path) as (process, channel):
        line = process.stdout.readline()
        token = re.fullmatch(r'bus\.serialPortOrig\.write\(b"K([\w-]{16})\\r"\); bus\.open\(\)\n', line)[1]
        assert process.stdout.readline().endswith(f"take the token from the environment: DRIVE_ENV_TOKEN={token}\n")
        names = {"can": can}
        exec(f'bus = can.Bus(interface="slcan", channel="{channel}", sleep_after_open=0)\n{line}', names)
        with names["bus"] as bus:
            assert bus.get_version(20.0) == (10, 13)
        with pytest.raises(OpenError, match="asks for a token"), open_bus(None, channel) as bus:
            bus.recv(20.0)
        with open_bus(None, channel, token=token) as bus:
            bus.send(can.Message(arbitration_id=0x000, data=b"\x82\x01", is_extended_id=False))
            assert bus.recv(20.0).arbitration_id == 0x701


@pytest.mark.slow
def test_what_is_open_to_the_network_is_said(monkeypatch):
    monkeypatch.setattr(Hub, "is_public", True)  # without opening anything to it
    app = typer.Typer()
    app.command()(serve)
    arguments = ["--port", "0", "--token", "a-token_of_chance", "--duration", "0.05"]
    done = CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert (
        "is open to the network: any program that can reach it and has the token may read and move these drives."
        in done.stdout
    )
    assert "Token and frames travel as plain text; where others listen, serve on 127.0.0.1 and use an" in done.stdout


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_code_0_and_one_line(tmp_path, number):
    with served(cwd=tmp_path) as (process, _):
        process.send_signal(number)
        output, errors = process.communicate(timeout=30)
    assert (process.returncode, output, errors) == (0, "drive-env: stopped\n", "")


@pytest.mark.slow
def test_a_duration_ends_it_and_stats_say_how_late_and_how_full(tmp_path):
    done = run_serve("--port", 0, "--duration", "0.3", "--stats", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "node 1 (tmcm1636, qbl4208, two_mass), 1000 kbit/s, in real time" in done.stdout
    assert re.search(
        r"lateness of \d+ cycles of 1 ms: p50 \d+\.\d{3} ms, p99 \d+\.\d{3} ms, max \d+\.\d{3} ms", done.stdout
    )
    assert re.search(r"\d+ frames in 0\.\d{3} s of the drives' time = \d+/s, 0 error frames, 0 lost", done.stdout)
    assert re.search(r"bus load \d+\.\d %", done.stdout)


@pytest.mark.slow
def test_the_example_bus_is_served(tmp_path):
    done = run_serve("--config", EXAMPLE, "--port", 0, "--duration", "0.1", "--lockstep", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "node 1 (tmcm1636, qbl4208, belt), node 2 (tmcm1636, ec_i_40, two_mass)" in done.stdout
    assert "in lockstep: each SYNC is 1 ms" in done.stdout


def test_nobody_reaches_the_port_while_kernels_are_compiled(tmp_path, monkeypatch):
    """A master would take drives that do not answer yet for drives that are not there."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
    heard = []

    def compile_for_long(bus):
        with socket.socket() as client:
            heard.append(client.connect_ex(("127.0.0.1", port)))

    monkeypatch.setattr("drive_env.commands.serve._warm_up", compile_for_long)
    app = typer.Typer()
    app.command()(serve)
    done = CliRunner().invoke(app, ["--port", str(port), "--duration", "0.1"])
    assert (done.exit_code, heard) == (0, [errno.ECONNREFUSED])
    assert f"socket://127.0.0.1:{port}" in done.stdout


@pytest.mark.slow
def test_drives_with_factory_values_turn_the_motor_that_was_named(tmp_path):
    arguments = ("--motor", "ec_i_40", "--factory", "--lockstep")
    with (
        served(*arguments, cwd=tmp_path) as (_, channel),
        CanDrives("tmcm1636", channel=channel, interface="slcan", pace="lockstep", safety=False) as drives,
    ):
        assert [int(drives.read(name)[0]) for name in ("Maximum Current", "Motor Type", (0x2042, 1))] == [0, 0, 0]
    world = build_world(Bus(machines=(Machine(motor="ec_i_40", commissioned=False),)), lockstep=True)
    assert world.drives[0].motor is MOTORS["ec_i_40"]
    assert world.drives[0].read("Maximum Current").tolist() == [0]
    world.close()


@pytest.mark.slow
def test_any_interface_serves(tmp_path):
    done = run_serve("--interface", "virtual", "--channel", "test", "--duration", "0.1", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "on virtual test" in done.stdout


@pytest.mark.every(7)
@pytest.mark.parametrize(("arguments", "message"), [
    (["tmcm1637"], "drive-env: no device is named 'tmcm1637'; there are tgz_d, tgz_d_2026"),
    (["--load", "abc"], "drive-env: no load is named 'abc'; there are "),
    (["--motor", "abc"], "drive-env: no motor is named 'abc'; there are"),
    (["--motor", "none"], "drive-env: motor none: every machine has a motor; name it, and for a drive with factory "
                          "values add --factory"),
    (["--config", "two.toml", "--factory"], "drive-env: two.toml has 2 machines, so --factory is ambiguous"),
    (["--node", "0"], "drive-env: node 0 is out of range; identifiers are 1 to 127"),
    (["--node", "1", "--node", "2"], "2 node identifiers were given"),
    (["--port", "70000"], "drive-env: --port 70000 must be 0 to 65535"),
    (["--listen", "no.such.host.invalid"], "drive-env: cannot listen on no.such.host.invalid:29636"),
    (["--listen", "x" * 70], "drive-env: cannot listen on xxx"),
    (["--listen", ""], "drive-env: --listen must be an address, e.g. 127.0.0.1; 0.0.0.0 lets the whole network in"),
    (["--listen", "0.0.0.0"], "drive-env: 0.0.0.0 is not a loopback address: it is open to the network, which needs a "
                              "token; give --token auto, --token TEXT of 8 characters or more, or --listen 127.0.0.1"),
    (["--token", "short"], "drive-env: a token has 8 to 48 letters, digits, - and _; this one has 5 characters; give "),
    (["--interface", "virtual", "--token", "auto"], "--token is for the hub; --interface virtual has no tokens"),
    (["--host", "127.0.0.1"], "No such option"),
    (["--seed", "-1"], "drive-env: seed = -1 must be 0 or more"),
    (["--bitrate", "123"], "drive-env: tmcm1636 has no bit rate of 123 bit/s; it has 20000, 50000"),
    (["--bitrate", "0"], "drive-env: bit_rate must be above 0 bit/s, not 0"),
    (["--duration", "0"], "drive-env: --duration 0 s must be above 0 s"),
    (["--duration", "soon"], "--duration"),
    (["--channel", "can0"], "drive-env: --channel can0 needs --interface"),
    (["--interface", "socketcan"], "drive-env: --interface socketcan needs --channel, e.g. --channel vcan0; without"),
    (["--interface", "nonsense", "--channel", "x"], "drive-env: cannot open --interface nonsense --channel x: "),
    (["--config", "none.toml"], "drive-env: cannot read the bus none.toml: No such file"),
    (["--config", "two.toml", "--node", "3"], "drive-env: two.toml has 2 machines, so --node is ambiguous"),
    (["--store", "two.toml"], "drive-env: the store two.toml cannot be made: "),
    (["--lock"], "No such option"),
])  # fmt: skip
def test_a_mistake_ends_with_code_2_and_one_clear_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "two.toml").write_text("[[machines]]\n[[machines]]\nnodes = [2]\n", encoding="utf-8")
    app = typer.Typer()
    app.command()(serve)
    done = CliRunner(env={"COLUMNS": "100", "NO_COLOR": "1"}).invoke(app, arguments)
    assert (done.exit_code, type(done.exception)) == (2, SystemExit), done.output
    assert message in done.stderr
    if message.startswith("drive-env"):
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_a_port_that_is_taken_is_named_with_the_remedy(tmp_path):
    with served(cwd=tmp_path) as (_, channel):
        port = channel.rpartition(":")[2]
        done = run_serve("--port", port, cwd=tmp_path)
    assert done.returncode == 2
    assert f"cannot listen on 127.0.0.1:{port}" in done.stderr
    assert "choose another --port (0: a free one)" in done.stderr


def test_help_says_what_it_does(tmp_path):
    done = run_serve("--help", cwd=tmp_path)
    assert done.returncode == 0
    for word in ("--lockstep", "--store", "--interface", "--stats", "examples/bus.toml"):
        assert word in done.stdout, word


# --- the bus as TOML ------------------------------------------------------------------------------------------------
def written(tmp_path, text):
    path = tmp_path / "bus.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_key_has_the_default_that_the_example_shows(tmp_path):
    bus = load_bus(EXAMPLE)
    assert (bus.bit_rate, bus.seed, bus.faults) == (Bus().bit_rate, Bus().seed, Faults())
    assert tomllib.loads(EXAMPLE.read_text(encoding="utf-8"))["faults"].keys() == set(vars(Faults()))
    assert load_bus(written(tmp_path, "[[machines]]")) == Bus()


def test_a_bus_is_read_as_it_is_written(tmp_path):
    bus = load_bus(written(tmp_path, """
        bit_rate = 500_000
        seed = 7
        store = "saved"
        [[machines]]
        device = "tmcm1636"
        load = "inertia"
        motor = "ec_i_40"
        commissioned = false
        nodes = [10]
        ideal = true
        parameters = { "load.inertia" = 1e-4 }
        [faults]
        drop = 0.01
        only = [0x581]
    """))  # fmt: skip
    machine = Machine("tmcm1636", "inertia", "ec_i_40", (10,), False, True, {"load.inertia": 1e-4})
    assert bus == Bus(500_000, 7, str(tmp_path / "saved"), (machine,), Faults(drop=0.01, only=(0x581,)))


@pytest.mark.parametrize(("text", "message"), [
    ("", "there are no machines; add a table [[machines]]"),
    ("machines = []", "there are no machines"),
    ("machines = 3", "machines must be tables [[machines]], not 3"),
    ("machines = [3]", "machines[0] = 3 must be a table"),
    ("[[machines]]\nnode = 1", "machines[0]: key 'node' is unknown; there are device, load, motor, nodes"),
    ("[[machines]]\nnodes = 1", "nodes = 1 must be a list of whole numbers, as [1, 2]"),
    ("[[machines]]\nnodes = [1.5]", "nodes = [1.5] must be a list of whole numbers"),
    ("[[machines]]\nideal = 1", "ideal = 1 must be true or false"),
    ("[[machines]]\nparameters = 1", "parameters = 1 must be a table of numbers"),
    ("[[machines]]\nparameters = { a = 'x' }", "parameters.a = 'x' must be a number"),
    ("bit_rate = 1e6\n[[machines]]", "bit_rate = 1000000.0 must be a whole number"),
    ("faults = 1\n[[machines]]", "faults = 1 must be a table"),
    ("[[machines]]\n[faults]\ndrop = 2", "drop = 2.0 must be a share of all frames, 0 to 1"),
    ("[[machines]]\n[faults]\nloss = 2", "faults: key 'loss' is unknown; there are drop, delay"),
    ("[[machines", "is not a TOML file"),
])  # fmt: skip
def test_a_bus_that_cannot_be_says_why(tmp_path, text, message):
    with pytest.raises(BusConfigError) as error:
        load_bus(written(tmp_path, text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("machines", "message"), [
    ((Machine(nodes=(1,)), Machine(nodes=(1,))), "node 1 is on the bus already"),
    ((Machine(parameters={"load.mass": 1.0}),), "machines have no parameter 'load.mass'; they have"),
])  # fmt: skip
def test_machines_that_cannot_be_say_why(machines, message):
    with pytest.raises(BusConfigError) as error:
        build_world(Bus(machines=machines), lockstep=True)
    assert message in str(error.value)


def test_a_world_is_built_as_the_bus_says():
    bus = Bus(500_000, 3, None, (Machine(load="inertia"), Machine(load="belt", commissioned=False, nodes=(9,))))
    world = build_world(bus, lockstep=False)
    assert list(world.nodes) == [1, 9]
    assert [drives.load.name for drives in world.drives] == ["inertia", "belt"]
    assert world.wire.bit_rate == 500_000
    assert [node.bit_rate for node in world.nodes.values()] == [500, 500]
    world.receive(Frame(0x080))
    world.run_until(0.003)
    assert world.cycles == 3
    world.close()


def test_what_a_node_saves_is_there_when_it_is_served_again(tmp_path):
    bus = Bus(store=str(tmp_path / "nodes"), machines=(Machine(load="inertia", nodes=(5,)),))
    values = []
    for _ in range(2):
        world = build_world(bus, lockstep=True)
        world.power_on()
        values.append(int(world.drives[0].read((0x2042, 1))[0]))
        world.drives[0].write((0x2042, 1), 777)
        world.receive(Frame(0x605, bytes.fromhex("23 10 10 01 73 61 76 65")))  # 1010h:01 "save"
        world.close()
    assert values[0] != 777
    assert values[1] == 777
    assert [path.name for path in (tmp_path / "nodes").iterdir()] == ["node-5-tmcm1636.json"]


# --- a file for scripts -------------------------------------------------------------------------------------------
@contextmanager
def served_with_ready_file(path, *arguments):
    """A server in a process of its own; yields the process and what its file says once that is there."""
    process = subprocess.Popen(
        command("--ready-file", path, *arguments), env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        while not path.exists():
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.01)
        yield process, json.loads(path.read_text(encoding="utf-8"))
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals and rights")
def test_a_script_finds_the_drives_by_the_ready_file_alone(tmp_path):
    path = tmp_path / "ready.json"
    options = ["--port", 0, "--control", 0, "--token", "a-token_of_chance", "--lockstep"]
    with served_with_ready_file(path, *options) as (process, ready):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600  # whoever reads the token may move the drives
        assert (ready["pid"], ready["token"]) == (process.pid, "a-token_of_chance")
        with open_bus(ready["interface"], ready["channel"], token=ready["token"]) as bus:
            bus.send(can.Message(arbitration_id=0x000, data=b"\x82\x01", is_extended_id=False))
            assert bus.recv(20.0).arbitration_id == 0x701
        assert ask(ready["control"], "faults") == {"faults": []}
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_a_script_finds_slaves_on_ethercat_by_the_ready_file(tmp_path):
    path = tmp_path / "ready.json"
    options = ["tmcm3313", "--interface", "ethercat-udp", "--channel", 0, "--lockstep"]
    with served_with_ready_file(path, *options) as (process, ready):
        assert ready["interface"] == "ethercat-udp"
        with open_drives("tmcm3313", interface=ready["interface"], channel=ready["channel"], safety=False) as drives:
            assert int(drives.read(0x1000)[0]) & 0xFFFF == 402
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    assert not path.exists()


@pytest.mark.slow
def test_a_ready_file_that_is_there_already_is_left_alone(tmp_path):
    """It may be of a server that runs, and a script that waits for the file would take it for this one's."""
    path = tmp_path / "ready.json"
    path.write_text("{}")
    done = run_serve("--port", 0, "--ready-file", path, cwd=tmp_path)
    assert (done.returncode, path.read_text()) == (2, "{}")
    assert "exists already" in done.stderr
    done = run_serve("--port", 0, "--ready-file", tmp_path / "no_folder" / "ready.json", cwd=tmp_path)
    assert done.returncode == 2
    assert "no folder" in done.stderr
