"""The time-free form on a grid: single-pass fast marching.

V solves p' D p = 4 W with p = grad V (`selling_stencil`). With p' D p = sum_e w_e (e . p)^2, the
scheme at a node x is

    sum_e w_e max(0, V(x) - min(V(x + e), V(x - e)))^2 = 4 W(x),

which is monotone and causal: V(x) depends on smaller values only, so nodes are accepted once, in
the order of their values, from a heap (Mirebeau 2014, "Anisotropic fast-marching on Cartesian grids
using lattice basis reduction"; 2018, "Fast-marching methods for curvature penalized shortest
paths"). When a node is accepted its value is computed anew with differences of second order,
(3 V(x) - 4 V(x + e) + V(x + 2 e)) / 2, along offsets whose both nodes are accepted, in order
(limited, see `march_kernels`).

Most of the error on a coarse grid is made near the goal, where V is not smooth. Where an exact
value U without obstacles is known (`goal_table`; it solves the equation for some W_U <= W), the
scheme's own truncation error at U is therefore put on the right side:

    scheme(V)(x) = scheme(U)(x) + 4 (W(x) - W_U(x)).

Where no obstacle is felt, V = U at the nodes whatever the spacing and relaxation; elsewhere this
is still consistent, as scheme(U) tends to 4 W_U. On the unicycle with obstacles it divides the
median error by 2 to 4.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ocp.compiled.batch import state_costs
from ocp.grid import Grid
from ocp.grids import march_kernels
from ocp.grids.bellman import arrival_costs
from ocp.grids.goal_table import goal_table, has_goal_table
from ocp.grids.hard_obstacles import MAX_MOVES, blocked_moves
from ocp.grids.selling_stencil import SellingStencil, cost_axes, relaxation, selling_stencil
from ocp.query import Query
from ocp.trajectory import SolveError, Status

__all__ = ["Marched", "march", "marched", "relaxation"]

Floats = NDArray[np.float64]

ARRIVAL_CELLS = 3.0  # nodes this near to the goal start with the cost of driving straight in


@dataclass(frozen=True)
class Marched:
    """What a march gives.

    Attributes:
        values: `[*grid.shape]`; infinite where hard obstacles leave no way.
        accepted: flat indices of the nodes in the order of acceptance, without those given.
    """

    values: Floats
    accepted: NDArray[np.int64]


def march(
    query: Query,
    grid: Grid,
    *,
    order: int = 2,
    relaxation: float | None = None,
    seed: bool = True,
) -> Floats:
    """V `[*grid.shape]` of a time-free query at the nodes of a grid.

    Args:
        query: without drift and without input bounds, at most 3 states.
        grid: over the robot's states; it may use the half-turn symmetry.
        order: of the differences, 1 or 2.
        relaxation: of D, in (0, 1]; by default the function `relaxation` of the grid.
        seed: use what is known near the goal: the exact value without obstacles if the robot has a
            `goal_table`, else the cost of driving straight into the goal from the nodes next to it.
            If not, only the nodes in the goal are given.

    Raises:
        SolveError: NOT_APPLICABLE if the query is not time-free, or the robot not suited.
        ValueError: if an argument does not fit, or the grid is too coarse to meet the goal.
    """
    return marched(query, grid, order=order, relaxation=relaxation, seed=seed).values


def marched(
    query: Query,
    grid: Grid,
    *,
    order: int = 2,
    relaxation: float | None = None,
    seed: bool = True,
    scale: Floats | None = None,
) -> Marched:
    """As `march`, with the order in which nodes were accepted.

    `scale` `[*grid.shape]` multiplies 2 sqrt(W) at the nodes; by default 1.

    Raises:
        SolveError, ValueError: as `march`.
    """
    _check(query, grid, order, relaxation)
    problem = _Problem(query, grid, _relaxation(grid) if relaxation is None else relaxation)
    if seed and has_goal_table(query, problem.reach):
        values, first, final, starts = problem.with_table(order)
    elif seed:
        values, first, final, starts = problem.with_arrivals()
    else:
        values, first = problem.in_goal(), problem.right_side()
        final, starts = first, np.zeros((0, 2))
    if scale is not None:
        factor = problem.stencil.padded(scale**2, 1.0)
        first, final = first * factor, np.where(final < 0, final, final * factor)
    if not (np.isfinite(values).any() or len(starts)):
        raise ValueError(
            f"grid.shape: {grid.shape} is too coarse for any node to meet the goal of radius "
            f"{query.goal.radius:g} m (or hard obstacles close it off)"
        )
    padded, order_of = problem.solve(values, first, final, starts, order)
    return Marched(problem.stencil.unpadded(padded), problem.numbers()[order_of])


_relaxation = relaxation  # `march` has an argument of this name


def _check(query: Query, grid: Grid, order: int, relaxation: float | None) -> None:
    system = query.system
    if not query.is_time_free:
        detail = "the time-free form needs no drift and no input bounds"
        raise SolveError(Status.NOT_APPLICABLE, detail)
    if grid.dimension != system.n:
        raise ValueError(f"grid: {system.name} has {system.n} states, got {grid.shape}")
    if order not in (1, 2):
        raise ValueError(f"order: must be 1 or 2, got {order}")
    if relaxation is not None and not 0.0 < relaxation <= 1.0:
        raise ValueError(f"relaxation: must lie in (0, 1], got {relaxation}")
    for i, c in enumerate(system.coordinates):
        extent = grid.upper[i] - grid.lower[i]
        allowed = (c.extent, c.extent / 2) if i == system.half_turn else (c.extent,)
        fits = c.periodic and any(abs(extent - a) < 1e-9 * c.extent for a in allowed)
        if grid.periodic[i] and not fits:
            raise ValueError(f"grid: axis {c.name} cannot be periodic over {extent:g} {c.unit}")


class _Problem:
    """A query on a grid as flat arrays with ghosts."""

    def __init__(self, query: Query, grid: Grid, relaxation: float) -> None:
        self.query, self.grid = query, grid
        self.stencil: SellingStencil = selling_stencil(query, grid, relaxation)
        d = len(query.system.position)
        self.positions = self._states(np.arange(grid.dimension) < d)
        corners = np.array([grid.lower[:d], grid.upper[:d]]) - query.goal_position
        self.reach = max(0.0, float(np.hypot.reduce(abs(corners).max(axis=0))) - query.goal.radius)
        self.distance = query.goal_distance(self.positions)

    def _states(self, axes: NDArray[np.bool_]) -> Floats:
        """`[..., n]`, the grid's nodes; one node in the middle along axes that are not wanted."""
        middle = [(a + b) / 2 for a, b in zip(self.grid.lower, self.grid.upper, strict=True)]
        rows = [
            axis if wanted else np.array([m])
            for axis, wanted, m in zip(self.grid.axes, axes, middle, strict=True)
        ]
        return np.stack(np.meshgrid(*rows, indexing="ij"), axis=-1)

    def in_goal(self) -> Floats:
        """0 at the nodes in the goal, else infinite."""
        return self.stencil.padded(np.where(self.distance <= 0, 0.0, np.inf), np.inf)

    def right_side(self) -> Floats:
        """4 W."""
        return self.stencil.padded(4.0 * self._costs(self.query), 0.0)

    def _costs(self, query: Query) -> Floats:
        return state_costs(query, self._states(cost_axes(query)))

    def with_table(self, order: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Given values, right sides of the schemes, and nodes to start with."""
        query, stencil = self.query, self.stencil
        table = goal_table(query, self.reach)
        exact = stencil.padded(table.on_product(*self.grid.axes), np.inf)
        alone = replace(query, obstacles=(), cost=replace(query.cost, state=None))
        base, cost = self._costs(alone), self._costs(query)
        excess = stencil.padded(4.0 * (cost - base), 0.0)
        first, final = np.zeros(len(exact)), np.zeros(len(exact))
        march_kernels.schemes(
            exact, stencil.entry, stencil.count, stencil.weights, stencil.near, stencil.far,
            order == 2, first, final,
        )  # fmt: skip
        # Nodes without a neighbour nearer to the goal, in terms of U: they cannot be reached by
        # differences of U. There the obstacle's cost is taken as a constant share of W.
        cells = abs(stencil.offsets[..., :2]).max(axis=(0, 1))
        near = (self.distance > 0) & (self.distance <= np.hypot(*(cells * self.grid.spacing[:2])))
        lowest = (first == 0.0) & stencil.padded(near, 0.0).astype(bool)
        with np.errstate(divide="ignore", invalid="ignore"):
            growth = stencil.padded(np.sqrt(cost / base), 1.0)
        values = self.in_goal()
        values[lowest] = exact[lowest] * growth[lowest]
        return values, first + excess, final + excess, np.zeros((0, 2))

    def with_arrivals(self) -> tuple[Floats, Floats, Floats, Floats]:
        """As `with_table`; a final right side of -1 says that the start is not to be bettered."""
        query, grid, stencil = self.query, self.grid, self.stencil
        first = self.right_side()
        h = grid.spacing[list(query.system.position)].max()
        near = np.broadcast_to(
            (self.distance > 0) & (self.distance < ARRIVAL_CELLS * h), grid.shape
        )
        costs = np.full(grid.shape, np.inf)
        costs[near] = arrival_costs(query, grid, grid.nodes()[near], ARRIVAL_CELLS)
        padded = stencil.padded(costs, np.inf)
        rows = np.flatnonzero(padded < np.inf)
        final = first.copy()
        final[rows] = -1.0
        return self.in_goal(), first, final, np.column_stack([rows.astype(float), padded[rows]])

    def solve(
        self, values: Floats, first: Floats, final: Floats, starts: Floats, order: int
    ) -> tuple[Floats, NDArray[np.int32]]:
        """Values `[N]`, and the nodes in the order of acceptance."""
        s, query = self.stencil, self.query
        entry, shut = s.entry, np.zeros(0, dtype=np.uint32)
        if query.hard_obstacles:
            inside = query.clearance(self.positions, hard_only=True) < 0
            entry = np.where(s.padded(inside, 0.0) > 0, np.int32(-1), entry)
            values[entry < 0] = np.inf
            shut = self._shut()
        accepted = np.empty(len(values), dtype=np.int32)
        count = march_kernels.march(
            values, first, final, entry, s.count, s.weights, s.near, s.far, s.reverse_start,
            s.reverse, s.reverse_weight, shut, starts, order == 2, accepted,
        )  # fmt: skip
        return values, accepted[:count]

    def numbers(self) -> NDArray[np.int64]:
        """`[N]`, the grid's own flat index of each node, -1 for ghosts."""
        numbers = np.full(self.stencil.shape, -1, dtype=np.int64)
        numbers[self.stencil.core] = np.arange(self.grid.size).reshape(self.grid.shape)
        return numbers.ravel()

    def _shut(self) -> NDArray[np.uint32]:
        """`[N]`, for `march_kernels.march`: which offsets cross a hard obstacle."""
        s, query, grid = self.stencil, self.query, self.grid
        d = len(query.system.position)
        once = np.stack([s.offsets, -s.offsets], axis=2)[..., :d]
        steps = np.stack([once, 2 * once], axis=1)
        moves, which = np.unique(steps.reshape(-1, d), axis=0, return_inverse=True)
        blocked = np.stack(
            [
                blocked_moves(query, grid, moves[i : i + MAX_MOVES]).ravel()
                for i in range(0, len(moves), MAX_MOVES)
            ]
        )
        place = np.zeros(s.shape, dtype=np.int64)
        place[s.core] = np.arange(blocked.shape[1]).reshape(self.distance.shape)
        out = np.zeros(s.entry.size, dtype=np.uint32)
        which = which.reshape(*steps.shape[:2], -1).astype(np.int64)
        march_kernels.collect(s.entry, place.ravel(), which, blocked, MAX_MOVES, out)
        return out
