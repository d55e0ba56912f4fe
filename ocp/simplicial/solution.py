"""V on a mesh: the first solve, and its repair when the mesh has changed."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.grids.goal_table import GoalTable, goal_table, has_goal_table
from ocp.query import Query
from ocp.simplicial import march as kernels
from ocp.simplicial.mesh import Mesh
from ocp.simplicial.mesh_value import MeshPolicy, MeshValue
from ocp.simplicial.stencils import GOAL_SLACK, Stencils, goal_ball, merged, stencils
from ocp.trajectory import SolveError, Status

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

TOLERANCE = 1e-4
FACTORS = (0.3, 3.0)
"""Bounds of what a cost may be multiplied by so that the exact value without obstacles fits."""
BUDGET = 400
"""Updates a vertex after which a march counts as not converging."""


@dataclass(frozen=True)
class Effort:
    """What a march took.

    Attributes:
        updates: how often a vertex's value was computed.
        acceptances: how often one was accepted; label setting accepts each vertex once.
        rises: acceptances that raised a value.
        again: vertices that were accepted more than once.
        from_scratch: whether a repair was given up for a solve from scratch.
    """

    updates: int
    acceptances: int
    rises: int
    again: int
    from_scratch: bool = False


@dataclass(frozen=True, eq=False)
class MeshSolution:
    """V at the vertices of a mesh.

    Attributes:
        query: what was solved.
        mesh: `N` vertices.
        values: `[N]`; infinite where no admissible motion reaches the goal.
        fixed: `[N]`, vertices in the goal or in hard obstacles.
        stencils: of the mesh.
        table: the exact value without obstacles that corrects the scheme; `None` for the plain one.
        factor: `[N]`, of costs.
        tolerance: of V, relative to the scheme's fixed point.
        effort: of the last march.
    """

    query: Query
    mesh: Mesh
    values: Floats
    fixed: NDArray[np.uint8]
    stencils: Stencils
    table: GoalTable | None
    factor: Floats
    tolerance: float
    effort: Effort

    @property
    def value(self) -> MeshValue:
        return MeshValue(self.query, self.mesh, self.values)

    def policy(self, margin: float = 0.0) -> MeshPolicy:
        """Feedback, `margin` metres clear of hard obstacles."""
        return MeshPolicy(self.value, margin)

    def scheme(self) -> tuple[Any, ...]:
        """What the kernels are given after the values."""
        s = self.stencils
        return self.fixed, self.factor, s.span, s.nodes, s.weight, s.effort, s.cost, s.pieces

    def residual(self) -> float:
        """Largest |V - T V| over the least cost of leaving the vertex: bounds the relative error
        against the scheme's fixed point."""
        fixed, factor, *rest = self.scheme()
        free = np.flatnonzero(fixed == 0)
        new = np.empty(len(free))
        kernels.updates(self.values, factor, *rest, free, new)
        least = kernels.least_costs(self.stencils.span, self.stencils.cost, factor)[free]
        known = np.isfinite(self.values[free]) | np.isfinite(new)
        gap = np.abs(np.where(known, new - self.values[free], 0.0))
        return float((gap / np.where(known, least, 1.0)).max(initial=0.0))

    def refined(self, marked: Ints) -> "MeshSolution":
        """The solution on the mesh with the leaves `marked` bisected, see `repaired`."""
        return self.repaired(self.mesh.refined(marked))

    def repaired(self, mesh: Mesh) -> "MeshSolution":
        """The solution on a refinement of its mesh: the values that the refinement makes invalid
        are repaired, the others are kept.

        Raises:
            SolveError: NOT_CONVERGED.
        """
        old = len(self.values)
        touched = np.unique(mesh.simplices[len(self.mesh.simplices) :])
        joined = merged(self.stencils, stencils(self.query, mesh, touched), touched)
        fixed, values = _given(self.query, mesh)
        free = fixed[:old] == 0
        values[:old][free] = self.values[free]
        # New vertices begin with the old value there: mostly near the new one.
        fresh = old + np.flatnonzero(fixed[old:] == 0)
        vertices, weights = self.mesh.locate(mesh.vertices[fresh])
        corner = np.where(weights > 0, self.values[vertices], 0.0)
        values[fresh] = (weights * corner).sum(axis=1)
        factor = np.ones(len(values))
        factor[:old] = self.factor
        _set_factors(factor, self.table, mesh, joined, touched)
        answer = replace(
            self, mesh=mesh, values=values, fixed=fixed, stencils=joined, factor=factor
        )
        return answer._marched(touched)

    def from_scratch(self) -> "MeshSolution":
        """The same mesh solved anew."""
        _, values = _given(self.query, self.mesh)
        return replace(self, values=values)._marched(np.arange(len(values)))

    def by_value_iteration(self, limit: int = 100_000) -> "MeshSolution":
        """The same mesh solved by plain value iteration, all vertices at once.

        Raises:
            SolveError: NOT_CONVERGED after `limit` sweeps.
        """
        _, values = _given(self.query, self.mesh)
        sweeps, updates = kernels.sweep(values, *self.scheme(), self.tolerance, limit)
        if sweeps < 0:
            raise SolveError(Status.NOT_CONVERGED, f"{limit} sweeps over the mesh")
        return replace(self, values=values, effort=Effort(updates, updates, 0, 0))

    def by_label_setting(self) -> "MeshSolution":
        """The same mesh in one pass without repair: exact where the scheme is causal, else high."""
        _, values = _given(self.query, self.mesh)
        effort = self._march(values, np.arange(len(values)), repair=False)
        assert effort is not None
        return replace(self, values=values, effort=effort)

    def _marched(self, stale: Ints) -> "MeshSolution":
        values = self.values.copy()
        effort = self._march(values, stale)
        if effort is None and len(stale) < len(values):
            # Refinement may cut a region off: its values would then rise for ever.
            _, values = _given(self.query, self.mesh)
            effort = self._march(values, np.arange(len(values)))
            effort = None if effort is None else replace(effort, from_scratch=True)
        if effort is None:
            raise SolveError(Status.NOT_CONVERGED, f"{BUDGET} updates a vertex")
        return replace(self, values=values, effort=effort)

    def _march(self, values: Floats, stale: Ints, repair: bool = True) -> Effort | None:
        """Brings `values` to the fixed point; `None` if the budget was spent."""
        accepted = np.zeros(len(values), dtype=np.int64)
        whole = len(stale) == len(values)
        stage = kernels.FIRST_STAGE if whole else kernels.REPAIR_STAGE
        updates, acceptances, rises = kernels.march(
            values, *self.scheme(), *self.stencils.readers(), stale, self.tolerance, repair,
            BUDGET * len(values), accepted, stage,
        )  # fmt: skip
        if updates < 0:
            return None
        return Effort(updates, acceptances, rises, int((accepted > 1).sum()))


def solve_on_mesh(
    query: Query, mesh: Mesh, *, table: bool = True, tolerance: float = TOLERANCE
) -> MeshSolution:
    """V of a time-free query on a mesh.

    Args:
        query: see `stencils.goal_ball`.
        mesh: over its states; its grid may use the half-turn symmetry.
        table: correct the scheme by the exact value without obstacles, if the robot has one.
        tolerance: of V, relative to the scheme's fixed point.

    Raises:
        SolveError: NOT_APPLICABLE; NOT_CONVERGED; INFEASIBLE if nothing reaches the goal.
        ValueError: if the mesh does not fit.
    """
    if mesh.dimension != query.system.n:
        raise ValueError(
            f"mesh: {query.system.name} has {query.system.n} states, not {mesh.dimension}"
        )
    if not 0.0 < tolerance < 1.0:
        raise ValueError(f"tolerance: must lie between 0 and 1, got {tolerance}")
    built = stencils(query, mesh)
    fixed, values = _given(query, mesh)
    reach = _reach(query, mesh)
    known = goal_table(query, reach) if table and has_goal_table(query, reach) else None
    factor = np.ones(len(values))
    _set_factors(factor, known, mesh, built, np.arange(len(values)))
    empty = Effort(0, 0, 0, 0)
    answer = MeshSolution(query, mesh, values, fixed, built, known, factor, tolerance, empty)
    answer = answer._marched(np.arange(len(values)))
    if not np.isfinite(answer.values[answer.fixed == 0]).any():
        raise SolveError(Status.INFEASIBLE, "no vertex of the mesh reaches the goal")
    return answer


def _given(query: Query, mesh: Mesh) -> tuple[NDArray[np.uint8], Floats]:
    """Which vertices are fixed, and values to start from."""
    in_goal = query.goal_distance(mesh.vertices) <= GOAL_SLACK
    inside = np.zeros(len(in_goal), dtype=bool)
    if query.hard_obstacles:
        inside = query.clearance(mesh.vertices, hard_only=True) < 0
    return (in_goal | inside).astype(np.uint8), np.where(in_goal & ~inside, 0.0, np.inf)


def _reach(query: Query, mesh: Mesh) -> float:
    """The largest distance of the mesh's box from the goal's boundary."""
    axes = list(query.system.position)
    ball = goal_ball(query)
    ends = np.array([mesh.grid.lower, mesh.grid.upper])[:, axes] - np.array(ball.center)
    return max(0.0, float(np.linalg.norm(abs(ends).max(axis=0))) - ball.radius)


def _set_factors(
    factor: Floats, table: GoalTable | None, mesh: Mesh, built: Stencils, which: Ints
) -> None:
    """Set the factors of the vertices `which`; 1 without a table, and beside hard obstacles."""
    factor[which] = 1.0
    if table is None:
        return
    exact = table.value(mesh.vertices)
    start, feet, pieces = built.span, built.span[which, 1] > built.span[which, 0], built.pieces
    which = np.ascontiguousarray(which[feet & (built.blocked[which] == 0)])
    kernels.factors(
        exact, start, built.nodes, built.weight, built.effort, built.alone, pieces, which,
        *FACTORS, factor,
    )  # fmt: skip
