"""What a vertex of a mesh reads: where the motions that leave it cross the simplices around it.

The link of a vertex x is the set of faces opposite to it in the simplices around it. A motion with
a constant input u crosses the link at a foot y with y - x = G((x + y) / 2) u (midpoint rule). If
there are as many inputs as states, every point of the link is a foot. If there is one input fewer
(the unicycle), the feet form a curve on the link: where the part of y - x that no input makes is
zero. It is found on the link's edges, and joined by a straight piece in each link simplex. So a
foot lies on an edge between two vertices, whose values it mixes.

A foot stands for a motion of effort |u| (R-norm) and of cost l = integral of 2 sqrt(W) |u| dt, that
of the best speed. A motion that meets the goal ball ends there: its foot has the value 0.
"""

from dataclasses import dataclass, replace

import numpy as np
from numba import int64, types
from numpy.typing import NDArray

from ocp.compiled.jit import compiled
from ocp.compiled.parameters import parameters
from ocp.grids.hard_obstacles import clear_segment, hard_data
from ocp.kernels import kernels
from ocp.query import Goal, Query
from ocp.simplicial.feet import find_feet
from ocp.simplicial.mesh import Mesh
from ocp.trajectory import SolveError, Status

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

I1 = types.Array(int64, 1, "C")
I2 = types.Array(int64, 2, "C")
GOAL_SLACK = 1e-9  # metres, so that rounding decides nothing


@dataclass(frozen=True, eq=False)
class Stencils:
    """The feet of every vertex, `F` in all, and the pieces of link between them, `P` in all.

    Attributes:
        span: `[N, 4]`, first and last + 1 of a vertex's feet and of its pieces.
        nodes: `[F, 2]`, the ends of the edge that holds the foot; GOAL, GOAL in the goal.
        weight: `[F]`, of the second end.
        effort: `[F, m]`, sqrt(R) u.
        cost: `[F]`, l.
        alone: `[F]`, l without obstacles and quadratic cost.
        blocked: `[N]`, whether a hard obstacle takes some of a vertex's feet.
        pieces: `[P, 3]`, feet that bound a piece; the third is -1 if there are two.
    """

    span: Ints
    nodes: Ints
    weight: Floats
    effort: Floats
    cost: Floats
    alone: Floats
    blocked: NDArray[np.uint8]
    pieces: Ints

    def readers(self) -> tuple[Ints, Ints]:
        """Starts `[N + 1]` in a list of vertices: those that read each vertex."""
        count = len(self.span)
        start = np.zeros(count + 1, dtype=np.int64)
        _count_readers(self.span, self.nodes, start)
        np.cumsum(start, out=start)
        readers = np.empty(start[-1], dtype=np.int64)
        _list_readers(self.span, self.nodes, start[:-1].copy(), readers)
        return start, readers


def goal_ball(query: Query) -> Goal:
    """The goal of a query to which the scheme applies.

    Raises:
        SolveError: NOT_APPLICABLE, saying which condition fails.
    """
    system, goal = query.system, query.goal
    if not isinstance(goal, Goal):
        raise SolveError(Status.NOT_APPLICABLE, "the goal must be a ball")
    if not query.is_time_free:
        detail = "the time-free form needs no drift and no input bounds"
        raise SolveError(Status.NOT_APPLICABLE, detail)
    if not (system.m == system.n <= 3 or (system.n, system.m) == (3, 2)):
        detail = f"{system.name} has {system.n} states and {system.m} inputs; 3 and 2, or as many"
        raise SolveError(Status.NOT_APPLICABLE, f"{detail} inputs as states, up to 3, are needed")
    return goal


def stencils(query: Query, mesh: Mesh, which: Ints | None = None) -> Stencils:
    """The stencils of a time-free query on a mesh.

    Args:
        query: see `goal_ball`.
        mesh: over its states.
        which: the vertices to make them for; the others get none. By default all.
    """
    ball = goal_ball(query)
    k, system = kernels(query), query.system
    bare = replace(query, obstacles=(), cost=replace(query.cost, state=None))
    count = len(mesh.vertices)
    which = np.arange(count) if which is None else which
    start, around = mesh.stars
    faces = int((start[which + 1] - start[which]).sum())
    corners = 3  # no link simplex has more feet
    span = np.zeros((count, 4), dtype=np.int64)
    nodes = np.empty((faces * corners, 2), dtype=np.int64)
    weight, cost, alone = np.empty((3, faces * corners))
    blocked = np.zeros(count, dtype=np.uint8)
    effort = np.empty((faces * corners, system.m))
    pieces = np.empty((faces * 4, 3), dtype=np.int64)
    goal = np.array([ball.radius + GOAL_SLACK, *ball.center])
    feet, joined = find_feet(
        k.dynamics, k.state_cost, kernels(bare).state_cost, clear_segment, parameters(query),
        parameters(bare), query.input_weights, goal, np.array(system.position), hard_data(query),
        mesh.vertices, mesh.period, mesh.cells, start, around, which, span, nodes, weight, effort,
        cost, alone, blocked, pieces,
    )  # fmt: skip
    return Stencils(
        span,
        nodes[:feet].copy(),
        weight[:feet].copy(),
        effort[:feet].copy(),
        cost[:feet].copy(),
        alone[:feet].copy(),
        blocked,
        pieces[:joined].copy(),
    )


def merged(old: Stencils, new: Stencils, renewed: Ints) -> Stencils:
    """`old` with the stencils of the vertices `renewed` taken from `new`."""
    span = new.span.copy()
    kept = np.ones(len(span), dtype=bool)
    kept[renewed] = False
    kept = np.flatnonzero(kept)
    rows = old.span[kept]
    feet, pieces = _ranges(rows[:, 0], rows[:, 1]), _ranges(rows[:, 2], rows[:, 3])
    at = len(new.weight) + np.concatenate([[0], np.cumsum(rows[:, 1] - rows[:, 0])])
    on = len(new.pieces) + np.concatenate([[0], np.cumsum(rows[:, 3] - rows[:, 2])])
    span[kept] = np.column_stack([at[:-1], at[1:], on[:-1], on[1:]])
    shift = np.repeat(at[:-1] - rows[:, 0], rows[:, 3] - rows[:, 2])[:, None]
    moved = old.pieces[pieces]
    moved = np.where(moved >= 0, moved + shift, -1)
    blocked = new.blocked.copy()
    blocked[kept] = old.blocked[kept]
    return Stencils(
        span,
        np.concatenate([new.nodes, old.nodes[feet]]),
        np.concatenate([new.weight, old.weight[feet]]),
        np.concatenate([new.effort, old.effort[feet]]),
        np.concatenate([new.cost, old.cost[feet]]),
        np.concatenate([new.alone, old.alone[feet]]),
        blocked,
        np.concatenate([new.pieces, moved]),
    )


def _ranges(first: Ints, last: Ints) -> Ints:
    """The numbers of all ranges [first, last), in a row."""
    sizes = last - first
    ends = np.cumsum(sizes)
    return np.arange(sizes.sum()) + np.repeat(first - (ends - sizes), sizes)


@compiled(types.boolean(I2, int64, int64, int64))
def _is_new(nodes, first, foot, side):
    """Whether no earlier entry since row `first` names the same vertex."""
    i = nodes[foot, side]
    for f in range(first, foot + 1):
        for other in range(2 if f < foot else side):
            if nodes[f, other] == i:
                return False
    return True


@compiled(types.void(I2, I2, I1))
def _count_readers(span, nodes, start):
    for v in range(span.shape[0]):
        for f in range(span[v, 0], span[v, 1]):
            for side in range(2):
                i = nodes[f, side]
                if i >= 0 and _is_new(nodes, span[v, 0], f, side):
                    start[i + 1] += 1


@compiled(types.void(I2, I2, I1, I1))
def _list_readers(span, nodes, at, readers):
    for v in range(span.shape[0]):
        for f in range(span[v, 0], span[v, 1]):
            for side in range(2):
                i = nodes[f, side]
                if i >= 0 and _is_new(nodes, span[v, 0], f, side):
                    readers[at[i]] = v
                    at[i] += 1
