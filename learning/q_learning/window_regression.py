"""Regression of a plant's integral identity on windows of sampled motion.

For x' = A x + B u and the monomials z = [x_i x_j, i <= j] every symmetric P gives, over a window,

    change of x'P x = integral of x'(A'P + P A) x + 2 u'B'P x.

Both sides are linear in z, so  change of z = Theta' [integral of z; integral of u_k x_i]  with one
unknown matrix Theta `[p, q]`, q = n(n+1)/2, p = q + mn, and the plant itself never appears.
After Bian and Jiang, "Value iteration and adaptive dynamic programming for data-driven adaptive
optimal control design", Automatica 71 (2016).

The input is held while a hold's samples are taken, so that the integrands are smooth between the
hold's ends and a high-order rule applies; across a change of the input nothing beats the trapezoid
rule. A window is a number of holds; windows slide by one hold.

The regression is recursive: one Givens rotation per unknown and row keeps the triangular factor of
the regressors. Normal equations (the usual covariance form) would square the condition number,
which reaches 1e7 in use.
"""

from functools import cache
from time import thread_time

import numpy as np
from numba import float64, int64, njit, types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled

Array = NDArray[np.float64]

FILLED, HEAD, ROWS = 0, 1, 2


@cache
def quadrature(substeps: int) -> Array:
    """Two rules `[2, substeps + 1]` on equidistant samples, in units of the sample period.

    The first is the closed Newton-Cotes rule (trapezoid, Simpson, 3/8, Boole, ...) and is used; the
    second is of lower order, and their difference estimates the error of the first, on the safe
    side. One substep leaves only the rectangle rule to compare with.

    Raises:
        ValueError: unless 1 <= substeps <= 7 (beyond, the rule has negative weights).
    """
    if not 1 <= substeps <= 7:
        raise ValueError(f"substeps: must be 1 to 7, got {substeps}")
    nodes = np.arange(substeps + 1.0)
    powers = np.arange(substeps + 1)
    fine = np.linalg.solve(
        nodes[None] ** powers[:, None], substeps ** (powers + 1.0) / (powers + 1)
    )
    coarse = np.zeros(substeps + 1)
    if substeps == 1:
        coarse[0] = 1.0
    elif substeps % 2 == 0 and substeps > 2:
        for k in range(0, substeps, 2):
            coarse[k : k + 3] += np.array([1.0, 4.0, 1.0]) / 3.0
    else:
        for k in range(substeps):
            coarse[k : k + 2] += 0.5
    return np.array([fine, coarse], dtype=np.float64)


@njit(cache=True, error_model="numpy")
def _monomials(x, out):
    index = 0
    for i in range(x.shape[0]):
        for j in range(i, x.shape[0]):
            out[index] = x[i] * x[j]
            index += 1


@njit(cache=True, error_model="numpy")
def _hold_integrals(samples, u, weights, step, z, out):
    """`out[0]`: the regressors integrated over one hold; `out[1]`: by how much the rules differ."""
    n, m, q = samples.shape[1], u.shape[0], z.shape[0]
    out[:] = 0.0
    for k in range(samples.shape[0]):
        fine, difference = weights[0, k] * step, (weights[0, k] - weights[1, k]) * step
        _monomials(samples[k], z)
        for i in range(q):
            out[0, i] += fine * z[i]
            out[1, i] += difference * z[i]
        for i in range(n):
            out[0, q + i] += fine * samples[k, i]
            out[1, q + i] += difference * samples[k, i]
    for rule in range(2):
        for k in range(m - 1, -1, -1):
            for i in range(n):
                out[rule, q + k * n + i] = u[k] * out[rule, q + i]


@njit(cache=True, error_model="numpy")
def _rotate_in(triangle, rotated, residual, row, right):
    """Add one equation row Theta = right to the triangular system; both are overwritten."""
    p, width, q = row.shape[0], right.shape[0], residual.shape[0]
    for j in range(p):
        if row[j] == 0.0:
            continue
        length = np.hypot(triangle[j, j], row[j])
        c, s = triangle[j, j] / length, row[j] / length
        triangle[j, j] = length
        for k in range(j + 1, p):
            above = triangle[j, k]
            triangle[j, k] = c * above + s * row[k]
            row[k] = c * row[k] - s * above
        for k in range(width):
            above = rotated[j, k]
            rotated[j, k] = c * above + s * right[k]
            right[k] = c * right[k] - s * above
    for i in range(q):
        for k in range(q):
            residual[i, k] += right[i] * right[k]


@compiled(
    types.void(
        MATRIX,
        MATRIX,
        MATRIX,
        float64,
        float64,
        float64[:, :, ::1],
        MATRIX,
        int64[::1],
        VECTOR,
        MATRIX,
        MATRIX,
        MATRIX,
    )
)
def _absorb(
    samples,
    inputs,
    weights,
    step,
    memory,
    integrals,
    ends,
    counters,
    moments,
    triangle,
    rotated,
    residual,
):
    """Take in a stretch of motion: `inputs` `[k, m]` each held over the rule's samples."""
    q, p, window = ends.shape[1], triangle.shape[0], integrals.shape[0]
    substeps = weights.shape[1] - 1
    z, row, right = np.empty(q), np.empty(p), np.empty(q + p)
    if counters[FILLED] == 0:
        counters[HEAD] = 0
        _monomials(samples[0], ends[0])
    for k in range(inputs.shape[0]):
        piece = samples[k * substeps : (k + 1) * substeps + 1]
        head = counters[HEAD]
        _hold_integrals(piece, inputs[k], weights, step, z, integrals[head % window])
        for i in range(q):
            moments[i] = memory * moments[i] + integrals[head % window, 0, i]
        _monomials(piece[substeps], ends[(head + 1) % (window + 1)])
        counters[HEAD] = head + 1
        counters[FILLED] = min(counters[FILLED] + 1, window)
        if counters[FILLED] < window:
            continue
        row[:] = 0.0
        right[:] = 0.0
        for w in range(window):
            for i in range(p):
                row[i] += integrals[w, 0, i]
                right[q + i] += integrals[w, 1, i]
        for i in range(q):
            right[i] = ends[(head + 1) % (window + 1), i] - ends[(head + 2) % (window + 1), i]
        if memory < 1.0:
            triangle *= np.sqrt(memory)
            rotated *= np.sqrt(memory)
            residual *= memory
        _rotate_in(triangle, rotated, residual, row, right)
        counters[ROWS] += 1


class WindowRegression:
    """The regression's state: init, `absorb`, and the triangular system to solve.

    Attributes:
        n, m, p, q: states, inputs, unknowns per output, outputs.
        substeps: samples a hold, beyond its first.
        window: holds a window.
        memory: factor on all older information at each new row; 1 forgets nothing.
        triangle: `[p, p]`, upper triangular factor of the regressors.
        rotated: `[p, q + p]`, in the same rotated frame the changes of z (first q columns) and the
            difference between the two quadrature rules.
        residual: `[q, q]`, the sum of outer products of the rows' residuals.
        moments: `[q]`, the integrals of x_i x_j (i <= j) over all that was absorbed.
    """

    def __init__(
        self, n: int, m: int, sample_period: float, substeps: int, window: int, memory: float
    ) -> None:
        self.n, self.m = n, m
        self.q = n * (n + 1) // 2
        self.p = self.q + m * n
        self.sample_period, self.substeps = sample_period, substeps
        self.window, self.memory = window, memory
        self.triangle = np.zeros((self.p, self.p))
        self.rotated = np.zeros((self.p, self.q + self.p))
        self.residual = np.zeros((self.q, self.q))
        self.moments = np.zeros(self.q)
        self._weights = quadrature(substeps)
        self._integrals = np.zeros((window, 2, self.p))
        self._ends = np.zeros((window + 1, self.q))
        self._counters = np.zeros(3, dtype=np.int64)

    @property
    def rows(self) -> int:
        """Windows taken in so far."""
        return int(self._counters[ROWS])

    @property
    def effective_rows(self) -> float:
        """Windows still remembered, each by the weight it has left."""
        if self.memory == 1.0:
            return float(self.rows)
        return (1.0 - self.memory**self.rows) / (1.0 - self.memory)

    def absorb(self, samples: ArrayLike, inputs: ArrayLike) -> float:
        """Take in states `[k * substeps + 1, n]` while each of the inputs `[k, m]` was held.

        Continues the motion absorbed before (the first state is the last one again) unless
        `interrupt` was called in between. Returns the CPU seconds that the compiled update took.

        Raises:
            ValueError: if the shapes do not fit or a number is not finite.
        """
        states = np.ascontiguousarray(samples, dtype=float)
        held = np.ascontiguousarray(inputs, dtype=float)
        if held.ndim != 2 or held.shape[1] != self.m:
            raise ValueError(f"inputs: must have shape (k, {self.m}), got {held.shape}")
        wanted = (len(held) * self.substeps + 1, self.n)
        if states.shape != wanted:
            raise ValueError(f"samples: must have shape {wanted}, got {states.shape}")
        if not (np.isfinite(states).all() and np.isfinite(held).all()):
            raise ValueError("samples, inputs: numbers must be finite")
        begun = thread_time()
        _absorb(
            states,
            held,
            self._weights,
            self.sample_period,
            self.memory,
            self._integrals,
            self._ends,
            self._counters,
            self.moments,
            self.triangle,
            self.rotated,
            self.residual,
        )
        return thread_time() - begun

    def interrupt(self) -> None:
        """The motion jumps (a new waypoint, a lost sample): drop the windows that would span it."""
        self._counters[FILLED] = 0
