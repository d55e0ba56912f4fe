"""Certified lower bounds of V that know the goal only: obstacles add to the cost, so they hold.

`RadialGoalBound`: the position moves at most at speed c at unit effort, so V is at least
R = (2 / c) times the integral of sqrt(Q) along the ray. Exact for a robot that heads for the goal.

`HeadingGoalBound`: for robots with a `goal_table`, which drive as they head, V without obstacles is
a function of the distance r to the goal's centre and of the angle a between heading and ray. In
these, time scaled away, a function w(r, a) is nowhere above V if

    drive (cos a w_r - sin a w_a / r)^2 + turn w_a^2 <= 4 Q(r)

almost everywhere, and w <= 0 in the goal. The table is sampled finely, multilinear in r and a. The
left side is bounded on every cell by interval arithmetic, and what violation there is is taken out
by w = phi(table), phi' = 1 / the largest ratio on the level set, as in `ocp.bracket`. Two
dimensions afford what three do not: the bound is within some 0.5 % of V.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import casadi as ca
import numpy as np
from numba import float64, types
from numpy.typing import NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled
from ocp.cost import goal_cost
from ocp.grids.goal_table import drive_of, goal_table, has_goal_table
from ocp.grids.subsolution_kernels import level_ratios
from ocp.query import Goal, Query
from ocp.trajectory import SolveError, Status

Array = NDArray[np.float64]
CUBE = float64[:, :, ::1]

SLACK = 1e-9  # relative: covers rounding in the bounds
ROOTS, ANGLES = 3000, 1000  # nodes in the root of the distance, and in the angle
LEVEL = 0.002  # of cost: width of phi's pieces
CUTS = (0.002, 0.004, 0.01, 0.02, 0.05)  # of cost: first levels that are tried


class GoalBound(Protocol):
    """A function nowhere above V, and 0 in the goal."""

    def value(self, states: Array) -> Array:
        """The bound `[...]` at states `[..., n]`."""
        ...

    def floors(self, x: Array, y: Array, headings: Array) -> Array:
        """Its least value `[a, b, c]` in each cell between coordinates `[a + 1]`, ..."""
        ...


def goal_ball(query: Query) -> Goal:
    """The query's goal.

    Raises:
        SolveError: NOT_APPLICABLE if it is no ball.
    """
    if not isinstance(query.goal, Goal):
        raise SolveError(Status.NOT_APPLICABLE, "certified lower bounds need a goal ball")
    return query.goal


def goal_bound(query: Query, speed: float, reach: float) -> GoalBound:
    """The better of the two bounds that the robot admits.

    Args:
        query: time-free, its goal a ball.
        speed: of the position at unit effort, at most.
        reach: metres from the goal's boundary up to which it is wanted.
    """
    if drive_of(query) is None or not has_goal_table(query, reach):
        return RadialGoalBound(query, speed)
    return HeadingGoalBound.of(query, speed, reach)


def _nearest(center: Array, x: Array, y: Array) -> Array:
    """Least distance `[a, b]` from a point to the rectangles between coordinates."""
    gaps = [np.clip(c, axis[:-1], axis[1:]) - c for c, axis in zip(center, (x, y), strict=True)]
    return np.hypot(gaps[0][:, None], gaps[1][None, :])


@dataclass(frozen=True)
class RadialGoalBound:
    """R, from below."""

    query: Query
    speed: float

    def value(self, states: Array) -> Array:
        return self.at(np.maximum(self.query.goal_distance(states), 0.0))

    def floors(self, x: Array, y: Array, headings: Array) -> Array:
        distance = _nearest(self.query.goal_position, x, y) - goal_ball(self.query).radius
        floor = self.at(np.maximum(distance, 0.0))[:, :, None]
        return np.ascontiguousarray(np.broadcast_to(floor, (*distance.shape, len(headings) - 1)))

    def at(self, distances: Array) -> Array:
        """R `[...]` at distances `[...]` >= 0 from the goal's boundary.

        Q grows with the distance, so the sum with each piece's least sqrt(Q) is below the integral.
        """
        distances = np.asarray(distances, dtype=float)
        reach = float(np.ceil(distances.max(initial=1.0) / 16) * 16)
        ball, w = goal_ball(self.query), self.query.cost
        key = ball.radius, w.goal, w.goal_steepness
        knots, sums, rates = _radial_table(*key, self.speed, reach)
        k = np.searchsorted(knots, distances, side="right") - 1
        return (sums[k] + rates[k] * (distances - knots[k])) * (1 - SLACK)


@lru_cache(maxsize=16)
def _radial_table(
    radius: float, weight: float, steepness: float, speed: float, reach: float
) -> tuple[Array, Array, Array]:
    """Distances, R and its least slope from each to the next."""
    knots = np.concatenate([[0.0], np.geomspace(1e-6, reach + 1e-3, 4000)])
    rates = 2.0 / speed * np.sqrt(_goal_costs(radius, weight, steepness, radius + knots))
    sums = np.concatenate([[0.0], np.cumsum(rates[:-1] * np.diff(knots))])
    return knots, sums, rates


def goal_costs(query: Query, radii: Array) -> Array:
    """Q `[k]` at distances `[k]` from the goal's centre."""
    w = query.cost
    return _goal_costs(goal_ball(query).radius, w.goal, w.goal_steepness, radii)


def _goal_costs(radius: float, weight: float, steepness: float, radii: Array) -> Array:
    r = ca.SX.sym("r")  # pyright: ignore[reportArgumentType]
    cost = goal_cost(r, ca.SX(0), radius, weight, steepness)
    return np.array(ca.Function("Q", [r], [cost])(radii[None])).ravel()


@dataclass(frozen=True, eq=False)
class _Profile:
    """The bound for one robot, goal radius and cost: what all goal centres share.

    Attributes:
        values: `[k, a]`, the table at distances `root^2` and angles, growing along both axes.
        step: of the roots.
        levels: `[l]`, phi at multiples of `LEVEL`.
        most: no value is above it, since motions may leave the table.
    """

    values: Array
    step: float
    levels: Array
    most: float


@dataclass(frozen=True, eq=False)
class HeadingGoalBound:
    """min(phi(table), R at the table's end): a motion may leave the table, which then costs R."""

    center: Array
    radius: float
    profile: _Profile

    @classmethod
    def of(cls, query: Query, speed: float, reach: float) -> "HeadingGoalBound":
        """Up to the table's end at `reach` or beyond."""
        end = float(np.ceil(reach / 4) * 4)  # few different ones
        end = end if has_goal_table(query, end) else reach
        ball = goal_ball(query)
        w, weights = query.cost, tuple(map(float, query.input_weights))
        centre = (query.system.lower + query.system.upper)[list(query.system.position)] / 2
        alone = Query(
            query.system,
            Goal(tuple(map(float, centre)), ball.radius),
            (),
            type(w)(weights, w.goal, w.goal_steepness),
        )
        return cls(query.goal_position, ball.radius, _profile(alone, speed, end))

    def value(self, states: Array) -> Array:
        states = np.asarray(states, dtype=float)
        rows = np.ascontiguousarray(states.reshape(-1, 3))
        p, out = self.profile, np.empty(len(rows))
        _values(p.values, p.step, self.center, self.radius, rows, out)
        return self._phi(out).reshape(states.shape[:-1])

    def floors(self, x: Array, y: Array, headings: Array) -> Array:
        p = self.profile
        out = np.empty((len(x) - 1, len(y) - 1, len(headings) - 1))
        _floors(p.values, p.step, self.center, self.radius, x, y, headings, out)
        return self._phi(out)

    def _phi(self, table: Array) -> Array:
        p = self.profile
        phi = np.interp(table, LEVEL * np.arange(len(p.levels)), p.levels)
        return np.minimum(phi, p.most) * (1 - SLACK)


@lru_cache(maxsize=4)
def _profile(query: Query, speed: float, reach: float) -> _Profile:
    drive = drive_of(query)
    assert drive is not None
    table, ball = goal_table(query, reach), goal_ball(query)
    roots = np.linspace(0.0, np.sqrt(reach), ROOTS)
    angles = np.linspace(0.0, np.pi / 2, ANGLES)
    x, y = table.center
    values = np.zeros((ROOTS, ANGLES))
    values[1:] = table.on_product(x + ball.radius + roots[1:] ** 2, np.array([y]), angles)[:, 0]
    # V grows along both; so must what stands for it, or corners would not bound it.
    values = np.minimum.accumulate(values[::-1], axis=0)[::-1]
    values = np.ascontiguousarray(np.minimum.accumulate(values[:, ::-1], axis=1)[:, ::-1])
    radii = ball.radius + roots**2
    cost = np.maximum(goal_costs(query, radii[:-1]), 0.0) * (1 - SLACK)
    ratio = np.empty((ROOTS - 1, ANGLES - 1, 1))
    _ratios(values, radii, angles, drive.drive, drive.turn, cost, ratio)
    low = np.ascontiguousarray(values[:-1, :-1, None])
    high = np.ascontiguousarray(values[1:, 1:, None])
    count = int(values.max() / LEVEL) + 2
    active = np.ones(low.shape)
    ratios = np.ones(count)
    level_ratios(np.minimum(ratio, 1e9), low, high, active, LEVEL, ratios)
    best = np.zeros(1)
    for cut in CUTS:
        slopes = 1.0 / (ratios * (1 + SLACK))
        slopes[: int(np.ceil(cut / LEVEL))] = 0.0
        levels = np.concatenate([[0.0], np.cumsum(LEVEL * slopes)])
        best = levels if levels[-1] > best[-1] else best
    most = float(RadialGoalBound(query, speed).at(np.array([reach]))[0])
    return _Profile(values, float(roots[1]), best, most)


@compiled(types.void(MATRIX, VECTOR, VECTOR, float64, float64, VECTOR, CUBE))
def _ratios(w, radii, angles, drive, turn, cost, out):
    """Bounds `[k - 1, a - 1, 1]` of the ratio of the condition's sides, rooted, in every cell."""
    for i in range(radii.shape[0] - 1):
        h = radii[i + 1] - radii[i]
        for j in range(angles.shape[0] - 1):
            g = angles[j + 1] - angles[j]
            r0, r1 = (w[i + 1, j] - w[i, j]) / h, (w[i + 1, j + 1] - w[i, j + 1]) / h
            a0, a1 = (w[i, j + 1] - w[i, j]) / g, (w[i + 1, j + 1] - w[i + 1, j]) / g
            # All four are >= 0, and so are sine and cosine.
            ahead = max(r0, r1) * np.cos(angles[j]), min(r0, r1) * np.cos(angles[j + 1])
            aside = (
                min(a0, a1) * np.sin(angles[j]) / radii[i + 1],
                max(a0, a1) * np.sin(angles[j + 1]) / radii[i],
            )
            along = max(ahead[0] - aside[0], aside[1] - ahead[1])
            turned = max(a0, a1)
            size = drive * along * along + turn * turned * turned
            if size == 0.0:
                out[i, j, 0] = 0.0
            elif cost[i] > 0.0:
                out[i, j, 0] = np.sqrt(size / (4.0 * cost[i]))
            else:
                out[i, j, 0] = np.inf


@compiled(float64(MATRIX, float64, float64, float64))
def _lookup(w, step, distance, angle):
    """w at `distance` >= 0 from the goal's boundary, at `angle` in [0, pi / 2]."""
    rows, columns = w.shape
    i = min(int(np.sqrt(distance) / step), rows - 2)
    below, above = (i * step) ** 2, ((i + 1) * step) ** 2
    s = min(max((distance - below) / (above - below), 0.0), 1.0)
    place = angle / (0.5 * np.pi) * (columns - 1)
    j = min(int(place), columns - 2)
    t = min(max(place - j, 0.0), 1.0)
    near = (1.0 - t) * w[i, j] + t * w[i, j + 1]
    far = (1.0 - t) * w[i + 1, j] + t * w[i + 1, j + 1]
    return (1.0 - s) * near + s * far


@compiled(types.void(MATRIX, float64, VECTOR, float64, MATRIX, VECTOR))
def _values(w, step, center, radius, states, out):
    for row in range(states.shape[0]):
        x, y = states[row, 0] - center[0], states[row, 1] - center[1]
        distance = np.hypot(x, y) - radius
        out[row] = 0.0
        if distance > 0.0:
            angle = states[row, 2] - np.arctan2(y, x)
            angle = abs(angle - np.pi * np.round(angle / np.pi))
            out[row] = _lookup(w, step, distance, angle)


@compiled(types.UniTuple(float64, 3)(VECTOR, float64, float64, float64, float64))
def _seen(center, x0, x1, y0, y1):
    """A rectangle from the goal's centre: its nearest distance, and its bearings' middle and
    half-width."""
    near_x = min(max(center[0], x0), x1) - center[0]
    near_y = min(max(center[1], y0), y1) - center[1]
    middle = np.arctan2(0.5 * (y0 + y1) - center[1], 0.5 * (x0 + x1) - center[0])
    spread = 0.0
    for a in range(2):
        for b in range(2):
            turn = np.arctan2((y1 if b else y0) - center[1], (x1 if a else x0) - center[0])
            turn -= middle
            turn -= 2.0 * np.pi * np.round(turn / (2.0 * np.pi))
            spread = max(spread, abs(turn))
    return np.hypot(near_x, near_y), middle, spread


@compiled(float64(float64, float64))
def _least_angle(first, last):
    """The least angle to a line of directions in [first, last]."""
    first, last = first / np.pi, last / np.pi
    if np.floor(first) != np.floor(last):
        return 0.0
    angle = np.pi * min(abs(first - np.round(first)), abs(last - np.round(last)))
    return max(angle - 1e-9, 0.0)  # rounding


@compiled(types.void(MATRIX, float64, VECTOR, float64, VECTOR, VECTOR, VECTOR, CUBE))
def _floors(w, step, center, radius, x, y, headings, out):
    """As w grows with distance and angle, its least value is at the least of both."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            nearest, middle, spread = _seen(center, x[i], x[i + 1], y[j], y[j + 1])
            out[i, j] = 0.0
            if nearest > radius:
                for k in range(out.shape[2]):
                    angle = _least_angle(
                        headings[k] - middle - spread, headings[k + 1] - middle + spread
                    )
                    out[i, j, k] = _lookup(w, step, nearest - radius, angle)
