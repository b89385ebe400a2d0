"""numba's njit, with a cache on disk that notices a change of any kernel.

numba looks at the age of a function's own file only. After a change in a module from which it takes other functions or
constants it would go on running the old code, on memory that is laid out anew.
"""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any

import numba


def njit(*arguments: Any, **options: Any) -> Any:
    """Do what numba.njit does; with cache=True the cache is as old as the newest source of a kernel."""
    if not (arguments and callable(arguments[0])):
        return lambda function: njit(function, *arguments, **options)
    dispatcher = numba.njit(*arguments, **options)
    index = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if index is not None:
        index._source_stamp = kernel_stamp()
    return dispatcher


@functools.cache
def kernel_stamp() -> str:
    """Return a digest of every module of this package that holds kernels or the numbers they are compiled with."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        source = path.read_bytes()
        if b"fusion.compiled import" in source or path.stem in ("compiled", "nav_state"):
            digest.update(source)
    return digest.hexdigest()
