"""Families of regulation problems: what varies from query to query, and where motions start.

A family is told from a query alone, by its `context`: what the cost and the input limits are. The
goal may be anywhere where the robot does not notice the difference (`free_coordinates`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.cost import RunningCost
from ocp.models import get_model
from ocp.models.moving_frame import CRUISE
from ocp.query import Equilibrium, Query
from ocp.system import System
from ocp.trajectory import SolveError, Status

Array = NDArray[np.float64]

GOAL_RADIUS = 0.1
"""Of the region that counts as reached, over all coordinates."""


@dataclass(frozen=True)
class RegulationFamily:
    """A distribution of queries with a common robot, and of starts.

    Attributes:
        name: for records and messages.
        draw: one query from a random generator.
        reach: `[n]`, starts are uniform within so much of the goal in each coordinate.
        mirror: `[n]`, signs of a reflection of the offset from the goal under which V is unchanged;
            empty if there is none.
    """

    name: str
    draw: Callable[[np.random.Generator], Query]
    reach: tuple[float, ...]
    mirror: tuple[float, ...] = ()

    def sample(self, rng: np.random.Generator) -> Query:
        """One query."""
        return self.draw(rng)

    def starts(self, query: Query, count: int, rng: np.random.Generator) -> Array:
        """`[count, n]`, uniform round the goal."""
        reach = np.array(self.reach)
        return query.reference + rng.uniform(-reach, reach, (count, len(reach)))


def context(query: Query) -> Array:
    """What tells a regulation query from others of the same robot, `[n + 3 m]`.

    Roots of the diagonals of M and R, and the reciprocals of the room that each input has above and
    below the one that holds the equilibrium (0 without a bound).

    Raises:
        SolveError: NOT_APPLICABLE for goal balls, obstacles, other costs.
    """
    if not query.is_regulation:
        raise _refusal("the goal is no equilibrium")
    if query.obstacles:
        raise _refusal("there are obstacles")
    if query.cost.own:
        raise _refusal("the cost is not quadratic alone")
    M = np.array(query.cost.state)
    if np.abs(M - np.diag(np.diag(M))).max() > 0:
        raise _refusal("cost.state is not diagonal")
    lower, upper = query.input_bounds
    held = query.reference_input
    return np.concatenate(
        [
            np.sqrt(np.diag(M)),
            np.sqrt(query.input_weights),
            1.0 / (upper - held),
            1.0 / (held - lower),
        ]
    )


def _refusal(reason: str) -> SolveError:
    return SolveError(Status.NOT_APPLICABLE, f"causality-free learning: {reason}")


@lru_cache(maxsize=64)
def free_coordinates(system: System) -> tuple[int, ...]:
    """The coordinates that the dynamics do not depend on: a goal may lie anywhere along them."""
    everything = ca.vertcat(system.drift, ca.vec(system.input_matrix))
    return tuple(i for i in range(system.n) if not ca.depends_on(everything, system.state[i]))


def _log_uniform(rng: np.random.Generator, lower: float, upper: float) -> float:
    return float(np.exp(rng.uniform(np.log(lower), np.log(upper))))


def _diagonal(entries: list[float]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(map(float, row)) for row in np.diag(entries))


def loaded_quadrotor(load: float, weights: list[float], effort: float, goal: Array) -> Query:
    """The planar quadrotor, flying to `goal` `[6]`, its mass and inertia `load` times as large.

    Thrusts divided by `load` move it as they move the empty one, so the query is one of the empty
    quadrotor: its limits are divided by `load`, its weight of effort is multiplied by `load`^2.
    """
    system = get_model("planar_quadrotor")
    upper = tuple(float(i.upper) / load for i in system.inputs)
    return Query(
        "planar_quadrotor",
        Equilibrium(tuple(map(float, goal)), GOAL_RADIUS),
        cost=RunningCost(
            goal=0.0, obstacle=0.0, state=_diagonal(weights), input=(effort * load**2,) * system.m
        ),
        input_upper=upper,
    )


def _draw_quadrotor(rng: np.random.Generator) -> Query:
    load = rng.uniform(1.0, 1.5)
    position, tilt, speed = (_log_uniform(rng, 0.5, 2.0) for _ in range(3))
    effort = _log_uniform(rng, 0.15, 0.6)
    goal = np.zeros(6)
    goal[:2] = rng.uniform(-1.5, 1.5, 2)
    weights = [position, position, tilt, 0.5 * speed, 0.5 * speed, 0.1]
    return loaded_quadrotor(load, weights, effort, goal)


def merging_car(weights: list[float], effort: list[float], limits: list[float]) -> Query:
    """The car that merges into a moving slot, its inputs within +-`limits`."""
    slot = (0.0, 0.0, 0.0, CRUISE, 0.0)
    bounds = tuple(map(float, limits))
    return Query(
        "car_in_lane",
        Equilibrium(slot, GOAL_RADIUS),
        cost=RunningCost(
            goal=0.0, obstacle=0.0, state=_diagonal(weights), input=tuple(map(float, effort))
        ),
        input_lower=tuple(-b for b in bounds),
        input_upper=bounds,
    )


def _draw_car(rng: np.random.Generator) -> Query:
    along, across = (_log_uniform(rng, 0.5, 2.0) for _ in range(2))
    effort = [_log_uniform(rng, 0.15, 0.6) for _ in range(2)]
    limits = [rng.uniform(1.0, 3.0), rng.uniform(0.8, 2.0)]
    return merging_car([along, across, 0.5, 0.3, 0.3], effort, limits)


FAMILIES: dict[str, RegulationFamily] = {
    "quadrotor": RegulationFamily(
        "quadrotor", _draw_quadrotor, (3.0, 3.0, 1.2, 3.0, 3.0, 3.0), (-1, 1, -1, -1, 1, -1)
    ),
    "car": RegulationFamily("car", _draw_car, (2.5, 2.0, 0.8, 0.7, 0.4), (1, -1, -1, 1, -1)),
}


def get_family(name: str) -> RegulationFamily:
    """A family by name.

    Raises:
        ValueError: if it is unknown; the message lists those that are known.
    """
    if name not in FAMILIES:
        raise ValueError(f"family: {name!r} is unknown; known are {', '.join(FAMILIES)}")
    return FAMILIES[name]
