"""How the robot, which is anywhere, gets onto the tree."""

import numpy as np
from numpy.typing import NDArray

from planners.roadmap import Roadmap
from planners.roadmap_kernels import nodes_within

# How many connection radii away the robot looks for a node, when nearer ones are barred.
WIDEST = 2


class Approach:
    """Straight lines from the robot to the nodes around it, certified when they are needed.

    Attributes:
        robot: `[d]`.
        distance: `[n]`, to each node the robot may go to straight; infinite for nodes too far away
            and for those whose line was found blocked.
    """

    def __init__(self, roadmap: Roadmap, robot: NDArray[np.float64]) -> None:
        self._roadmap = roadmap
        self.move(robot)

    def move(self, robot: NDArray[np.float64]) -> None:
        """The robot is at `robot` `[d]`."""
        self.robot = robot
        self._free: set[int] = set()
        self.forget()

    def forget(self) -> None:
        """The world, the padding or the nodes changed: what was known of the lines is void.

        Nodes whose line was free stay candidates, so that a shrinking radius loses no route.
        """
        self._kept, self._free = self._free, set()
        self._refused: set[int] = set()
        self._radius = self._roadmap.radius
        self._look()

    def best(self, cost_to_go: NDArray[np.float64]) -> int:
        """The node to go to first; -1 if there is none."""
        total = self.distance + cost_to_go
        node = int(np.argmin(total))
        return node if np.isfinite(total[node]) else -1

    def confirm(self, cost_to_go: NDArray[np.float64]) -> bool:
        """Whether the best line is certified free, or no line is left; else repair goes on.

        The most promising line is looked at alone; if it is blocked, all others are looked at
        together. Once none is left, nodes up to `WIDEST` radii away are taken in.
        """
        node = self.best(cost_to_go)
        if node >= 0:
            if node in self._free:
                return True
            if self._certify(np.array([node])):
                return True
            self._certify(np.flatnonzero(np.isfinite(self.distance)))
            return False
        if self._radius >= WIDEST * self._roadmap.radius:
            return True
        self._radius *= 2
        self._look()
        return False

    def _certify(self, nodes: NDArray[np.int64]) -> bool:
        """Certify the lines to these nodes, and drop the blocked ones. Whether all are free."""
        ends = self._roadmap.points[nodes]
        starts = np.broadcast_to(self.robot, ends.shape)
        free = self._roadmap.world.certify(starts, ends, self._roadmap.padding)
        self._free.update(nodes[free].tolist())
        self._refused.update(nodes[~free].tolist())
        self.distance[nodes[~free]] = np.inf
        return bool(free.all())

    def _look(self) -> None:
        world, points = self._roadmap.world, self._roadmap.points
        self.distance = np.full(len(points), np.inf)
        here = self.robot[None]
        if world.certify(here, here, self._roadmap.padding)[0]:
            nodes, away = nodes_within(points, self.robot, self._radius)
            self.distance[nodes] = away
            kept = list(self._kept)
            self.distance[kept] = np.linalg.norm(points[kept] - self.robot, axis=1)
            self.distance[list(self._refused)] = np.inf
