"""The time-free form on a grid: semi-Lagrangian sweeps to a fixed point.

With no drift, no input bounds and the running cost W + u' R u, the best speed satisfies u' R u = W.
So V(x) = min over paths of the integral of 2 sqrt(W) ds, with ds the R-norm of the input: an
eikonal problem. The scheme is the fixed point of

    V(x) = min over a of  l (s(x) + 4 s(x_m) + s(y)) / 6 + V(y),   s = 2 sqrt(W),

where y is the foot of a motion of about two cells in direction a, l its length, x_m its middle, and
V and s are interpolated. Feet of neighbouring directions are joined to simplices; the minimum over
each is taken in closed form, with V linear on it (Tsitsiklis 1995; Sethian and Vladimirsky 2003),
so directions are not quantised. Longer motions spread a value less but cut corners: of those tried,
two cells in 16 directions, and one along each input, did best for the unicycle.

Nodes are swept in alternating orders (Gauss-Seidel); a node is computed again only when a value
that it reads has changed. Values only fall, so an unfinished result bounds the scheme's from above.
"""

import math
from dataclasses import replace
from functools import cached_property, lru_cache

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.compiled.batch import state_costs
from ocp.compiled.jit import compiled, float64
from ocp.cost import RunningCost
from ocp.grid import MAX_DIMENSION, Grid
from ocp.grids.bellman import arrival_costs
from ocp.grids.fixed_point import FixedPoint
from ocp.grids.hard_obstacles import blocked_moves
from ocp.grids.stencil import coordinates_in, cost_stencil, flat_strides, stencil
from ocp.query import Goal, Query
from ocp.system import System
from ocp.trajectory import SolveError, Status

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

DIRECTIONS = 16
REACH = 2  # cells
COST_FINER = 2  # cells of the grid that holds s to one of V's: s has a square root's kink
TOLERANCE = 1e-4  # of V; a fixed point reached to 1e-4 was within 1.1e-4 of the exact one
MAX_SWEEPS = 1000

FIXED, PLAIN = -2, -1  # kinds of nodes: see `_Problem.start`


def sweep_time_free(
    query: Query,
    grid: Grid,
    upper_bound: Floats | None = None,
    tolerance: float = TOLERANCE,
    max_sweeps: int = MAX_SWEEPS,
) -> FixedPoint:
    """The value of a time-free query on a grid.

    Args:
        query: without drift and without input bounds.
        grid: over the robot's states; it may use the half-turn symmetry.
        upper_bound: `[*grid.shape]`, a value that V is known not to exceed (infinite where nothing
            is known), such as exact values near the goal.
        tolerance: changes smaller than this are not passed on.
        max_sweeps: give up after so many; the result then says so.

    Raises:
        SolveError: if the query is not time-free.
        ValueError: if the grid does not fit, or is too coarse for any node to meet the goal.
    """
    if not query.is_time_free:
        detail = "the time-free form needs no drift and no input bounds"
        raise SolveError(Status.NOT_APPLICABLE, detail)
    if grid.dimension != query.system.n:
        raise ValueError(f"grid: {query.system.name} has {query.system.n} states, got {grid.shape}")
    problem = _Problem(query, grid)
    values, kind, enters = problem.start(upper_bound)
    stale = np.zeros(len(values), dtype=np.uint8)
    sweeps, updates, change = _sweeps(
        values, kind, enters, *problem.tables, tolerance, max_sweeps, stale
    )
    return FixedPoint(problem.unpadded(values), sweeps, updates, change, tolerance)


class _Problem:
    """A query on a grid as the flat tables of the kernel."""

    def __init__(self, query: Query, grid: Grid) -> None:
        self.query, self.grid = query, grid
        # Where inputs move the robot every way, one cell spreads a value little and is exact along
        # the axes.
        reach = REACH if query.system.m < query.system.n else 1
        self.feet = stencil(query, grid, DIRECTIONS, reach)
        self.shape = np.array(grid.shape) + 2 * self.feet.ghost
        self.core = tuple(
            slice(g, g + count) for g, count in zip(self.feet.ghost, grid.shape, strict=True)
        )

    def start(self, upper_bound: Floats | None) -> tuple[Floats, Ints, NDArray[np.bool_]]:
        """Padded flat values to start from, what to do with each node, and a table for that.

        A motion that enters the goal ends at the first hit, so its cost is not one up to its foot:
        near the goal such motions are taken care of by the start values, and their feet do not
        count. A node is `FIXED`, `PLAIN`, or the row of `enters` `[near, J]` that says which feet
        lie in the goal.
        """
        query, grid, feet = self.query, self.grid, self.feet
        nodes = grid.nodes()
        distance = query.goal_distance(nodes)
        values = np.where(distance <= 0, 0.0, np.inf)
        h = grid.spacing[list(query.system.position)]
        near = (distance > 0) & (distance < feet.reach * np.linalg.norm(h))
        index = np.argwhere(near) * (feet.shape > 1)
        ends = nodes[near][:, None] + feet.foot[index @ flat_strides(feet.shape)] * grid.spacing
        enters = query.goal_distance(ends) <= 1e-9  # metres, so that rounding decides nothing
        if near.any():
            values[near] = arrival_costs(query, grid, nodes[near], float(feet.reach))
        if upper_bound is not None:
            if upper_bound.shape != grid.shape:
                raise ValueError(f"upper_bound: needs shape {grid.shape}, got {upper_bound.shape}")
            values = np.fmin(values, upper_bound)
        kind = np.where(distance <= 0, FIXED, PLAIN)
        kind[near] = np.arange(len(enters))
        if query.hard_obstacles:
            blocked = query.clearance(nodes, hard_only=True) < 0
            values[blocked] = np.inf
            kind[blocked] = FIXED
        if not np.isfinite(values).any():
            raise ValueError(
                f"grid.shape: {grid.shape} is too coarse for any node to meet the goal of radius "
                f"{query.goal.radius} m (or hard obstacles close it off)"
            )
        padded = np.full(self.shape, np.inf)
        padded[self.core] = values
        kinds = np.full(self.shape, FIXED)
        kinds[self.core] = kind
        return padded.ravel(), kinds.ravel(), enters

    def unpadded(self, values: Floats) -> Floats:
        return np.ascontiguousarray(values.reshape(self.shape)[self.core])

    @cached_property
    def tables(self) -> tuple:
        """What the kernel is given between values and tolerance."""
        query, grid, feet = self.query, self.grid, self.feet
        system = query.system
        n = system.n
        depends = _cost_axes(system, replace(query.cost, goal=1.0))
        finer = COST_FINER if depends.sum() <= 3 else 1
        offset, weight, own = cost_stencil(feet, grid, tuple(map(bool, depends)), finer)
        ghost = np.where(depends, finer * feet.ghost, 0)
        center = (np.array(grid.lower) + grid.upper) / 2
        last = finer * (np.array(grid.shape) - 1) + (finer - 1) * np.array(grid.periodic)
        axes = [
            grid.lower[i] + grid.spacing[i] / finer * np.arange(-ghost[i], last[i] + ghost[i] + 1)
            if depends[i]
            else center[i : i + 1]
            for i in range(n)
        ]
        states = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        slowness = 2 * np.sqrt(state_costs(query, states)).ravel()
        d = len(system.position)
        position_shape = np.array([*grid.shape[:d], *[1] * (n - d)])
        rows = [
            np.array(grid.shape),
            flat_strides(self.shape),
            flat_strides(feet.shape) * (feet.shape > 1),
            flat_strides(np.array(states.shape[:-1])) * depends * finer,
            flat_strides(position_shape) * (np.arange(n) < d),
        ]
        layout = np.ones((len(rows), MAX_DIMENSION), dtype=np.int64)
        layout[1:] = 0
        layout[:, MAX_DIMENSION - n :] = rows
        first = np.array(
            [feet.ghost @ rows[1], feet.ghost @ rows[3]]
        )  # flat index of the first node
        blocked, blocking = self._obstacles()
        return (
            layout, first, feet.node_offset, feet.node_weight, slowness, offset, weight, own,
            feet.length, feet.pairs, feet.pair_geometry, feet.faces, feet.face_geometry,
            blocked, blocking, feet.readers, feet.reader_count,
        )  # fmt: skip

    def _obstacles(self) -> tuple[Ints, Ints]:
        """Blocked moves of each position, and the moves that each foot `[g, J]` needs."""
        feet, query = self.feet, self.query
        if not query.hard_obstacles:
            return np.zeros(0, dtype=np.int64), np.zeros((1, 1), dtype=np.int64)
        d = len(query.system.position)
        steps = feet.corners[..., :d]
        moves, where = np.unique(steps.reshape(-1, d), axis=0, return_inverse=True)
        blocked = blocked_moves(query, self.grid, moves)
        bits = (np.int64(1) << where.astype(np.int64)).reshape(steps.shape[:-1])
        return blocked.ravel(), np.bitwise_or.reduce(bits, axis=2)


@lru_cache
def _cost_axes(system: System, cost: RunningCost) -> NDArray[np.bool_]:
    """`[n]`: which coordinates W depends on, at any goal and obstacles."""
    center = [(system.lower[i] + system.upper[i]) / 2 for i in system.position]
    query = Query(system, Goal(tuple(center), 1.0), cost=cost)
    return coordinates_in(query.state_cost_expression(system.state), system.state)


def _array(dtype, dimension: int):
    return types.Array(dtype, dimension, "C")


I1, I2, I3 = (_array(types.int64, k) for k in (1, 2, 3))
F1, F2, F3, F4 = (_array(types.float64, k) for k in (1, 2, 3, 4))


# Inlined: handing a dozen arrays to a function takes as long as the function.
inlined = numba.njit(inline="always")


@inlined
def _mean(c, g, j, slowness, cost_offset, cost_weight, own):
    """The mean of s along a motion."""
    mean = own[g, j] * slowness[c]
    for k in range(cost_offset.shape[2]):
        mean += cost_weight[g, j, k] * slowness[c + cost_offset[g, j, k]]
    return mean


@inlined
def _update(
    node, c, g, kind, enters, shut, values, node_offset, node_weight, slowness, cost_offset,
    cost_weight, own, length, pairs, pair_geometry, faces, face_geometry, blocking, foot, cost,
):  # fmt: skip
    """The scheme's right side at one node, if it is below the node's value, else that value.

    A foot whose value is not below the best one found cannot lower it, whatever the way there
    costs. Comparisons with NaN (infinity - infinity) are false.
    """
    best = values[node]
    for j in range(node_offset.shape[1]):
        value = 0.0
        for k in range(node_offset.shape[2]):
            value += node_weight[g, j, k] * values[node + node_offset[g, j, k]]
        if (shut and shut & blocking[g, j]) or (kind >= 0 and enters[kind, j]):
            value = np.inf
        foot[j] = value
        if value < best or faces.shape[0] > 0:
            cost[j] = _mean(c, g, j, slowness, cost_offset, cost_weight, own)
            total = value + cost[j] * length[g, j]
            if total < best:
                best = total
        else:
            cost[j] = -1.0
    for k in range(pairs.shape[0]):
        a, b = pairs[k, 0], pairs[k, 1]
        if not min(foot[a], foot[b]) < best:
            continue
        if cost[a] < 0.0:
            cost[a] = _mean(c, g, a, slowness, cost_offset, cost_weight, own)
        if cost[b] < 0.0:
            cost[b] = _mean(c, g, b, slowness, cost_offset, cost_weight, own)
        # With the mean of the two, raising one could lower the minimum by moving it inside, where
        # the other's lower cost counts: the larger keeps the scheme monotone.
        mean = max(cost[a], cost[b])
        rise = foot[b] - foot[a]
        if rise < -mean * pair_geometry[g, k, 0] and rise > -mean * pair_geometry[g, k, 1]:
            r = rise / (mean * pair_geometry[g, k, 2])
            total = (
                foot[a]
                - rise * pair_geometry[g, k, 4]
                + mean * pair_geometry[g, k, 3] * math.sqrt(max(1.0 - r * r, 0.0))
            )
            if total < best:
                best = total
    for k in range(faces.shape[0]):
        # The costate p solves motion_i . p = V - foot_i with |p| = mean: a quadratic in V. The
        # minimum lies inside the face if the weights of the motions in p are positive.
        size, mean = 0, 0.0
        while size < faces.shape[1] and faces[k, size] >= 0:
            mean = max(mean, cost[faces[k, size]])
            size += 1
        ones, mixed, square = 0.0, 0.0, -mean * mean
        for i in range(size):
            for j in range(size):
                inverse = face_geometry[g, k, i, j]
                ones += inverse
                mixed += inverse * foot[faces[k, j]]
                square += inverse * foot[faces[k, i]] * foot[faces[k, j]]
        root = mixed * mixed - ones * square
        if not root >= 0.0:
            continue
        total = (mixed + math.sqrt(root)) / ones
        if total < best:
            inside = True
            for i in range(size):
                share = 0.0
                for j in range(size):
                    share += face_geometry[g, k, i, j] * (total - foot[faces[k, j]])
                inside = inside and share > 0.0
            if inside:
                best = total
    return best


@compiled(
    types.Tuple((types.int64, types.int64, float64))(
        F1, I1, _array(types.boolean, 2), I2, I1, I3, F3, F1, I3, F3, F2,
        F2, I2, F3, I2, F4, I1, I2, I2, I1, float64, types.int64, _array(types.uint8, 1),
    )
)  # fmt: skip
def _sweeps(
    values, kind, enters, layout, first, node_offset, node_weight, slowness, cost_offset,
    cost_weight, own, length, pairs, pair_geometry, faces, face_geometry, blocked, blocking,
    readers, reader_count, tolerance, max_sweeps, stale,
):  # fmt: skip
    """Gauss-Seidel sweeps in alternating orders until nothing changes: sweeps, updates, change.

    `stale` marks the nodes that read a value which has changed since they were last computed.
    """
    shape, strides, sub, cost_strides, place = (
        layout[0], layout[1], layout[2], layout[3], layout[4],
    )  # fmt: skip
    J = node_offset.shape[1]
    foot, cost = np.empty(J), np.empty(J)
    sweeps, updates, change = 0, 0, np.inf
    while sweeps <= max_sweeps and change > tolerance:
        change = 0.0
        for i in range(shape[0]):
            i0 = shape[0] - 1 - i if sweeps & 8 else i
            for j in range(shape[1]):
                i1 = shape[1] - 1 - j if sweeps & 4 else j
                for k in range(shape[2]):
                    i2 = shape[2] - 1 - k if sweeps & 2 else k
                    for h in range(shape[3]):
                        i3 = shape[3] - 1 - h if sweeps & 1 else h
                        node = (
                            first[0]
                            + i0 * strides[0] + i1 * strides[1] + i2 * strides[2] + i3 * strides[3]
                        )  # fmt: skip
                        if sweeps > 0 and not stale[node]:
                            continue
                        g = i0 * sub[0] + i1 * sub[1] + i2 * sub[2] + i3 * sub[3]
                        old = values[node]
                        if sweeps == 0:  # only tells the readers of the values given
                            if old < np.inf:
                                change = np.inf
                                for r in range(reader_count[g]):
                                    stale[node + readers[g, r]] = 1
                            continue
                        stale[node] = 0
                        if kind[node] == FIXED:
                            continue
                        c = (
                            first[1] + i0 * cost_strides[0] + i1 * cost_strides[1]
                            + i2 * cost_strides[2] + i3 * cost_strides[3]
                        )  # fmt: skip
                        shut = 0
                        if blocked.shape[0] > 0:
                            shut = blocked[
                                i0 * place[0] + i1 * place[1] + i2 * place[2] + i3 * place[3]
                            ]
                        new = _update(
                            node, c, g, kind[node], enters, shut, values, node_offset, node_weight,
                            slowness, cost_offset, cost_weight, own, length, pairs, pair_geometry,
                            faces, face_geometry, blocking, foot, cost,
                        )  # fmt: skip
                        updates += 1
                        if new < old:
                            values[node] = new
                            change = max(change, old - new)
                            if old - new > tolerance:
                                for r in range(reader_count[g]):
                                    stale[node + readers[g, r]] = 1
        sweeps += 1
    return sweeps - 1, updates, change
