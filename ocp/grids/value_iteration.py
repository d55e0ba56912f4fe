"""The general scheme on a grid, for drift and bounded inputs: value iteration to a fixed point.

The semi-Lagrangian discretisation (Falcone and Ferretti, "Semi-Lagrangian Approximation Schemes for
Linear and Hamilton-Jacobi Equations", 2013)

    V(x) = min over u of  integral of L over a step + V(end of the step),

a step lasting until it has moved by about one cell, V interpolated, 0 at the first hit of the goal
ball. The box of the grid is a state constraint: where every motion leaves it, V is infinite.

Nodes are swept in alternating orders (Gauss-Seidel). Most sweeps only follow each node's best input
so far, as in modified policy iteration; inputs from all over the admissible set are tried when a
node is first reached, in every eighth sweep, and in closing sweeps over all nodes. Values only
fall, so an unfinished result bounds the scheme's from above.
"""

import numpy as np
from numba import types
from numpy.typing import NDArray

from ocp.compiled.function_address import ADDRESSES
from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64
from ocp.compiled.parameters import parameters
from ocp.grid import Grid
from ocp.grids.bellman import (
    SCRATCH_ROWS,
    bellman_addresses,
    bellman_at,
    bellman_geometry,
    bellman_settings,
)
from ocp.grids.fixed_point import FixedPoint
from ocp.grids.input_samples import sampled_inputs
from ocp.query import Query

TOLERANCE = 1e-4
MAX_SWEEPS = 500
CELLS = 1.0
ROUNDS = 3  # of refinement where many inputs are tried
PERIOD = 8  # sweeps from one that tries many inputs to the next


def iterate_values(
    query: Query,
    grid: Grid,
    upper_bound: NDArray[np.float64] | None = None,
    tolerance: float = TOLERANCE,
    max_sweeps: int = MAX_SWEEPS,
    held: NDArray[np.float64] | None = None,
) -> FixedPoint:
    """The value of any query on a grid.

    Args:
        query: any robot with at most 4 states.
        grid: over the robot's states; its box constrains the motion.
        upper_bound: `[*grid.shape]`, a value that V is known not to exceed (infinite where nothing
            is known).
        tolerance: changes smaller than this are not passed on.
        max_sweeps: give up after so many; the result then says so.
        held: `[*grid.shape]`, values that do not change where they are finite; they take the place
            of 0 in the goal.

    Raises:
        ValueError: if the grid does not fit the query.
    """
    if grid.dimension != query.system.n:
        raise ValueError(f"grid: {query.system.name} has {query.system.n} states, got {grid.shape}")
    nodes = grid.nodes().reshape(-1, grid.dimension)
    if held is None:
        fixed = query.goal_distance(nodes) <= 0
        values = np.where(fixed, 0.0, np.inf)
    else:
        if held.shape != grid.shape:
            raise ValueError(f"held: needs shape {grid.shape}, got {held.shape}")
        fixed = np.isfinite(held).ravel()
        values = held.ravel().copy()
    if upper_bound is not None:
        if upper_bound.shape != grid.shape:
            raise ValueError(f"upper_bound: needs shape {grid.shape}, got {upper_bound.shape}")
        values = np.where(fixed, values, np.fmin(values, upper_bound.ravel()))
    if query.hard_obstacles:
        blocked = query.clearance(nodes, hard_only=True) < 0
        values[blocked] = np.inf
        fixed |= blocked
    candidates, spread = sampled_inputs(query)
    functions = bellman_addresses(query, for_scheme=True)
    sweeps, updates, change = _iterate(
        nodes, values, np.full((grid.size, query.system.m), np.nan), fixed,
        np.array(grid.shape), candidates, spread, functions, parameters(query),
        bellman_settings(query, CELLS), bellman_geometry(query, grid), tolerance, max_sweeps,
    )  # fmt: skip
    return FixedPoint(values.reshape(grid.shape), sweeps, updates, change, tolerance)


@compiled(
    types.void(
        types.Array(types.int64, 1, "C"), types.Array(types.int64, 1, "C"), VECTOR,
        types.Array(types.uint8, 1, "C"),
    )
)  # fmt: skip
def _mark_neighbours(index, shape, geometry, stale):
    """Mark the 3^n nodes around a node as stale."""
    n = shape.shape[0]
    total = 1
    for _ in range(n):
        total *= 3
    for code in range(total):
        rest, node, stride = code, 0, 1
        inside = True
        for back in range(n):
            i = n - 1 - back
            at = index[i] + rest % 3 - 1
            rest //= 3
            if geometry[3 * n + i] > 0.0:
                at %= shape[i]
            inside = inside and 0 <= at < shape[i]
            node += at * stride
            stride *= shape[i]
        if inside:
            stale[node] = 1


@compiled(
    types.Tuple((types.int64, types.int64, float64))(
        MATRIX, VECTOR, MATRIX, types.Array(types.boolean, 1, "C"),
        types.Array(types.int64, 1, "C"), MATRIX, VECTOR, ADDRESSES, VECTOR,
        VECTOR, VECTOR, float64, types.int64,
    )
)  # fmt: skip
def _iterate(
    nodes, values, inputs, fixed, shape, candidates, spread, functions, q, settings, geometry,
    tolerance, max_sweeps,
):  # fmt: skip
    """Sweeps until a closing one changes nothing: number of sweeps, updates, last change."""
    count, n = nodes.shape
    m = inputs.shape[1]
    bellman = bellman_at(functions[4, 0], functions[4, 1])
    scratch = np.empty((SCRATCH_ROWS, max(2 * n, m)))
    nothing = np.empty((0, m))
    u = np.empty(m)
    index = np.zeros(n, dtype=np.int64)
    # What a node reads has changed since it was last computed, and since inputs were last tried.
    stale = np.ones(count, dtype=np.uint8)
    untried = np.ones(count, dtype=np.uint8)
    sweeps, updates, change = 0, 0, np.inf
    closing = True  # the first sweep, too, looks at all nodes
    while sweeps < max_sweeps:
        change = 0.0
        phase = sweeps % PERIOD
        for step in range(count):
            # The node that is `step`-th when bit i of the sweep says which way axis i is taken.
            rest, node, stride = step, 0, 1
            for back in range(n):
                i = n - 1 - back
                along = rest % shape[i]
                rest //= shape[i]
                index[i] = shape[i] - 1 - along if sweeps >> back & 1 else along
                node += index[i] * stride
                stride *= shape[i]
            u[:] = inputs[node]
            trying = closing or (untried[node] and (phase == 0 or np.isnan(u[0])))
            if fixed[node] or not (trying or stale[node]):
                continue
            stale[node] = 0
            if trying:
                untried[node] = 0
            elif np.isnan(u[0]):
                continue
            old = values[node]
            new = bellman(
                nodes[node], u, candidates if trying else nothing, spread,
                ROUNDS if trying else int(phase == PERIOD // 2),
                functions, q, settings, values, geometry, scratch,
            )  # fmt: skip
            updates += 1
            if new < old:
                values[node] = new
                inputs[node] = u
                change = max(change, old - new)
                if old - new > tolerance:
                    _mark_neighbours(index, shape, geometry, stale)
                    _mark_neighbours(index, shape, geometry, untried)
        sweeps += 1
        quiet = change <= tolerance
        if quiet and closing:
            return sweeps, updates, change
        closing = quiet
    return sweeps, updates, np.inf  # no quiet closing sweep
