"""The linear system of a Newton step of multiple shooting, solved from the end to the start.

A basis of the terminal manifold's tangents is carried backward through the segments, made
orthonormal at each node (Godunov 1961): those are the growing solutions, so nothing is lost to
their growth.
"""

import math

import numpy as np
from numba import types

from ocp.compiled.jit import MATRIX, VECTOR, compiled
from ocp.extremals.hamiltonian_flow import CUBE, INTEGERS

# The types of `factor`, `newton_step` and `solve`
FACTOR = types.FunctionType(
    types.boolean(INTEGERS, types.boolean, MATRIX, CUBE, MATRIX, CUBE, CUBE)
)
NEWTON_STEP = types.FunctionType(
    types.boolean(INTEGERS, MATRIX, CUBE, MATRIX, CUBE, CUBE, VECTOR, MATRIX)
)
SOLVE = types.FunctionType(types.boolean(MATRIX, VECTOR))


@compiled(types.boolean(INTEGERS, types.boolean, MATRIX, CUBE, MATRIX, CUBE, CUBE))
def factor(layout, free_time, edge, linear, speeds, basis, triangle):
    """Carry the tangents of the manifold backward: `basis[k]` `[2n + 1, n]` at node k, with the
    change of duration as last row, orthonormal; `triangle[k]` turns coordinates at node k into
    those at node k - 1. Returns whether the basis kept its rank.
    """
    n = layout[0]
    count = linear.shape[0]
    last = basis[count]
    last[:] = 0.0
    for j in range(edge.shape[1]):
        for i in range(2 * n):
            last[i, j] = edge[i, j]
    if free_time:
        last[2 * n, n - 1] = 1.0
    for k in range(count, 0, -1):
        here, there, right = basis[k - 1], basis[k], triangle[k]
        right[:] = 0.0
        for c in range(n):
            for i in range(2 * n):
                total = speeds[k - 1, i] * there[2 * n, c]
                for j in range(2 * n):
                    total += linear[k - 1, i, j] * there[j, c]
                here[i, c] = total
            here[2 * n, c] = there[2 * n, c]
            # Gram and Schmidt, twice
            for _ in range(2):
                for b in range(c):
                    share = 0.0
                    for i in range(2 * n + 1):
                        share += here[i, b] * here[i, c]
                    right[b, c] += share
                    for i in range(2 * n + 1):
                        here[i, c] -= share * here[i, b]
            length = 0.0
            for i in range(2 * n + 1):
                length += here[i, c] ** 2
            length = math.sqrt(length)
            if not (1e-200 < length < 1e200):
                return False
            right[c, c] = length
            for i in range(2 * n + 1):
                here[i, c] /= length
    return True


@compiled(types.boolean(MATRIX, VECTOR))
def solve(matrix, right):
    """Gauss with row pivoting, in place; whether the matrix is regular."""
    n = right.shape[0]
    for c in range(n):
        pivot = c
        for i in range(c + 1, n):
            if abs(matrix[i, c]) > abs(matrix[pivot, c]):
                pivot = i
        if not abs(matrix[pivot, c]) > 1e-14:
            return False
        if pivot != c:
            for j in range(n):
                matrix[c, j], matrix[pivot, j] = matrix[pivot, j], matrix[c, j]
            right[c], right[pivot] = right[pivot], right[c]
        for i in range(c + 1, n):
            factor = matrix[i, c] / matrix[c, c]
            for j in range(c, n):
                matrix[i, j] -= factor * matrix[c, j]
            right[i] -= factor * right[c]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]
    return True


@compiled(types.boolean(INTEGERS, MATRIX, CUBE, MATRIX, CUBE, CUBE, VECTOR, MATRIX))
def newton_step(layout, gaps, linear, speeds, basis, triangle, ends, step):
    """The Newton step for `gaps`: `step[k]` `[2n + 1]`, the change of z_k and of T, and `ends`
    `[n]`, that of the manifold's coordinates (and T). Returns whether the system is regular.
    """
    n = layout[0]
    count = linear.shape[0]
    shift = np.empty((count, n))
    step[count] = 0.0
    for k in range(count, 0, -1):  # a particular solution, kept orthogonal to the basis
        here, there, frame = step[k - 1], step[k], basis[k - 1]
        for i in range(2 * n):
            total = gaps[k - 1, i] + speeds[k - 1, i] * there[2 * n]
            for j in range(2 * n):
                total += linear[k - 1, i, j] * there[j]
            here[i] = total
        here[2 * n] = there[2 * n]
        for c in range(n):
            share = 0.0
            for i in range(2 * n + 1):
                share += frame[i, c] * here[i]
            shift[k - 1, c] = share
        for c in range(n):
            for i in range(2 * n + 1):
                here[i] -= shift[k - 1, c] * frame[i, c]
    matrix = basis[0, :n].copy()
    for i in range(n):
        ends[i] = -step[0, i]
    if not solve(matrix, ends):
        return False
    for k in range(count + 1):
        if k > 0:
            for i in range(n):
                ends[i] -= shift[k - 1, i]
            for i in range(n - 1, -1, -1):
                for j in range(i + 1, n):
                    ends[i] -= triangle[k, i, j] * ends[j]
                ends[i] /= triangle[k, i, i]
        for c in range(n):
            for i in range(2 * n + 1):
                step[k, i] += basis[k, i, c] * ends[c]
    return True
