"""Why there is no route: the widest way to the goal, as far as the roadmap knows."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from planners.repair_kernels import widest_ways
from planners.roadmap import Roadmap
from planners.roadmap_kernels import nodes_within
from planners.robot_approach import WIDEST
from planners.world import TOLERANCE


class Barrier(Enum):
    """What bars the way."""

    OBSTACLES = "the obstacles bar every way of the roadmap, whatever the padding"
    PADDING = "the padding alone bars the way"


@dataclass(frozen=True)
class Blockage:
    """What bars the way from the robot to the goal on this roadmap.

    Attributes:
        barrier: the obstacles themselves, or only their padding.
        largest_padding: metres; every padding below it leaves a route, 0 if none does.
    """

    barrier: Barrier
    largest_padding: float

    def __str__(self) -> str:
        if self.barrier is Barrier.OBSTACLES:
            return self.barrier.value
        return f"{self.barrier.value}: below {self.largest_padding:.6g} m there is a route"


def find_blockage(roadmap: Roadmap, root: int, robot: NDArray[np.float64]) -> Blockage:
    """The widest way from `robot` `[d]` to the node `root`.

    Only edges whose uncertain clearance could decide are measured exactly. Refines the roadmap's
    intervals; changes nothing else.
    """
    lines = _Lines(roadmap, robot)
    owner = np.empty(len(roadmap.slot), dtype=np.int64)
    owner[roadmap.slot] = np.repeat(np.arange(len(roadmap.edges)), 2)
    while True:
        at_least = _width(roadmap, owner, root, roadmap.lower, lines, lines.lower)
        at_most = _width(roadmap, owner, root, roadmap.upper, lines, lines.upper)
        if at_most <= TOLERANCE:
            return Blockage(Barrier.OBSTACLES, 0.0)
        decisive = (roadmap.upper > at_least) & (roadmap.lower < at_most)
        loose = np.flatnonzero(decisive & (roadmap.upper > roadmap.lower + 2 * TOLERANCE))
        if at_most - at_least <= 4 * TOLERANCE or not (len(loose) or lines.loose):
            return Blockage(Barrier.PADDING, max(at_least, 0.0))
        roadmap.make_exact(loose)
        lines.make_exact()


class _Lines:
    """The robot's straight lines to nodes around it, and their clearances."""

    def __init__(self, roadmap: Roadmap, robot: NDArray[np.float64]) -> None:
        self._roadmap = roadmap
        self.nodes, lengths = nodes_within(roadmap.points, robot, WIDEST * roadmap.radius)
        self._points = np.concatenate([robot[None], roadmap.points[self.nodes]])
        k = len(self.nodes)
        self._edges = np.column_stack([np.zeros(k, dtype=np.int64), np.arange(1, k + 1)])
        self.lower, self.upper = np.full(k, np.inf), np.full(k, np.inf)
        for handle in roadmap.world.handles:
            near = roadmap.world.edge_clearances(
                handle, self._points, self._edges, lengths, roadmap.horizon
            )
            self.lower[near.index] = np.minimum(self.lower[near.index], near.lower)
            self.upper[near.index] = np.minimum(self.upper[near.index], near.upper)

    @property
    def loose(self) -> bool:
        return bool(((self.upper > self.lower + 2 * TOLERANCE) & (self.upper > 0)).any())

    def make_exact(self) -> None:
        """Shrink the intervals to no width."""
        starts, ends = self._points[self._edges[:, 0]], self._points[self._edges[:, 1]]
        self.lower[:], self.upper[:] = np.inf, np.inf
        for handle in self._roadmap.world.handles:
            low, high = self._roadmap.world.refine(handle, starts, ends, None)
            np.minimum(self.lower, low, out=self.lower)
            np.minimum(self.upper, high, out=self.upper)


def _width(
    roadmap: Roadmap,
    owner: NDArray[np.int64],
    root: int,
    clearance: NDArray[np.float64],
    lines: _Lines,
    reach: NDArray[np.float64],
) -> float:
    """Width of the robot's widest way; infinite beyond the horizon."""
    width, _ = widest_ways(
        roadmap.start, roadmap.into, roadmap.target, clearance, owner, root, np.full(1, np.inf)
    )
    return float(np.minimum(width[lines.nodes], reach).max(initial=-np.inf))
