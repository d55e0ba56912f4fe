"""Bounds of CasADi functions over boxes, by interval arithmetic on whole arrays of boxes.

Where nothing is known (a divisor may be 0) the bounds are infinite. Rounding is not directed: a
caller that certifies adds a relative slack far above 1e-12.
"""

from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Interval = tuple[NDArray[np.float64], NDArray[np.float64]]


def _product(a: Interval, b: Interval) -> Interval:
    with np.errstate(invalid="ignore"):
        corners = [x * y for x in a for y in b]
    low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
    return np.where(np.isnan(low), -np.inf, low), np.where(np.isnan(high), np.inf, high)


def _quotient(a: Interval, b: Interval) -> Interval:
    """Everything where the divisor may be 0."""
    sure = (b[0] > 0) | (b[1] < 0)
    low, high = _product(a, (1 / np.where(sure, b[1], 1.0), 1 / np.where(sure, b[0], 1.0)))
    return np.where(sure, low, -np.inf), np.where(sure, high, np.inf)


def _square(a: Interval) -> Interval:
    low, high = np.abs(a[0]), np.abs(a[1])
    across = (a[0] <= 0) & (a[1] >= 0)
    return np.where(across, 0.0, np.minimum(low, high) ** 2), np.maximum(low, high) ** 2


def _absolute(a: Interval) -> Interval:
    low, high = _square(a)
    return np.sqrt(low), np.sqrt(high)


def _sine(a: Interval) -> Interval:
    """The ends, and 1 or -1 where a crest or trough lies between."""
    low, high = np.sin(a[0]), np.sin(a[1])

    def holds(phase: float) -> NDArray[np.bool_]:
        return np.floor((a[1] - phase) / (2 * np.pi)) > np.floor((a[0] - phase) / (2 * np.pi)) - (
            np.abs(np.sin((a[0] - phase) / 2)) < 1e-9
        )

    top = np.where(holds(np.pi / 2), 1.0, np.maximum(low, high))
    return np.where(holds(-np.pi / 2), -1.0, np.minimum(low, high)), top


def _truth(sure: NDArray[np.bool_], possible: NDArray[np.bool_]) -> Interval:
    """1 where sure, 0 where impossible, [0, 1] between."""
    return sure.astype(float), possible.astype(float)


def _sign(a: Interval) -> Interval:
    return np.sign(a[0]), np.sign(a[1])


def _not(a: Interval) -> Interval:
    return _truth((a[0] == 0) & (a[1] == 0), (a[0] <= 0) & (a[1] >= 0))


def _if_else_zero(a: Interval, b: Interval) -> Interval:
    sure, impossible = (a[0] > 0) | (a[1] < 0), (a[0] == 0) & (a[1] == 0)
    low = np.where(sure, b[0], np.where(impossible, 0.0, np.minimum(b[0], 0.0)))
    return low, np.where(sure, b[1], np.where(impossible, 0.0, np.maximum(b[1], 0.0)))


def _increasing(function: Callable) -> Callable[[Interval], Interval]:
    return lambda a: (function(a[0]), function(a[1]))


UNARY: dict[int, Callable[[Interval], Interval]] = {
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_NEG: lambda a: (-a[1], -a[0]),
    ca.OP_TWICE: lambda a: (2 * a[0], 2 * a[1]),
    ca.OP_SQ: _square,
    ca.OP_FABS: _absolute,
    ca.OP_SQRT: _increasing(np.sqrt),
    ca.OP_EXP: _increasing(np.exp),
    ca.OP_TANH: _increasing(np.tanh),
    ca.OP_INV: lambda a: _quotient((np.ones(()), np.ones(())), a),
    ca.OP_SIGN: _sign,
    ca.OP_NOT: _not,
    ca.OP_SIN: _sine,
    ca.OP_COS: lambda a: _sine((a[0] + np.pi / 2, a[1] + np.pi / 2)),
}
BINARY: dict[int, Callable[[Interval, Interval], Interval]] = {
    ca.OP_ADD: lambda a, b: (a[0] + b[0], a[1] + b[1]),
    ca.OP_SUB: lambda a, b: (a[0] - b[1], a[1] - b[0]),
    ca.OP_MUL: _product,
    ca.OP_DIV: _quotient,
    ca.OP_FMAX: lambda a, b: (np.maximum(a[0], b[0]), np.maximum(a[1], b[1])),
    ca.OP_LT: lambda a, b: _truth(a[1] < b[0], a[0] < b[1]),
    ca.OP_LE: lambda a, b: _truth(a[1] <= b[0], a[0] <= b[1]),
    ca.OP_EQ: lambda a, b: _truth(
        (a[0] == a[1]) & (b[0] == b[1]) & (a[0] == b[0]), (a[0] <= b[1]) & (b[0] <= a[1])
    ),
    ca.OP_IF_ELSE_ZERO: _if_else_zero,
    ca.OP_FMIN: lambda a, b: (np.minimum(a[0], b[0]), np.minimum(a[1], b[1])),
}


def bounds(function: ca.Function, boxes: Sequence[Interval]) -> list[Interval]:
    """Bounds of each entry of an SX function's one dense output, column by column.

    Args:
        function: of one dense vector.
        boxes: lower and upper ends of each of the vector's entries; arrays that broadcast.

    Raises:
        ValueError: if an operation has no bounds here.
    """
    with np.errstate(over="ignore"):  # an infinite bound is a bound
        return _bounds(function, boxes)


def _bounds(function: ca.Function, boxes: Sequence[Interval]) -> list[Interval]:
    work: dict[int, Interval] = {}
    out: dict[int, Interval] = {}
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        sources, targets = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            work[targets[0]] = boxes[sources[1]]
        elif operation == ca.OP_OUTPUT:
            out[targets[1]] = work[sources[0]]
        elif operation == ca.OP_CONST:
            constant = np.asarray(function.instruction_constant(k))
            work[targets[0]] = constant, constant
        elif operation in UNARY:
            work[targets[0]] = UNARY[operation](work[sources[0]])
        elif operation in BINARY:
            work[targets[0]] = BINARY[operation](*(work[s] for s in sources))
        else:
            raise ValueError(f"interval: CasADi operation {operation} has no bounds")
    return [out[k] for k in range(len(out))]
