"""A robot of Drake's `MultibodyPlant` among convex solids: a world of configurations.

The padding keeps every link that far from every obstacle; it does not count between links of the
robot itself. Along a straight edge the distance of two bodies changes at most as fast as they move
(`MotionBounds`), which turns distances at a few configurations into a certificate for the edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.obstacle import Obstacle
from planners.checks import checked_box
from planners.drake_geometry import drake_shape
from planners.motion_bound import MotionBounds
from planners.solids import Solid
from planners.world import EdgeClearances

# Handles that are not obstacles of the user's: the robot against itself, and whatever else the
# model holds.
ITSELF, SCENE = -1, -2
# Drake's distance of two convex bodies is good to about 1e-6 m.
ACCURACY = 1e-5


@dataclass(frozen=True)
class _Pairs:
    """Pairs of geometries that must not meet.

    Attributes:
        first, second: `[p]`, Drake's identities.
        bounds: `[p, n]`, metres that their distance changes at most per unit of each position.
    """

    first: list[Any]
    second: list[Any]
    bounds: NDArray[np.float64]


class RobotWorld:
    """Configurations of a robot among convex solids, checked by `SceneGraphCollisionChecker`.

    Attributes:
        certified: whether edges are proved free. False for robots with a joint whose motion is not
            bounded here (screws, quaternions): then edges are sampled.
        resolution: metres; no clearance along an edge is known better than this, and an edge whose
            clearance is not told from the padding at this resolution is blocked.
    """

    def __init__(
        self,
        model: Any,
        robots: Sequence[Any],
        obstacles: Sequence[Solid | Obstacle] = (),
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        resolution: float = 1e-3,
        sample_step: float = 0.01,
    ) -> None:
        """A robot in a built `pydrake.planning.RobotDiagram`, which the world owns from now on.

        Args:
            model: the diagram.
            robots: model instances that are the robot; all positions of the plant are theirs.
            obstacles: in the world's frame; solids of the plane become prisms about z = 0.
            lower, upper: `[n]`, box of configurations; by default the plant's position limits.
            resolution: see the class.
            sample_step: metres of largest motion between samples of an edge, if sampled.

        Raises:
            ValueError: if the box is not finite, or the numbers are out of range.
        """
        from pydrake.common import Parallelism
        from pydrake.planning import SceneGraphCollisionChecker

        for name, value in (("resolution", resolution), ("sample_step", sample_step)):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: must be a positive finite number, got {value}")
        plant = model.plant()
        self.lower, self.upper = checked_box(
            plant.GetPositionLowerLimits() if lower is None else lower,
            plant.GetPositionUpperLimits() if upper is None else upper,
        )
        if plant.num_positions() != len(self.lower):
            raise ValueError(
                f"lower: the plant has {plant.num_positions()} positions, got {len(self.lower)}"
            )
        # A dictionary, since Drake's type stubs do not know these keywords.
        options: dict[str, Any] = {
            "model": model,
            "robot_model_instances": list(robots),
            "edge_step_size": sample_step,
            "implicit_context_parallelism": Parallelism(num_threads=1),
        }
        self._checker: Any = SceneGraphCollisionChecker(**options)
        self.resolution, self._sample_step = float(resolution), float(sample_step)
        self._plant = self._checker.plant()
        self._checker.UpdatePositions((self.lower + self.upper) / 2)
        self._motion = MotionBounds(
            self._plant, self._checker.plant_context(), self.lower, self.upper
        )
        self.certified = self._motion.known
        self._solids: dict[int, Solid] = {}
        self._pairs: dict[int, _Pairs] = {}
        self._next = 0
        self._find_robot()
        for obstacle in obstacles:
            self.add(obstacle)

    @classmethod
    def from_file(
        cls, path: str | Path, obstacles: Sequence[Solid | Obstacle] = (), **options: Any
    ) -> "RobotWorld":
        """The robot of an SDF or URDF file, which must be attached to the world.

        Raises:
            OSError: if there is no such file.
            ValueError: if it holds no robot with position limits.
        """
        from pydrake.planning import RobotDiagramBuilder

        path = Path(path)
        if not path.is_file():
            raise FileNotFoundError(f"model: no file {path}")
        builder = RobotDiagramBuilder()
        try:
            robots = builder.parser().AddModels(path)
        except RuntimeError as error:
            raise ValueError(f"model: {path} could not be read: {error}") from error
        return cls(builder.Build(), robots, obstacles, **options)

    @property
    def dimension(self) -> int:
        return len(self.lower)

    @property
    def handles(self) -> Sequence[int]:
        return tuple(self._pairs)

    @property
    def obstacles(self) -> dict[int, Solid]:
        """The solids present, by handle."""
        return dict(self._solids)

    @property
    def checker(self) -> Any:
        """Drake's collision checker, for drawing and for second opinions; do not change it."""
        return self._checker

    def add(self, obstacle: Solid | Obstacle) -> int:
        """Put a solid into the robot's workspace. Returns its handle."""
        solid = Solid.of(obstacle)
        handle = self._next
        self._next += 1
        self._register(handle, solid)
        return handle

    def remove(self, handle: int) -> None:
        """Take an obstacle away.

        Raises:
            ValueError: if there is none with this handle.
        """
        self._check(handle)
        self._checker.RemoveAllAddedCollisionShapes(group_name=_group(handle))
        del self._solids[handle], self._pairs[handle]

    def move(self, handle: int, translation: ArrayLike, rotation: ArrayLike | float = 0.0) -> None:
        """Move an obstacle by `translation` `[3]`, turning it about its centre.

        Raises:
            ValueError: if there is none with this handle, or for numbers that make no motion.
        """
        self._check(handle)
        moved = self._solids[handle].moved(translation, rotation)
        order = list(self._pairs)
        self.remove(handle)
        self._register(handle, moved)
        self._pairs = {h: self._pairs[h] for h in order}

    def edge_clearances(
        self,
        handle: int,
        points: NDArray[np.float64],
        edges: NDArray[np.int64],
        lengths: NDArray[np.float64],  # noqa: ARG002 (lengths in the box are no distances)
        within: float,
    ) -> EdgeClearances:
        pairs = self._pairs[handle]
        used, compact = np.unique(edges, return_inverse=True)
        distance = self._distances(pairs, points[used])
        first, second = compact.reshape(-1, 2).T
        least = np.minimum(distance[first], distance[second])
        span = np.abs(points[edges[:, 1]] - points[edges[:, 0]])
        motion = span @ pairs.bounds.T
        lower = ((distance[first] + distance[second] - motion) / 2).min(axis=1, initial=np.inf)
        upper = least.min(axis=1, initial=np.inf)
        if not self.certified or handle == ITSELF:
            threshold = 0.0 if handle == ITSELF else None
            near = np.flatnonzero(lower <= (0.0 if handle == ITSELF else within))
            if not self.certified:
                near = np.arange(len(edges))
            ends = points[edges[near, 0]], points[edges[near, 1]]
            lower[near], upper[near] = self._bounds(pairs, *ends, threshold)
        if handle == ITSELF:
            index = np.flatnonzero(lower <= 0)
            # No padding between links: they meet or they do not.
            return EdgeClearances(index, np.zeros(len(index)), np.zeros(len(index)))
        index = np.flatnonzero(lower <= within)
        return EdgeClearances(index, lower[index], upper[index])

    def refine(
        self,
        handle: int,
        starts: NDArray[np.float64],
        ends: NDArray[np.float64],
        threshold: float | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._bounds(self._pairs[handle], starts, ends, threshold)

    def certify(
        self, starts: NDArray[np.float64], ends: NDArray[np.float64], padding: float
    ) -> NDArray[np.bool_]:
        """Which straight edges `[k, n]` to `[k, n]` are free: proved, or sampled; see the class."""
        free = np.ones(len(starts), dtype=bool)
        for handle, pairs in self._pairs.items():
            threshold = 0.0 if handle == ITSELF else padding
            open_ = np.flatnonzero(free)
            if len(open_) and pairs.first:
                lower, _ = self._bounds(pairs, starts[open_], ends[open_], threshold)
                free[open_] = lower > threshold
        return free

    def _check(self, handle: int) -> None:
        if handle not in self._solids:
            raise ValueError(f"handle: no obstacle {handle}; present are {list(self._solids)}")

    def _find_robot(self) -> None:
        """List the robot's geometries, with bounds on their motion, and their permanent foes."""
        checker, plant = self._checker, self._plant
        inspector = checker.model_context().GetQueryObject().inspector()
        world = plant.world_body()
        links, itself, scene = [], [], []
        bodies = _bodies(plant)
        geometries = {
            int(body.index()): list(plant.GetCollisionGeometriesForBody(body)) for body in bodies
        }
        bound = {
            geometry: self._bound_of(body, inspector, geometry)
            for body in bodies
            if checker.IsPartOfRobot(body)
            for geometry in geometries[int(body.index())]
        }
        for i, body in enumerate(bodies):
            if not checker.IsPartOfRobot(body):
                continue
            if not checker.IsCollisionFilteredBetween(body.index(), world.index()):
                links += [(g, bound[g]) for g in geometries[int(body.index())]]
            for j, other in enumerate(bodies):
                if i == j or checker.IsCollisionFilteredBetween(body.index(), other.index()):
                    continue
                both = [
                    (a, b)
                    for a in geometries[int(body.index())]
                    for b in geometries[int(other.index())]
                ]
                if not checker.IsPartOfRobot(other):
                    scene += [(a, b, bound[a]) for a, b in both]
                elif i < j:
                    # Positions that move both bodies together do not change their distance.
                    shared = self._motion.upstream(body) & self._motion.upstream(other)
                    for a, b in both:
                        relative = bound[a] + bound[b]
                        relative[list(shared)] = 0.0
                        itself.append((a, b, relative))
        self._links = links
        for handle, found in ((ITSELF, itself), (SCENE, scene)):
            if found:
                first, second, bounds = zip(*found, strict=True)
                self._pairs[handle] = _Pairs(list(first), list(second), np.array(bounds))

    def _bound_of(self, body: Any, inspector: Any, geometry: Any) -> NDArray[np.float64]:
        if not self.certified:
            return np.full(self.dimension, np.inf)
        return self._motion.of(body, inspector, geometry)

    def _register(self, handle: int, solid: Solid) -> None:
        from pydrake.math import RigidTransform, RotationMatrix

        d = solid.dimension
        rotation: Any = np.eye(3)
        center: Any = np.zeros(3)
        rotation[:d, :d], center[:d] = solid.rotation, solid.center
        before = self._geometries()
        added = self._checker.AddCollisionShapeToBody(
            _group(handle),
            self._plant.world_body(),
            drake_shape(solid),
            RigidTransform(RotationMatrix(rotation), center),
        )
        if not added:
            raise RuntimeError(f"the collision checker refused the shape of obstacle {handle}")
        (identity,) = self._geometries() - before
        self._solids[handle] = solid
        self._pairs[handle] = _Pairs(
            [g for g, _ in self._links],
            [identity] * len(self._links),
            np.array([b for _, b in self._links]),
        )

    def _geometries(self) -> set[Any]:
        inspector = self._checker.model_context().GetQueryObject().inspector()
        return set(inspector.GetAllGeometryIds())

    def _distances(self, pairs: _Pairs, configurations: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances `[k, p]` of the pairs, less the engine's inaccuracy."""
        out = np.empty((len(configurations), len(pairs.first)))
        both = list(zip(pairs.first, pairs.second, strict=True))
        for i, configuration in enumerate(configurations):
            self._checker.UpdatePositions(configuration)
            query = self._checker.model_context().GetQueryObject()
            for p, (a, b) in enumerate(both):
                out[i, p] = query.ComputeSignedDistancePairClosestPoints(a, b).distance
        return out - ACCURACY

    def _bounds(
        self,
        pairs: _Pairs,
        starts: NDArray[np.float64],
        ends: NDArray[np.float64],
        threshold: float | None,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least distance along each edge: intervals that exclude the threshold, or are narrow.

        Halves every piece of an edge whose ends and motion do not yet settle it.
        """
        if not self.certified:
            least = self._sampled(pairs, starts, ends)
            return least, least.copy()
        k = len(starts)
        motion = np.abs(ends - starts) @ pairs.bounds.T
        at_start, at_end = self._distances(pairs, starts), self._distances(pairs, ends)
        upper = np.minimum(at_start, at_end).min(axis=1)
        settled = np.full(k, np.inf)
        edge, left, right = np.arange(k), np.zeros(k), np.ones(k)
        while len(edge):
            travel = motion[edge] * (right - left)[:, None]
            low = ((at_start + at_end - travel) / 2).min(axis=1)
            done = np.full(len(edge), -np.inf) if threshold is None else low
            final = (
                (done > (np.inf if threshold is None else threshold))
                | (upper[edge] - low <= self.resolution)
                | (upper[edge] <= (0.0 if threshold is None else threshold))
            )
            np.minimum.at(settled, edge[final], low[final])
            keep = ~final
            edge, left, right = edge[keep], left[keep], right[keep]
            at_start, at_end = at_start[keep], at_end[keep]
            middle = (left + right) / 2
            places = starts[edge] + middle[:, None] * (ends[edge] - starts[edge])
            at_middle = self._distances(pairs, places)
            np.minimum.at(upper, edge, at_middle.min(axis=1, initial=np.inf))
            edge = np.concatenate([edge, edge])
            left, right = np.concatenate([left, middle]), np.concatenate([middle, right])
            at_start = np.concatenate([at_start, at_middle])
            at_end = np.concatenate([at_middle, at_end])
        return np.minimum(settled, upper), upper

    def _sampled(
        self, pairs: _Pairs, starts: NDArray[np.float64], ends: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Least distance `[k]` at samples of each edge; no certificate."""
        least = np.full(len(starts), np.inf)
        for i, (a, b) in enumerate(zip(starts, ends, strict=True)):
            count = int(np.ceil(np.linalg.norm(b - a) / self._sample_step)) + 1
            places = a + np.linspace(0, 1, count)[:, None] * (b - a)
            least[i] = self._distances(pairs, places).min(initial=np.inf)
        return least


def three_link_arm(obstacles: Sequence[Solid | Obstacle] = (), **options: Any) -> RobotWorld:
    """A planar arm of three links (1, 0.8 and 0.6 m) at the origin, among solids of the plane."""
    path = Path(__file__).parent / "models" / "three_link_arm.sdf"
    return RobotWorld.from_file(path, obstacles, **options)


def _bodies(plant: Any) -> list[Any]:
    from pydrake.multibody.tree import BodyIndex

    return [plant.get_body(BodyIndex(i)) for i in range(plant.num_bodies())]


def _group(handle: int) -> str:
    return f"obstacle {handle}"
