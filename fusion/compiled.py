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
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.errors import NumbaError

ALLOCATES = frozenset({"zeros", "empty", "ones", "full", "array", "arange", "copy"})

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
