"""Families of regulation problems: what varies from query to query, and where motions start.

A family is told from a query alone, by its `context`: what the cost and the input limits are, and
by where its obstacles lie. The goal may be anywhere where the robot does not notice the difference
(`free_coordinates`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ocp.cost import RunningCost
from ocp.models import get_model
from ocp.models.moving_frame import CRUISE
from ocp.obstacle import Obstacle
from ocp.query import Equilibrium, Query
from ocp.system import System
from ocp.trajectory import SolveError, Status

Array = NDArray[np.float64]

GOAL_RADIUS = 0.1
"""Of the region that counts as reached, over all coordinates."""


SHADOW = (1.2, 1.8)
"""A start behind an obstacle is so many times as far from the goal."""


@dataclass(frozen=True)
class Layouts:
    """Layouts of soft circles round the goal, so far from it that resting there costs nothing.

    Attributes:
        most: of them, at least one.
        radii: smallest and largest, metres.
        extent: `[d]`, centres lie within so much of the goal in each coordinate.
        weight, steepness: of the penalty, as in `RunningCost`.
        at_goal: the most that one penalty may be at the goal.
    """

    most: int
    radii: tuple[float, float]
    extent: tuple[float, ...]
    weight: float
    steepness: float
    at_goal: float = 3e-7

    def clear(self, radius: float) -> float:
        """Least distance from the goal to the centre of a circle, metres."""
        return float(np.sqrt(radius**2 + np.log(self.weight / self.at_goal) / self.steepness))

    def sample(self, goal: Array, rng: np.random.Generator) -> tuple[Obstacle, ...]:
        """One to `most` circles that do not overlap, round `goal` `[d]`."""
        wanted, found = int(rng.integers(1, self.most + 1)), []
        while len(found) < wanted:
            radius = float(rng.uniform(*self.radii))
            offset = rng.uniform(-1, 1, len(self.extent)) * self.extent
            gaps = [np.linalg.norm(goal + offset - o.center) - o.radius - radius for o in found]
            if np.linalg.norm(offset) >= self.clear(radius) and min(gaps, default=0.0) >= 0:
                found.append(Obstacle.circle(goal + offset, radius))
        return tuple(found)

    def why_foreign(self, query: Query) -> str | None:
        """Why a query's obstacles are none of these; `None` if they are."""
        cost, lower, upper = query.cost, *self.radii
        slack = 1e-9 + 0.25 * (upper - lower)
        if not 1 <= len(query.obstacles) <= self.most:
            return f"there are {len(query.obstacles)} obstacles, not 1 to {self.most}"
        if any(o.vertices or o.hard for o in query.obstacles):
            return "the obstacles are not soft circles"
        if (cost.obstacle, cost.obstacle_steepness) != (self.weight, self.steepness):
            return f"the penalty's weight and steepness are not {self.weight}, {self.steepness}"
        for o in query.obstacles:
            offset = np.abs(np.array(o.center) - query.goal_position)
            if not lower - slack <= o.radius <= upper + slack:
                return f"an obstacle's radius is not within {lower} to {upper} m"
            if (offset > 1.1 * np.array(self.extent)).any():
                return "an obstacle lies farther from the goal than any that was trained on"
        return None


@dataclass(frozen=True)
class RegulationFamily:
    """A distribution of queries with a common robot, and of starts.

    Attributes:
        name: for records and messages.
        draw: one query from a random generator.
        reach: `[n]`, starts are uniform within so much of the goal in each coordinate.
        mirror: `[n]`, signs of a reflection of the offset from the goal under which V is unchanged,
            if the obstacles are reflected too; empty if there is none.
        layouts: of obstacles; `None` if there are none.
    """

    name: str
    draw: Callable[[np.random.Generator], Query]
    reach: tuple[float, ...]
    mirror: tuple[float, ...] = ()
    layouts: Layouts | None = None

    def sample(self, rng: np.random.Generator) -> Query:
        """One query."""
        return self.draw(rng)

    def starts(self, query: Query, count: int, rng: np.random.Generator) -> Array:
        """`[count, n]`, uniform round the goal, outside obstacles.

        Where there are obstacles every second start lies behind one, seen from the goal.
        """
        rows = [self._start(query, k % 2 == 1, rng) for k in range(count)]
        return np.array(rows).reshape(count, len(self.reach))

    def _start(self, query: Query, behind: bool, rng: np.random.Generator) -> Array:
        reach, place = np.array(self.reach), list(query.system.position)
        while True:
            offset = rng.uniform(-reach, reach)
            if behind and query.obstacles:
                hidden = query.obstacles[rng.integers(len(query.obstacles))]
                away = np.array(hidden.center) - query.goal_position
                aside = 0.5 * hidden.radius * rng.normal(size=len(place))
                offset[place] = rng.uniform(*SHADOW) * away + aside
                if (np.abs(offset) > reach).any():
                    continue
            if query.clearance(query.reference + offset) >= 0:
                return query.reference + offset

    def why_foreign(self, query: Query) -> str | None:
        """Why a query's obstacles are none of the family's; `None` if they are."""
        if self.layouts is not None:
            return self.layouts.why_foreign(query)
        return "there are obstacles" if query.obstacles else None


def mirrored(query: Query, signs: Array) -> Query:
    """The query reflected at its goal by `signs` `[n]`: its obstacles lie on the other side."""
    if not query.obstacles:
        return query
    goal, flip = query.goal_position, signs[list(query.system.position)]
    return replace(
        query,
        obstacles=tuple(
            replace(o, center=tuple(map(float, goal + flip * (np.array(o.center) - goal))))
            for o in query.obstacles
        ),
    )


def context(query: Query) -> Array:
    """What tells a regulation query from others of the same robot and layout, `[n + 3 m]`.

    Roots of the diagonals of M and R, and the reciprocals of the room that each input has above and
    below the one that holds the equilibrium (0 without a bound).

    Raises:
        SolveError: NOT_APPLICABLE for goal balls, other costs.
    """
    if not query.is_regulation:
        raise _refusal("the goal is no equilibrium")
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


TRAFFIC = Layouts(most=3, radii=(0.3, 0.5), extent=(2.4, 1.2), weight=3.0, steepness=6.0)


def car_in_traffic(query: Query, others: tuple[Obstacle, ...]) -> Query:
    """The merging car among `others` that drive along in the lane, at rest in the slot's frame."""
    cost = replace(query.cost, obstacle=TRAFFIC.weight, obstacle_steepness=TRAFFIC.steepness)
    return replace(query, cost=cost, obstacles=others)


def _draw_traffic(rng: np.random.Generator) -> Query:
    query = _draw_car(rng)
    return car_in_traffic(query, TRAFFIC.sample(query.goal_position, rng))


FAMILIES: dict[str, RegulationFamily] = {
    "quadrotor": RegulationFamily(
        "quadrotor", _draw_quadrotor, (3.0, 3.0, 1.2, 3.0, 3.0, 3.0), (-1, 1, -1, -1, 1, -1)
    ),
    "car": RegulationFamily("car", _draw_car, (2.5, 2.0, 0.8, 0.7, 0.4), (1, -1, -1, 1, -1)),
    "traffic": RegulationFamily(
        "traffic", _draw_traffic, (3.5, 1.8, 0.6, 0.7, 0.3), (1, -1, -1, 1, -1), TRAFFIC
    ),
}


def balancing(model: str, state: list[float], weights: list[float], effort: float) -> Query:
    """A pole on its tip, at rest at `state`."""
    return Query(
        model,
        Equilibrium(tuple(state), 0.2),
        cost=RunningCost(goal=0.0, state=_diagonal(weights), input=(effort,)),
    )


def _draw_pendulum(rng: np.random.Generator) -> Query:
    angle, rate, effort = (_log_uniform(rng, 0.5, 2.0) for _ in range(3))
    return balancing("pendulum", [np.pi, 0.0], [5 * angle, 0.5 * rate], effort)


def _draw_cart_pole(rng: np.random.Generator) -> Query:
    place, angle, effort = (_log_uniform(rng, 0.5, 2.0) for _ in range(3))
    weights = [place, 5 * angle, 0.1, 0.1]
    return balancing("cart_pole", [0.0, np.pi, 0.0, 0.0], weights, 0.05 * effort)


SMALL: dict[str, RegulationFamily] = {
    "pendulum": RegulationFamily("pendulum", _draw_pendulum, (0.35, 0.8), (-1, -1)),
    "cart-pole": RegulationFamily(
        "cart-pole", _draw_cart_pole, (0.8, 0.5, 0.8, 1.0), (-1, -1, -1, -1)
    ),
}
"""Near the upright rest, where no swing pays; trained in a minute, no weights are shipped."""


def get_family(name: str) -> RegulationFamily:
    """A family by name.

    Raises:
        ValueError: if it is unknown; the message lists those that are known.
    """
    known = FAMILIES | SMALL
    if name not in known:
        raise ValueError(f"family: {name!r} is unknown; known are {', '.join(known)}")
    return known[name]
