"""How close a forecast motion comes to obstacles that stand or move: compiled, conservative.

Distances are exact to balls and to polygons of the plane, and lower bounds to solids of space (the
largest of their facets' distances). Drake remains the judge: the planner's routes are certified and
the simulated motion is checked by its geometry. A forecast has too many samples for that.
"""

from collections.abc import Sequence

import numpy as np
from numba import boolean, float64, int64, njit, types
from numpy.typing import NDArray

from ocp.compiled.jit import MATRIX, compiled
from planners.solids import Shape, Solid

Array = NDArray[np.float64]

FAR = 1e3
"""Metres: clearances are not looked at beyond this."""
PIECES = 4


@njit(cache=True, error_model="numpy")
def _distance(point, first, last, radius, facets, sides, planar):
    """From a point in the solid's own frame (its centre the origin) to the solid."""
    d = point.shape[0]
    if last == first:
        square = 0.0
        for i in range(d):
            square += point[i] * point[i]
        return np.sqrt(square) - radius
    outside = -np.inf
    for f in range(first, last):
        total = facets[f, d]
        for i in range(d):
            total += facets[f, i] * point[i]
        outside = max(outside, total)
    if outside <= 0.0 or not planar:
        return outside
    best = np.inf
    for f in range(first, last):
        ax, ay = sides[f, 0], sides[f, 1]
        bx, by = sides[f, 2] - ax, sides[f, 3] - ay
        px, py = point[0] - ax, point[1] - ay
        t = min(1.0, max(0.0, (px * bx + py * by) / (bx * bx + by * by)))
        best = min(best, (px - t * bx) ** 2 + (py - t * by) ** 2)
    return np.sqrt(best)


@njit(cache=True, error_model="numpy")
def _between(a, b, share, time, center, velocity, out):
    """In the solid's frame: where the robot is on its way from a to b, at `time`."""
    for i in range(a.shape[0]):
        out[i] = a[i] + share * (b[i] - a[i]) - center[i] - velocity[i] * time


@njit(cache=True, error_model="numpy")
def _step(path, k, velocity, growth, period):
    """How much closer robot and obstacle may come from sample k - 1 to sample k, metres."""
    square = 0.0
    for i in range(path.shape[1]):
        square += (path[k, i] - path[k - 1, i] - velocity[i] * period) ** 2
    return np.sqrt(square) + growth * period


@compiled(
    float64[::1](
        float64[:, :, ::1],
        types.UniTuple(float64, 4),
        boolean,
        MATRIX,
        MATRIX,
        MATRIX,
        int64[::1],
        MATRIX,
        MATRIX,
    )
)
def clearances(paths, numbers, first_only, centers, velocities, bodies, first, facets, sides):
    """The least distance `[c]` of each of `paths` `[c, k, d]` to any solid, at most `cap`.

    `numbers`: the period between samples, the foresight, `enough` and `cap`. `bodies` `[o, 3]`:
    radius, reach and growth of each solid.

    Obstacles that move are looked at for the foresight (seconds) only; their positions are extended
    by their velocities, and their bodies grow by so many metres a second. A path that comes nearer
    than `enough` is not looked at any further; with `first_only` nor are paths after the first that
    does not (they get -1). Between samples the way is taken as straight; where something is
    near it is cut into pieces, and the distance between the cuts is bounded from below.
    """
    count, samples, d = paths.shape
    period, foresight, enough, cap = numbers
    planar = d == 2
    out = np.full(count, -1.0)
    point, at = np.empty(d), np.empty(d)
    for c in range(count):
        path = paths[c]
        least = cap
        for o in range(centers.shape[0]):
            radius, reach, growth = bodies[o]
            begin, end = first[o], first[o + 1]
            moving = growth > 0.0
            for i in range(d):
                moving = moving or velocities[o, i] != 0.0
            k = 0
            while k < samples and least >= enough:
                time = k * period
                if moving and time > foresight:
                    break
                _between(path[k], path[k], 0.0, time, centers[o], velocities[o], point)
                square = 0.0
                for i in range(d):
                    square += point[i] * point[i]
                away = np.sqrt(square) - reach - growth * time
                if away <= least:
                    away = _distance(point, begin, end, radius, facets, sides, planar)
                    away -= growth * time
                k += 1
                length = _step(path, k, velocities[o], growth, period) if k < samples else 0.0
                room = away - least - length
                if room >= 0.0:
                    # Not nearer than the nearest so far for as long as it takes to come closer.
                    while k + 1 < samples:
                        room -= _step(path, k + 1, velocities[o], growth, period)
                        if room < 0.0:
                            break
                        k += 1
                    continue
                if k < samples:
                    for piece in range(1, PIECES + 1):
                        share = piece / PIECES
                        now = time + share * period
                        _between(path[k - 1], path[k], share, now, centers[o], velocities[o], at)
                        cut = _distance(at, begin, end, radius, facets, sides, planar)
                        away = min(away, cut - growth * now)
                    away -= 0.5 * length / PIECES
                least = min(least, away)
            if least < enough:
                break
        out[c] = least
        if first_only and least >= enough:
            break
    return out


class Surroundings:
    """The obstacles that a robot knows of, as arrays: rebuilt when one comes or goes."""

    def __init__(self, dimension: int) -> None:
        self.dimension = dimension
        self.update([], np.zeros((0, dimension)), np.zeros(0))

    def update(self, solids: Sequence[Solid], velocities: Array, growths: Array) -> None:
        """What is there now.

        Args:
            solids: where they are.
            velocities: `[o, d]`, metres a second.
            growths: `[o]`, metres a second by which their bodies are extended in forecasts.
        """
        d, count = self.dimension, len(solids)
        self._velocities = np.ascontiguousarray(velocities, dtype=float).reshape(count, d)
        self._centers = np.array([s.center for s in solids], dtype=float).reshape(count, d)
        self._bodies = np.array(
            [(s.radius, s.reach, g) for s, g in zip(solids, growths, strict=True)], dtype=float
        ).reshape(count, 3)
        facets, sides, first = [np.zeros((0, d + 1))], [np.zeros((0, 4))], [0]
        for solid in solids:
            if solid.shape is Shape.BALL:
                first.append(first[-1])
                continue
            # Facets a.x + b <= 0 in the world become a.x + (b + a.c) about the centre c.
            own = solid.facets.copy()
            own[:, d] += own[:, :d] @ solid.center
            facets.append(own)
            if d == 2:
                sides.append((solid.sides - solid.center).reshape(-1, 4))
            else:
                sides.append(np.zeros((len(own), 4)))
            first.append(first[-1] + len(own))
        self._facets = np.ascontiguousarray(np.concatenate(facets))
        self._sides = np.ascontiguousarray(np.concatenate(sides))
        self._first = np.array(first, dtype=np.int64)

    def clearances(
        self, paths: Array, period: float, foresight: float, cap: float = FAR, enough: float = -FAR
    ) -> Array:
        """Least clearance `[c]`, at most `cap`, of forecast positions `[c, k, d]`: the kernel's."""
        return self._ask(paths, (period, foresight, enough, cap), False)

    def first_clear(
        self, paths: Array, period: float, foresight: float, enough: float
    ) -> int | None:
        """Which of `paths` `[c, k, d]` is the first that keeps `enough` from everything."""
        found = self._ask(paths, (period, foresight, enough, enough + 1e-6), True)
        clear = np.flatnonzero(found >= enough)
        return int(clear[0]) if len(clear) else None

    def _ask(self, paths: Array, numbers: tuple[float, ...], first_only: bool) -> Array:
        return clearances(
            np.ascontiguousarray(paths),
            numbers,
            first_only,
            self._centers,
            self._velocities,
            self._bodies,
            self._first,
            self._facets,
            self._sides,
        )
