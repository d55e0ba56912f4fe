"""The closed form: V on a straight drive to the goal.

Without obstacles, and where time can be scaled away, no motion gains distance on the goal at less
than 2 sqrt(Q) / c a metre, c the largest speed of the position under inputs of unit effort. A state
from which the robot can drive straight at the goal at that speed attains the bound:
V = (2 / c) times the integral of sqrt(Q) from the goal's boundary.
"""

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.cost import goal_cost
from ocp.query import Query
from ocp.trajectory import SolveError, Status

TOLERANCE = 1e-9


def straight_value(query: Query, state: NDArray[np.float64]) -> float:
    """V at `state` `[n]` if the closed form holds there.

    Raises:
        SolveError: NOT_APPLICABLE, saying which condition fails.
    """
    if not query.is_time_free or query.obstacles or query.cost.state is not None:
        raise SolveError(
            Status.NOT_APPLICABLE,
            "the closed form needs no drift, no bounds, no obstacles and no quadratic cost",
        )
    system = query.system
    rows = list(system.position)
    if query.goal_distance(state) <= 0:
        return 0.0
    matrix = ca.Function("G", [system.state], [ca.densify(system.input_matrix)])
    root = np.sqrt(query.input_weights)

    def motion(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """G R^(-1/2) and its rows of position."""
        scaled = np.array(matrix(x)) / root
        return scaled, scaled[rows]

    rng = np.random.default_rng(0)
    samples = rng.uniform(system.lower, system.upper, (32, system.n))
    speed = max(np.linalg.norm(motion(x)[1], 2) for x in samples)
    toward = query.goal_position - state[rows]
    distance = float(np.linalg.norm(toward))
    wanted = np.zeros(system.n)
    wanted[rows] = toward / distance
    for fraction in np.linspace(0.0, 1.0 - query.goal.radius / distance, 9):
        x = state + fraction * distance * wanted
        effort, *_ = np.linalg.lstsq(motion(x)[0], speed * wanted, rcond=None)
        straight = np.allclose(motion(x)[0] @ effort, speed * wanted, atol=TOLERANCE)
        if not straight or np.linalg.norm(effort) > 1 + TOLERANCE:
            raise SolveError(
                Status.NOT_APPLICABLE, "the robot cannot drive straight at the goal from here"
            )
    return float(2.0 / speed * _root_integral(query, distance))


def _root_integral(query: Query, distance: float) -> float:
    """The integral of sqrt(Q) from the goal's boundary to `distance` from its centre.

    Substituting r = r_g + s^2 removes the square-root singularity at the boundary; Gauss-Legendre
    on pieces then converges to rounding.
    """
    w, radius = query.cost, query.goal.radius
    r = ca.SX.sym("r")
    cost = ca.Function("Q", [r], [goal_cost(r, ca.SX(0), radius, w.goal, w.goal_steepness)])
    nodes, weights = np.polynomial.legendre.leggauss(20)
    edges = np.linspace(0.0, np.sqrt(distance - radius), 17)
    half = np.diff(edges)[:, None] / 2
    s = (edges[:-1, None] + half + half * nodes).ravel()
    values = np.sqrt(np.array(cost((radius + s**2)[None])).ravel()) * 2 * s
    return float((values.reshape(-1, 20) * weights * half).sum())
