"""The translation of kernels to C: what Python's statements mean, and what is refused."""

import math
from pathlib import Path

import numpy as np
import pytest
from c_compiler import compiled_policy, needs_compiler
from numba import float32, types
from numpy.testing import assert_allclose

from ocp.c_code.statements import new_module
from ocp.c_code.types import UntranslatableError
from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64
from ocp.compiled.kernel_call import KernelCall
from ocp.export import export_c
from ocp.query_family import paper_query

PAIRS = ((0, 2.0), (1, -3.0))
TABLE = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
SINGLE = types.Array(float32, 2, "C")


@compiled(types.UniTuple(float64, 2)(float64, float64))
def _turned(c, s):
    return (c, s) if c > 0.0 else (-s, c)


@compiled(types.void(MATRIX, MATRIX))
def _loops(states, inputs):
    for row in range(states.shape[0]):
        x = states[row]
        n, first = x.shape[0], 0.0
        a, b = x[0], x[1]
        a, b = b, a  # both are evaluated before either is assigned
        for i in range(n - 1, -1, -1):
            if x[i] < 0.0:
                continue
            first += i * x[i]
            if first > 3.0:
                break
        else_value, count = 0.0, 0
        while count < 3 and else_value < 2.0:
            else_value += abs(x[count]) ** 2
            count += 1
        inputs[row, 0] = first + 10 * a - b + count // 2 + (-7) // 2 + (-7) % 3 + (6 >> 1 & 1 << 1)
        inputs[row, 1] = 0.0
        p, q = _turned(*_turned(a, b))
        for k, weight in ((0, p), (1, q)):
            inputs[row, 1] += weight * TABLE[k, 2] if k > 0 else weight
        inputs[row, 1] += max(a, b, 0.5) - min(a, math.floor(b)) + int(a) + 1 / 2


@compiled(types.void(MATRIX, MATRIX))
def _arrays(states, inputs):
    n = states.shape[1]
    for row in range(states.shape[0]):
        inputs[row] = 0.0
        z = np.zeros(2 * n)
        z[:n] = states[row]
        z[n:] = z[:n] * 2.0 - states[row] / 3.0
        matrix = z.reshape((2, n)).copy()
        matrix += z[:n]
        single = matrix.astype(np.float32)
        square, rest = np.dot(single, single[:, :].copy().reshape((n, 2))), np.empty(2)
        rest[:] = 1.0
        rest *= np.exp(-square[0, 0])
        inputs[row] += rest
        inputs[row] -= square[1]


@pytest.mark.parametrize("kernel", [_loops, _arrays], ids=["loops", "arrays"])
@needs_compiler
def test_c_does_what_python_does(kernel, tmp_path: Path) -> None:
    class Tested:
        """A policy of two inputs for three states."""

        query = paper_query((4.0, 4.0))
        kernel_call = KernelCall(kernel)

    states = np.random.default_rng(0).normal(0.0, 1.5, (300, 3))
    expected = np.zeros((300, 2))
    for row, out in zip(states, expected, strict=True):
        kernel.py_func(row[None].copy(), out[None])
    run = compiled_policy(export_c(Tested(), tmp_path))  # pyright: ignore[reportArgumentType]
    found = run(states)
    tolerance = 2e-5 if kernel is _arrays else 1e-13  # single precision, or double
    assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


@compiled(types.void(VECTOR))
def _strided(x):
    y = np.empty((3, 3))
    x[:] = y[:, 0]


@compiled(types.void(VECTOR))
def _outlives(x):
    for i in range(2):
        y = np.zeros(3)
        y[0] = i
    x[0] = y[0]  # pyright: ignore[reportPossiblyUnboundVariable]


@compiled(types.void(VECTOR))
def _sorts(x):
    x[:] = np.sort(x)


@pytest.mark.parametrize(
    ("kernel", "complaint"),
    [
        (_strided, "not a contiguous part"),
        (_outlives, "read outside the block"),
        (_sorts, "no translation: np.sort"),
    ],
    ids=["strided", "outlives", "sorts"],
)
def test_what_has_no_translation_is_refused(kernel, complaint: str) -> None:
    with pytest.raises(UntranslatableError, match=complaint):
        new_module().name_of(kernel)
