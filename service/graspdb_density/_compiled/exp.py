"""The exponential of every compiled loop: float32, straight-line code that LLVM turns into vectors.

It is a power of two: the argument over ln 2 is split into its nearest integer, which goes to the exponent's
bits, and a rest, of which a fifth-degree polynomial is taken. The error grows with the argument, like that of
the arguments themselves, and it is half the work of an exact reduction (Cephes expf).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from .options import inlined

F32 = np.float32
LOG2E = F32(1.44269504088896341)
#: 2^r over -1/2 <= r <= 1/2, least largest relative error (7.5e-8): fitted by weighted least squares.
_P0, _P1, _P2 = F32(1.00000007), F32(0.69314697), F32(0.2402212)
_P3, _P4, _P5 = F32(0.05550713), F32(0.00967554), F32(0.00132765)
#: 2^-108 times a weight is still a normal number: results that are not cost a hundred cycles each.
_FLOOR = F32(-108.0)


@intrinsic
def _times_power_of_two(typing_context: Any, value: Any, power: Any) -> Any:
    """A float32 times 2^power (int32), both factors and the product normal: added to the exponent's bits."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        bits = builder.bitcast(arguments[0], ir.IntType(32))
        raised = builder.add(bits, builder.shl(arguments[1], ir.Constant(ir.IntType(32), 23)))
        return builder.bitcast(raised, ir.FloatType())

    return types.float32(types.float32, types.int32), generate


@inlined
def exp2(t: Any) -> Any:
    """2^t in float32 for -108 <= t <= 115, relative error below 3e-7 + 6e-8 |t|; smaller t give 2^-108."""
    t = max(t, _FLOOR)
    k = np.rint(t)
    r = t - k
    y = _P5 * r + _P4
    y = y * r + _P3
    y = y * r + _P2
    y = y * r + _P1
    y = y * r + _P0
    return _times_power_of_two(y, np.int32(k))  # type: ignore[call-arg]


@inlined
def exp(x: Any) -> Any:
    """e^x in float32 for -75 <= x <= 80, relative error below 3e-7 + 1e-7 |x|; smaller x give 3e-33."""
    return exp2(x * LOG2E)
