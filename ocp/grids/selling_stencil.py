"""The offsets and weights of fast marching on a grid, for any driftless robot of 1 to 3 states.

V solves p' D p = 4 W with p = grad V and D = G R^-1 G'. Where D is singular (a robot that cannot
move sideways) it is relaxed: seen in coordinates scaled by the mean square speed along each, D's
eigenvalues are raised to at least relaxation^2 times the largest. For the unicycle that is
n n' + relaxation^2 t t' in the plane, n along the heading and t across it (Mirebeau 2018, "Fast-
marching methods for curvature penalized shortest paths", the Reeds-Shepp model). In units of cells,
Selling's decomposition then gives p' D p = sum_e w_e (e . p)^2.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.cost import RunningCost
from ocp.grid import Grid
from ocp.grids.selling import decompose
from ocp.grids.stencil import coordinates_in, flat_strides
from ocp.query import Goal, Query
from ocp.system import System
from ocp.trajectory import SolveError, Status

Ints = NDArray[np.int32]
Floats = NDArray[np.float64]

NEGLIGIBLE = 1e-10  # of the largest weight: an offset with less is rounding
MAX_ENTRIES = 5_000_000


@dataclass(frozen=True, eq=False)
class SellingStencil:
    """Offsets from each node; `k` runs over the nodes of the axes that D depends on (and periodic
    ones), `f` over at most F offsets, `s` over an offset (0) and its opposite (1).

    Arrays of node values have ghost layers along axes that are not periodic, so that neighbours
    are plain differences of flat indices; wrapping round periodic axes is in the differences.

    Attributes:
        shape: of arrays with ghost layers.
        core: the part of such an array that is the grid.
        entry: `[N]`, k of each node, -1 for ghosts.
        offsets: `[k, F, n]`, in cells.
        count: `[k]`, how many offsets there are.
        weights: `[k, F]`, 1 / s; 0 beyond `count`.
        near, far: `[k, F, 2]`, flat differences to the nodes one and two offsets away.
        reverse_start: `[k + 1]`, where in `reverse` the nodes begin that have this one as
            a neighbour.
        reverse: `[r, 4]`, such a node's flat difference, from there that to the node opposite,
            its k, and 2 f + s.
        reverse_weight: `[r]`.
    """

    shape: tuple[int, ...]
    core: tuple[slice, ...]
    entry: Ints
    offsets: NDArray[np.int64]
    count: Ints
    weights: Floats
    near: Ints
    far: Ints
    reverse_start: Ints
    reverse: Ints
    reverse_weight: Floats

    def padded(self, values: NDArray[Any], ghost: float) -> Floats:
        """Flat `[N]`: `values`, which broadcast to the grid's shape, amid ghosts."""
        out = np.full(self.shape, ghost)
        out[self.core] = values
        return out.ravel()

    def unpadded(self, values: Floats) -> Floats:
        return np.ascontiguousarray(values.reshape(self.shape)[self.core])


def relaxed_metrics(query: Query, states: Floats, relaxation: float) -> Floats:
    """D `[k, n, n]` at `states` `[k, n]`, relaxed.

    Raises:
        SolveError: NOT_APPLICABLE if no input moves some coordinate.
    """
    system, count = query.system, len(states)
    column = ca.vec(ca.densify(system.input_matrix))  # pyright: ignore[reportArgumentType]
    matrices = ca.Function("G", [system.state], [column]).map(count)
    G = np.array(matrices(states.T)).T.reshape(count, system.m, system.n).swapaxes(1, 2)
    G = G / np.sqrt(query.input_weights)
    D = G @ np.swapaxes(G, -1, -2)
    speeds = np.sqrt(np.einsum("kii->ki", D).mean(axis=0))
    if not (speeds > 0).all():
        stuck = system.coordinates[int(speeds.argmin())].name
        raise SolveError(Status.NOT_APPLICABLE, f"no input of {system.name} moves {stuck}")
    scale = np.multiply.outer(speeds, speeds)
    sizes, directions = np.linalg.eigh(D / scale)
    sizes = np.maximum(sizes, relaxation**2 * sizes[:, -1:])
    return np.einsum("kij,kj,klj->kil", directions, sizes, directions) * scale


def selling_stencil(query: Query, grid: Grid, relaxation: float) -> SellingStencil:
    """The stencil of a time-free query's robot and input weights on a grid.

    Raises:
        SolveError: NOT_APPLICABLE if there are more than 3 states, or some coordinate is not moved.
        ValueError: if the input matrix depends on so many coordinates that the tables get too big.
    """
    if query.system.n > 3:
        detail = f"Selling's decomposition is for 1 to 3 states, {query.system.name} has more"
        raise SolveError(Status.NOT_APPLICABLE, detail)
    return _stencil(query.system, tuple(map(float, query.input_weights)), grid, relaxation)


def cost_axes(query: Query) -> NDArray[np.bool_]:
    """`[n]`: which coordinates W depends on."""
    return _cost_axes(query.system, query.cost.state)


@lru_cache(maxsize=32)
def _cost_axes(system: System, state: tuple[tuple[float, ...], ...] | None) -> NDArray[np.bool_]:
    expression = _plain_query(system, RunningCost(state=state)).state_cost_expression(system.state)
    depends = coordinates_in(expression, system.state)
    depends[list(system.position)] = True  # obstacles
    return depends


def _plain_query(system: System, cost: RunningCost) -> Query:
    """A query of this robot whose goal and obstacles do not matter."""
    center = tuple(float(system.lower[i] + system.upper[i]) / 2 for i in system.position)
    return Query(system, Goal(center, 1.0), cost=cost)


@lru_cache(maxsize=16)
def _stencil(
    system: System, weights_of_input: tuple[float, ...], grid: Grid, relaxation: float
) -> SellingStencil:
    n, periodic = system.n, np.array(grid.periodic)
    depends = coordinates_in(system.input_matrix, system.state) | periodic
    table = np.where(depends, grid.shape, 1)
    if table.prod() * n * (n + 1) > MAX_ENTRIES:
        raise ValueError(
            f"grid.shape: the input matrix of {system.name} depends on so many coordinates that "
            f"{grid.shape} needs too big a stencil; use fewer nodes"
        )
    index = np.stack(np.meshgrid(*map(np.arange, table), indexing="ij"), axis=-1).reshape(-1, n)
    center = (np.array(grid.lower) + grid.upper) / 2
    states = np.where(depends, np.array(grid.lower) + index * grid.spacing, center)
    query = _plain_query(system, RunningCost(input=weights_of_input))
    metrics = relaxed_metrics(query, states, relaxation)
    weights, offsets = decompose(metrics / np.multiply.outer(grid.spacing, grid.spacing))

    counts = weights > NEGLIGIBLE * weights.max(axis=1, keepdims=True)
    first = np.argsort(~counts, axis=1, kind="stable")[:, : int(counts.sum(axis=1).max())]
    weights = np.take_along_axis(np.where(counts, weights, 0.0), first, axis=1)
    offsets = np.take_along_axis(offsets * counts[..., None], first[..., None], axis=1)
    count = counts.sum(axis=1).astype(np.int32)

    ghost = np.where(periodic, 0, abs(offsets).max(axis=(0, 1)))
    shape = np.array(grid.shape) + 2 * ghost
    strides = flat_strides(shape)
    core = tuple(slice(g, g + c) for g, c in zip(ghost, grid.shape, strict=True))
    entry = np.full(shape, -1, dtype=np.int32)
    entry[core] = np.arange(len(index), dtype=np.int32).reshape(table)

    def differences(steps: int) -> Ints:
        there = index[:, None, None] + steps * np.stack([offsets, -offsets], axis=2)
        there = np.where(periodic, there % grid.shape, there)
        return ((there - index[:, None, None]) @ strides).astype(np.int32)

    near = differences(1)
    there = index[:, None, None] + np.stack([offsets, -offsets], axis=2)
    there = np.where(periodic, there % grid.shape, np.where(depends, there, 0))
    real = (weights > 0)[..., None] & np.all((there >= 0) & (there < table), axis=-1)
    k, f, s = np.nonzero(real)
    target = there[real] @ flat_strides(table)
    order = np.argsort(target, kind="stable")
    k, f, s, target = k[order], f[order], s[order], target[order]
    reverse = np.stack([-near[k, f, s], near[k, f, 1 - s], k, 2 * f + s], axis=-1)
    start = np.searchsorted(target, np.arange(len(index) + 1))
    return SellingStencil(
        tuple(map(int, shape)), core, entry.ravel(), offsets, count, weights, near, differences(2),
        start.astype(np.int32), np.ascontiguousarray(reverse, dtype=np.int32), weights[k, f],
    )  # fmt: skip


def relaxation(grid: Grid) -> float:
    """How much to relax D on a grid: 1.4 / sqrt(cells), at most 1; see `selling_stencil`.

    The relaxation errs by relaxation^2; offsets reach 1 / relaxation cells, so differences of
    second order err by (1 / (cells relaxation))^2. Both fall alike, like 1 / cells, for a multiple
    of 1 / sqrt(cells). `cells` is the number along the axis with most. The multiple had the least
    95 % quantile of the error over five queries of the unicycle, on grids of 28 to 114 cells a
    side; the median hardly depends on it.
    """
    cells = (np.array(grid.shape) - 1 + np.array(grid.periodic)).max()
    return min(1.0, 1.4 / math.sqrt(cells))
