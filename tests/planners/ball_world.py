"""A world of balls in any number of dimensions, in closed form."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planners.world import EdgeClearances

Ball = tuple[NDArray[np.float64], float]


class BallWorld:
    """Balls given as (centre, radius)."""

    certified = True
    resolution = 1e-9

    def __init__(self, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> None:
        self.lower, self.upper = lower, upper
        self._balls: dict[int, Ball] = {}
        self._next = 0

    @property
    def dimension(self) -> int:
        return len(self.lower)

    @property
    def handles(self) -> Sequence[int]:
        return tuple(self._balls)

    def add(self, obstacle: Ball) -> int:
        self._balls[self._next] = obstacle
        self._next += 1
        return self._next - 1

    def remove(self, handle: int) -> None:
        del self._balls[handle]

    def move(self, handle: int, translation: ArrayLike, rotation: ArrayLike | float = 0.0) -> None:
        assert np.ndim(rotation) == 0
        center, radius = self._balls[handle]
        self._balls[handle] = (center + np.asarray(translation), radius)

    def edge_clearances(
        self,
        handle: int,
        points: NDArray[np.float64],
        edges: NDArray[np.int64],
        lengths: NDArray[np.float64],
        within: float,
    ) -> EdgeClearances:
        assert len(lengths) == len(edges)
        exact, _ = self.refine(handle, points[edges[:, 0]], points[edges[:, 1]], None)
        index = np.flatnonzero(exact <= within)
        return EdgeClearances(index, exact[index], exact[index])

    def refine(
        self,
        handle: int,
        starts: NDArray[np.float64],
        ends: NDArray[np.float64],
        threshold: float | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        del threshold
        center, radius = self._balls[handle]
        along = ends - starts
        square = (along**2).sum(axis=1)
        t = ((center - starts) * along).sum(axis=1) / np.where(square > 0, square, 1.0)
        nearest = starts + np.clip(t, 0, 1)[:, None] * along
        exact = np.linalg.norm(nearest - center, axis=1) - radius
        return exact, exact.copy()

    def certify(
        self, starts: NDArray[np.float64], ends: NDArray[np.float64], padding: float
    ) -> NDArray[np.bool_]:
        free = np.ones(len(starts), dtype=bool)
        for handle in self._balls:
            free &= self.refine(handle, starts, ends, None)[0] > padding + 1e-9
        return free

    def clearance(self, way: NDArray[np.float64]) -> float:
        """Least clearance along the way."""
        return min(float(self.refine(h, way[:-1], way[1:], None)[0].min()) for h in self._balls)
