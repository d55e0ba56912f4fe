"""Finding the leaf at a state, and what is read off it: compiled for values on a mesh.

The kernels take a mesh and its values as one vector, since an `INTERPOLATION` has room for no more:

    the grid's geometry `[4 n]`, N, K, the address of `clear_segment` `[2]`, values `[N]`,
    vertices `[N, n]`, simplices `[K, n + 1]`, tags `[K]`, children `[K]`.

Integers and addresses are below 2^53, so that doubles hold them exactly.
"""

import numpy as np
from numba import types

from ocp.compiled.function_address import ADDRESSES, function_at
from ocp.compiled.jit import MATRIX, SCALAR, VECTOR, compiled, float64
from ocp.grids.bellman import SCRATCH_ROWS, bellman_at
from ocp.grids.hard_obstacles import SEGMENT

I1 = types.Array(types.int64, 1, "C")
I2 = types.Array(types.int64, 2, "C")

scalar_at = function_at(SCALAR)
segment_at = function_at(SEGMENT)


@compiled(types.int64(VECTOR, VECTOR, I1, VECTOR))
def _leaf(values, point, vertices, weights):
    """The depth of the leaf at `point` `[n]`, its vertices and weights `[n + 1]`; -1 outside.

    The root simplex is found by the order of the fractions in the grid's cell, then by descent:
    with weights w in a simplex of tag k, the point lies in the first child if w_0 >= w_k, with
    weights w_0 - w_k at x_0 and 2 w_k at the new vertex; else in the second, likewise.
    """
    n = point.shape[0]
    count, total = int(values[4 * n]), int(values[4 * n + 1])
    simplices = 4 * n + 4 + count * (n + 1)
    tag = simplices + total * (n + 1)
    child = tag + total
    fraction, order = weights, vertices  # room that is free until the end
    root = 0
    for i in range(n):
        cells = int(values[2 * n + i])
        t = (point[i] - values[i]) * values[n + i]
        if values[3 * n + i] > 0.0:
            t -= np.floor(t / cells) * cells
            if not 0.0 <= t <= cells:
                return -1
        else:
            cells -= 1
            if not -1e-9 <= t <= cells + 1e-9:
                return -1
        cell = min(max(int(t), 0), cells - 1)
        fraction[i] = min(max(t - cell, 0.0), 1.0)
        root = root * cells + cell
    for i in range(n):  # axes by falling fraction: the order of the path
        j = i
        while j > 0 and fraction[order[j - 1]] < fraction[i]:
            order[j] = order[j - 1]
            j -= 1
        order[j] = i
    rank, s = 0, root
    for i in range(n):
        smaller = 0
        for j in range(i + 1, n):
            smaller += order[j] < order[i]
        rank = rank * (n - i) + smaller
        s *= i + 1
    s += rank
    w = np.empty(n + 1)
    w[0] = 1.0 - fraction[order[0]]
    for i in range(1, n):
        w[i] = fraction[order[i - 1]] - fraction[order[i]]
    w[n] = fraction[order[n - 1]]
    depth = 0
    while values[child + s] >= 0.0:
        k = int(values[tag + s])
        low, high = w[0], w[k]
        s = int(values[child + s])
        if low >= high:
            w[0], w[k] = low - high, 2.0 * high
        else:
            s += 1
            for i in range(k):
                w[i] = w[i + 1]
            w[k - 1], w[k] = high - low, 2.0 * low
        depth += 1
    for i in range(n + 1):
        vertices[i] = int(values[simplices + s * (n + 1) + i])
        weights[i] = w[i]
    return depth


@compiled(types.void(VECTOR, MATRIX, I2, MATRIX))
def locate_rows(values, points, vertices, weights):
    """Vertices and weights `[k, n + 1]` of the leaves at `points` `[k, n]`; -1 and 0 outside."""
    for row in range(points.shape[0]):
        if _leaf(values, points[row], vertices[row], weights[row]) < 0:
            vertices[row] = -1
            weights[row] = 0.0


@compiled(float64(VECTOR, VECTOR, VECTOR))
def interpolate_mesh(values, geometry, point):
    """The value at `point` `[n]`; an `INTERPOLATION`, for `ocp.grids.bellman`.

    Args:
        values: the vector described above.
        geometry: of a grid, followed by `hard_data`; only the latter is used, and spacings.
        point: infinite outside the box.

    Next to hard obstacles as `interpolate_visible`: from the finite vertices in sight, and the way
    to their mean.
    """
    n = point.shape[0]
    vertices, weights = np.empty(n + 1, dtype=np.int64), np.empty(n + 1)
    if _leaf(values, point, vertices, weights) < 0:
        return np.inf
    first = 4 * n + 4
    total = 0.0
    if not geometry[4 * n + 2] > 0.0:
        for i in range(n + 1):
            if weights[i] > 0.0:
                total += weights[i] * values[first + vertices[i]]
        return total
    clear = segment_at(int(values[4 * n + 2]), int(values[4 * n + 3]))
    data = geometry[4 * n :]
    if clear(point, point, data) == 0.0:
        return np.inf
    seen, cell = 0.0, 0.0
    target = np.empty(n)
    corners = first + int(values[4 * n])
    for i in range(n + 1):
        value = values[first + vertices[i]]
        if not (weights[i] > 1e-12 and value < np.inf):
            continue
        for k in range(n):
            target[k] = values[corners + vertices[i] * n + k]
        if clear(point, target, data) > 0.0:
            total += weights[i] * value
            seen += weights[i]
    if not seen > 0.0:
        return np.inf
    for k in range(int(data[0])):
        cell = max(cell, 1.0 / geometry[n + k])
    return total / seen + max(1.0 - seen, 0.0) * cell * data[3]


@compiled(types.boolean(VECTOR, VECTOR, VECTOR))
def _set_spacing(values, geometry, point):
    """Make the spacings in `geometry` those of the leaf at `point`; whether there is a leaf."""
    n = point.shape[0]
    vertices, weights = np.empty(n + 1, dtype=np.int64), np.empty(n + 1)
    depth = _leaf(values, point, vertices, weights)
    for i in range(n):
        geometry[n + i] = values[n + i] * 2.0 ** (max(depth, 0) / n)
    return depth >= 0


@compiled(types.void(VECTOR, VECTOR, MATRIX, VECTOR))
def interpolate_rows(values, geometry, points, out):
    own = geometry.copy()
    for row in range(points.shape[0]):
        _set_spacing(values, own, points[row])
        out[row] = interpolate_mesh(values, own, points[row])


@compiled(types.void(VECTOR, VECTOR, MATRIX, MATRIX))
def gradient_rows(values, geometry, points, out):
    n = points.shape[1]
    own = geometry.copy()
    point = np.empty(n)
    for row in range(points.shape[0]):
        _set_spacing(values, own, points[row])
        point[:] = points[row]
        here = interpolate_mesh(values, own, point)
        for i in range(n):
            h = 1.0 / own[n + i]
            point[i] = points[row, i] + h
            above = interpolate_mesh(values, own, point)
            point[i] = points[row, i] - h
            below = interpolate_mesh(values, own, point)
            point[i] = points[row, i]
            if above < np.inf and below < np.inf:
                out[row, i] = (above - below) / (2.0 * h)
            elif above < np.inf and here < np.inf:
                out[row, i] = (above - here) / h
            elif below < np.inf and here < np.inf:
                out[row, i] = (here - below) / h
            else:
                out[row, i] = 0.0


@compiled(
    types.void(
        MATRIX, MATRIX, VECTOR, types.int64, ADDRESSES, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX
    )
)
def lookahead(states, candidates, spread, rounds, functions, q, settings, values, geometry, inputs):
    n, m, d = states.shape[1], inputs.shape[1], settings.shape[0] - 4
    state_cost = scalar_at(functions[1, 0], functions[1, 1])
    feedback = bellman_at(functions[6, 0], functions[6, 1])
    scratch = np.empty((SCRATCH_ROWS, max(2 * n, m)))
    for row in range(states.shape[0]):
        x, u = states[row], inputs[row]
        squared = 0.0
        for i in range(d):
            squared += (x[i] - settings[4 + i]) ** 2
        u[:] = np.nan
        if squared <= settings[3] ** 2:
            u[:] = 0.0
            continue
        _set_spacing(values, geometry, x)
        feedback(
            x, u, candidates, spread, rounds, functions, q, settings, values, geometry, scratch
        )
        u *= np.sqrt(state_cost(x, q))
