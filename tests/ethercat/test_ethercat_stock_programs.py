"""SOEM's slaveinfo and pysoem's examples, not a byte of them changed, against drives that `drive-env serve` serves.

They are in the sources alone, and PYSOEM_SOURCE and SOEM_SOURCE are the folders of these (`.ci/run` has them). A SOEM
1.4 is in pysoem's source package, its folder soem. The library's context there has two fields more than the table that
fills it for programs with one master, as slaveinfo is, so that the library does not compile for them; a copy of that
table has them:

pip download --no-deps --no-binary pysoem pysoem && tar xf pysoem-*.tar.gz
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rigs.namespaces import needs_namespaces, served, spaces  # noqa: F401

from drive_env.devices import find_device
from drive_env.ethercat.sii_content import sii_content

EXAMPLES = Path(os.environ.get("PYSOEM_SOURCE", "nowhere")) / "examples"
SOEM = Path(os.environ.get("SOEM_SOURCE", "nowhere"))
SLAVEINFO = SOEM / "test" / "linux" / "slaveinfo" / "slaveinfo.c"
BEFORE_IT = "    &EcatError,         // .ecaterror     =\n    "
LACKS = f"{BEFORE_IT}&ec_DCtime,         // .DCtime        ="
COMPILER = shutil.which("cc")
PATIENCE = 240.0  # s
IMAGE = os.urandom(3000)

pytestmark = [pytest.mark.slow, needs_namespaces]


@pytest.fixture
def slaveinfo(tmp_path):
    """Compile SOEM's slaveinfo as it is."""
    if COMPILER is None:
        pytest.skip("there is no C compiler (Debian: apt install gcc libc6-dev)")
    program = tmp_path / "slaveinfo"
    folders = [SOEM / "soem", SOEM / "osal", SOEM / "osal" / "linux", SOEM / "oshw" / "linux"]
    sources = [SLAVEINFO, *(file for folder in folders for file in folder.glob("*.c"))]
    main = SOEM / "soem" / "ethercatmain.c"
    text = main.read_text(encoding="utf-8")
    if "uint16         DCtO;" in (SOEM / "soem" / "ethercatmain.h").read_text(encoding="utf-8") and LACKS in text:
        filled = tmp_path / main.name
        filled.write_text(text.replace(LACKS, f"{BEFORE_IT}0, 0, {LACKS.removeprefix(BEFORE_IT)}"), encoding="utf-8")
        sources[sources.index(main)] = filled
    includes = [f"-I{folder}" for folder in folders]
    subprocess.run([COMPILER, "-w", *includes, *sources, "-o", program, "-lpthread", "-lrt"], check=True)
    return program


def printed(space, *command, expected, code=0):
    """Return what a program prints; again where this computer was too busy for SOEM's timeouts of some milliseconds."""
    end = time.monotonic() + PATIENCE
    while True:
        done = subprocess.run(
            ["ip", "netns", "exec", space, *map(str, command)], capture_output=True, text=True, timeout=PATIENCE
        )
        text = done.stdout + done.stderr
        if done.returncode == code and all(part in text for part in expected):
            return text
        missing = [part for part in expected if part not in text]
        assert time.monotonic() < end, (done.returncode, missing, text[-1000:])


@pytest.mark.skipif(not SLAVEINFO.is_file(), reason="SOEM_SOURCE is no folder of SOEM with its slaveinfo")
@pytest.mark.parametrize(
    ("device", "load", "expected"),
    [
        ("tmcm3313", "portal", {
            "-sdo": (
                "1 slaves found and configured.", "Calculated workcounter 3", "Output size: 240bits", "State: 4",
                "Input size: 240bits", "Has DC: 1", "Man: 00000286 ID: 00000cf1 Rev: 00010009",
                "CoE Object Description found, 331 entries.", '"TMCM-3313"\n',
                '0x7502      "Supported drive modes axis 2"', "End program",
            ),
            "-map": (
                "[0x0000.0] 0x6040:0x00 0x10 UNSIGNED16   Controlword",
                "[0x001A.0] 0x70FF:0x00 0x20 INTEGER32    Target velocity axis 2",
                "[0x0038.0] 0x706C:0x00 0x20 INTEGER32    Velocity actual value axis 2", "End program",
            ),
        }),
        ("tgz_d", "gantry", {
            "-sdo": (
                "Calculated workcounter 3", "Output size: 320bits", "Input size: 320bits", "State: 4",
                "CoE Object Description found, 365 entries.", '0x6d02      "Supported drive modes axis 1"',
                "End program",
            ),
            "-map": (
                "[0x000C.0] 0x6040:0x00 0x10 UNSIGNED16   Controlword",
                "[0x004A.0] 0x6877:0x00 0x10 INTEGER16    Torque actual value axis 1", "End program",
            ),
        }),
    ],
    ids=["tmcm3313", "tgz_d"],
)  # fmt: skip
def test_slaveinfo_scans_reads_all_objects_and_maps(spaces, slaveinfo, device, load, expected):  # noqa: F811
    with served(spaces, "--real-time", device, load):
        for option, parts in expected.items():
            printed(spaces.master, slaveinfo, spaces.master_interface, option, expected=parts)


def eeprom(text):
    """Return the bytes that read_eeprom.py prints, four in a row."""
    rows = [line.partition(":")[2] for line in text.splitlines() if line[4:5] == ":"]
    return bytes.fromhex("".join(rows).replace("|", ""))


@pytest.mark.skipif(not EXAMPLES.is_dir(), reason="PYSOEM_SOURCE is no folder of pysoem's source package")
def test_pysoems_examples_run(spaces, tmp_path):  # noqa: F811
    """minimal_example.py and basic_example.py want terminals of Beckhoff, and end as soon as they see another maker."""
    pytest.importorskip("pysoem", reason="pysoem is not installed: pip install -e '.[ethercat]'")
    image = tmp_path / "image.bin"
    image.write_bytes(IMAGE)

    def run(name, *arguments, expected, code=0):
        return printed(spaces.master, sys.executable, EXAMPLES / name, *arguments, expected=expected, code=code)

    at = spaces.master_interface
    with served(spaces, "--real-time"):
        run("find_adapters.py", expected=(at,))
        text = run("read_eeprom.py", at, expected=("007e:",))
        assert eeprom(text) == sii_content(find_device("tmcm3313"), serial=1)[:256]
        text = run("read_sdo_info.py", at, expected=("Idx: 0x1000;", "Idx: 0x7502;"))
        assert text.count(" Idx: ") == 331
        run("firmware_update.py", at, 1, image, expected=())
        run("write_foe.py", at, image, expected=("script started",))  # in Pre-Op, which refuses it: nobody is told
        run("minimal_example.py", at, expected=("1 slaves found and configured",), code=1)
        run("basic_example.py", at, expected=("unexpected slave layout",), code=1)
