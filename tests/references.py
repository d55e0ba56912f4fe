"""Problems whose answers are known: closed forms, and queries that exercise every kernel."""

import numpy as np
from scipy.integrate import quad

from ocp.cost import RunningCost
from ocp.models import MODELS, get_model
from ocp.obstacle import Obstacle
from ocp.query import Equilibrium, Goal, Query

TABLE_ONE_OPTIMA = {
    (4.0, 4.0): 23.29976,
    (1.0, 1.0): 15.57723,
    (1.0, 4.0): 19.11246,
    (4.0, 1.0): 19.11246,
}
"""Optimal costs of the paper's four queries from PAPER_START: direct collocation (LGR) and PMP
multiple shooting agree on them to five digits."""


def aligned_value(distance: float, radius: float = 0.5, steepness: float = 3.0) -> float:
    """V at `distance` from the goal's centre when the heading is along the ray, no obstacles.

    The robot drives straight: V is twice the integral of sqrt(Q) from the goal's boundary. Q is
    written out here on its own, as an oracle independent of ocp.cost. The substitution
    r = radius + s^2 removes the square-root singularity of sqrt(Q) at the boundary.
    """

    def integrand(s: float) -> float:
        excess = (radius + s**2) ** 2 - radius**2
        q = 2.0 / (1.0 + np.exp(-steepness * excess)) - 1.0
        return 2.0 * np.sqrt(max(q, 0.0)) * 2.0 * s

    return quad(integrand, 0.0, np.sqrt(distance - radius), epsabs=1e-13, epsrel=1e-13)[0]


def typical_query(model: str, bounded: bool = False) -> Query:
    """A query for any registered robot, with an obstacle of each shape that its space admits.

    A robot whose positions are angles has an equilibrium as its goal: half a turn from 0 in the
    first, where pendulums stand.
    """
    system = get_model(model)
    d = len(system.position)
    angular = any(system.coordinates[i].periodic for i in system.position)
    obstacles = [] if angular else [Obstacle.circle([-1.0] * d, 0.9)]
    if d == 2 and not angular:
        obstacles += [
            Obstacle.diamond((-2.0, 2.0), 0.8),
            Obstacle.polygon([(2.0, -2.0), (3.0, -1.5), (2.5, -0.5), (1.7, -0.9)]),
        ]
    diagonal = np.diag(np.linspace(0.1, 0.4, system.n)) + 0.05
    quadratic = tuple(tuple(map(float, row)) for row in diagonal)
    cost = RunningCost(
        input=tuple(np.linspace(0.5, 2.0, system.m)), state=quadratic, goal=0.0 if angular else 1.0
    )
    limits = (-0.8,) * system.m, (0.6,) * system.m
    goal = Equilibrium((np.pi, *[0.0] * (system.n - 1)), 0.5) if angular else Goal((1.0,) * d, 0.5)
    return Query(model, goal, tuple(obstacles), cost, *(limits if bounded else (None, None)))


ALL_QUERIES = [(name, bounded) for name in MODELS for bounded in (False, True)]
"""Every robot, with free and with bounded inputs."""


def _meets_a_ball(model: str) -> bool:
    system = get_model(model)
    follows = not system.has_drift or system.n == 2 * len(system.position)
    return isinstance(typical_query(model).goal, Goal) and follows


BALL_QUERIES = [(name, bounded) for name, bounded in ALL_QUERIES if _meets_a_ball(name)]
"""Of these, goals that are balls of positions, for robots without drift or with a velocity for each
position: a test can then choose ends that move inward."""


def tame_states(model: str, rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    """States `[count, n]` within `size` of 0 and well inside the robot's domain.

    A steering angle near a quarter turn, say, has no finite motion.
    """
    system = get_model(model)
    lower, upper = np.maximum(-size, 0.8 * system.lower), np.minimum(size, 0.8 * system.upper)
    return rng.uniform(lower, upper, (count, system.n))
