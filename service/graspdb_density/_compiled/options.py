"""Numba's options, said once.

Compiled functions carry no annotations: Numba infers their types. Everything is cached on disk beside the
package (or in the user's cache where that is read-only) and runs without the interpreter lock.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from numba import njit

__all__ = ["exact", "fast", "inlined"]

_Function = Callable[..., Any]


def fast(function: _Function) -> _Function:
    """Compile with reassociation, so that sums turn into vector code; no use of nan or infinity inside."""
    return cast(_Function, njit(fastmath=True, error_model="numpy", nogil=True, cache=True)(function))


def exact(function: _Function) -> _Function:
    """Compile with IEEE arithmetic in the order written."""
    return cast(_Function, njit(error_model="numpy", nogil=True, cache=True)(function))


def inlined(function: _Function) -> _Function:
    """Compile into every caller."""
    return cast(_Function, njit(inline="always")(function))
