"""Operations that Numba lacks: calls by address, and a counter shared by threads."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_HOOK = types.int64(types.int64, types.int64, types.int64)


def address_of_hook(function: Any) -> int:
    """Return the address of a compiled function of three integers that returns one, for `call_hook`."""
    compiled = function.get_compile_result(_HOOK)
    return int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name))


@intrinsic
def call_hook(_context: Any, address: Any, bundle: Any, first: Any, count: Any) -> Any:
    """Call the function at an address; see `address_of_hook`."""

    def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
        whole = ir.IntType(64)
        function = builder.inttoptr(args[0], ir.FunctionType(whole, [whole] * 3).as_pointer())
        return builder.call(function, args[1:])

    return types.int64(types.int64, types.int64, types.int64, types.int64), generate


@intrinsic
def next_number(_context: Any, counter: Any) -> Any:
    """Return the first element of an array and increment it atomically, so that each thread gets another number."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, args[0])
        return builder.atomic_rmw("add", array.data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), generate
