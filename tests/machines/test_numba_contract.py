"""What our kernels take of Numba's private parts: a release that has them no more fails here, with their names.

They hold from the version that pyproject.toml asks for up to that of constraints.txt. What is made of them is tested in
test_stage_compiler.py, test_bundle.py and test_kernel_files.py.
"""

import ast
import importlib
import inspect

from rigs import ROOT

PRIVATE = ("numba.core", "numba.np", "llvmlite")
# Module and name, with what is used of it beyond the name: arguments of a function, parts of a class.
RELIES_ON = {
    "llvmlite.binding": "load_library_permanently",
    "llvmlite.ir": "Constant DoubleType FunctionType IntType",
    "numba.core.caching FunctionCache": "_index_key _save_overload load_overload",
    "numba.core.cgutils": "voidptr_t",
    "numba.core.codegen JITCodeLibrary": "finalize _get_module_for_linking get_pointer_to_function",
    "numba.core.compiler CompilerBase": "define_pipelines",
    "numba.core.compiler DefaultPassBuilder": "define_nopython_pipeline",
    "numba.core.compiler_machinery register_pass": "",
    "numba.core.datamodel models": "OpaqueModel",
    "numba.core.event": "Listener register",
    "numba.core.inline_closurecall": "copy",
    "numba.core.ir": "Block",
    "numba.core.serialize dumps": "obj",
    "numba.core.targetconfig": "ConfigStack",
    "numba.core.typed_passes NativeLowering": "run_pass",
    "numba.core.typing.templates AttributeTemplate": "generic_resolve",
    "numba.np.arrayobj populate_array": "array data shape strides itemsize meminfo",
    "numba.np.numpy_support as_dtype": "nbtype",
}


def private_parts(path):
    """What a file imports of Numba's private parts, as module and name; a module that is imported is its name alone."""
    found, text = set(), path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(text)) if "numba" in text or "llvmlite" in text else ():
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PRIVATE):
            found |= {f"{node.module} {alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.startswith(PRIVATE)}
    return found


def thing(name):
    module, _, part = name.partition(" ")
    return getattr(importlib.import_module(module), part) if part else importlib.import_module(module)


def test_numba_has_what_the_kernels_rely_on():
    missing = {}
    for name, parts in RELIES_ON.items():
        one = thing(name)
        there = inspect.signature(one).parameters if inspect.isfunction(one) else dir(one)
        missing |= {name: left} if (left := [part for part in parts.split() if part not in there]) else {}
    assert not missing


def test_only_the_room_of_kernels_touches_them():
    found = {}
    for package in ("mechanics", "drive_env", "tuning", "agents", "research"):
        for path in (ROOT / package).rglob("*.py"):
            found |= {path.relative_to(ROOT).as_posix(): parts} if (parts := private_parts(path)) else {}
    assert found.pop("tuning/runs/provenance.py") == {"llvmlite.binding"}  # asks for the processor's name
    assert all(path.startswith("mechanics/kernels/") for path in found), found
    # `from numba.core import event` is the module numba.core.event.
    imported = {part.replace(" ", ".") for parts in found.values() for part in parts}
    assert {name.replace(" ", ".") for name in RELIES_ON} == imported
