"""The class that PythonFMU finds in an FMU: it registers the drive's variables, and forwards an importer's calls."""

from __future__ import annotations

import atexit
import ctypes
import importlib
import io
import pickle
import sys
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, SubElement

from drive_env import __version__
from drive_env.dictionary.aborts import ObjectAccessError
from drive_env.fmu.drive import FmuDrive, read_settings
from drive_env.fmu.variables import BOOLEAN, INPUT, INTEGER, LARGE, PARAMETER, REAL, FmuVariable
from drive_env.saved_state import State

# Exponents of the SI base units in each unit; FMI 3 has them defined. Other units are in the descriptions alone.
_UNITS = {
    "rad": {"rad": 1}, "rad/s": {"rad": 1, "s": -1}, "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "N*m": {"kg": 1, "m": 2, "s": -2}, "N": {"kg": 1, "m": 1, "s": -2},
}  # fmt: skip


class Standard(NamedTuple):
    """A version of FMI as its library has it: the library, the prefix of its names, the class of each kind of variable.

    `states` are the attributes of a model description that promise saved and serialised states.
    """

    library: str
    prefix: str
    kinds: dict[str, str]
    states: tuple[str, str]

    @property
    def slave(self) -> str:
        """Name of the class that a slave is made of."""
        return f"{self.prefix}Slave"


STANDARDS = {  # FMI 2 has no integers beyond 32 bits: they are real numbers there
    2: Standard(
        "pythonfmu", "Fmi2", {INTEGER: "Integer", LARGE: "Real", REAL: "Real", BOOLEAN: "Boolean"},
        ("canGetAndSetFMUstate", "canSerializeFMUstate"),
    ),
    3: Standard(
        "pythonfmu3", "Fmi3", {INTEGER: "Int32", LARGE: "Int64", REAL: "Float64", BOOLEAN: "Boolean"},
        ("canGetAndSetFMUState", "canSerializeFMUState"),
    ),
}  # fmt: skip


_kept: list[dict[str, Any]] = []


def keep(names: dict[str, Any]) -> None:
    """Add a reference to the names of an FMU's module.

    PythonFMU (0.7.0) executes the module again for each instance, and then releases a borrowed reference to its names:
    without this one the second instance would crash.
    """
    _kept.append(names)


def _give_up_the_interpreter_once(resources: Path) -> None:
    """Make the FMU's library release its interpreter once, before a Python program ends.

    On Linux, PythonFMU (0.7.0) and PythonFMU3 (0.3.4) release it twice when they are unloaded: once too often if each
    instance was freed; the program then aborted with "corrupted double-linked list". The library is held so that it is
    not unloaded earlier.
    """
    for file in resources.parent.glob("binaries/*linux*/*.so") if sys.orig_argv else ():
        atexit.register(ctypes.CDLL(str(file)).finalizePythonInterpreter)


class PlainData(pickle.Unpickler):
    """Reads only states: numbers, text, and arrays of them, since a serialised state is not trusted."""

    KNOWN = (("numpy._core.multiarray", "_reconstruct"), ("numpy", "ndarray"), ("numpy", "dtype"))

    def find_class(self, module: str, name: str) -> Any:
        """Return a class or function for arrays; UnpicklingError for any other."""
        if (module, name) not in self.KNOWN:
            raise pickle.UnpicklingError(f"the state holds {module}.{name}, which is no data; it is of no drive")
        return super().find_class(module, name)


class DriveSlave:
    """A drive as a slave of PythonFMU; the script of an FMU puts it before the library's own class.

    Attributes:
        STANDARD: Version of FMI, 2 or 3.
    """

    STANDARD: int
    resources: str
    log: Any
    register_units: Any
    register_variable: Any

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self._standard = STANDARDS[self.STANDARD]
        self._library = importlib.import_module(self._standard.library)
        _give_up_the_interpreter_once(Path(self.resources))
        settings = read_settings(Path(self.resources))
        assert settings["device"] and settings["load"], "export_fmu writes them"
        self._drive = FmuDrive(settings["device"], settings["load"], settings["motor"])
        self.description = f"{self._drive.drives.device.title} with load {self._drive.drives.load.name}"
        self.version, self.license = __version__, "MIT"
        cycle = self._drive.drives.device.cycle
        self.default_experiment = self._library.DefaultExperiment(start_time=0.0, stop_time=1.0, step_size=cycle)
        self._time = 0.0
        if self.STANDARD == 3:
            self.register_units([self._library.Unit(name, **exponents) for name, exponents in _UNITS.items()])
            self.register_variable(self._library.Float64(
                "time", causality=self._library.Fmi3Causality.independent,
                variability=self._library.Fmi3Variability.continuous, getter=lambda: self._time,
            ))  # fmt: skip
        for one in self._drive.variables:
            self._register(one)

    def _register(self, one: FmuVariable) -> None:
        causality = getattr(self._library, f"{self._standard.prefix}Causality")
        variability = getattr(self._library, f"{self._standard.prefix}Variability")
        row, drive = one.row, self._drive
        kind = "fixed" if row.causality == PARAMETER else "continuous" if row.kind == REAL else "discrete"
        unit = {"unit": row.unit} if self.STANDARD == 3 and row.kind == REAL and row.unit in _UNITS else {}
        self.register_variable(getattr(self._library, self._standard.kinds[row.kind])(
            one.name, causality=causality[row.causality], variability=variability[kind],
            description=row.meaning + (f" [{row.unit}]" if row.unit else ""), getter=lambda: drive.get(one),
            setter=(lambda value: drive.set(one, value)) if row.causality in (INPUT, PARAMETER) else None, **unit,
        ))  # fmt: skip

    def to_xml(self, model_options: Any = ()) -> Element:
        """Return the model description, with the capabilities of this class."""
        root: Element = super().to_xml(dict(model_options))  # type: ignore[misc]
        found = root.find("CoSimulation")
        assert found is not None, "the library writes it"
        for name in (*self._standard.states, "canHandleVariableCommunicationStepSize"):
            found.set(name, "true")
        if self.STANDARD == 3:
            found.set("fixedInternalStepSize", f"{self._drive.drives.device.cycle:g}")
        else:
            # The library omits which outputs are computed at the start of the simulation: all of them.
            structure = root.find("ModelStructure")
            assert structure is not None, "the library writes it"
            SubElement(structure, "InitialUnknowns").extend(structure.findall("Outputs/Unknown"))
        return root

    def exit_initialization_mode(self) -> None:
        """Write the parameters; an error ends the instance, with its message in the importer's log."""
        self._drive.begin()

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Let a step pass; False, with the reason in the importer's log, if it is refused."""
        try:
            self._drive.step(step_size)
        except (ValueError, ObjectAccessError) as error:
            status = importlib.import_module(f"{self._standard.library}.enums")
            self.log(str(error), getattr(status, f"{self._standard.prefix}Status").error)
            return False
        self._time = current_time + step_size
        return True

    def terminate(self) -> None:
        """End the drive."""
        self._drive.drives.close()

    # --- names that PythonFMU calls -------------------------------------------------------------------------------
    def _get_fmu_state(self) -> State:
        return self._drive.save_state() | {"time": self._time}

    def _set_fmu_state(self, state: State) -> None:
        self._drive.restore_state(state)
        self._time = state["time"]

    @staticmethod
    def _fmu_state_to_bytes(state: State) -> bytes:
        return pickle.dumps(state, protocol=4)

    @staticmethod
    def _fmu_state_from_bytes(state: bytes) -> State:
        found: State = PlainData(io.BytesIO(state)).load()
        return found
