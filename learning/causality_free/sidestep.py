"""Guesses that pass an obstacle on a given side: a closed loop knows one way only, often none.

A soft obstacle leaves several extremals: left of it, right of it, through it. The linear regulator
aimed at a point beside the goal for as long as the robot is near the obstacle passes it on that
side; multiple shooting makes an extremal of that, and the cheapest counts.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.obstacle import Obstacle
from ocp.query import Query
from ocp.regulation import RegulatorValue

Array = NDArray[np.float64]

RANGE = 0.6  # metres round an obstacle within which the aim is moved
AIM = 2.0  # by so many times the obstacle's radius and a third of a metre
PASSED, SHARPNESS = 0.3, 8.0  # metres towards the goal where the aim goes back; per metre


class Sidestep:
    """The linear regulator's value, its goal moved sideways near an obstacle: a guess, no value.

    Args:
        query: with an `Equilibrium` as its goal.
        obstacle: that is passed.
        side: 1 to its left, seen on the way to the goal; -1 to its right.
    """

    def __init__(self, query: Query, obstacle: Obstacle, side: int) -> None:
        self.query, self.regulator = query, RegulatorValue(query)
        self.center, self.radius = np.array(obstacle.center), obstacle.radius
        ahead = query.goal_position - self.center
        ahead = ahead / np.linalg.norm(ahead)
        self.ahead = ahead
        self.aim = side * AIM * (self.radius + 0.33) * np.array([-ahead[1], ahead[0]])

    def nearness(self, states: Array) -> float:
        """The obstacle's largest penalty, without its weight, along states `[k, n]`."""
        gap = ((self.query.position(states) - self.center) ** 2).sum(axis=-1).min()
        return float(np.exp(-self.query.cost.obstacle_steepness * (gap - self.radius**2)))

    def value(self, states: ArrayLike) -> Array:
        """The regulator's, `[...]` at states `[..., n]`."""
        return self.regulator.value(states)

    def gradient(self, states: ArrayLike) -> Array:
        """The regulator's costate `[..., n]` for the moved goal, at states `[..., n]`."""
        e = self.query.system.difference(states, self.query.reference)
        gap = self.query.position(states) - self.center
        near = np.exp(-0.5 * (gap**2).sum(axis=-1) / (self.radius + RANGE) ** 2)
        near = near * 0.5 * (1 - np.tanh(SHARPNESS / 2 * (gap @ self.ahead - PASSED)))
        e[..., list(self.query.system.position)] -= near[..., None] * self.aim
        return 2.0 * e @ self.regulator.P


def sidesteps(query: Query) -> list[Sidestep]:
    """Both sides of every obstacle; none for a robot that does not move in the plane."""
    if len(query.system.position) != 2:
        return []
    return [Sidestep(query, o, side) for o in query.obstacles for side in (1, -1)]
