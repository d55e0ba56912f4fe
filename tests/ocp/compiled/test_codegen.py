"""Generated Python equals CasADi, operation by operation."""

import math

import casadi as ca
import numpy as np
import pytest

from ocp.compiled.codegen import BINARY, UNARY, statements

SAMPLES = (0.3, -0.7, 1.0, 0.0, 2.5, -3.0)


def evaluate(function: ca.Function, *arguments: float) -> float:
    """Run the generated statements in plain Python."""
    names = [f"in{i}[{{0}}]" for i in range(function.n_in())]
    scope: dict = {"math": math, "out": [0.0]}
    scope |= {f"in{i}": [a] for i, a in enumerate(arguments)}
    exec("\n".join(statements(function, names, ["out[{0}]"])), scope)
    return scope["out"][0]


def agree(function: ca.Function, *arguments: float) -> None:
    expected = float(function(*arguments))
    if not math.isfinite(expected):
        return  # plain Python raises where compiled code and CasADi return nan or inf
    assert evaluate(function, *arguments) == pytest.approx(expected, rel=1e-15, abs=1e-300)


@pytest.mark.parametrize(
    "make",
    [
        lambda x: -x,
        lambda x: x**2,
        lambda x: 2 * x,
        lambda x: ca.sqrt(x**2),
        ca.exp,
        lambda x: ca.log(ca.fabs(x) + 1),
        ca.log1p,
        ca.expm1,
        ca.sin,
        ca.cos,
        ca.tan,
        lambda x: ca.asin(x / 4),
        lambda x: ca.acos(x / 4),
        ca.atan,
        ca.sinh,
        ca.cosh,
        ca.tanh,
        ca.fabs,
        lambda x: 1 / (x + 10),
        ca.floor,
        ca.ceil,
        ca.sign,
        lambda x: ca.logic_not(x > 0),
    ],
)
def test_unary_operations(make) -> None:
    x = ca.SX.sym("x")
    function = ca.Function("f", [x], [make(x)])
    for a in SAMPLES:
        if not (a <= -1 and "log1p" in str(function)):
            agree(function, a)


@pytest.mark.parametrize(
    "make",
    [
        lambda x, y: x + y,
        lambda x, y: x - y,
        lambda x, y: x * y,
        lambda x, y: x / (y + 10),
        lambda x, y: ca.fabs(x) ** y,
        lambda x, y: (x + 10) ** 3.5 + y,
        ca.atan2,
        ca.hypot,
        ca.fmin,
        ca.fmax,
        lambda x, y: x < y,
        lambda x, y: x <= y,
        lambda x, y: x == y,
        lambda x, y: x != y,
        lambda x, y: ca.logic_and(x > 0, y > 0),
        lambda x, y: ca.logic_or(x > 0, y > 0),
        lambda x, y: ca.if_else(x > y, x, 3 * y),
    ],
)
def test_binary_operations(make) -> None:
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    function = ca.Function("f", [x, y], [make(x, y)])
    for a in SAMPLES:
        for b in SAMPLES:
            if a == 0 and b < 0:
                continue  # 0 to a negative power
            agree(function, a, b)


def test_infinite_constants_survive() -> None:
    x = ca.SX.sym("x")
    function = ca.Function("f", [x], [ca.fmin(x, np.inf)])
    assert evaluate(function, 2.0) == 2.0


def test_sparse_outputs_and_unknown_operations_are_refused() -> None:
    x = ca.SX.sym("x", 2)
    sparse = ca.Function("f", [x], [ca.diag(x)])
    with pytest.raises(ValueError, match="output 0 is sparse"):
        statements(sparse, ["x[{0}]"], ["out[{0}]"])
    unknown = ca.Function("g", [x], [ca.erf(x)])
    with pytest.raises(ValueError, match="has no translation"):
        statements(unknown, ["x[{0}]"], ["out[{0}]"])


def test_no_operation_is_listed_twice() -> None:
    assert not UNARY.keys() & BINARY.keys()
