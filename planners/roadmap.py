"""The graph under the planner: nodes, edges, and how close each edge comes to each obstacle.

The graph is built as if the world were empty and never loses an edge. Each obstacle keeps a list of
the edges near it with certified intervals of their clearance, so that an obstacle that appears
lowers the clearance of a few edges, one that vanishes gives back exactly what it took, and a
change of padding is a comparison with stored numbers. An edge is blocked where its clearance is at
most the padding.
"""

import math

import numpy as np
from numpy.typing import NDArray

from planners.roadmap_kernels import (
    compress,
    connect,
    lower_marked,
    lower_to,
    reclassify,
    shrinking_radius,
    undecided,
)
from planners.world import TOLERANCE, EdgeClearances, World


class Roadmap:
    """Nodes, edges and clearances; every change returns the edges it blocked and freed.

    Attributes:
        points: `[n, d]`, in the order of insertion.
        edges: `[m, 2]`, older and newer end.
        lengths: `[m]`.
        lower, upper: `[m]`, the clearance of each edge lies between; infinite beyond the horizon.
        blocked: `[m]`.
        start, both, into, target, weight, slot: compressed rows, see `roadmap_kernels.compress`.
    """

    def __init__(
        self,
        world: World,
        root: NDArray[np.float64],
        padding: float,
        horizon: float,
        reach: float,
        radius_factor: float,
        culling: bool,
    ) -> None:
        d = world.dimension
        self.world = world
        self.padding = padding
        self.horizon = horizon
        self.reach = reach
        ball = math.pi ** (d / 2) / math.gamma(d / 2 + 1)
        volume = float(np.prod(world.upper - world.lower))
        # At radius_factor 1 the bound of Karaman and Frazzoli (2011) for an optimal random graph.
        self._gamma = radius_factor * 2 * ((1 + 1 / d) * volume / ball) ** (1 / d)
        self.culling = culling
        self.points = np.ascontiguousarray(root[None])
        self.edges = np.zeros((0, 2), dtype=np.int64)
        self.lengths = np.zeros(0)
        self.lower, self.upper = np.zeros(0), np.zeros(0)
        self.blocked = np.zeros(0, dtype=np.bool_)
        self._near: dict[int, EdgeClearances] = {
            handle: EdgeClearances(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0))
            for handle in world.handles
        }
        self.compress(np.full(1, -1, dtype=np.int32))

    @property
    def radius(self) -> float:
        """The connection radius at the present number of nodes."""
        return shrinking_radius(self.reach, self._gamma, len(self.points), self.points.shape[1])

    @property
    def cull_radius(self) -> float:
        """Longer edges serve their newer end only; infinite without culling."""
        return self.radius if self.culling else np.inf

    @property
    def threshold(self) -> float:
        """Clearances up to here are blocked."""
        return self.padding + TOLERANCE

    def insert(self, samples: NDArray[np.float64], pull: bool = True) -> NDArray[np.int64]:
        """Join `samples` `[k, d]` to the graph. Returns the new edges that are free.

        Args:
            pull: whether a sample out of reach of the graph is pulled towards it.
        """
        first, old = len(self.points), len(self.edges)
        self.points = np.ascontiguousarray(np.concatenate([self.points, samples]))
        edges, lengths = connect(
            self.points,
            first,
            self.world.lower,
            self.world.upper,
            self.reach if pull else np.inf,
            self._gamma,
        )
        self.edges = np.ascontiguousarray(np.concatenate([self.edges, edges]))
        self.lengths = np.concatenate([self.lengths, lengths])
        fresh = np.full(len(edges), np.inf)
        self.lower = np.concatenate([self.lower, fresh])
        self.upper = np.concatenate([self.upper, fresh])
        # Blocked until they are known to be free: `reclassify` reports the free ones.
        self.blocked = np.concatenate([self.blocked, np.ones(len(edges), dtype=np.bool_)])
        for handle, near in self._near.items():
            found = self.world.edge_clearances(handle, self.points, edges, lengths, self.horizon)
            more = EdgeClearances(found.index + old, found.lower, found.upper)
            lower_to(self.lower, self.upper, more.index, more.lower, more.upper)
            self._near[handle] = EdgeClearances(
                *(np.concatenate(pair) for pair in zip(_fields(near), _fields(more), strict=True))
            )
        return self._classify()[1]

    def appear(self, handle: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Take notice of a new obstacle. Returns the edges blocked and freed."""
        near = self._clearances(handle)
        self._near[handle] = near
        lower_to(self.lower, self.upper, near.index, near.lower, near.upper)
        return self._classify()

    def vanish(self, handle: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Forget an obstacle. Returns the edges blocked and freed."""
        self._merge_again(self._near.pop(handle).index)
        return self._classify()

    def shift(self, handle: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Take notice that an obstacle moved. Returns the edges blocked and freed."""
        before, after = self._near[handle], self._clearances(handle)
        self._near[handle] = after
        self._merge_again(np.concatenate([before.index, after.index]))
        return self._classify()

    def set_padding(self, padding: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Change the padding. Returns the edges blocked and freed.

        Beyond the horizon, clearances are gathered anew up to twice the padding, which is slower.
        """
        self.padding = padding
        if self.threshold >= self.horizon:
            self.horizon = 2 * padding
            self.lower[:], self.upper[:] = np.inf, np.inf
            for handle in self._near:
                near = self._near[handle] = self._clearances(handle)
                lower_to(self.lower, self.upper, near.index, near.lower, near.upper)
        return self._classify()

    def compress(self, parent: NDArray[np.int32]) -> None:
        """Build the compressed rows anew, after nodes were inserted."""
        self.start, self.both, self.into, self.target, self.weight, self.slot = compress(
            len(self.points), self.edges, self.lengths, self.blocked, parent, self.cull_radius
        )

    def make_exact(self, index: NDArray[np.int64]) -> None:
        """Shrink the clearance intervals of these edges to the world's resolution."""
        self._refine(index, None)

    def _clearances(self, handle: int) -> EdgeClearances:
        return self.world.edge_clearances(
            handle, self.points, self.edges, self.lengths, self.horizon
        )

    def _classify(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Settle on which side of the threshold each edge lies. Returns those that changed."""
        open_ = undecided(self.lower, self.upper, self.threshold)
        # What is already as narrow as the world can make it stays blocked.
        open_ = open_[self.upper[open_] - self.lower[open_] > self.world.resolution]
        if len(open_):
            self._refine(open_, self.threshold)
        return reclassify(self.lower, self.threshold, self.blocked)

    def _refine(self, index: NDArray[np.int64], threshold: float | None) -> None:
        marked = np.zeros(len(self.edges), dtype=np.bool_)
        marked[index] = True
        for handle, near in self._near.items():
            if threshold is None:
                wide = near.upper - near.lower > self.world.resolution
                loose = np.flatnonzero(wide & (near.upper > 0))
            else:
                loose = undecided(near.lower, near.upper, threshold)
            loose = loose[marked[near.index[loose]]]
            if len(loose):
                ends = self.edges[near.index[loose]]
                near.lower[loose], near.upper[loose] = self.world.refine(
                    handle, self.points[ends[:, 0]], self.points[ends[:, 1]], threshold
                )
        self._merge(marked)

    def _merge_again(self, index: NDArray[np.int64]) -> None:
        marked = np.zeros(len(self.edges), dtype=np.bool_)
        marked[index] = True
        self._merge(marked)

    def _merge(self, marked: NDArray[np.bool_]) -> None:
        """Recompute the least clearance of the marked edges over all obstacles."""
        self.lower[marked] = np.inf
        self.upper[marked] = np.inf
        for near in self._near.values():
            lower_marked(self.lower, self.upper, marked, near.index, near.lower, near.upper)


def _fields(near: EdgeClearances) -> tuple[NDArray, ...]:
    return near.index, near.lower, near.upper
