"""The cache of compiled kernels: whatever its files hold, a program runs, and says in one line what it rebuilds."""

import errno
import gc
import logging
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError
from numba.extending import overload
from rigs import ROOT
from rigs.tables import every_row
from rigs.thinning import STRIDE

from drive_env import EmulatedDrives
from drive_env.emulator import cyclic_control, prepared_record
from drive_env.emulator.prepared_record import from_od
from drive_env.envs import bus_delays, tracking_cycle
from drive_env.firmware.servo import stages
from drive_env.firmware.servo.stages import FIRMWARE
from mechanics.kernels import kernel_files
from mechanics.kernels.compiled import source_hash, sources, stage, user_cache_folder
from mechanics.kernels.kernel_files import KernelFiles

# What a program does with two small kernels, and how many it compiled.
SMALL = """
import logging, numpy as np
logging.basicConfig(format="%(message)s")
from drive_env.firmware.servo import stages
from drive_env.emulator.prepared_record import from_od
values = np.empty((2, 1, 1))
code = np.array([-10, 10, 0.0, *[np.nan] * 4])
assert from_od(np.array([[3], [4]]), np.array([0.5]), code, values, 0) and values.ravel().tolist() == [1.5, 2.0]
print("compiled", sum(from_od.stats.cache_misses.values()), "kept", sum(from_od.stats.cache_hits.values()))
"""
WHOLE = """
import logging
logging.basicConfig(format="%(message)s")
from drive_env import EmulatedDrives, motion
with EmulatedDrives() as drives:
    motion.enable(drives, "csv")
    print(drives.record(["Statusword"], 0.01)["Statusword"][-1, 0])
"""
DAMAGES = {
    "empty": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "cut by one": lambda content: content[:-1],
    "another byte": lambda content: content[:-100] + bytes([content[-100] ^ 1]) + content[-99:],
    "noise": lambda content: os.urandom(len(content)),
    "zeros": lambda content: bytes(len(content)),  # what some file systems leave after a power cut
}


def run(program: str, cache: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program], env={**os.environ, "DRIVE_ENV_CACHE": str(cache)}, capture_output=True,
        text=True, timeout=300,
    )  # fmt: skip


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    """A copy of the real cache, with all kernels that these programs use."""
    values = np.empty((2, 1, 1))
    from_od(np.array([[3], [4]]), np.array([0.5]), np.array([-10, 10, 0.0, *[np.nan] * 4]), values, 0)
    with EmulatedDrives() as drives:
        drives.advance(0.001)
    copy = tmp_path_factory.mktemp("cache")
    for kernel in (from_od, FIRMWARE.run):
        folder = Path(kernel._cache.cache_path).relative_to(user_cache_folder()).parts[0]
        shutil.copytree(user_cache_folder() / folder, copy / folder, dirs_exist_ok=True)
    return copy


def kernels(cache: Path) -> list[Path]:
    return sorted(cache.rglob("*.kernel"))


@pytest.mark.slow
def test_another_program_finds_the_kernels_of_this_one(cache):
    found = run(SMALL, cache)
    assert (found.stdout, found.stderr) == ("compiled 0 kept 1\n", "")


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_told_removed_and_written_anew(cache, tmp_path, damage):
    copy = Path(shutil.copytree(cache, tmp_path / "cache"))
    assert len(kernels(copy)) > 1
    for path in kernels(copy):
        path.write_bytes(DAMAGES[damage](path.read_bytes()))
    first = run(SMALL, copy)
    assert first.returncode == 0, first.stderr
    assert first.stdout == "compiled 1 kept 0\n"
    assert "is damaged or of another version; it is compiled again" in first.stderr
    assert first.stderr.count("\n") == 1
    second = run(SMALL, copy)
    assert (second.stdout, second.stderr) == ("compiled 0 kept 1\n", "")


@pytest.mark.slow
def test_drives_run_though_every_kernel_is_damaged(cache, tmp_path):
    copy = Path(shutil.copytree(cache, tmp_path / "cache"))
    whole = run(WHOLE, copy)
    for k, path in enumerate(kernels(copy)[::STRIDE]):
        path.write_bytes(list(DAMAGES.values())[k % len(DAMAGES)](path.read_bytes()))
    rebuilt = run(WHOLE, copy)
    assert rebuilt.returncode == 0, rebuilt.stderr
    assert rebuilt.stdout == whole.stdout


@pytest.mark.slow
def test_files_of_another_kind_do_not_matter(cache, tmp_path):
    """A folder in the place of a file, what an older version left, half a file of a program that was killed."""
    copy = Path(shutil.copytree(cache, tmp_path / "cache"))
    path = next(one for one in kernels(copy) if "from_od" in one.name)
    path.with_suffix(".nbi").write_bytes(b"torn")
    path.with_name(path.name + ".0123456789abcdef").write_bytes(b"half")
    path.unlink()
    path.mkdir()
    found = run(SMALL, copy)
    assert found.returncode == 0, found.stderr
    assert found.stdout == "compiled 1 kept 0\n"


@pytest.mark.slow
def test_two_programs_at_once_share_what_they_compile(tmp_path):
    """Both begin with an empty cache; each file that they leave is whole."""
    both = [
        subprocess.Popen([sys.executable, "-c", SMALL], env={**os.environ, "DRIVE_ENV_CACHE": str(tmp_path)})
        for _ in range(2)
    ]
    assert [one.wait(300) for one in both] == [0, 0]
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == kernels(tmp_path)
    assert run(SMALL, tmp_path).stdout == "compiled 0 kept 1\n"


def test_two_signatures_never_share_a_file(tmp_path):
    """Numba's index gives both the number 1 if two processes save at once; the second would run the first's code."""
    mine, other = KernelFiles(tmp_path, "f-1.py311", 0), KernelFiles(tmp_path, "f-1.py311", 0)
    mine.save(("int64",), "code of int64")
    other.save(("float64",), "code of float64")
    assert (other.load(("int64",)), mine.load(("float64",))) == ("code of int64", "code of float64")
    assert KernelFiles(tmp_path, "f-1.py311", 1).load(("int64",)) is None, "of an edited source"
    mine.flush()
    assert mine.load(("int64",)) is None


def test_a_full_disk_costs_the_cache_alone(tmp_path, monkeypatch, caplog):
    def full(self, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    kernel_files._tell_not_kept.cache_clear()
    monkeypatch.setattr(Path, "write_bytes", full)
    files = KernelFiles(tmp_path, "f-1.py311", 0)
    with caplog.at_level(logging.WARNING):
        files.save("key", "kernel")
        files.save("other", "kernel")
    assert [record.getMessage() for record in caplog.records] == [
        f"compiled kernels cannot be stored in {tmp_path}: No space left on device; every program compiles them again. "
        "Make room, or set DRIVE_ENV_CACHE to another folder"
    ]
    assert list(tmp_path.iterdir()) == []


# --- what a kernel is keyed by ----------------------------------------------------------------------------------------
def compiled_from(function: object) -> set[str]:
    """Return the modules of all compiled functions that a kernel calls, found by walking their globals."""
    found: set[object] = set()
    waiting = [function]
    while waiting:
        one = waiting.pop()
        python = getattr(one, "py_func", None)
        if python is None or python in found:
            continue
        found.add(python)
        closure = [cell.cell_contents for cell in python.__closure__ or ()]
        waiting += [python.__globals__[each] for each in python.__code__.co_names if each in python.__globals__]
        waiting += closure
    return {python.__module__ for python in found}


KERNELS = [
    (kernel, module)
    for module in (cyclic_control, prepared_record, tracking_cycle, bus_delays)
    for kernel in vars(module).values()
    if hasattr(kernel, "py_func") and kernel.py_func.__module__ == module.__name__ and hasattr(kernel._cache, "flush")
] + [(kernel, stages) for kernel in FIRMWARE if hasattr(kernel, "py_func") and hasattr(kernel._cache, "flush")]


@every_row(("kernel", "module"), KERNELS)
def test_a_kernel_is_keyed_by_every_file_that_it_calls_and_by_no_command(kernel, module):
    known = sources(module)
    assert compiled_from(kernel) <= known.keys()
    assert not [name for name in known if ".tools" in name or ".commands" in name or name.endswith("cli")]


def test_cyclic_control_is_keyed_by_prepared_records_and_the_firmware_by_no_python_around_it():
    assert {"drive_env.emulator.prepared_record", "mechanics.stepping"} <= sources(cyclic_control).keys()
    assert {"drive_env.firmware.servo.loops", "drive_env.firmware.cycle", "mechanics.stepping"} <= sources(
        stages
    ).keys()
    assert (
        not {"drive_env.emulator.emulated_drives", "drive_env.emulator.prepared_record", "mechanics.packed"}
        & sources(stages).keys()
    )


def test_the_key_is_that_of_names_and_contents_wherever_they_lie(tmp_path):
    files = sources(stages)
    elsewhere = {name: tmp_path / f"{k}.py" for k, name in enumerate(files)}
    for name, path in files.items():
        shutil.copyfile(path, elsewhere[name])
    assert source_hash(elsewhere) == source_hash(files)
    edited = elsewhere["drive_env.firmware.servo.loops"]
    edited.write_text(edited.read_text() + "# another\n")
    assert source_hash(elsewhere) != source_hash(files)


@pytest.mark.slow
def test_kernels_of_a_copy_of_the_sources_are_those_of_the_original(cache, tmp_path):
    for name in ("mechanics", "drive_env"):
        shutil.copytree(ROOT / name, tmp_path / "copy" / name, ignore=shutil.ignore_patterns("__pycache__"))
    found = subprocess.run(
        [sys.executable, "-c", SMALL], cwd=tmp_path / "copy", capture_output=True, text=True, timeout=300,
        env={**os.environ, "DRIVE_ENV_CACHE": str(cache), "PYTHONPATH": str(tmp_path / "copy")},
    )  # fmt: skip
    assert (found.stdout, found.stderr) == ("compiled 0 kept 1\n", "")


def test_a_stage_is_compiled_once_whatever_numbers_its_callers_have_written_out():
    @stage
    def add(values, number):
        values[0] += number

    @njit
    def kernel(values, number):
        add(values, 1)
        add(values, 20)
        add(values, number)

    values = np.zeros(1)
    kernel(values, 300)
    assert values[0] == 321.0
    assert len(add.signatures) == 1


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_waits_while_something_is_compiled_and_is_as_it_was_then(enabled):
    seen = []

    def unknown(_):
        raise AssertionError("compiled code alone calls it")

    @overload(unknown)
    def _look(_):  # the compiler asks, in the middle of its work, and is told of no such function
        seen.append(gc.isenabled())

    before = gc.isenabled()
    (gc.enable if enabled else gc.disable)()
    try:
        with pytest.raises(TypingError):
            njit(lambda x: unknown(x))(1.0)
        assert gc.isenabled() is enabled
    finally:
        (gc.enable if before else gc.disable)()
    assert seen and not any(seen)
