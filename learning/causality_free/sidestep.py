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


class Sidesteps:
    """The linear regulator's value, its goal moved sideways near an obstacle: a guess, no value.

    The obstacle and the side may differ from state to state, so that all ways from all starts are
    driven together.

    Args:
        query: with an `Equilibrium` as its goal.
        passed: `[k]`, numbers of obstacles.
        sides: `[k]`, 1 to pass on the left, seen on the way to the goal; -1 on the right.
    """

    def __init__(self, query: Query, passed: ArrayLike, sides: ArrayLike) -> None:
        self.query, self.regulator = query, RegulatorValue(query)
        obstacles = [query.obstacles[k] for k in np.asarray(passed)]
        self.centers = np.array([o.center for o in obstacles])
        self.radii = np.array([o.radius for o in obstacles])
        ahead = query.goal_position - self.centers
        self.ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        left = np.column_stack([-self.ahead[:, 1], self.ahead[:, 0]])
        self.aims = (np.asarray(sides) * AIM * (self.radii + 0.33))[:, None] * left

    def value(self, states: ArrayLike) -> Array:
        """The regulator's, `[k]` at states `[k, n]`."""
        return self.regulator.value(states)

    def gradient(self, states: ArrayLike) -> Array:
        """The regulator's costate `[k, n]` for the moved goals, at states `[k, n]`."""
        e = self.query.system.difference(states, self.query.reference)
        gap = self.query.position(states) - self.centers
        near = np.exp(-0.5 * (gap**2).sum(axis=-1) / (self.radii + RANGE) ** 2)
        onward = (gap * self.ahead).sum(axis=-1) - PASSED
        near = near * 0.5 * (1 - np.tanh(SHARPNESS / 2 * onward))
        e[..., list(self.query.system.position)] -= near[..., None] * self.aims
        return 2.0 * e @ self.regulator.P


def nearness(query: Query, obstacle: Obstacle, states: Array) -> float:
    """The obstacle's largest penalty, without its weight, along states `[k, n]`."""
    gap = ((query.position(states) - np.array(obstacle.center)) ** 2).sum(axis=-1).min()
    return float(np.exp(-query.cost.obstacle_steepness * (gap - obstacle.radius**2)))
