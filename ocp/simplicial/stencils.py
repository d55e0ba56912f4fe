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

from ocp.compiled.jit import KERNEL, MATRIX, SCALAR, VECTOR, compiled
from ocp.compiled.parameters import parameters
from ocp.grids.hard_obstacles import SEGMENT, clear_segment, hard_data
from ocp.kernels import kernels
from ocp.query import Goal, Query
from ocp.simplicial.mesh import Mesh
from ocp.trajectory import SolveError, Status

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

I1 = types.Array(int64, 1, "C")
I2 = types.Array(int64, 2, "C")
FLAGS = types.Array(types.uint8, 1, "C")
GOAL = -1
GOAL_SLACK = 1e-9  # metres, so that rounding decides nothing
ROOT_STEPS = 12
ROOT_TOLERANCE = 1e-7  # share of an edge
GAUSS = (0.21132486540518713, 0.7886751345948129)  # two-point rule on [0, 1]


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
    feet, joined = _build(
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


@compiled(types.float64(KERNEL, VECTOR, VECTOR, MATRIX, VECTOR, VECTOR))
def _missed(dynamics, x, gap, columns, u, point):
    """What no input makes of a motion by `gap` `[3]` from x: its part along the normal of G.

    `columns` `[2, 3]`, `u` `[2]` and `point` `[3]` are overwritten.
    """
    for i in range(3):
        point[i] = x[i] + 0.5 * gap[i]
    for j in range(2):
        u[:] = 0.0
        u[j] = 1.0
        dynamics(point, u, columns[j])
    a, b = columns[0], columns[1]
    n0, n1, n2 = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return (n0 * gap[0] + n1 * gap[1] + n2 * gap[2]) / np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)


@compiled(types.boolean(KERNEL, VECTOR, VECTOR, VECTOR, MATRIX, VECTOR, MATRIX))
def _input(dynamics, x, gap, u, columns, point, system):
    """Into `u` `[m]` the input that moves by `gap` from x, by least squares; whether there is one.

    `columns` `[m, n]`, `point` `[n]` and `system` `[m, m + 1]` are overwritten.
    """
    n, m = x.shape[0], u.shape[0]
    for i in range(n):
        point[i] = x[i] + 0.5 * gap[i]
    for j in range(m):
        u[:] = 0.0
        u[j] = 1.0
        dynamics(point, u, columns[j])
    for i in range(m):
        for j in range(m + 1):
            total = 0.0
            for k in range(n):
                total += columns[i, k] * (columns[j, k] if j < m else gap[k])
            system[i, j] = total
    for i in range(m):  # Gauss: the matrix is positive definite, or no input moves the robot so
        if not system[i, i] > 0.0:
            return False
        for j in range(i + 1, m):
            ratio = system[j, i] / system[i, i]
            for k in range(i, m + 1):
                system[j, k] -= ratio * system[i, k]
    for back in range(m):
        i = m - 1 - back
        total = system[i, m]
        for j in range(i + 1, m):
            total -= system[i, j] * u[j]
        u[i] = total / system[i, i]
    return True


@compiled(
    types.UniTuple(int64, 2)(
        KERNEL, SCALAR, SCALAR, SEGMENT, VECTOR, VECTOR, VECTOR, VECTOR, I1, VECTOR, MATRIX, VECTOR,
        I2, I1, I1, I1, I2, I2, VECTOR, MATRIX, VECTOR, VECTOR, FLAGS, I2,
    )
)  # fmt: skip
def _build(
    dynamics, state_cost, bare_cost, clear, q, bare, weights, goal, position, hard, vertices,
    period, cells, start, around, which, span, nodes, weight, effort, cost, alone, blocked, pieces,
):  # fmt: skip
    """Fill the arrays of `Stencils`; returns the numbers of feet and pieces."""
    n, m = vertices.shape[1], effort.shape[1]
    d = position.shape[0]
    obstructed = hard[2] > 0.0
    obstacles = bare.shape[0] < q.shape[0]
    columns, point, u = np.empty((m, n)), np.empty(n), np.empty(m)
    system = np.empty((m, m + 1))
    gaps, missed = np.empty((n, n)), np.empty(n)
    link, corner = np.empty(n, dtype=np.int64), np.empty(n + 3, dtype=np.int64)
    gap, end, other = np.empty(n), np.empty(n), np.empty(n)
    largest_star = 0
    for v in which:
        largest_star = max(largest_star, start[v + 1] - start[v])
    keys = np.empty((largest_star * n, 2), dtype=np.int64)
    # Of the vertices around the present one
    slot = np.full(vertices.shape[0], -1, dtype=np.int64)
    star_gaps, star_missed = np.empty((largest_star * n, n)), np.zeros(largest_star * n)
    foot, piece = 0, 0
    for v in which:
        x = vertices[v]
        first, first_piece = foot, piece
        span[v, 0], span[v, 1], span[v, 2], span[v, 3] = foot, foot, piece, piece
        away = 0.0
        for i in range(d):
            away += (x[position[i]] - goal[1 + i]) ** 2
        away -= goal[0] ** 2
        if away <= 0.0:
            continue
        known_vertices = 0
        own, own_alone = np.sqrt(state_cost(x, q)), np.sqrt(bare_cost(x, bare))
        for row in range(start[v], start[v + 1]):
            size = 0
            for i in range(n + 1):
                j = cells[around[row], i]
                if j == v:
                    continue
                link[size] = j
                if slot[j] < 0:
                    slot[j] = known_vertices
                    largest = 0.0
                    for k in range(n):
                        step = vertices[j, k] - x[k]
                        if period[k] > 0.0:
                            step -= period[k] * np.round(step / period[k])
                        star_gaps[slot[j], k] = step
                        largest = max(largest, abs(step))
                    if m < n:
                        off = _missed(dynamics, x, star_gaps[slot[j]], columns, u, point)
                        star_missed[slot[j]] = 0.0 if abs(off) < 1e-11 * largest else off
                    known_vertices += 1
                for k in range(n):
                    gaps[size, k] = star_gaps[slot[j], k]
                missed[size] = star_missed[slot[j]]
                size += 1

            found = 0
            for i in range(n):
                for j in range(i, n):
                    # With as many inputs as states, the feet are the link's vertices. Else they are
                    # where nothing is missed: at a vertex, or inside an edge.
                    if m == n:
                        if i != j:
                            continue
                    elif i == j:
                        if missed[i] != 0.0:
                            continue
                    elif not missed[i] * missed[j] < 0.0:
                        continue
                    one, two = min(link[i], link[j]), max(link[i], link[j])
                    known = -1
                    for f in range(first, foot):
                        if keys[f - first, 0] == one and keys[f - first, 1] == two:
                            known = f
                    if known >= 0:
                        corner[found] = known
                        found += 1
                        continue

                    share = 0.0
                    if i != j:
                        low, high, a, b = 0.0, 1.0, missed[i], missed[j]
                        for _ in range(ROOT_STEPS):  # regula falsi (Illinois)
                            share = low + (high - low) * a / (a - b)
                            for k in range(n):
                                gap[k] = (1.0 - share) * gaps[i, k] + share * gaps[j, k]
                            c = _missed(dynamics, x, gap, columns, u, point)
                            if abs(c) <= ROOT_TOLERANCE * abs(missed[i] - missed[j]):
                                break
                            if c * b < 0.0:
                                low, a = high, b
                            else:
                                a *= 0.5
                            high, b = share, c
                    for k in range(n):
                        gap[k] = (1.0 - share) * gaps[i, k] + share * gaps[j, k]
                        end[k] = x[k] + gap[k]
                    if not _input(dynamics, x, gap, u, columns, point, system):
                        continue

                    # First hit of the goal ball, on the chord
                    a, b, hit = 0.0, 0.0, 2.0
                    for k in range(d):
                        step = gap[position[k]]
                        a += step * step
                        b += step * (x[position[k]] - goal[1 + k])
                    if b < 0.0 and b * b >= a * away:
                        hit = (-b - np.sqrt(b * b - a * away)) / a
                    arrives = hit <= 1.0
                    if arrives:
                        for k in range(n):
                            end[k] = x[k] + hit * gap[k]
                    if obstructed:
                        shut = clear(x, end, hard) == 0.0
                        if not arrives:
                            for side in (i, j):
                                for k in range(n):
                                    other[k] = x[k] + gaps[side, k]
                                shut = shut or clear(end, other, hard) == 0.0
                        if shut:
                            blocked[v] = 1
                            continue

                    scale = hit if arrives else 1.0
                    length = 0.0
                    for k in range(m):
                        effort[foot, k] = scale * np.sqrt(weights[k]) * u[k]
                        length += effort[foot, k] ** 2
                    length = np.sqrt(length)
                    if arrives:
                        total, without = 0.0, 0.0
                        for g in range(2):  # Gauss: W has a square root's end at the goal
                            for k in range(n):
                                point[k] = x[k] + hit * GAUSS[g] * gap[k]
                            total += np.sqrt(state_cost(point, q))
                            without += np.sqrt(bare_cost(point, bare))
                        cost[foot], alone[foot] = total * length, without * length
                        nodes[foot, 0] = nodes[foot, 1] = GOAL
                        weight[foot] = 0.0
                    else:
                        for k in range(n):
                            point[k] = x[k] + 0.5 * gap[k]
                        total = own + 4.0 * np.sqrt(state_cost(point, q))
                        total += np.sqrt(state_cost(end, q))
                        cost[foot] = alone[foot] = total / 3.0 * length
                        if obstacles:
                            total = own_alone + 4.0 * np.sqrt(bare_cost(point, bare))
                            total += np.sqrt(bare_cost(end, bare))
                            alone[foot] = total / 3.0 * length
                        nodes[foot, 0], nodes[foot, 1] = one, two
                        weight[foot] = share if link[i] == one else 1.0 - share
                        if i == j:
                            weight[foot] = 0.0
                    keys[foot - first, 0], keys[foot - first, 1] = one, two
                    corner[found] = foot
                    found += 1
                    foot += 1
            if m == n and found == 3:
                pieces[piece, 0], pieces[piece, 1], pieces[piece, 2] = (
                    corner[0], corner[1], corner[2],
                )  # fmt: skip
                piece += 1
            for i in range(found):
                for j in range(i):
                    one, two = min(corner[i], corner[j]), max(corner[i], corner[j])
                    known = False
                    for p in range(first_piece, piece):
                        if pieces[p, 0] == one and pieces[p, 1] == two and pieces[p, 2] < 0:
                            known = True
                    if not known:
                        pieces[piece, 0], pieces[piece, 1], pieces[piece, 2] = one, two, -1
                        piece += 1
        for row in range(start[v], start[v + 1]):
            for i in range(n + 1):
                slot[cells[around[row], i]] = -1
        span[v, 1], span[v, 3] = foot, piece
    return foot, piece
