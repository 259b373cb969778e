"""Faster compilation of kernels: no machine code for single stages, and cached answers inside Numba.

Together they take two fifths off a cold start. They stand on private parts of Numba;
`tests/machines/test_stage_compiler.py` fails where a version has these no more.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from numba import types
from numba.core import inline_closurecall, ir, targetconfig
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import register_pass
from numba.core.typed_passes import NativeLowering

# The operators of these types depend on nothing else.
_PLAIN = (types.Number, types.Boolean, types.Buffer, types.Record)


class _StageLibrary(JITCodeLibrary):  # type: ignore[misc]  # Numba has no types
    """A stage as LLVM's intermediate code: the kernel that it is linked into is optimised and compiled as a whole."""

    def finalize(self) -> None:
        """Link the functions that the stage calls, and leave the rest to the kernel."""
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True


@register_pass(mutates_CFG=True, analysis_only=False)
class _StageLowering(NativeLowering):  # type: ignore[misc]
    """Numba's lowering, without an entry point."""

    _name = "stage_lowering"

    def run_pass(self, state: Any) -> bool:
        """Lower a stage. A wrapper for Python would raise."""
        state.library = _StageLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        no_entry_point = (f"{state.func_id.func_qualname} is called by kernels only",).index
        state.targetctx.insert_user_function(no_entry_point, state.cr.fndesc, [state.library])
        state.cr = state.cr._replace(cfunc=no_entry_point)
        return True


class StageCompiler(CompilerBase):  # type: ignore[misc]
    """Compiles a function that only kernels call to intermediate code."""

    def define_pipelines(self) -> list[Any]:
        """Return Numba's own passes, with the lowering replaced."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [(_StageLowering if one is NativeLowering else one, told) for one, told in passes.passes]
        passes._finalized = False
        passes.finalize()
        return [passes]


@contextmanager
def remembered_answers() -> Iterator[None]:
    """Make Numba cache unchanging answers while it compiles a kernel.

    Otherwise it searches each operator's implementation among dozens at each use and each round of type inference (a
    fifth of the time), formats a record's 400 fields for unread events and errors (a twelfth), and copies all variables
    of a function with each inlined block (an eighth).
    """
    with ExitStack() as changed:
        for owner, name, other in (
            (types.Record, "__repr__", _remember_texts(types.Record.__repr__)),
            (types.Function, "get_call_type", _remember_operators(types.Function.get_call_type)),
            (inline_closurecall, "copy", _BlockCopies()),
        ):
            changed.callback(setattr, owner, name, getattr(owner, name))
            setattr(owner, name, other)
        yield


def _remember_texts(write: Callable[[Any], str]) -> Callable[[Any], str]:
    known: dict[int, tuple[Any, str]] = {}  # with the record, so that its id is not reused

    def text(record: Any) -> str:
        if id(record) not in known:
            known[id(record)] = record, write(record)
        return known[id(record)][1]

    return text


def _remember_operators(find: Callable[..., Any]) -> Callable[..., Any]:
    known: dict[Any, tuple[Any, Any]] = {}
    options: dict[int, tuple[Any, str]] = {}

    def get_call_type(function: Any, context: Any, args: Any, kws: Any) -> Any:
        if kws or not all(isinstance(one, _PLAIN) for one in args):
            return find(function, context, args, kws)
        flags = targetconfig.ConfigStack.top_or_none()
        if id(flags) not in options:
            options[id(flags)] = flags, "" if flags is None else flags.summary()
        key = id(function), id(context), tuple(args), options[id(flags)][1]
        if key not in known:
            known[key] = function, find(function, context, args, kws)
        return known[key][1]

    return get_call_type


class _BlockCopies:
    """Replaces Python's `copy` so that the blocks of one function share their copied variables."""

    def __init__(self) -> None:
        self._scope: Any = None
        self._memo: dict[int, Any] = {}

    def deepcopy(self, one: Any) -> Any:
        """Copy; blocks share copied variables until one comes again, which begins another copy of the function."""
        if not isinstance(one, ir.Block):
            return copy.deepcopy(one)
        if one.scope is not self._scope or id(one) in self._memo:
            self._scope, self._memo = one.scope, {}
        return copy.deepcopy(one, self._memo)

    def copy(self, one: Any) -> Any:
        """Copy as Python does."""
        return copy.copy(one)
