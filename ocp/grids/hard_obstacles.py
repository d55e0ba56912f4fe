"""Hard obstacles for compiled solvers: clearance, clear segments, and what a grid may mix.

`hard_data` is one vector that carries the hard obstacles of a query into numba kernels: [d, robot
radius, count, cost of a metre], then for each obstacle [k, centre `[d]`, radius, k vertices `[2]`],
with k = 0 for a ball. The geometry is that of `Obstacle.signed_distance`, compiled.

A grid sees an obstacle through moves between its nodes: a node may use another's value only if the
straight segment between their positions is clear of hard obstacles. Then a value is passed on along
clear segments alone, and cannot leak through an obstacle, however thin. Gaps narrower than a cell
may be closed.
"""

import math

import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64
from ocp.grid import EDGE_TOLERANCE, MAX_DIMENSION, Grid
from ocp.query import Query

# (from `[>= d]`, to `[>= d]`, data) -> clearance along the segment, or <= 0: see `clear_segment`
SEGMENT = types.FunctionType(float64(VECTOR, VECTOR, VECTOR))

MAX_ADVANCES = 64
MAX_MOVES = 62


def hard_data(query: Query, margin: float = 0.0) -> NDArray[np.float64]:
    """The hard obstacles of `query` as one vector; `margin` metres are added to the robot."""
    d = len(query.system.position)
    metre = 2 * np.sqrt(query.cost.goal * query.input_weights.max())  # at the best speed of p' = u
    parts = [[d, query.robot_radius + margin, len(query.hard_obstacles), metre]]
    for o in query.hard_obstacles:
        parts += [[len(o.vertices)], o.center, [o.radius], np.array(o.vertices, float).ravel()]
    return np.concatenate([np.asarray(p, dtype=float) for p in parts])


@compiled(float64(VECTOR, VECTOR))
def clearance(point, data):
    """Distance from the robot's ball at `point` `[>= d]` to the nearest hard obstacle."""
    d, count = int(data[0]), int(data[2])
    nearest = np.inf
    at = 4
    for _ in range(count):
        k, center, corners = int(data[at]), at + 1, at + d + 2
        if k == 0:
            squared = 0.0
            for i in range(d):
                squared += (point[i] - data[center + i]) ** 2
            distance = math.sqrt(squared) - data[center + d]
        else:
            inside, squared = True, np.inf
            for i in range(k):
                a, b = corners + 2 * i, corners + 2 * ((i + 1) % k)
                ex, ey = data[b] - data[a], data[b + 1] - data[a + 1]
                rx, ry = point[0] - data[a], point[1] - data[a + 1]
                along = min(max((rx * ex + ry * ey) / (ex * ex + ey * ey), 0.0), 1.0)
                gap = (rx - along * ex) ** 2 + (ry - along * ey) ** 2
                squared = min(squared, gap)
                inside = inside and ex * ry - ey * rx >= 0.0  # counter-clockwise corners
            distance = -math.sqrt(squared) if inside else math.sqrt(squared)
        nearest = min(nearest, distance)
        at = corners + 2 * k
    return nearest - data[1]


@compiled(float64(VECTOR, VECTOR, VECTOR))
def clear_segment(start, end, data):
    """1.0 if the robot's ball can move straight from `start` to `end`, else 0.0.

    Conservative advancement: clearance has slope at most 1, so the ball may move by its clearance.
    A segment that grazes an obstacle may be called blocked, one that enters it is never clear.
    """
    if data[2] == 0.0:
        return 1.0
    d = int(data[0])
    length = 0.0
    for i in range(d):
        length += (end[i] - start[i]) ** 2
    length = math.sqrt(length)
    point = np.empty(d)
    done = 0.0
    for _ in range(MAX_ADVANCES):
        for i in range(d):
            point[i] = start[i] + (end[i] - start[i]) * (done / length if length > 0.0 else 0.0)
        gap = clearance(point, data)
        if gap <= 0.0:
            return 0.0
        done += gap
        if done >= length:
            # The last advance ended at `end` or beyond, inside a ball known to be clear.
            return 1.0
    return 0.0


@compiled(float64(VECTOR, VECTOR, VECTOR, types.boolean))
def _mixed(values, geometry, point, strict):
    """Multilinear value from the corners that `point` sees; if `strict`, it must see all."""
    n = point.shape[0]
    data = geometry[4 * n :]
    gap = clearance(point, data)
    if gap < 0.0:
        return np.inf
    d = int(data[0])
    reach, cell = 0.0, 0.0
    for i in range(d):
        reach += 1.0 / geometry[n + i] ** 2
        cell = max(cell, 1.0 / geometry[n + i])
    check = gap < math.sqrt(reach)
    index = np.zeros(2 * MAX_DIMENSION, dtype=np.int64)
    weight = np.zeros(2 * MAX_DIMENSION)
    corner_point = np.empty((2, n))
    stride = 1
    for reverse in range(n):
        i = n - 1 - reverse
        count = int(geometry[2 * n + i])
        t = (point[i] - geometry[i]) * geometry[n + i]
        if geometry[3 * n + i] > 0.0:
            t -= math.floor(t / count) * count
            if not 0.0 <= t <= count:
                return np.inf
            low = min(int(t), count - 1)
            high = low + 1 if low + 1 < count else 0
        else:
            if not -EDGE_TOLERANCE <= t <= count - 1 + EDGE_TOLERANCE:
                return np.inf
            t = min(max(t, 0.0), count - 1.0)
            low = min(int(t), count - 2)
            high = low + 1
        weight[2 * i], weight[2 * i + 1] = 1.0 - (t - low), t - low
        index[2 * i], index[2 * i + 1] = low * stride, high * stride
        corner_point[0, i] = point[i] - (t - low) / geometry[n + i]
        corner_point[1, i] = corner_point[0, i] + 1.0 / geometry[n + i]
        stride *= count
    total, weights = 0.0, 0.0
    target = np.empty(n)
    for corner in range(1 << n):
        w, k = 1.0, 0
        for i in range(n):
            side = corner >> i & 1
            w *= weight[2 * i + side]
            k += index[2 * i + side]
            target[i] = corner_point[side, i]
        if w <= EDGE_TOLERANCE:
            continue
        if math.isfinite(values[k]) and (not check or clear_segment(point, target, data) > 0.0):
            total += w * values[k]
            weights += w
        elif strict:
            return np.inf
    if not weights > 0.0:
        return np.inf
    return total / weights + (1.0 - min(weights, 1.0)) * cell * data[3]


@compiled(float64(VECTOR, VECTOR, VECTOR))
def interpolate_joined(values, geometry, point):
    """Multilinear value at `point` `[n]` if all the corners that count are finite and joined to it
    by clear segments, else infinite: what a scheme may use without leaking through an obstacle.

    As `grid.interpolate`, with `hard_data` appended to `geometry`.
    """
    return _mixed(values, geometry, point, True)


@compiled(float64(VECTOR, VECTOR, VECTOR))
def interpolate_visible(values, geometry, point):
    """As `interpolate_joined`, but from those corners alone that are finite and joined to `point`.

    Their weights are scaled to sum to 1, so that a point beside an obstacle has a value. Their mean
    belongs to a point up to a cell away: the way there is added, as the cost of that share of a
    cell; or else a robot would cling to obstacles. Infinite outside the box, inside an obstacle,
    and where no corner is left.
    """
    return _mixed(values, geometry, point, False)


@compiled(types.void(VECTOR, VECTOR, MATRIX, VECTOR))
def interpolate_visible_rows(values, geometry, points, out):
    """`interpolate_visible` at `points` `[k, n]`."""
    for row in range(points.shape[0]):
        out[row] = interpolate_visible(values, geometry, points[row])


def blocked_moves(query: Query, grid: Grid, moves: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which short moves from the grid's positions a hard obstacle blocks.

    Args:
        query: has the hard obstacles, and the robot's radius.
        grid: its first axes are the position.
        moves: `[k, d]`, k <= 62, in cells.

    Returns:
        `[*position shape]` bit masks: bit k is set if the straight segment from that position to
        the one `moves[k]` away is not clear. All are set inside an obstacle.

    Raises:
        ValueError: if there are more moves than fit a bit mask.
    """
    d = len(query.system.position)
    shape = grid.shape[:d]
    if len(moves) > MAX_MOVES:
        raise ValueError(f"moves: at most {MAX_MOVES} fit a bit mask, got {len(moves)}")
    out = np.zeros(int(np.prod(shape)), dtype=np.int64)
    if query.hard_obstacles:
        nodes = np.stack(np.meshgrid(*grid.axes[:d], indexing="ij"), axis=-1).reshape(-1, d)
        offsets = np.ascontiguousarray(moves * grid.spacing[:d])
        _blocked(np.ascontiguousarray(nodes), offsets, hard_data(query), out)
    return out.reshape(shape)


@compiled(types.void(MATRIX, MATRIX, VECTOR, types.Array(types.int64, 1, "C")))
def _blocked(nodes, offsets, data, out):
    reach = 0.0
    for k in range(offsets.shape[0]):
        reach = max(reach, np.sqrt((offsets[k] ** 2).sum()))
    for row in range(nodes.shape[0]):
        if clearance(nodes[row], data) > reach:
            continue
        for k in range(offsets.shape[0]):
            if clear_segment(nodes[row], nodes[row] + offsets[k], data) == 0.0:
                out[row] |= 1 << k
