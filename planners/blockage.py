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

    The way that is widest by the upper bounds of the clearances is measured, until it stays the
    widest; other edges are left as they are.
    """
    lines = _Lines(roadmap, robot)
    owner = np.empty(len(roadmap.slot), dtype=np.int64)
    owner[roadmap.slot] = np.repeat(np.arange(len(roadmap.edges)), 2)
    narrow = roadmap.world.resolution + TOLERANCE
    while True:
        width, successor, along = widest_ways(
            roadmap.start, roadmap.into, roadmap.target, roadmap.upper, owner, root
        )
        through = np.minimum(width[lines.nodes], lines.upper)
        at_most = float(through.max(initial=-np.inf))
        if at_most <= narrow:
            return Blockage(Barrier.OBSTACLES, 0.0)
        line = int(np.argmax(through))
        edges = []
        node = int(lines.nodes[line])
        while successor[node] >= 0:
            edges.append(int(along[node]))
            node = int(successor[node])
        way = np.array(edges, dtype=np.int64)
        at_least = min(float(roadmap.lower[way].min(initial=np.inf)), float(lines.lower[line]))
        if at_least >= at_most - narrow:
            return Blockage(Barrier.PADDING, max(at_least, 0.0))
        loose = way[roadmap.lower[way] < at_most - narrow]
        roadmap.make_exact(loose[roadmap.upper[loose] > roadmap.lower[loose] + narrow])
        if lines.upper[line] > lines.lower[line] + narrow:
            lines.make_exact(line)


class _Lines:
    """The robot's straight lines to nodes around it, and their clearances."""

    def __init__(self, roadmap: Roadmap, robot: NDArray[np.float64]) -> None:
        self._roadmap = roadmap
        self.nodes, lengths = nodes_within(roadmap.points, robot, WIDEST * roadmap.radius)
        self._points = np.concatenate([robot[None], roadmap.points[self.nodes]])
        k = len(self.nodes)
        self._edges = np.column_stack([np.zeros(k, dtype=np.int64), np.arange(1, k + 1)])
        self.lower, self.upper = np.full(k, np.inf), np.full(k, np.inf)
        self._known = np.full(k, np.inf)
        self._loose: list[list[int]] = [[] for _ in range(k)]
        for handle in roadmap.world.handles:
            near = roadmap.world.edge_clearances(
                handle, self._points, self._edges, lengths, roadmap.horizon
            )
            self.lower[near.index] = np.minimum(self.lower[near.index], near.lower)
            self.upper[near.index] = np.minimum(self.upper[near.index], near.upper)
            loose = near.upper > near.lower
            known = near.index[~loose]
            self._known[known] = np.minimum(self._known[known], near.upper[~loose])
            for line in near.index[loose]:
                self._loose[line].append(handle)

    def make_exact(self, line: int) -> None:
        """Shrink the interval of one line to the world's resolution."""
        start, end = self._points[:1], self._points[line + 1][None]
        bounds = [
            self._roadmap.world.refine(handle, start, end, None) for handle in self._loose[line]
        ]
        self.lower[line] = min(self._known[line], *(low[0] for low, _ in bounds))
        self.upper[line] = min(self._known[line], *(high[0] for _, high in bounds))
