"""Files that anybody may have written: too large, too deep, of another kind. A line comes of it, never gigabytes."""

import contextlib
import io
import itertools
import json
import os
import resource
import struct
import subprocess
import sys
import time
import tomllib
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from agents.commands.cli import app as agent_app
from agents.evaluation import episode_log
from agents.policies import onnx_policy
from agents.policies.agent_file import AgentFile, BundleError
from agents.studio.event_curves import read_curves
from agents.training import hyperparameters
from drive_env.bus.config import BusConfigError, load_bus
from drive_env.commands import recorded_frames
from drive_env.commands.cli import app as env_app
from drive_env.dictionary.entries import read_eds
from drive_env.envs.configuration import configured
from drive_env.envs.tracking import TrackingConfig
from drive_env.motors import find_motor
from drive_env.node.store import Store
from drive_env.pictures.demonstration import DemonstrationError, load_demonstration
from drive_env.randomisation.random_machines import Distributions
from drive_env.studio import runs_folder
from drive_env.trials.replay import read_log
from drive_env.whole_file import content_hash
from mechanics.reading import untrusted
from mechanics.reading.untrusted import UntrustedFileError, parse_json, parse_toml, read_arrays, read_bytes, read_toml
from tuning.certificate import certificate, certificate_files
from tuning.commands.cli import app as tune_app
from tuning.compare.suite import load_suite
from tuning.runs.experiment import ExperimentError, load_experiment
from tuning.runs.shard_log import ShardLog, ShardLogError
from tuning.search import trials_files

DEEP = 100_000
DEEP_TOML = "a = " + "[" * DEEP + "]" * DEEP
DEEP_KEYS = ".".join("a" * DEEP) + " = 1"  # tomllib reads it without recursion, in 40 GB
DEEP_JSON = "[" * DEEP + "]" * DEEP
DIGITS = "a = " + "9" * 5000  # more than Python turns into a number


# Whose keys tomllib takes 5 s and 1.6 GB for; the scan that looks for them took 91 s for the last.
HOSTILE_TOML = {
    "brackets": DEEP_TOML,
    "dotted key": DEEP_KEYS,
    "quoted parts": ".".join(['"\\""'] * 20_000) + " = 1",
    "parts apart": " . ".join(["'.'"] * 20_000) + " = 1",
    "title": f"[{'.'.join('a' * 20_000)}]",
    "inline": "a = " + "{a = " * 20_000,
    "digits": DIGITS,
    "many": "a = [" + "0," * 1_100_000 + "]",
    "many tables": "".join(f"k{k}.{'.'.join('a' * 38)} = 1\n" for k in range(20_000)),
}
LONG_TOML = {"identifier": "a" * 1_000_000, "text": "a = '" + "." * 1_000_000 + "'", "open": '"' * 999_998,
             "escaped": '"""' + '\\"""' * 200_000, "spaces": "a" + " " * 1_000_000, "dots": "a ." * 100_000,
             "broken parts": (".".join("a" * 39) + "\n") * 2500}  # fmt: skip


@pytest.mark.every(3)
@pytest.mark.parametrize("text", HOSTILE_TOML.values(), ids=HOSTILE_TOML)
def test_toml_within_limits(text):
    with pytest.raises(tomllib.TOMLDecodeError) as told:
        parse_toml(text)
    assert "\n" not in str(told.value)


@pytest.mark.every(5)
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("text", [text for text in HOSTILE_TOML.values() if text is not DIGITS])
def test_what_would_be_large_is_refused_before_tomllib_begins(text, monkeypatch, memory):
    monkeypatch.setattr(tomllib, "loads", lambda text: pytest.fail("tomllib began"))
    with pytest.raises(tomllib.TOMLDecodeError, match="more than"):
        parse_toml(text)


@pytest.mark.parametrize("text", LONG_TOML.values(), ids=LONG_TOML)
def test_the_scan_takes_time_that_grows_as_the_text_does(text):
    """A million letters: milliseconds. A scan that begins anew at each letter takes hours."""
    begun = time.process_time()
    with contextlib.suppress(UntrustedFileError):
        untrusted._check_toml(text)
    assert time.process_time() - begun < 20.0


def test_dots_in_strings_and_comments_nest_nothing():
    text = 'a = "%s"  # %s\nb = """\n%s"""\n' % ((".".join("a" * 50),) * 2 + ("[" * 50,))
    assert parse_toml(text) == {"a": ".".join("a" * 50), "b": "[" * 50}


@pytest.mark.parametrize(
    "text", [DEEP_JSON, "[NaN]", "[-Infinity]", "[1e999]", '{"a":' * DEEP, "[" + "[]," * 3_000_000]
)
def test_json_within_limits(text):
    with pytest.raises(ValueError) as told:
        parse_json(text)
    assert "\n" not in str(told.value)


DOUBLED = '{"a": 1, "b": {"axes": [1], "axes": [2]}}'


@pytest.mark.parametrize("text", [DOUBLED, DOUBLED.encode(), '[{"a":1,"\\u0061":1}]'])
def test_a_name_that_stands_twice_is_refused(text):
    with pytest.raises(UntrustedFileError, match=r"the name '(axes|a)' stands twice in one table"):
        parse_json(text)


def test_what_is_within_the_limits_is_read():
    table = {"a": [1, {"b": [2.5, "text", True]}]}
    assert parse_json(json.dumps(table)) == table
    assert parse_toml('a = [1, {b = [2.5, "text", true]}]') == table
    depth = "[" * untrusted.DEEPEST + "]" * untrusted.DEEPEST
    assert parse_json(depth)
    with pytest.raises(UntrustedFileError, match="more than 40 deep"):
        parse_json(f"[{depth}]")


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no such device here")
def test_a_file_without_end_is_refused():
    with pytest.raises(UntrustedFileError, match="/dev/zero is a pipe or a device; give a file"):
        read_bytes("/dev/zero")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
@pytest.mark.parametrize(
    "read",
    [read_toml, untrusted.read_json, untrusted.read_text, lambda path: untrusted.read_start(path, 10), read_arrays,
     lambda path: untrusted.read_member(path, "a"), find_motor, read_eds, lambda path: Store(path, "tmcm1636")],
)  # fmt: skip
def test_a_pipe_is_refused_before_it_is_opened(read, tmp_path):
    """Nobody writes into it: whoever opens it waits without end."""
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(ValueError, match="is a pipe or a device"):
        read(tmp_path / "pipe.toml")


def test_a_file_that_is_too_large_is_refused_unread(tmp_path):
    with (tmp_path / "large.toml").open("wb") as file:
        file.truncate(1 << 40)  # a hole: takes no room
    with pytest.raises(tomllib.TOMLDecodeError, match="has 1099512 MB, and 4 MB are read"):
        read_toml(tmp_path / "large.toml")


READERS = {
    "serve": (load_bus, BusConfigError),
    "render": (load_demonstration, DemonstrationError),
    "sweep": (load_experiment, ExperimentError),
    "compare": (load_suite, ExperimentError),
    "search": (trials_files.load_options, ValueError),
    "environment": (lambda path: configured(TrackingConfig, path, {}), ValueError),
    "distributions": (Distributions.load, ValueError),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("text", [DEEP_TOML, DEEP_KEYS, DIGITS], ids=["deep", "keys", "digits"])
def test_each_reader_of_toml_refuses_in_its_own_words(reader, text, tmp_path):
    read, error = READERS[reader]
    path = tmp_path / "file.toml"
    path.write_text(text)
    with pytest.raises(error, match=r"file\.toml"):
        read(path)


COMMANDS = {
    "serve": (env_app, ("serve", "--config", "deep.toml", "--duration", "0.1")),
    "render": (env_app, ("render", "--config", "deep.toml", "--show-config")),
    "sweep": (tune_app, ("sweep", "--config", "deep.toml", "--show-config")),
    "compare": (tune_app, ("rank", "--suite", "deep.toml")),
    "search": (tune_app, ("auto", "--config", "deep.toml")),
    "verify": (tune_app, ("verify", "deep.json")),
    "evaluate": (agent_app, ("evaluate", "tracking_two_mass", "--config", "deep.toml")),
    "against": (agent_app, ("evaluate", "tracking_two_mass", "--against", "deep.json", "--episodes", "1")),
    "train": (agent_app, ("train", "--config", "deep.toml")),  # YAML reads brackets, too
}


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "against"])
def test_a_command_ends_with_a_line(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("deep.toml").write_text(DEEP_TOML)
    Path("deep.json").write_text(DEEP_JSON)
    app, arguments = COMMANDS[name]
    found = CliRunner().invoke(app, arguments)
    assert found.exit_code == 2, (found.output, found.exception)
    assert isinstance(found.exception, SystemExit)
    assert "Traceback" not in found.output and found.output.strip().count("\n") == 0


# --- arrays -----------------------------------------------------------------------------------------------------------
def npy(shape, kind="<f4", data=b""):
    header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def npz(path, members, packed=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", packed) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return path


@pytest.fixture
def memory():
    """A process that may take half a GB more than it has now."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + 500_000_000, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture(scope="module")
def bomb(tmp_path_factory):
    """1 GB of zeros, packed into 5 MB."""
    path = tmp_path_factory.mktemp("bomb") / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        with archive.open("observations.npy", "w", force_zip64=True) as file:
            file.write(npy((1000, 250_000)))
            for _ in range(1000):
                file.write(bytes(1_000_000))
        archive.writestr("about.npy", npy((2,), "|u1", b"{}"))
    return path


LYING = {
    "a header that says more": lambda path: npz(path, {"a": npy((10**9,)), "about": npy((10**11,), "|u1")}),
    "a negative length": lambda path: npz(path, {"a": npy((-1,)), "about": npy((2,), "|u1", b"{}")}),
    "no length": lambda path: npz(path, {"a": npy((10**15,), "|V0")}),
    "objects": lambda path: npz(path, {"about": npy((1,), "|O", b"cos\nsystem\n(S'true'\ntR.")}),
    "another packing": lambda path: npz(path, {"a": npy((10**6,), "|u1", bytes(10**6))}, zipfile.ZIP_BZIP2),
    "no header": lambda path: npz(path, {"a": b"hello"}),
    "a torn header": lambda path: npz(path, {"a": npy((3,))[:40]}),
    "a header of brackets": lambda path: npz(path, {"a": npy("(" * 3000)}),
    "no zip": lambda path: path.write_bytes(b"hello") and path,
    "nothing": lambda path: path.write_bytes(b"") or path,
    "half of it": lambda path: path.write_bytes(npz(path, {"a": npy((4,), data=bytes(16))}).read_bytes()[:90]) and path,
}


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("kind", LYING)
def test_arrays_that_are_not_what_they_say(kind, tmp_path, memory):
    path = LYING[kind](tmp_path / "agent.npz")
    with pytest.raises(UntrustedFileError, match=r"agent\.npz") as told:
        read_arrays(path)
    assert "\n" not in str(told.value)
    with pytest.raises(BundleError, match=r"agent\.npz is not an agent"):
        AgentFile.load(path)
    with pytest.raises(ValueError, match=r"agent\.npz has no episodes"):
        episode_log.load(path)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_bomb_is_refused_before_it_is_unpacked(bomb, memory):
    assert bomb.stat().st_size < 10_000_000
    with pytest.raises(UntrustedFileError, match="would unpack to 1000 MB in 2 arrays, and 500 MB in 10000 are read"):
        read_arrays(bomb)
    for arguments in (("evaluate", bomb), ("evaluate", "tracking_two_mass", "--replay", bomb), ("export", bomb)):
        found = CliRunner().invoke(agent_app, [str(one) for one in arguments])
        assert found.exit_code == 2 and "would unpack to 1000 MB" in found.output


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_directory_that_lies_gets_no_more_than_it_says(bomb, tmp_path, memory):
    """The directory says 100 bytes, the packed data are 1 GB."""
    path = tmp_path / "lies.npz"
    content = bytearray(bomb.read_bytes())
    with zipfile.ZipFile(io.BytesIO(bytes(content))) as archive:
        start = archive.start_dir
    place = content.index((1_000_000_128).to_bytes(4, "little"), start)
    content[place : place + 4] = (100).to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(UntrustedFileError, match=r"not a complete \.npz"):
        read_arrays(path)


def test_arrays_of_ours_are_read(tmp_path):
    stored = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 4), np.int8),
              "d": np.asfortranarray(np.arange(6).reshape(2, 3)), "e": np.array([True])}  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **stored)
    found = read_arrays(tmp_path / "a.npz")
    assert found.keys() == stored.keys()
    assert all(found[name].dtype == array.dtype and np.array_equal(found[name], array)
               for name, array in stored.items())  # fmt: skip


ABOUT = {"environment": "ServoDrive/Tracking-v0", "configuration": {}, "seeds": [1, 2]}


@pytest.mark.parametrize(
    "change",
    [
        {"lengths": np.array([3, -1])},
        {"lengths": np.array([3, 3])},
        {"lengths": np.zeros(0, int)},
        {"lengths": np.array(np.nan)},
        {"actions": np.full((5, 1), np.nan)},
        {"actions": np.zeros(5)},
        {"actions": np.full((5, 1), "x")},
        {"about": np.frombuffer(b"[]", np.uint8)},
        {"about": np.frombuffer(b'{"environment": 1, "configuration": 2, "seeds": 3}', np.uint8)},
        {"about": np.frombuffer(DEEP_JSON.encode(), np.uint8)},
    ],
)
def test_episodes_whose_arrays_do_not_fit(change, tmp_path):
    whole = {"about": np.frombuffer(json.dumps(ABOUT).encode(), np.uint8), "lengths": np.array([2, 3]),
             "observations": np.zeros((5, 4)), "actions": np.zeros((5, 1))}  # fmt: skip
    np.savez(tmp_path / "whole.npz", **whole)
    assert [len(one) for one in episode_log.load(tmp_path / "whole.npz").actions] == [2, 3]
    np.savez(tmp_path / "broken.npz", **(whole | change))
    with pytest.raises(ValueError, match=r"broken\.npz has no episodes"):
        episode_log.load(tmp_path / "broken.npz")


@pytest.mark.parametrize("header", [{"bytes": -1}, {"bytes": 10**15}, {"bytes": "all"}, {"bytes": 1.5}])
def test_a_frame_of_a_run_says_how_long_it_is(header, tmp_path):
    path = tmp_path / "shards"
    with ShardLog(path, "run") as log:
        log.append(0, {"a": np.arange(3)})
    with path.open("ab") as file:
        file.write(json.dumps({"shard": 1, "sha256": "", **header}).encode() + b"\n" + b"data")
    with ShardLog(path, "run") as log:
        assert list(log.done) == [0]


def test_a_frame_that_holds_no_arrays_is_told(tmp_path):
    import hashlib

    path = tmp_path / "shards"
    with ShardLog(path, "run") as log:
        log.append(0, {"a": np.arange(3)})
    with path.open("ab") as file:
        header = {"shard": 1, "bytes": 4, "sha256": hashlib.sha256(b"data").hexdigest()}
        file.write(json.dumps(header).encode() + b"\ndata")
    with pytest.raises(ShardLogError, match=r"shards is damaged: .*; remove it to start again"):
        ShardLog(path, "run")


# --- the rest ---------------------------------------------------------------------------------------------------------
STORE = '{"format": 1, "device": "tmcm1636", "sections": {"communication": {"607A:0": %s}}}'


@pytest.mark.parametrize("value", ["Infinity", "NaN", "1e999", "1.5", '"5"', "true", "null", "[]", DEEP_JSON])
def test_a_store_holds_whole_numbers(value, tmp_path):
    (tmp_path / "node.json").write_text(STORE % value)
    with pytest.raises(ValueError, match=r"node\.json has no parameters of a tmcm1636 \(.*\); give another file"):
        Store(tmp_path / "node.json", "tmcm1636")


@pytest.mark.parametrize("key", ["607A", "607A:0:1", "x:0", "٣:0", ""])
def test_a_store_names_objects(key, tmp_path):
    (tmp_path / "node.json").write_text((STORE % "5").replace("607A:0", key))
    if key == "٣:0":  # digits all the same
        assert Store(tmp_path / "node.json", "tmcm1636").sections == {"communication": {(3, 0): 5}}
        return
    with pytest.raises(ValueError, match=r"node\.json has no parameters of a tmcm1636"):
        Store(tmp_path / "node.json", "tmcm1636")


LAUGHS = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in itertools.pairwise("abcdefghi")
)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (LAUGHS, "more than 1000000 values"),
        (DEEP_JSON, "nests too deep"),
        ("- 1\n- 2", "holds no sections"),
        ("ServoDrive/Tracking-v0: [1, 2]", "must be a table of hyper-parameters by name"),
        ("1: {n_envs: 1}", "section 1 must be a table"),
        ("ServoDrive/Tracking-v0: {n_envs: .inf, n_timesteps: 1, policy: x}", "n_envs must be a whole number"),
        ("ServoDrive/Tracking-v0: {n_envs: .nan, n_timesteps: 1, policy: x}", "n_envs must be a whole number"),
        ("a: {n_envs: 1, n_envs: 2}", "the name 'n_envs' stands twice in one table"),
        ("a: b: c", "cannot be read as YAML: mapping values are not allowed here"),
        (f"ServoDrive/Tracking-v0: {{x: '{'[' * 3000}'}}", "nests too deep|cannot be read"),
        ("ServoDrive/Tracking-v0: {x: 'dict(a={[]: 1})'}", "cannot be read: unhashable type"),
    ],
)
def test_hyper_parameters_within_limits(text, told, tmp_path):
    (tmp_path / "own.yaml").write_text(text)
    with pytest.raises(ValueError, match=told) as error:
        hyperparameters.load("ServoDrive/Tracking-v0", "ppo", "quick", path=tmp_path / "own.yaml")
    assert "\n" not in str(error.value)


def test_a_certificate_within_limits(tmp_path):
    (tmp_path / "certificate.json").write_text(DEEP_JSON)
    with pytest.raises(certificate.CertificateError, match=r"certificate\.json is not a certificate: .* 40 deep"):
        certificate_files.is_unchanged(tmp_path / "certificate.json")


@pytest.mark.slow
def test_a_device_without_end_is_no_file_of_anybody(tmp_path):
    """In a process of its own: today's code takes all the memory there is."""
    if not Path("/dev/zero").exists():
        pytest.skip("no such device here")
    program = "from drive_env.programs import drive_env; drive_env()"
    found = subprocess.run(
        [sys.executable, "-c", program, "serve", "--config", "/dev/zero"], capture_output=True, text=True, timeout=60
    )
    assert found.returncode == 2 and "is a pipe or a device" in found.stderr


def test_a_certificate_that_says_two_things_is_not_unchanged(tmp_path):
    """A person reads the first of two values, the program the last; `verify` called it unchanged."""
    data = {"format": certificate.FORMAT, "passed": False}
    whole = json.dumps(data | {certificate.HASH: content_hash(data)})
    path = tmp_path / "certificate.json"
    path.write_text(whole)
    assert certificate_files.is_unchanged(path)
    path.write_text(whole.replace('"passed": false', '"passed": true, "passed": false'))
    with pytest.raises(certificate.CertificateError, match="the name 'passed' stands twice in one table"):
        certificate_files.is_unchanged(path)
    found = CliRunner().invoke(tune_app, ["verify", str(path)])
    assert found.exit_code == 2 and "'passed' stands twice" in found.output.replace("\n", " ")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with a name here")
@pytest.mark.parametrize(
    "text", [".".join("a" * 20_000) + " = 1", DEEP_TOML[:190_000], "a" * 190_000 + " = 1"], ids=["keys", "deep", "long"]
)
def test_a_run_of_others_is_shown_whatever_is_in_it(text, tmp_path):
    """A settings.toml of 40 kB held the page's thread, and with it the quick stop, for 47 s."""
    run = tmp_path / "run"
    run.mkdir()
    (run / "settings.toml").write_text(text)
    (run / "config.toml").write_text("known = 1\n")
    (run / "certificate.json").write_text(DOUBLED)
    os.mkfifo(run / "args.toml")
    os.mkfifo(run / "events.out.tfevents.1")
    begun = time.process_time()
    (found,) = runs_folder.list_runs(tmp_path)
    assert runs_folder.settings_of(found, tmp_path).get("known") == "1"
    assert runs_folder.certificate_of(found, tmp_path) == {}
    assert time.process_time() - begun < 5.0
    with pytest.raises(UntrustedFileError, match="is a pipe or a device"):
        runs_folder.text_of(run / "args.toml")
    pytest.importorskip("tensorboard")
    assert read_curves(run) == {}


# --- what is read in a process with limits ----------------------------------------------------------------------------
def blf_bomb(path, megabytes):
    """A log of Vector's whose one container is zeros."""
    packed = zlib.compress(bytes(megabytes * 1_000_000), 9)
    container = struct.pack("<H6xL4x", 2, megabytes * 1_000_000) + packed
    whole = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(container), 10) + container
    head = struct.pack(
        "<4sLBBBBBBBBQQLL8H8H72x", b"LOGG", 144, 5, 0, 0, 0, 2, 6, 8, 1, 144 + len(whole), 0, 0, 0, *[1] * 16
    )
    path.write_bytes(head + whole)
    return path


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux alone")
def test_a_log_of_frames_that_unpacks_without_end_is_refused(tmp_path, monkeypatch):
    """600 kB that unpack to 600 MB: of 500 MB that are read 500 GB could come."""
    monkeypatch.setattr(recorded_frames, "MEMORY", 400_000_000)
    path = blf_bomb(tmp_path / "frames.blf", 600)
    assert path.stat().st_size < 700_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(
        UntrustedFileError, match=r"the log .*frames\.blf takes more than 0.4 GB of memory to read"
    ) as told:
        recorded_frames.read_frames(path, everything=True)
    assert "\n" not in str(told.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000  # kB


def test_a_recorded_move_has_lines_of_a_length(tmp_path):
    (tmp_path / "move.csv").write_text("t [s]," + "," * 1_100_000)
    with pytest.raises(UntrustedFileError, match="has a line of more than 1000000 letters"):
        read_log(tmp_path / "move.csv")


@pytest.mark.every(2)
@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux alone")
@pytest.mark.parametrize(("kind", "told"), [("numbers", "more than 2 GB of memory"), ("rounds", "more than 1 s")])
def test_an_onnx_model_acts_once_within_limits_before_it_is_loaded(kind, told, tmp_path, monkeypatch):
    """10^11 numbers of 200 bytes took 400 GB, 10^15 rounds of a loop held the drives' cycle without end."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(onnx_policy, "ACTION_TIME", 1.0)
    make, floats, constant = onnx.helper, onnx.TensorProto.FLOAT, onnx.numpy_helper.from_array
    value = make.make_tensor_value_info
    if kind == "numbers":
        nodes = [make.make_node("ConstantOfShape", ["n"], ["zeros"]),
                 make.make_node("ReduceSum", ["zeros"], ["sum"], keepdims=0),
                 make.make_node("Add", ["observation", "sum"], ["action"])]  # fmt: skip
        numbers = [constant(np.array([10**11]), "n")]
    else:
        inner = [make.make_node("Identity", ["on"], ["still"]), make.make_node("Identity", ["x"], ["y"])]
        inputs = [
            value("k", onnx.TensorProto.INT64, []),
            value("on", onnx.TensorProto.BOOL, []),
            value("x", floats, None),
        ]
        body = make.make_graph(
            inner, "body", inputs, [value("still", onnx.TensorProto.BOOL, []), value("y", floats, None)]
        )
        nodes = [make.make_node("Loop", ["n", "yes", "observation"], ["action"], body=body)]
        numbers = [constant(np.array(10**15), "n"), constant(np.array(True), "yes")]
    graph = make.make_graph(
        nodes, "g", [value("observation", floats, ["rows", 4])], [value("action", floats, None)], numbers
    )
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, str(tmp_path / "agent.onnx"))
    with pytest.raises(BundleError, match=told):
        onnx_policy.OnnxPolicy(tmp_path / "agent.onnx")
