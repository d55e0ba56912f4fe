"""The Riccati sweep through a learned map: P(t) backward from P(T), without A and B.

With c the coefficients of x'P x in the monomials [x_i x_j, i <= j], Theta c = [h; l] holds the
coefficients of x'(A'P + P A) x and of 2 u'B'P x: H = mat(h), where mat halves the off-diagonal
coefficients, and L = mat(l)/2 = B'P. Then -dP/dt = M + H - L'R^-1 L.
"""

import numpy as np
from numba import float64, int64, njit, types

from ocp.compiled.jit import MATRIX, VECTOR, compiled

# Dormand and Prince, 1980: fifth order with an embedded fourth; the last stage is the next first.
_STAGES = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
_ERROR = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])


@njit(cache=True, error_model="numpy")
def _apply(theta, c, h, L):
    """[h; l] = Theta c, with L = mat(l)/2 `[m, n]`."""
    q, (m, n) = c.shape[0], L.shape
    for i in range(q):
        total = 0.0
        for k in range(q):
            total += theta[i, k] * c[k]
        h[i] = total
    for a in range(m):
        for b in range(n):
            total = 0.0
            for k in range(q):
                total += theta[q + a * n + b, k] * c[k]
            L[a, b] = 0.5 * total


@njit(cache=True, error_model="numpy")
def _rate(theta, mass, R_inverse, c, h, L, RL, out):
    """dc/ds = coefficients of M + H - L'R^-1 L, with s = T - t the time to go."""
    m, n = L.shape
    _apply(theta, c, h, L)
    for a in range(m):
        for b in range(n):
            total = 0.0
            for k in range(m):
                total += R_inverse[a, k] * L[k, b]
            RL[a, b] = total
    index = 0
    for i in range(n):
        for j in range(i, n):
            quadratic = 0.0
            for a in range(m):
                quadratic += L[a, i] * RL[a, j]
            out[index] = mass[index] + h[index] - (1.0 if i == j else 2.0) * quadratic
            index += 1


@njit(cache=True, error_model="numpy")
def _second_rate(theta, R_inverse, c, first, h, L, L_rate, out):
    """d2c/ds2, by differentiating the sweep once."""
    m, n = L.shape
    _apply(theta, c, h, L)
    _apply(theta, first, h, L_rate)
    index = 0
    for i in range(n):
        for j in range(i, n):
            mixed = 0.0
            for a in range(m):
                for b in range(m):
                    weight = R_inverse[a, b]
                    mixed += weight * (L_rate[a, i] * L[b, j] + L[a, i] * L_rate[b, j])
            out[index] = h[index] - (1.0 if i == j else 2.0) * mixed
            index += 1


@compiled(
    int64(
        MATRIX,
        VECTOR,
        MATRIX,
        VECTOR,
        types.UniTuple(int64, 2),
        float64,
        float64,
        VECTOR,
        float64[:, :, ::1],
    )
)
def sweep(theta, mass, R_inverse, terminal, shape, horizon, tolerance, times, nodes):
    """Integrate from the end; fills `times` (to go) and `nodes` `[k, 3, q]` (c and its two rates).

    `shape` is (n, m); `mass` and `terminal` `[q]` are coefficients of M and P_T. Returns the number
    of nodes, or -1 if P grew without bound or the nodes ran out.
    """
    n, m = shape
    q = mass.shape[0]
    h, L, RL = np.empty(q), np.empty((m, n)), np.empty((m, n))
    k = np.empty((7, q))
    c, trial = terminal.copy(), np.empty(q)
    s, step, count = 0.0, 1e-3 * horizon, 0
    _rate(theta, mass, R_inverse, c, h, L, RL, k[0])
    times[0] = 0.0
    nodes[0, 0], nodes[0, 1] = c, k[0]
    _second_rate(theta, R_inverse, c, k[0], h, L, RL, nodes[0, 2])
    for _ in range(20 * times.shape[0]):
        if s >= horizon * (1.0 - 1e-14):
            return count + 1
        step = min(step, horizon - s)
        for stage in range(1, 7):
            for i in range(q):
                total = 0.0
                for a in range(stage):
                    total += _STAGES[stage, a] * k[a, i]
                trial[i] = c[i] + step * total
            _rate(theta, mass, R_inverse, trial, h, L, RL, k[stage])
        error, scale = 0.0, 0.0
        for i in range(q):
            total = 0.0
            for a in range(7):
                total += _ERROR[a] * k[a, i]
            error = max(error, abs(step * total))
            scale = max(scale, abs(trial[i]), abs(c[i]))
        if not np.isfinite(error) or not np.isfinite(scale):
            return -1
        ratio = error / (tolerance * scale) if scale > 0.0 else 0.0
        if ratio <= 1.0:
            if count + 1 >= times.shape[0]:
                return -1
            s += step
            count += 1
            c[:] = trial
            k[0] = k[6]
            times[count] = s
            nodes[count, 0], nodes[count, 1] = c, k[0]
            _second_rate(theta, R_inverse, c, k[0], h, L, RL, nodes[count, 2])
        factor = 5.0 if ratio < 1e-4 else 0.9 * ratio**-0.2
        step *= min(5.0, max(0.2, factor))
        if step < 1e-12 * horizon:
            return -1
    return -1


@compiled(types.void(VECTOR, float64[:, :, ::1], VECTOR, MATRIX, MATRIX))
def interpolate(times, nodes, wanted, values, rates):
    """The quintic through `nodes` `[k, 3, q]` and its rate, both `[w, q]`, at times `wanted` `[w]`.

    Its error, of sixth order in the step, is below that of the integrator.
    """
    last = times.shape[0] - 2
    for row in range(wanted.shape[0]):
        k = min(max(np.searchsorted(times, wanted[row]) - 1, 0), last)
        h = times[k + 1] - times[k]
        x = (wanted[row] - times[k]) / h
        y = 1.0 - x
        # Hermite basis: value, slope and curvature at the left end; the right end mirrors it.
        value = y**3 * (1.0 + 3.0 * x + 6.0 * x * x), x**3 * (1.0 + 3.0 * y + 6.0 * y * y)
        slope = h * y**3 * x * (1.0 + 3.0 * x), -h * x**3 * y * (1.0 + 3.0 * y)
        curve = 0.5 * h * h * y**3 * x * x, 0.5 * h * h * x**3 * y * y
        value_rate = 30.0 * x * x * y * y / h
        slope_rate = (
            y * y * (1.0 + 2.0 * x - 15.0 * x * x),
            x * x * (1.0 + 2.0 * y - 15.0 * y * y),
        )
        curve_rate = (
            0.5 * h * y * y * x * (2.0 - 5.0 * x),
            -0.5 * h * x * x * y * (2.0 - 5.0 * y),
        )
        for i in range(nodes.shape[2]):
            values[row, i] = (
                value[0] * nodes[k, 0, i]
                + value[1] * nodes[k + 1, 0, i]
                + slope[0] * nodes[k, 1, i]
                + slope[1] * nodes[k + 1, 1, i]
                + curve[0] * nodes[k, 2, i]
                + curve[1] * nodes[k + 1, 2, i]
            )
            rates[row, i] = (
                value_rate * (nodes[k + 1, 0, i] - nodes[k, 0, i])
                + slope_rate[0] * nodes[k, 1, i]
                + slope_rate[1] * nodes[k + 1, 1, i]
                + curve_rate[0] * nodes[k, 2, i]
                + curve_rate[1] * nodes[k + 1, 2, i]
            )
