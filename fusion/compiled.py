"""numba's njit for many small kernels that call each other: compiled once, and the cache notices any change.

numba optimises a function with all that it calls, makes machine code of it, and does so again for each of its callers,
up to the loop over a whole log. Here only what Python calls comes that far: the kernels below it are typed once and
handed on as they are, to be optimised inside their caller.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from llvmlite import ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.datamodel.manager import DataModelManager
from numba.core.datamodel.models import TupleModel
from numba.core.datamodel.registry import default_manager
from numba.core.errors import NumbaError

ALLOCATES = frozenset({"zeros", "empty", "ones", "full", "array", "arange", "copy"})

_ITEMS, _DATA, _SHAPE, _STRIDES = 2, 4, 5, 6  # places in numba's array

_cached: list[Any] = []


def njit(*arguments: Any, **options: Any) -> Any:
    """Do what numba.njit does, with less to compile and a cache on disk as old as the newest source of a kernel.

    A constant argument is no reason for a kernel's own version. One that makes no arrays counts no references to them:
    its caller holds those that it works on. One that returns arrays in a tuple says so by _nrt=True.
    """
    if not (arguments and callable(arguments[0])):
        return lambda function: njit(function, *arguments, **options)
    allocates = not ALLOCATES.isdisjoint(arguments[0].__code__.co_names)
    options = {"_nrt": allocates, "no_cfunc_wrapper": True} | options
    dispatcher = _counting_where_it_must(numba.njit(*arguments, **options))
    inner = {"cache": False, "no_cpython_wrapper": True, "pipeline_class": _Inner}
    _hand_on(dispatcher, _counting_where_it_must(numba.njit(*arguments, **options | inner)))
    index = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if index is not None:
        index._source_stamp = kernel_stamp()
        _cached.append(dispatcher)
    return dispatcher


class _LeanTuple(TupleModel):  # type: ignore[misc]
    """A named tuple of contiguous arrays as an argument: where each begins and its shape, from which the rest follows.

    Its value is some hundred numbers, which every call between kernels would hand over.
    """

    def get_argument_type(self) -> Any:
        return tuple(whole[_DATA : _SHAPE + 1] for whole in super().get_argument_type())

    def as_argument(self, builder: Any, value: Any) -> Any:
        def part(*place: int) -> Any:
            return builder.extract_value(value, place)

        sizes = enumerate(each.ndim for each in self._members)
        return tuple((part(i, _DATA), tuple(part(i, _SHAPE, axis) for axis in range(n))) for i, n in sizes)

    def from_argument(self, builder: Any, value: Any) -> Any:
        """Put the arrays together; nobody counts references to them, and no object of Python's owns them."""
        kinds = self.get_value_type().elements
        struct = ir.Constant(self.get_value_type(), list(map(_blank, kinds, self._members)))
        for i, (data, shape) in enumerate(value):
            struct = builder.insert_value(struct, data, (i, _DATA))
            items = shape[-1]
            for axis in reversed(range(len(shape))):
                struct = builder.insert_value(struct, shape[axis], (i, _SHAPE, axis))
                if axis > 0:
                    stride = builder.mul(items, items.type(self._members[i].dtype.bitwidth // 8))
                    struct = builder.insert_value(struct, stride, (i, _STRIDES, axis - 1))
                    items = builder.mul(items, shape[axis - 1])
            struct = builder.insert_value(struct, items, (i, _ITEMS))
        return struct


def _blank(kind: Any, array: Any) -> ir.Constant:
    """Return an array of nothing."""
    meminfo, parent, number, _, data, shape, strides = kind.elements
    size = number(array.dtype.bitwidth // 8)
    parts = [meminfo(None), parent(None), number(0), size, data(None), shape(None), strides([size] * array.ndim)]
    return ir.Constant(kind, parts)


def _named_tuple_model(manager: DataModelManager, named_tuple: numba.types.NamedTuple) -> TupleModel:
    own = named_tuple.instance_class.__module__.startswith("fusion.")
    return (_LeanTuple if own and all(map(_is_contiguous, named_tuple)) else TupleModel)(manager, named_tuple)


def _is_contiguous(member: numba.types.Type) -> bool:
    return isinstance(member, numba.types.Array) and member.layout == "C"


default_manager.register(numba.types.NamedTuple, _named_tuple_model)


def kernels_from_scratch() -> int:
    """Return how many kernels this process has compiled and put on disk, not counting those found there."""
    return sum(sum(dispatcher.stats.cache_misses.values()) for dispatcher in _cached)


def _counting_where_it_must(dispatcher: Any) -> Any:
    """Let a dispatcher count references after all where numba finds that it must: for copies, for a new array."""
    compile_without = dispatcher.compile

    def compile_with_or_without(signature: Any) -> Any:
        try:
            return compile_without(signature)
        except NumbaError as error:
            must = any(words in str(error) for words in ("NRT required", "Only accept return"))
            if dispatcher.targetoptions["_nrt"] or not must:
                raise
            dispatcher.targetoptions["_nrt"] = True
            dispatcher._compiler._failed_cache.clear()
            return compile_without(signature)

    dispatcher.compile = compile_with_or_without
    return dispatcher


def _hand_on(dispatcher: Any, inner: Any) -> None:
    """Let kernels that call this dispatcher take the code of another, which is for them only."""

    def get_call_template(types: Sequence[Any], named: dict[str, Any]) -> Any:
        found = inner.get_call_template([numba.types.unliteral(one) for one in types], named)
        for signature in inner.nopython_signatures:
            parts = getattr(signature.return_type, "types", ())
            if not inner.targetoptions["_nrt"] and any(isinstance(one, numba.types.Array) for one in parts):
                raise TypeError(f"{inner.py_func.__qualname__} returns arrays: give its njit _nrt=True")
        return found

    dispatcher.get_call_template, dispatcher.get_overload = get_call_template, inner.get_overload


class _Unoptimised(JITCodeLibrary):  # type: ignore[misc]
    """The code of a kernel that only other kernels call: there is none of its own, its callers link it in."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    @property
    def codegen(self) -> Any:
        return self

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: an environment serves code that runs by itself."""


class _Inner(Compiler):  # type: ignore[misc]
    def compile_extra(self, func: FunctionType) -> Any:
        self.state.library = _Unoptimised(self.state.targetctx.codegen(), func.__qualname__)
        return super().compile_extra(func)


@functools.cache
def kernel_stamp() -> str:
    """Return a digest of every module of this package that holds kernels or the numbers they are compiled with."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        source = path.read_bytes()
        if b"fusion.compiled import" in source or path.stem in ("compiled", "nav_state"):
            digest.update(source)
    return digest.hexdigest()
