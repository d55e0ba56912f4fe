"""The shortest-path tree of RRT^X on a roadmap: state of the compiled core, and its three moves."""

import numpy as np
from numpy.typing import NDArray

from planners.repair_kernels import block, cascade, free
from planners.roadmap import Roadmap


class Tree:
    """Costs-to-go and parents of the roadmap's nodes, rooted at the goal.

    Attributes:
        g: `[n]`, the cost-to-go that a node's neighbours last heard of.
        lmc: `[n]`, the look-ahead value, never above g; infinite for a node without a way.
        parent: `[n]`, the next node on the way to the root; -1 for none.
        root: the goal's node.
    """

    def __init__(self, roadmap: Roadmap, root: int, epsilon: float) -> None:
        self._roadmap = roadmap
        self.epsilon = epsilon
        self.set_root(root)

    def set_root(self, root: int) -> None:
        """Forget the tree and begin anew from `root`."""
        n = len(self._roadmap.points)
        self.root = root
        self.g, self.lmc = np.full(n, np.inf), np.full(n, np.inf)
        none = np.full(n, -1, dtype=np.int32)
        self.parent = none
        self._child, self._following, self._previous = none.copy(), none.copy(), none.copy()
        self._heap, self._place = none.copy(), none.copy()
        self._size = np.zeros(1, dtype=np.int64)
        self.lmc[root] = 0.0
        self._heap[0], self._place[root], self._size[0] = root, 0, 1

    @property
    def settled(self) -> bool:
        """Whether no node is left to make consistent."""
        return self._size[0] == 0

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """`[n]`, which nodes wait for no repair."""
        return self._place < 0

    def grow(self) -> None:
        """Make room for the roadmap's new nodes."""
        more = len(self._roadmap.points) - len(self.g)
        unknown, none = np.full(more, np.inf), np.full(more, -1, dtype=np.int32)
        self.g, self.lmc = np.append(self.g, unknown), np.append(self.lmc, unknown)
        for name in ("parent", "_child", "_following", "_previous", "_heap", "_place"):
            setattr(self, name, np.append(getattr(self, name), none))

    def block(self, changed: NDArray[np.int64]) -> int:
        """Take these edges out. Returns how many nodes lost their way to the goal."""
        r = self._roadmap
        return block(
            r.start, r.both, r.into, r.target, r.weight, r.edges, r.slot, changed,
            self.g, self.lmc, *self._links, *self._queue,
        )  # fmt: skip

    def free(self, changed: NDArray[np.int64]) -> None:
        """Put these edges in."""
        r = self._roadmap
        free(
            r.weight, r.edges, r.slot, r.lengths, changed, r.cull_radius, self.epsilon,
            self.g, self.lmc, *self._links, *self._queue,
        )  # fmt: skip

    def cascade(self, approach: NDArray[np.float64], to_the_end: bool) -> tuple[int, float]:
        """Repair until the robot's cost-to-go is settled, or to the end.

        Args:
            approach: `[n]`, the robot's distance to the nodes it can go to, else infinite.

        Returns:
            how many nodes were made consistent, and the robot's cost-to-go.
        """
        r = self._roadmap
        return cascade(
            r.start, r.into, r.target, r.weight, self.epsilon,
            self.g, self.lmc, *self._links, *self._queue, approach, to_the_end,
        )  # fmt: skip

    def way(self, node: int) -> list[int]:
        """The nodes from `node` to the root."""
        nodes = [node]
        while self.parent[nodes[-1]] >= 0:
            nodes.append(int(self.parent[nodes[-1]]))
        return nodes

    @property
    def _links(self) -> tuple[NDArray[np.int32], ...]:
        return self.parent, self._child, self._following, self._previous

    @property
    def _queue(self) -> tuple[NDArray, ...]:
        return self._heap, self._place, self._size
