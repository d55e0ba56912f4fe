"""Integration of the Hamiltonian flow x' = dH/dp, p' = -dH/dx both ways in time, with tangents.

Dormand and Prince's pair of orders 5 and 4 (1980), with local extrapolation. The running cost has
kinks, where p' jumps: on a polygon's penalty where the facet that attains its gauge changes, and on
the goal's boundary. A step is therefore taken with the facets frozen and the goal cost as it was,
which makes the flow smooth, and cut where a kink is reached; there tangents (sensitivities) get the
jump of a perturbed crossing time (the saltation matrix).
"""

import math
from functools import cache

import numpy as np
from numba import int64, types
from numpy.typing import NDArray

from ocp.compiled.function_address import ADDRESSES, addresses, function_at
from ocp.compiled.jit import KERNEL, KERNEL_WITH_JACOBIAN, MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.compiled.parameters import Layout
from ocp.kernels import Kernels
from ocp.query import Query

INTEGERS = int64[::1]
CUBE = float64[:, :, ::1]

FINISHED, LEFT, FAILED = 0, 1, 2  # how `propagate` ended

# Rows: the stages' coefficients, then the weights of order 5, then those of the error estimate.
TABLEAU = np.zeros((8, 7))
TABLEAU[1, :1] = 1 / 5
TABLEAU[2, :2] = 3 / 40, 9 / 40
TABLEAU[3, :3] = 44 / 45, -56 / 15, 32 / 9
TABLEAU[4, :4] = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
TABLEAU[5, :5] = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
TABLEAU[6, :6] = 35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
TABLEAU[7] = 71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40

MAX_STEPS = 2000  # in one call
MAX_REJECTIONS = 40  # in a row
LEVEL = 1e-13  # a kink is reached to so much: gauges of two facets, squares of radii
SKIN = 1e-10  # so far beyond the goal's boundary it is crossed, in squares of radii
GOAL = -1  # the kink that is the goal's boundary, where polygons' numbers stand

kernel_at = function_at(KERNEL)
kernel_with_jacobian_at = function_at(KERNEL_WITH_JACOBIAN)
scalar_at = function_at(SCALAR)


@cache
def flow_addresses(k: Kernels) -> NDArray[np.intp]:
    """The functions that `propagate` calls, and itself last, for this robot and form of cost."""
    return addresses([k.flow, k.flow_jacobian, k.minimised_hamiltonian, propagate])


def flow_layout(query: Query) -> NDArray[np.int64]:
    """`[6]`: n, m, d, and where in q are: the number of obstacles, their stride, the goal."""
    layout = Layout.of(query)
    rows = [layout.n, layout.m, layout.d, layout.count, layout.stride, layout.goal]
    return np.array(rows, dtype=np.int64)


@compiled(float64(VECTOR, VECTOR, INTEGERS))
def _outside(x, q, layout):
    """How far x lies outside the goal ball: square of the distance to its centre in radii, - 1."""
    d, goal = layout[2], layout[5]
    square = 0.0
    for j in range(d):
        square += (x[j] - q[goal + j]) ** 2
    return square / q[goal + d] ** 2 - 1.0


@compiled(types.void(VECTOR, VECTOR, INTEGERS, VECTOR))
def _freeze(x, q, layout, frozen):
    """Copy q into `frozen`, leaving each polygon only the facet that attains its gauge at x, and
    taking away the goal cost if x is in the goal."""
    d, count, stride, goal = layout[2], layout[3], layout[4], layout[5]
    frozen[:] = q
    if _outside(x, q, layout) < 0.0:
        frozen[goal + d + 1] = 0.0
    for o in range(int(q[count])):
        k = count + 1 + o * stride
        best, largest = 0, -np.inf
        for i in range(int(q[k])):
            gauge = 0.0
            for j in range(d):
                gauge += q[k + 2 + d + d * i + j] * (x[j] - q[k + 2 + j])
            if gauge > largest:
                best, largest = i, gauge
        if q[k] > 0.0:
            frozen[k] = 1.0
            for j in range(d):
                frozen[k + 2 + d + j] = q[k + 2 + d + d * best + j]


@compiled(types.Tuple((float64, int64, int64))(VECTOR, VECTOR, INTEGERS, VECTOR))
def _excess(x, q, layout, frozen):
    """How far x lies beyond a kink, and which: a polygon (by how much the gauge of one of its
    facets exceeds the frozen one) and its facet, or GOAL."""
    d, count, stride, goal = layout[2], layout[3], layout[4], layout[5]
    worst, which, facet = -np.inf, GOAL, 0
    if q[goal + d + 1] > 0.0:
        worst = _outside(x, q, layout)
        if frozen[goal + d + 1] > 0.0:
            worst = -worst
        worst -= SKIN  # motions along the boundary must not go in and out by rounding
    for o in range(int(q[count])):
        k = count + 1 + o * stride
        for i in range(int(q[k])):
            gap, same = 0.0, True
            for j in range(d):
                a, b = q[k + 2 + d + d * i + j], frozen[k + 2 + d + j]
                gap += (a - b) * (x[j] - q[k + 2 + j])
                same = same and a == b
            if not same and gap > worst:
                worst, which, facet = gap, o, i
    return worst, which, facet


@compiled(types.void(ADDRESSES, VECTOR, VECTOR, float64, float64, VECTOR, MATRIX))
def _rate(functions, q, y, sign, energy, out, jacobian):
    """d/ds of [z, cost] at s = sign t: the running cost is H - p' x', and the flow conserves H.

    `jacobian` `[2n, 2n]` is filled with d(z')/dz, in t, unless it is empty.
    """
    n = (y.shape[0] - 1) // 2
    if jacobian.shape[0] > 0:
        kernel_with_jacobian_at(functions[1, 0], functions[1, 1])(y, q, out, jacobian)
    else:
        kernel_at(functions[0, 0], functions[0, 1])(y, q, out)
    work = 0.0
    for i in range(n):
        work += y[n + i] * out[i]
    for i in range(2 * n):
        out[i] *= sign
    out[2 * n] = energy - work  # counts up, forward and backward


@compiled(
    float64(
        ADDRESSES, VECTOR, VECTOR, float64, float64, float64, float64, MATRIX, CUBE, VECTOR
    )
)  # fmt: skip
def _step(functions, q, y, h, sign, energy, tolerance, stages, jacobians, out):
    """One step of length h from y `[2n + 1]`; `stages[0]` holds the rate at y, the rest is filled.

    So it is with `jacobians` `[7, 2n, 2n]` of the stages, or `[7, 0, 0]` if they are not wanted.

    Returns the error estimate over the tolerance.
    """
    size = y.shape[0]
    for s in range(1, 7):
        for i in range(size):
            total = 0.0
            for r in range(s):
                total += TABLEAU[s, r] * stages[r, i]
            out[i] = y[i] + h * total
        _rate(functions, q, out, sign, energy, stages[s], jacobians[s])
    error = 0.0
    for i in range(size):
        estimate = 0.0
        for s in range(7):
            estimate += TABLEAU[7, s] * stages[s, i]
        estimate *= h / (tolerance * (1.0 + max(abs(y[i]), abs(out[i]))))
        error += estimate * estimate
    return math.sqrt(error / size)


@compiled(types.void(float64, float64, CUBE, MATRIX, MATRIX))
def _tangent_step(h, sign, jacobians, tangents, scratch):
    """The same step of the tangents `[2n, c]`, by the stages' Jacobians.

    `scratch` `[7, 2n c]` is overwritten: six stages, and the argument of the next.
    """
    size, columns = tangents.shape
    flat, bent = tangents.reshape(-1), scratch[6]
    for s in range(6):
        # Long inner loops over contiguous memory: the compiler makes vector instructions of them.
        bent[:] = flat
        for r in range(s):
            weight = h * TABLEAU[s, r]
            for j in range(flat.shape[0]):
                bent[j] += weight * scratch[r, j]
        stage = scratch[s]
        stage[:] = 0.0
        for i in range(size):
            row = stage[i * columns : (i + 1) * columns]
            for k in range(size):
                weight = sign * jacobians[s, i, k]
                if weight != 0.0:
                    source = bent[k * columns : (k + 1) * columns]
                    for j in range(columns):
                        row[j] += weight * source[j]
    for s in range(6):
        weight = h * TABLEAU[6, s]
        for j in range(flat.shape[0]):
            flat[j] += weight * scratch[s, j]


@compiled(types.void(ADDRESSES, VECTOR, INTEGERS, VECTOR, VECTOR, int64, int64, MATRIX, MATRIX))
def _switch(functions, q, layout, frozen, y, polygon, facet, stages, tangents):
    """Go over to the other side of a kink at y: another facet, or in or out of the goal.

    Perturbed motions cross it at other times, so the tangents jump.
    """
    size, columns = tangents.shape
    d, count, stride, goal = layout[2], layout[3], layout[4], layout[5]
    flow = kernel_at(functions[0, 0], functions[0, 1])
    before, after = stages[1], stages[2]
    # Q is cut off in the goal, so its slope at the boundary is that from just outside.
    point = y.copy()
    if polygon == GOAL:
        for j in range(d):
            point[j] += 2.0 * SKIN * (y[j] - q[goal + j])
    flow(point, frozen, before)
    normal = np.empty(d)
    if polygon == GOAL:
        frozen[goal + d + 1] = q[goal + d + 1] if frozen[goal + d + 1] == 0.0 else 0.0
        for j in range(d):
            normal[j] = y[j] - q[goal + j]
    else:
        k = count + 1 + polygon * stride
        for j in range(d):
            a = q[k + 2 + d + d * facet + j]
            normal[j] = a - frozen[k + 2 + d + j]
            frozen[k + 2 + d + j] = a
    flow(point, frozen, after)
    speed = 0.0
    for j in range(d):
        speed += normal[j] * before[j]
    if speed == 0.0:
        return
    for c in range(columns):
        advance = 0.0
        for j in range(d):
            advance += normal[j] * tangents[j, c]
        advance /= speed
        for i in range(size):
            tangents[i, c] += (after[i] - before[i]) * advance


# The type of `propagate`
PROPAGATE = types.FunctionType(
    int64(ADDRESSES, VECTOR, INTEGERS, VECTOR, MATRIX, float64, float64, VECTOR, VECTOR, MATRIX)
)


@compiled(
    int64(ADDRESSES, VECTOR, INTEGERS, VECTOR, MATRIX, float64, float64, VECTOR, VECTOR, MATRIX)
)
def propagate(functions, q, layout, y, tangents, duration, tolerance, pace, limits, record):
    """Carry y = [x, p, cost] `[2n + 1]` along the flow for `duration` seconds, negative: back.

    Args:
        functions: of `flow_addresses`.
        q: the query's parameters.
        layout: of `flow_layout`.
        y: start, replaced by the end; the cost counts up, also backward.
        tangents: `[2n, c]` perturbations of z, carried along; no columns if not wanted.
        tolerance: of a step, relative to 1 + |component|.
        pace: `[1]`, seconds of the first step to try, 0 if that is not known; replaced by those of
            the step that would come next. Motions in pieces are so spared small first steps.
        limits: `[1 + 2n]`: largest cost, then lower and upper bounds of x; where one is crossed the
            motion ends (LEFT). Empty for no limits.
        record: `[k, 2n + 2]`: filled with (seconds gone by, z, cost) after each step, up to k rows,
            and then the motion ends (LEFT); no rows if not wanted. Rows not reached stay as they
            are.

    Returns:
        FINISHED, LEFT or FAILED (too many steps, or numbers that are not finite).
    """
    n = layout[0]
    size = 2 * n + 1
    sign = 1.0 if duration >= 0.0 else -1.0
    length = abs(duration)
    frozen = np.empty_like(q)
    _freeze(y, q, layout, frozen)
    energy = scalar_at(functions[2, 0], functions[2, 1])(y, q)
    stages, out = np.empty((7, size)), np.empty(size)
    scratch = np.empty((7, 2 * n * tangents.shape[1]))
    wanted = 2 * n if tangents.shape[1] > 0 else 0
    jacobians = np.empty((7, wanted, wanted))
    gone, rows, rejected = 0.0, 0, 0
    _rate(functions, frozen, y, sign, energy, stages[0], jacobians[0])
    h = pace[0]
    if h == 0.0:
        fastest = 0.0
        for i in range(2 * n):
            fastest = max(fastest, abs(stages[0, i]) / (1.0 + abs(y[i])))
        h = tolerance**0.2 / (1e-3 + fastest)
    for _ in range(MAX_STEPS):
        proposed = h
        h = min(h, length - gone)
        if length - gone - h < 1e-3 * h:
            h = length - gone
        error = _step(functions, frozen, y, h, sign, energy, tolerance, stages, jacobians, out)
        if not error <= 1.0:
            rejected += 1
            if rejected == MAX_REJECTIONS:
                return FAILED
            h *= max(0.2, 0.9 * error**-0.2) if error < np.inf else 0.2
            continue
        rejected = 0
        growth = min(5.0, 0.9 * max(error, 1e-10) ** -0.2)
        following = h * growth
        if h < proposed:  # cut short by the end, not by its error
            following = max(following, proposed)
        gap, polygon, facet = _excess(out, q, layout, frozen)
        crossed = gap > LEVEL
        if crossed:
            # The length of step at which the first other facet draws level: regula falsi, Illinois.
            low, high = 0.0, h
            at_low, at_high = min(_excess(y, q, layout, frozen)[0], 0.0), gap
            gap_at_end, side = gap, 0
            while gap_at_end > LEVEL and high - low > 1e-14 * h:
                middle = high - at_high * (high - low) / (at_high - at_low)
                if at_low > -LEVEL:  # already level at the start: does it rise at once?
                    middle = low + 0.1 * (high - low)
                _step(functions, frozen, y, middle, sign, energy, tolerance, stages, jacobians, out)
                gap, o, i = _excess(out, q, layout, frozen)
                if gap > 0.0:
                    at_low *= 0.5 if side == 1 else 1.0
                    high, at_high, polygon, facet, side = middle, gap, o, i, 1
                    gap_at_end = gap
                else:
                    at_high *= 0.5 if side == -1 else 1.0
                    low, at_low, side = middle, gap, -1
            h = high
            _step(functions, frozen, y, h, sign, energy, tolerance, stages, jacobians, out)
        if tangents.shape[1] > 0:
            _tangent_step(h, sign, jacobians, tangents, scratch)
            jacobians[0] = jacobians[6]
        y[:] = out
        gone += h
        stages[0] = stages[6]
        if crossed:
            _switch(functions, q, layout, frozen, y, polygon, facet, stages, tangents)
            _rate(functions, frozen, y, sign, energy, stages[0], jacobians[0])
        h = following
        pace[0] = h
        if record.shape[0] > 0:
            record[rows, 0] = gone
            record[rows, 1:] = y
            rows += 1
            if rows == record.shape[0]:
                return LEFT
        if limits.shape[0] > 0:
            if abs(y[2 * n]) > limits[0]:
                return LEFT
            for i in range(n):
                if not limits[1 + i] <= y[i] <= limits[1 + n + i]:
                    return LEFT
        if gone >= length * (1.0 - 1e-15):
            return FINISHED
    return FAILED
