"""Compiled functions passed by address: for solvers that are called once per control step.

A compiled function handed over as a typed argument (`KERNEL`, ...) costs numba some 30 to 80
microseconds a call, in looking its address up anew. A caller that is called often looks it up once
(`addresses`) and passes integers; inside, `kernel_at` and its like make functions of them again.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

ADDRESSES = types.Array(types.intp, 2, "C")

_BEHIND: dict[int, Any] = {}


def addresses(functions: Sequence[Any]) -> NDArray[np.intp]:
    """`[k, 2]` addresses of compiled functions (C convention, numba's own), one signature each.

    They hold as long as the functions live, in this process only.
    """
    rows = []
    for function in functions:
        (signature,) = function.nopython_signatures
        compiled = function.get_compile_result(signature)
        library, names = compiled.library, compiled.fndesc
        rows.append(
            [
                library.get_pointer_to_function(names.llvm_cfunc_wrapper_name),
                library.get_pointer_to_function(names.llvm_func_name),
            ]
        )
        _BEHIND[rows[-1][0]] = function
    return np.array(rows, dtype=np.intp)


def function_behind(c_address: int) -> Any:
    """The function of which `addresses` gave this first number."""
    return _BEHIND[c_address]


@cache
def address(function: Any) -> NDArray[np.intp]:
    """`addresses` of one function, looked up once; the function is kept alive with it."""
    return addresses([function])


def function_at(function_type: types.FunctionType) -> Any:
    """The compiled conversion (row of `addresses`) -> callable of `function_type`."""

    @intrinsic
    def convert(typingctx, c_address, numba_address):  # noqa: ARG001
        def codegen(context, builder, signature, arguments):  # noqa: ARG001
            struct = cgutils.create_struct_proxy(function_type)(context, builder)
            pointer = context.get_value_type(types.voidptr)
            struct.c_addr = builder.inttoptr(arguments[0], pointer)
            struct.jit_addr = builder.inttoptr(arguments[1], pointer)
            return struct._getvalue()

        return function_type(types.intp, types.intp), codegen

    return convert
