"""What a collocation program is built for, and its costs and constraints in CasADi symbols."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from ocp import cost as costs
from ocp.kernels import Layout
from ocp.obstacle import Obstacle
from ocp.query import Query
from ocp.system import System


@dataclass(frozen=True)
class Structure:
    """What a program is built for; everything else about a query is a parameter.

    Attributes:
        system: the robot.
        layout: where each number of the query stands in its parameter vector.
        facets: for each obstacle its number of facets, 0 for a ball.
        hard: the hard obstacles, built in as constants.
        inflated: whether the robot has a radius.
        intervals, degree: the mesh.
        ends_at_goal: free final time, on the goal's boundary; else fixed time.
        max_iterations: of IPOPT.
    """

    system: System
    layout: Layout
    facets: tuple[int, ...]
    hard: tuple[Obstacle, ...]
    inflated: bool
    intervals: int
    degree: int
    ends_at_goal: bool
    max_iterations: int

    @classmethod
    def of(
        cls,
        query: Query,
        intervals: int,
        degree: int = 3,
        ends_at_goal: bool = True,
        max_iterations: int = 300,
    ) -> "Structure":
        return cls(
            query.system,
            Layout.of(query),
            tuple(len(o.facets) for o in query.obstacles),
            query.hard_obstacles,
            query.robot_radius > 0,
            intervals,
            degree,
            ends_at_goal,
            max_iterations,
        )


def state_cost(structure: Structure, x: ca.SX, q: ca.SX) -> ca.SX:
    """W(x) with the query's numbers as symbols `q`, laid out as `kernels.parameters`."""
    layout = structure.layout
    n, d = layout.n, layout.d
    position = x[list(structure.system.position)]
    at = layout.goal + d
    total = costs.goal_cost(position, q[layout.goal : at], q[at], q[at + 1], q[at + 2])
    if layout.quadratic:
        M = q[layout.state + n : layout.state + n + n * n].reshape((n, n))
        total += costs.quadratic_cost(x, reference(structure, q), M, structure.system.period)
    if layout.own_cost:
        total += costs.own_cost(layout.own_cost)(x)
    for i, facets in enumerate(structure.facets):
        k = layout.count + 1 + i * layout.stride
        shape = (q[k + 1], q[at + 3], q[at + 4])
        center, rows = q[k + 2 : k + 2 + d], q[k + 2 + d : k + 2 + d + d * facets]
        if facets:
            rows = rows.reshape((d, facets)).T
            total += costs.polygon_penalty(position, center, rows, *shape)
        else:
            total += costs.ball_penalty(position, center, *shape)
    return total


def effort(structure: Structure, u: ca.SX, q: ca.SX) -> ca.SX:
    """(u - u_g)' R (u - u_g) with the query's numbers as symbols."""
    m = structure.layout.m
    moved = u - q[3 * m : 4 * m] if structure.layout.resting else u
    return ca.dot(q[:m], moved**2)


def reference(structure: Structure, q: ca.SX) -> ca.SX:
    """x_g `n x 1` with the query's numbers as symbols."""
    layout = structure.layout
    if layout.quadratic:
        return q[layout.state : layout.state + layout.n]
    state = ca.SX.zeros(layout.n, 1)
    for i, index in enumerate(structure.system.position):
        state[index] = q[layout.goal + i]
    return state


def clearance(o: Obstacle, position: ca.SX, needed: ca.SX, inflated: bool) -> ca.SX:
    """An expression that is >= 0 only where the distance to `o` is at least `needed`.

    The signed distance has no derivative at a disc's centre nor on a polygon's boundary. For a
    point robot that boundary is where the constraint is active, so there the largest distance to a
    facet's line stands in: equal but at corners, where it asks for a little more.
    """
    if not o.vertices:
        return ca.sumsqr(position - ca.DM(o.center)) - (o.radius + needed) ** 2
    if inflated:
        return o.signed_distance_expression(position) - needed
    lengths = ca.DM(np.linalg.norm(o.facets, axis=1))
    depth = ca.mmax((ca.DM(o.facets) @ (position - ca.DM(o.center)) - 1) / lengths)
    return depth - needed  # pyright: ignore[reportOperatorIssue]


def symbol(name: str, *shape: int) -> ca.SX:
    """CasADi symbols of a shape, a scalar by default."""
    return ca.SX.sym(name, *shape)  # pyright: ignore[reportCallIssue, reportArgumentType]
