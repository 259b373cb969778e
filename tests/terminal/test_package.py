"""What is installed: types, one version, and extras that say how they are installed where they are not."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile

import pytest
from rigs import ROOT

import drive_env

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PACKAGES = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
# What each extra brings that our code imports; a program that is run without it sees what a user sees.
OF_AGENTS = ("torch", "stable_baselines3", "sb3_contrib", "tensorboard", "yaml", "onnx", "onnxruntime")
OF_CLUSTER = ("dask", "distributed")
WITHOUT = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
"""


def run_without(names, program, folder):
    return subprocess.run(
        [sys.executable, "-c", WITHOUT.format(names=names) + program], cwd=folder, capture_output=True, text=True,
        timeout=300, check=False,
    )  # fmt: skip


def command(*arguments):
    function = arguments[0].replace("-", "_")
    return f"sys.argv = {list(arguments)!r}\nfrom drive_env import programs\nprograms.{function}()\n"


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_is_typed(package):
    assert (ROOT / package / "py.typed").is_file()


def test_the_version_has_one_home_and_its_heading_in_the_changelog():
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "drive_env/__init__.py"
    assert "version" in PROJECT["project"]["dynamic"]
    assert f"\n## {drive_env.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    cited = re.search(r"(?m)^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited and cited[1] == drive_env.__version__


@pytest.mark.every(18)
@pytest.mark.parametrize(("missing", "arguments", "extra"), [
    (OF_AGENTS, ("drive-agent", "train"), "agents"),
    (OF_AGENTS, ("drive-agent", "train", "tracking", "--algorithm", "sac"), "agents"),
    (OF_AGENTS, ("drive-agent", "search"), "agents"),
    (OF_AGENTS, ("drive-agent", "export", "tracking_two_mass"), "agents"),
    (OF_AGENTS, ("drive-agent", "evaluate", "mine.onnx"), "agents"),
    (OF_AGENTS, ("drive-agent", "evaluate", "mine.zip", "--environment", "tracking", "--trust"), "agents"),
    (OF_CLUSTER, ("drive-tune", "sweep", "--cluster", "tcp://127.0.0.1:8786"), "cluster"),
    (OF_CLUSTER, ("drive-tune", "auto", "--by", "tpe", "--cluster", "tcp://127.0.0.1:8786"), "cluster"),
    (OF_CLUSTER, ("drive-tune", "rank", "--cluster", "tcp://127.0.0.1:8786"), "cluster"),
    (OF_CLUSTER, ("drive-agent", "evaluate", "tracking_two_mass", "--cluster", "tcp://127.0.0.1:8786"), "cluster"),
])  # fmt: skip
def test_a_command_whose_extra_is_missing_says_the_pip_line_that_mends_it(missing, arguments, extra, tmp_path):
    (tmp_path / "mine.onnx").write_bytes(b"")  # nothing is read of it before
    with zipfile.ZipFile(tmp_path / "mine.zip", "w") as archive:  # as Stable-Baselines3's `save` writes it
        archive.writestr("data", '{"policy_class": {"__module__": "stable_baselines3.common.policies"}}')
    done = run_without(missing, command(*arguments), tmp_path)
    said = " ".join(done.stderr.split())
    assert done.returncode == 2, said
    assert re.search(rf"""pip install ['"]drive-env\[{extra}\]['"]""", said), said
    assert "Traceback" not in said


def test_an_environment_for_stable_baselines_without_it_says_the_pip_line(tmp_path):
    program = (
        "from drive_env.envs import make_vec_env\n"
        "try:\n    make_vec_env('ServoDrive/Tracking-v0')\nexcept ImportError as error:\n    print(error)\n"
    )
    done = run_without(OF_AGENTS, program, tmp_path)
    assert "pip install 'drive-env[agents]'" in done.stdout, done.stderr


@pytest.mark.every(4)
@pytest.mark.parametrize("arguments", [
    ("drive-agent", "evaluate", "--help"), ("drive-agent", "train", "--help"), ("drive-tune", "sweep", "--help"),
    ("drive-env", "list"),
])  # fmt: skip
def test_without_any_extra_the_programs_start(arguments, tmp_path):
    done = run_without(OF_AGENTS + OF_CLUSTER, command(*arguments), tmp_path)
    assert done.returncode == 0, done.stderr


def test_what_a_caller_uses_and_catches_comes_from_the_package():
    """Each name is the same object as in its home, and only what is asked for is imported."""
    assert [*drive_env.__all__] == sorted(drive_env.__all__) and {"BusError", "Drives", "open_drives"} <= {
        *drive_env.__all__
    }
    for name in drive_env.__all__:
        assert getattr(drive_env, name).__name__.rpartition(".")[2] == name
    told = [sys.executable, "-c", "import sys, drive_env; drive_env.BusError; print('mujoco' in sys.modules)"]
    assert subprocess.run(told, capture_output=True, text=True, check=True).stdout == "False\n"
