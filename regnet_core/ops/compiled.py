"""How functions are compiled: without the GIL, and with a cache on disk where there is a place for one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile the function at its first call; later processes take it from the cache.

    Division by 0 gives infinity or NaN, as numpy's does: a loop that could raise at every turn would be done number by
    number.

    numba keeps the cache beside the source file or in the user's home. Where it can write to neither (a read-only
    installation, a service without a home), each process compiles anew, which takes some seconds.

    The key of a cache entry is the text of the function's own file only: after an edit of an ``inlined`` function, or
    of one that is written as LLVM's code, the caches of the files that use it are stale. Delete their
    ``__pycache__/*.nbi`` then.
    """
    return _compiled(function)


def compiled_with_any_order(function: Function) -> Function:
    """The same, with sums of floats in any order, so that several numbers are added at a time."""
    return _compiled(function, fastmath={"reassoc", "nsz", "contract"})


def _compiled(function: Function, **options: Any) -> Function:
    options = {"nogil": True, "error_model": "numpy", **options}
    try:
        return cast(Function, njit(cache=True, **options)(function))
    except RuntimeError:  # numba's way to say that no locator finds a place for the cache
        return cast(Function, njit(**options)(function))


def inlined(function: Function) -> Function:
    """Make the function part of every compiled function that calls it; it has no cache of its own."""
    return cast(Function, njit(nogil=True, error_model="numpy", inline="always")(function))
