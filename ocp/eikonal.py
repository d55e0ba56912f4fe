"""Values on a grid: one interface over the convergent schemes.

Where time can be scaled away (no drift, unbounded inputs) V solves an eikonal equation, and two
schemes solve that: single-pass fast marching on Selling stencils, and semi-Lagrangian sweeps. Any
other query is solved by value iteration in time. The result says which scheme made it.
"""

from dataclasses import dataclass
from enum import Enum

from ocp.fixed_point import FixedPoint
from ocp.grid import Grid, GridValue
from ocp.lookahead import LookaheadPolicy
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
class EikonalSolution:
    """A value on a grid.

    Attributes:
        query: what was solved.
        scheme: the scheme that solved it.
        value: V; infinite at nodes from which no admissible motion reaches the goal.
        fixed_point: the iteration's own account.
    """

    query: Query
    scheme: Scheme
    value: GridValue
    fixed_point: FixedPoint

    def policy(self) -> LookaheadPolicy:
        """Feedback by interpolated one-step lookahead."""
        return LookaheadPolicy(self.query, self.value)


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
    """
    scheme = scheme or default_scheme(query)
    if scheme is not Scheme.VALUE_ITERATION and not query.is_time_free:
        raise SolveError(
            Status.NOT_APPLICABLE, f"{scheme.name} needs a robot without drift and input bounds"
        )
    grid = grid or Grid.for_query(query, nodes)
    found = _solve(query, grid, scheme).checked()
    return EikonalSolution(query, scheme, GridValue(grid, found.values), found)


def _solve(query: Query, grid: Grid, scheme: Scheme) -> FixedPoint:
    if scheme is Scheme.FAST_MARCHING:
        from ocp.fast_marching import march

        return FixedPoint(march(query, grid), 1, grid.size, 0.0, 0.0)
    if scheme is Scheme.SEMI_LAGRANGIAN:
        from ocp.semi_lagrangian import sweep_time_free

        return sweep_time_free(query, grid)
    from ocp.value_iteration import iterate_values

    return iterate_values(query, grid)
