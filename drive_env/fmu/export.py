"""Writing an FMU: the library packs its interface, a script that names the drive, and the user's files."""

from __future__ import annotations

import importlib.util
import json
import keyword
import re
import sys
import tempfile
import uuid
from pathlib import Path

from drive_env import __version__
from drive_env.devices import device_names
from drive_env.fmu.drive import NO_LOAD, SETTINGS
from drive_env.fmu.slave import STANDARDS, Standard
from drive_env.motors import MOTORS
from drive_env.whole_file import write_whole
from mechanics.loads import LOADS
from mechanics.reading.untrusted import read_bytes

# What an importer finds in an FMU; the library looks for the line of the class.
SCRIPT = '''"""A drive of drive-env {version} as an FMU."""

from {library} import {slave}

try:
    from drive_env.fmu.slave import DriveSlave, keep
except ImportError as error:
    raise ImportError(
        "this FMU needs the Python package drive-env {version} in the Python of the program that loads it; "
        "install it there: pip install drive-env=={version}"
    ) from error

keep(globals())


class {name}(DriveSlave, {slave}):
    """The drive that drive.json names."""

    STANDARD = {standard}
'''


def export_fmu(file: Path, device: str, load: str, motor: str | None = None, *, fmi: int = 3) -> None:
    """Write an FMU of a drive for co-simulation.

    Args:
        file: New file, NAME.fmu; its name without the ending is that of the model.
        device: Device by name, or the path of the user's own.
        load: Load by name, the path of an MJCF that needs no other files, or `none`.
        motor: Motor by name, or the path of the user's own; None: the device's usual one.
        fmi: Version of FMI, 2 or 3.

    Raises:
        ValueError: For a name that is not an identifier, a version without a library, a missing library, or an
            impossible drive.
        OSError: If the file cannot be written.
    """
    standard = _standard(fmi)
    name = file.stem
    if file.suffix != ".fmu" or re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) is None or keyword.iskeyword(name):
        raise ValueError(
            f"{file.name} must be letters, digits and _, a letter first, then .fmu: the model has that name"
        )
    settings = {"device": device, "load": load, "motor": motor}
    known = {*device_names(), *LOADS, NO_LOAD, *MOTORS}
    own = {
        key: Path(given)
        for key, given in settings.items()
        if given is not None and given not in known and Path(given).exists()
    }
    with tempfile.TemporaryDirectory() as folder:
        # A separate module name: one program may load several FMUs, and module names must be unique.
        script, packed = Path(folder) / f"drive_{uuid.uuid4().hex}.py", Path(folder) / "packed"
        script.write_text(
            SCRIPT.format(version=__version__, library=standard.library, slave=standard.slave, name=name, standard=fmi),
            encoding="utf-8",
        )
        data = Path(folder) / SETTINGS
        about = settings | {key: path.name for key, path in own.items()} | {"drive_env": __version__}
        data.write_text(json.dumps(about, indent=1), encoding="utf-8")
        before, library = list(sys.path), importlib.import_module(standard.library)
        try:
            made = library.FmuBuilder.build_FMU(script, dest=packed, project_files={data, *own.values()})
        finally:
            sys.path[:] = before  # the library leaves its folder there
            sys.modules.pop(script.stem, None)
        write_whole(file, read_bytes(made))


def _standard(fmi: int) -> Standard:
    if fmi not in STANDARDS:
        raise ValueError(f"FMI {fmi} is not among the versions that can be written: {', '.join(map(str, STANDARDS))}")
    standard = STANDARDS[fmi]
    if importlib.util.find_spec(standard.library) is None:
        raise ValueError(
            f"an FMU of FMI {fmi} needs {standard.library}, which is not installed: pip install 'drive-env[fmu]'"
        )
    return standard
