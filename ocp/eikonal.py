"""Values on a grid: one interface over the convergent schemes.

Where time can be scaled away (no drift, unbounded inputs) V solves an eikonal equation, and two
schemes solve that: single-pass fast marching on Selling stencils, and semi-Lagrangian sweeps. Any
other query is solved by value iteration in time. The result says which scheme made it.
"""

import time
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.grid import Grid, GridValue
from ocp.grids.bellman import bellman_geometry
from ocp.grids.fixed_point import FixedPoint
from ocp.grids.hard_obstacles import interpolate_visible_rows
from ocp.grids.lookahead import LookaheadPolicy
from ocp.query import Query
from ocp.trajectory import SolveError, Status

NODES = 60_000
"""Default size; with headings over half a turn, as fine as 120,000 nodes over the whole turn."""


class Scheme(Enum):
    """How values on a grid are found."""

    FAST_MARCHING = (
        "second-order fast marching on Selling stencils; time-free queries, 1 to 3 states"
    )
    SEMI_LAGRANGIAN = "ordered semi-Lagrangian sweeps; time-free queries, 1 to 4 states"
    VALUE_ITERATION = "semi-Lagrangian value iteration in time; any query, 1 to 4 states"


@dataclass(frozen=True, eq=False)
class QueryValue:
    """A grid's value that knows its query: 0 in the goal, not blurred by hard obstacles.

    Attributes:
        query: what was solved.
        on_grid: the nodes' values. Beside a hard obstacle only the nodes that a state sees past it
            are mixed, as the lookahead policy does.
    """

    query: Query
    on_grid: GridValue

    @property
    def grid(self) -> Grid:
        return self.on_grid.grid

    def value(self, states: ArrayLike) -> NDArray[np.float64]:
        """V `[...]` at states `[..., n]`; infinite outside the grid's box and in hard obstacles.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        states = np.asarray(states, dtype=float)
        values = self.on_grid.value(states)
        if self.query.hard_obstacles:
            rows = np.ascontiguousarray(states.reshape(-1, states.shape[-1]))
            seen = np.empty(len(rows))
            interpolate_visible_rows(self.on_grid.flat, self._geometry, rows, seen)
            values = seen.reshape(values.shape)
        return np.where(self.query.goal_distance(states) <= 0, 0.0, values)

    def gradient(self, states: ArrayLike) -> NDArray[np.float64]:
        """The gradient `[..., n]` of the interpolant at states `[..., n]`; 0 in the goal.

        Raises:
            ValueError: if a state is not finite or has the wrong length.
        """
        gradients = self.on_grid.gradient(states)
        outside = self.query.goal_distance(states) > 0
        return np.where(np.asarray(outside)[..., None], gradients, 0.0)

    @cached_property
    def _geometry(self) -> NDArray[np.float64]:
        return bellman_geometry(self.query, self.grid)


@dataclass(frozen=True, eq=False)
class EikonalSolution:
    """A value on a grid.

    Attributes:
        query: what was solved.
        scheme: the scheme that solved it.
        value: V; infinite where no admissible motion reaches the goal.
        fixed_point: the iteration's own account.
        seconds: how long it took, by the wall clock.
    """

    query: Query
    scheme: Scheme
    value: QueryValue
    fixed_point: FixedPoint
    seconds: float

    @property
    def grid(self) -> Grid:
        return self.value.grid

    @property
    def status(self) -> Status:
        return self.fixed_point.status

    def policy(self, margin: float = 0.0) -> LookaheadPolicy:
        """Feedback by interpolated one-step lookahead, `margin` metres clear of hard obstacles."""
        return LookaheadPolicy(self.query, self.value.on_grid, margin)


def default_scheme(query: Query) -> Scheme:
    """Fast marching where it applies, then sweeps, then value iteration."""
    if not query.is_time_free:
        return Scheme.VALUE_ITERATION
    return Scheme.FAST_MARCHING if query.system.n <= 3 else Scheme.SEMI_LAGRANGIAN


def solve_eikonal(
    query: Query,
    grid: Grid | None = None,
    *,
    nodes: int = NODES,
    scheme: Scheme | None = None,
) -> EikonalSolution:
    """V on a grid.

    Args:
        query: a query of a robot with at most 4 states.
        grid: by default one of about `nodes` nodes that suits the query.
        nodes: size of the default grid.
        scheme: by default `default_scheme`.

    Raises:
        SolveError: NOT_APPLICABLE if the scheme does not fit the query; NOT_CONVERGED; INFEASIBLE
            if nothing outside the goal reaches it.
        ValueError: if the grid does not fit.

    Example:
        >>> from ocp.query_family import PAPER_START, paper_query
        >>> solution = solve_eikonal(paper_query((1.0, 4.0)))
        >>> bool(abs(solution.value.value(PAPER_START) / 19.1125 - 1) < 0.005)  # exact: 19.1125
        True
        >>> solution.policy()(PAPER_START).shape
        (2,)
    """
    if query.is_regulation:
        raise SolveError(
            Status.NOT_APPLICABLE,
            "no front starts from an equilibrium, where V is no distance; the methods exact and "
            "value-iteration apply",
        )
    scheme = scheme or default_scheme(query)
    if scheme is not Scheme.VALUE_ITERATION and not query.is_time_free:
        raise SolveError(
            Status.NOT_APPLICABLE, f"{scheme.name} needs a robot without drift and input bounds"
        )
    began = time.perf_counter()
    grid = grid or Grid.for_query(query, nodes)
    found = _solve(query, grid, scheme).checked()
    seconds = time.perf_counter() - began
    value = QueryValue(query, GridValue(grid, found.values))
    return EikonalSolution(query, scheme, value, found, seconds)


def _solve(query: Query, grid: Grid, scheme: Scheme) -> FixedPoint:
    if scheme is Scheme.FAST_MARCHING:
        from ocp.grids.fast_marching import marched

        answer = marched(query, grid)
        return FixedPoint(answer.values, 1, len(answer.accepted), 0.0, 0.0)
    if scheme is Scheme.SEMI_LAGRANGIAN:
        from ocp.grids.semi_lagrangian import sweep_time_free

        return sweep_time_free(query, grid)
    from ocp.grids.value_iteration import iterate_values

    return iterate_values(query, grid)
