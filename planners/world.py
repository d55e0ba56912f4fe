"""Worlds: what a planner may ask of the space it plans in, and convex solids in a Drake SceneGraph.

Padding is the Minkowski sum of every obstacle with a ball (rrt-qx, eq. 7): a point is blocked where
its clearance, the signed distance to the nearest obstacle, is at most the padding.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.obstacle import Obstacle
from planners.checks import checked_box
from planners.clearance_kernels import ball_clearances, edges_within, polytope_clearances
from planners.drake_geometry import Lens, in_space
from planners.solids import Shape, Solid

# Distances of the engine are good to 1e-12 at these sizes; whatever is closer than this to the
# padding counts as blocked.
TOLERANCE = 1e-9
# Certificates look this far ahead, as a part of the box: farther, the answers cost more than they
# are worth.
LOOK_AHEAD = 0.05


@dataclass(frozen=True)
class EdgeClearances:
    """Certified intervals for the clearance of some edges from one obstacle.

    Attributes:
        index: `[k]`, which of the edges asked about; the others are farther than was asked.
        lower, upper: `[k]`, metres; the clearance lies between, a closed interval.
    """

    index: NDArray[np.int64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


class World(Protocol):
    """A box with obstacles, numbered by handles.

    Laws: the intervals of `edge_clearances` and `refine` hold the true clearance along the whole
    straight edge, not at samples of it, whenever `certified`; `certify` agrees with them.
    """

    @property
    def dimension(self) -> int:
        """Number of coordinates d of a point."""
        ...

    @property
    def lower(self) -> NDArray[np.float64]:
        """`[d]`, the lower corner of the box."""
        ...

    @property
    def upper(self) -> NDArray[np.float64]:
        """`[d]`, the upper corner of the box."""
        ...

    @property
    def certified(self) -> bool:
        """Whether edges are proved free; else they were only sampled."""
        ...

    @property
    def resolution(self) -> float:
        """Metres: `refine` may leave intervals this wide."""
        ...

    @property
    def handles(self) -> Sequence[int]:
        """The obstacles present, in the order of their arrival."""
        ...

    def edge_clearances(
        self,
        handle: int,
        points: NDArray[np.float64],
        edges: NDArray[np.int64],
        lengths: NDArray[np.float64],
        within: float,
    ) -> EdgeClearances:
        """Clearance of those edges `[m, 2]` of `points` `[n, d]` that may come `within` of it."""
        ...

    def refine(
        self,
        handle: int,
        starts: NDArray[np.float64],
        ends: NDArray[np.float64],
        threshold: float | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Intervals `[k]`, `[k]` that exclude the threshold, or are at most `resolution` wide."""
        ...

    def certify(
        self, starts: NDArray[np.float64], ends: NDArray[np.float64], padding: float
    ) -> NDArray[np.bool_]:
        """`[k]`, which straight segments keep more than `padding` from every obstacle."""
        ...

    def add(self, obstacle: Any) -> int:
        """Put an obstacle into the world. Returns its handle."""
        ...

    def remove(self, handle: int) -> None:
        """Take an obstacle out of the world."""
        ...

    def move(self, handle: int, translation: ArrayLike, rotation: ArrayLike | float = 0.0) -> None:
        """Move an obstacle by `translation` `[d]`, turning it about its centre."""
        ...


@dataclass(frozen=True)
class Nearest:
    """Distances to the nearest obstacle.

    Attributes:
        distance: `[...]`, metres, negative inside; infinite if nothing is in reach.
        gradient: `[..., d]`, of the distance; zero if nothing is in reach.
        handle: `[...]`, which obstacle; -1 if nothing is in reach.
    """

    distance: NDArray[np.float64]
    gradient: NDArray[np.float64]
    handle: NDArray[np.int64]


class SceneWorld:
    """A point among convex solids in the plane or in space; distances are Drake's.

    One SceneGraph without a plant serves all: the scene's context holds every obstacle and answers
    for the whole world; each obstacle also has a context of its own, so that a question about one
    does not pay for the others. Solids of the plane are prisms and cylinders, taller than wide, so
    that the nearest side is never the top.
    """

    certified = True
    resolution = TOLERANCE

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        obstacles: Sequence[Solid | Obstacle] = (),
    ) -> None:
        """The box between `lower` and `upper` `[d]`, d = 2 or 3, metres.

        Raises:
            ValueError: if the box is empty or a number is not finite.
        """
        from pydrake.geometry import SceneGraph

        self.lower, self.upper = checked_box(lower, upper)
        if len(self.lower) not in (2, 3):
            raise ValueError(f"lower: a scene has 2 or 3 coordinates, got {len(self.lower)}")
        self._graph = SceneGraph()
        self._source = self._graph.RegisterSource("obstacles")
        self._scene = Lens(self._graph, self._source)
        self._look_ahead = LOOK_AHEAD * float((self.upper - self.lower).max())
        self._solids: dict[int, Solid] = {}
        self._lenses: dict[int, Lens] = {}
        self._ids: dict[int, Any] = {}
        self._owners: dict[Any, int] = {}
        self._next = 0
        for obstacle in obstacles:
            self.add(obstacle)

    @property
    def dimension(self) -> int:
        return len(self.lower)

    @property
    def handles(self) -> Sequence[int]:
        return tuple(self._solids)

    @property
    def obstacles(self) -> Mapping[int, Solid]:
        """The solids present, by handle."""
        return MappingProxyType(self._solids)

    def add(self, obstacle: Solid | Obstacle) -> int:
        """Put a solid into the world. Returns its handle, a number never used again.

        Raises:
            ValueError: if it is not a solid of this world's dimension.
        """
        solid = Solid.of(obstacle)
        if solid.dimension != self.dimension:
            raise ValueError(
                f"obstacle: must have {self.dimension} coordinates, got {solid.dimension}"
            )
        handle = self._next
        self._next += 1
        self._register(handle, solid)
        return handle

    def remove(self, handle: int) -> None:
        """Take an obstacle out of the world.

        Raises:
            ValueError: if there is none with this handle.
        """
        self._check(handle)
        del self._owners[self._ids[handle]]
        self._scene.remove(self._ids.pop(handle))
        del self._solids[handle], self._lenses[handle]

    def move(self, handle: int, translation: ArrayLike, rotation: ArrayLike | float = 0.0) -> None:
        """Move an obstacle by `translation` `[d]`, turning it about its centre.

        Raises:
            ValueError: if there is none with this handle, or for numbers that make no motion.
        """
        self._check(handle)
        moved = self._solids[handle].moved(translation, rotation)
        order = list(self._solids)
        self.remove(handle)
        self._register(handle, moved)
        self._solids = {h: self._solids[h] for h in order}

    def distances(self, points: ArrayLike, within: float = np.inf) -> Nearest:
        """Distance and gradient at `points` `[..., d]`, looking no farther than `within` metres.

        Raises:
            ValueError: if a point is not finite or does not fit the world, or `within` is negative.
        """
        array = np.asarray(points, dtype=float)
        if array.shape[-1:] != (self.dimension,):
            raise ValueError(
                f"points: the last axis must have {self.dimension} coordinates, "
                f"got shape {array.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError("points: numbers must be finite")
        if not within >= 0:
            raise ValueError(f"within: must be a distance of at least 0, got {within}")
        flat = array.reshape(-1, self.dimension)
        distance = np.full(len(flat), np.inf)
        gradient = np.zeros(flat.shape)
        handle = np.full(len(flat), -1)
        query = self._scene.query.ComputeSignedDistanceToPoint
        for i, point in enumerate(in_space(flat)):
            answers = query(point, within)
            if answers:
                nearest = min(answers, key=_distance)
                distance[i] = nearest.distance
                gradient[i] = nearest.grad_W[: self.dimension]
                handle[i] = self._owners[nearest.id_G]
        shape = array.shape[:-1]
        return Nearest(
            distance.reshape(shape), gradient.reshape(array.shape), handle.reshape(shape)
        )

    def edge_clearances(
        self,
        handle: int,
        points: NDArray[np.float64],
        edges: NDArray[np.int64],
        lengths: NDArray[np.float64],
        within: float,
    ) -> EdgeClearances:
        solid = self._solids[handle]
        lower, upper = solid.bounds
        index = edges_within(
            points, edges, lengths, solid.center, solid.rotation, lower, upper, within
        )
        exact = self._exact(handle, points, edges[index], within)
        near = exact <= within
        return EdgeClearances(index[near], exact[near], exact[near])

    def refine(
        self,
        handle: int,
        starts: NDArray[np.float64],
        ends: NDArray[np.float64],
        threshold: float | None,  # noqa: ARG002 (exact whatever the threshold)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        k = len(starts)
        pairs = np.column_stack([np.arange(k), np.arange(k, 2 * k)])
        exact = self._exact(handle, np.concatenate([starts, ends]), pairs, np.inf)
        return exact, exact.copy()

    def certify(
        self, starts: NDArray[np.float64], ends: NDArray[np.float64], padding: float
    ) -> NDArray[np.bool_]:
        """Which straight segments `[k, d]` to `[k, d]` keep more than `padding` from everything.

        Conservative advancement: from a point of the segment, the free ball round it (looking no
        farther than is worth the answers) and the half-planes of the gradients say how far
        the segment is free for certain, and the next question is asked there.
        """
        first, last = in_space(starts), in_space(ends)
        query = self._scene.query.ComputeSignedDistanceToPoint
        free = np.zeros(len(first), dtype=bool)
        level = padding + TOLERANCE
        for i, (a, b) in enumerate(zip(first, last, strict=True)):
            direction = b - a
            length = float(np.sqrt(direction @ direction))
            t = 0.0
            while True:
                ahead = min((1.0 - t) * length, self._look_ahead)
                answers = query(a + t * direction, ahead + level)
                step = np.inf if ahead < self._look_ahead else ahead / length
                for answer in answers:
                    margin = answer.distance - level
                    slope = float(answer.grad_W @ direction)
                    if margin <= 0:
                        step = 0.0
                        break
                    if slope < 0:
                        step = min(step, margin / -slope)
                if t + step >= 1.0:
                    free[i] = True
                    break
                # A step this small cannot leave the padding any more.
                if step * length <= 1e-12:
                    break
                t += step
        return free

    def _check(self, handle: int) -> None:
        if handle not in self._solids:
            raise ValueError(f"handle: no obstacle {handle}; present are {list(self._solids)}")

    def _register(self, handle: int, solid: Solid) -> None:
        lens = Lens(self._graph, self._source)
        lens.add(solid, f"obstacle {handle}")
        identity = self._scene.add(solid, f"obstacle {handle}")
        self._lenses[handle] = lens
        self._ids[handle] = identity
        self._owners[identity] = handle
        self._solids[handle] = solid

    def _exact(
        self,
        handle: int,
        points: NDArray[np.float64],
        edges: NDArray[np.int64],
        within: float,
    ) -> NDArray[np.float64]:
        """Clearance `[m]` of edges `[m, 2]` from one obstacle; at most 0 if they touch it.

        Exact up to `within`: points whose box distance exceeds it are not asked about.
        """
        solid = self._solids[handle]
        out = np.empty(len(edges))
        if solid.shape is Shape.BALL:
            a, b = points[edges[:, 0]], points[edges[:, 1]]
            ball_clearances(a, b, solid.center, solid.radius, out)
            return out
        used, compact = np.unique(edges, return_inverse=True)
        corners = points[used]
        local = (corners - solid.center) @ solid.rotation
        lower, upper = solid.bounds
        gaps = np.maximum(np.maximum(lower - local, local - upper), 0.0)
        near = (gaps**2).sum(axis=1) <= within * within
        distance, gradient = np.full(len(used), np.inf), np.zeros(corners.shape)
        distance[near], gradient[near] = self._from(handle, corners[near])
        pairs = np.ascontiguousarray(compact.reshape(-1, 2))
        polytope_clearances(corners, pairs, distance, gradient, solid.sides, solid.facets, out)
        return out

    def _from(
        self, handle: int, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance `[k]` and gradient `[k, d]` to one obstacle."""
        query = self._lenses[handle].query.ComputeSignedDistanceToPoint
        answers = [query(point, np.inf)[0] for point in in_space(points)]
        distance = np.array([a.distance for a in answers])
        gradient = np.array([a.grad_W for a in answers]).reshape(-1, 3)
        return distance, np.ascontiguousarray(gradient[:, : self.dimension])


def _distance(answer: Any) -> float:
    return answer.distance
