"""Many arrays and numbers as one argument of compiled code: a bundle.

Numba unpacks a tuple of arrays at every call from Python (0.2 to 0.5 us per array) and passes it on as hundreds of
arguments to every function, each of which is compiled with them. A bundle is a table in memory with the address and
shape of each array; only the table's address is passed. Compiled code reads fields of a bundle as Python does.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    register_model,
    typeof_impl,
    unbox,
)
from numba.np.arrayobj import populate_array
from numba.np.numpy_support import as_dtype
from numpy.typing import NDArray

Vector = Annotated[NDArray[np.float64], types.float64[::1]]
Matrix = Annotated[NDArray[np.float64], types.float64[:, ::1]]
Cube = Annotated[NDArray[np.float64], types.float64[:, :, ::1]]
Numbers = Annotated[NDArray[np.int64], types.int64[::1]]
NumberMatrix = Annotated[NDArray[np.int64], types.int64[:, ::1]]
NumberCube = Annotated[NDArray[np.int64], types.int64[:, :, ::1]]
_SCALARS: dict[Any, types.Type] = {int: types.int64, float: types.float64, bool: types.boolean}


@dataclass(eq=False)
class Bundle:
    """Base of bundles: dataclasses whose fields are arrays of the kinds above, numbers and bundles.

    The arrays' addresses and the numbers are those at its creation, or at the last `replace`.
    """

    def __post_init__(self) -> None:
        fields = fields_of(self._layout)
        self._table = np.zeros(_size_of(self._layout), np.int64)
        self.address = int(self._table.ctypes.data)
        self._fill(fields)

    @property
    def _layout(self) -> Any:
        return type(self)

    def save_state(self) -> dict[str, Any]:
        """Return copies of its contents, except integers (addresses or fixed values) and read-only arrays."""
        found: dict[str, Any] = {}
        for name in fields_of(self._layout):
            value = getattr(self, name)
            if isinstance(value, Bundle):
                found[name] = value.save_state()
            elif isinstance(value, np.ndarray):
                found |= {name: value.copy()} if value.flags.writeable else {}
            elif not isinstance(value, int) or isinstance(value, bool):
                found[name] = value
        return found

    def restore_state(self, state: Mapping[str, Any]) -> None:
        """Restore a result of `save_state`, in place for arrays of equal size."""
        changed = {}
        for name, value in state.items():
            own = getattr(self, name)
            if isinstance(own, Bundle):
                own.restore_state(value)
            elif isinstance(own, np.ndarray) and own.shape == value.shape:
                own[...] = value
            else:
                changed[name] = np.array(value) if isinstance(own, np.ndarray) else value
        self.replace(**changed)

    def replace(self, **values: Any) -> None:
        """Set fields; compiled code sees them from its next call on."""
        for name, value in values.items():
            setattr(self, name, value)
        self._fill(values)

    def _fill(self, names: Collection[str]) -> None:
        reals = self._table.view(np.float64)
        for name, start, kind, ndim, item_size in slots_of(self._layout):
            if name not in names:
                continue
            value = getattr(self, name)
            if ndim:
                flags = value.flags
                assert value.ndim == ndim and flags.c_contiguous and flags.aligned, name
                assert value.dtype.itemsize == item_size, name
                self._table[start : start + 1 + ndim] = (value.ctypes.data, *value.shape)
            elif kind is types.float64:
                reals[start] = value
            else:
                self._table[start] = value.address if isinstance(kind, BundleType) else int(value)


class BundleType(types.Type):  # type: ignore[misc]
    """A bundle in compiled code: the address of its table."""

    def __init__(self, layout: Any) -> None:
        self.layout = layout
        super().__init__(name=f"bundle {layout.__module__}.{layout.__qualname__}")


@cache
def fields_of(layout: Any) -> dict[str, types.Type]:
    """Return the types of a bundle's fields in compiled code, in their order in the table."""
    found: dict[str, types.Type] = {}
    for name, hint in get_type_hints(layout, include_extras=True).items():
        if get_origin(hint) is Annotated:
            found[name] = get_args(hint)[1]
        else:
            found[name] = _SCALARS[hint] if hint in _SCALARS else BundleType(hint)
    return found


@cache
def slots_of(layout: Any) -> tuple[tuple[str, int, types.Type, int, int], ...]:
    """Return each field's name, first slot in the table and type, and an array's dimensions and item size."""
    return tuple(
        (name, place_of(layout, name), kind, kind.ndim, _item_size(kind))
        if isinstance(kind, types.Array)
        else (name, place_of(layout, name), kind, 0, 0)
        for name, kind in fields_of(layout).items()
    )


@cache
def _size_of(layout: Any) -> int:
    """Return the number of slots of a bundle's table."""
    return sum(_slots(kind) for kind in fields_of(layout).values())


@cache
def place_of(layout: Any, name: str) -> int:
    """Return the first slot of a field in the table, in units of 8 bytes."""
    place = 0
    for field, kind in fields_of(layout).items():
        if field == name:
            return place
        place += _slots(kind)
    raise AttributeError(name)


def reader(layout: type[Bundle]) -> Any:
    """Return a function, for compiled code, from a bundle's address to the bundle."""

    @intrinsic
    def at(_context: Any, address: Any) -> Any:
        def generate(_target: Any, builder: Any, _signature: Any, args: Any) -> Any:
            return builder.inttoptr(args[0], cgutils.voidptr_t)

        return BundleType(layout)(types.int64), generate

    return at


def _slots(kind: types.Type) -> int:
    return 1 + kind.ndim if isinstance(kind, types.Array) else 1


@cache
def _item_size(kind: Any) -> int:
    return int(as_dtype(kind.dtype).itemsize)


# --- in compiled code -------------------------------------------------------------------------------------------------
register_model(BundleType)(models.OpaqueModel)


@typeof_impl.register(Bundle)
def _typeof(value: Bundle, _context: Any) -> BundleType:
    return BundleType(type(value))


@unbox(BundleType)
def _unbox(_kind: Any, value: Any, context: Any) -> NativeValue:
    number = context.pyapi.object_getattr_string(value, "address")
    address = context.pyapi.long_as_longlong(number)
    context.pyapi.decref(number)
    return NativeValue(context.builder.inttoptr(address, cgutils.voidptr_t))


@infer_getattr
class _Fields(AttributeTemplate):  # type: ignore[misc]
    key = BundleType

    def generic_resolve(self, bundle: BundleType, name: str) -> types.Type | None:
        return fields_of(bundle.layout).get(name)


@lower_getattr_generic(BundleType)
def _get(context: Any, builder: Any, bundle: BundleType, value: Any, name: str) -> Any:
    kind, place = fields_of(bundle.layout)[name], place_of(bundle.layout, name)
    whole = ir.IntType(64)

    def slot(number: int, of: Any) -> Any:
        pointer = builder.bitcast(value, of.as_pointer())
        loaded = builder.load(builder.gep(pointer, [ir.Constant(whole, place + number)]), align=8)
        # No table changes while compiled code runs: LLVM need not reload it after a store.
        loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
        return loaded

    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder)
        shape = [slot(1 + k, whole) for k in range(kind.ndim)]
        size = ir.Constant(whole, _item_size(kind))
        strides = [size]
        for length in reversed(shape[1:]):
            strides.insert(0, builder.mul(strides[0], length, flags=("nsw",)))
        data = builder.inttoptr(slot(0, whole), context.get_data_type(kind.dtype).as_pointer())
        populate_array(array, data=data, shape=shape, strides=strides, itemsize=size, meminfo=None)
        return array._getvalue()
    if isinstance(kind, BundleType):
        return builder.inttoptr(slot(0, whole), cgutils.voidptr_t)
    if kind is types.float64:
        return slot(0, ir.DoubleType())
    number = slot(0, whole)
    return builder.icmp_signed("!=", number, ir.Constant(whole, 0)) if kind is types.boolean else number
