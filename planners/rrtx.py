"""RRT^X: a shortest-path tree rooted at the goal, repaired when the world changes.

Otte and Frazzoli, "RRT^X: asymptotically optimal single-query sampling-based motion planning with
quick replanning", International Journal of Robotics Research 35 (2016).
"""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.trajectory import SolveError, Status
from planners.blockage import Blockage, find_blockage
from planners.checks import checked_padding, checked_point
from planners.roadmap import Roadmap
from planners.roadmap_kernels import nearest_first, net_changes
from planners.robot_approach import Approach
from planners.samples import Samples
from planners.shortcut import shortest_over_corners
from planners.tree import Tree
from planners.update import Cause, Route, TreeView, Update
from planners.world import World

Motion = list[float] | NDArray[np.float64] | tuple[ArrayLike, ArrayLike]


class RRTX:
    """A planner that keeps its tree when the world, the padding, the robot or the goal changes.

    It owns the world: obstacles come and go through the planner (`change`), so that both agree.
    Every update repairs the tree until the robot's route is settled; `settle`, or
    `to_the_end=True`, repairs the rest.

    Example:
        >>> from planners.solids import Solid
        >>> from planners.world import SceneWorld
        >>> planner = RRTX(SceneWorld([-5, -5], [5, 5]), goal=[4, 4], robot=[-4, -4], nodes=500)
        >>> before = planner.route.cost
        >>> update = planner.appear(Solid.ball([0, 0], 1.0))
        >>> update.route.certified, update.route.cost > before
        (True, True)
    """

    def __init__(
        self,
        world: World,
        goal: ArrayLike,
        robot: ArrayLike,
        nodes: int = 5000,
        *,
        seed: int = 0,
        padding: float = 0.0,
        epsilon: float = 0.0,
        reach: float | None = None,
        radius_factor: float = 0.9,
        horizon: float | None = None,
        culling: bool = False,
    ) -> None:
        """Grow a tree of `nodes` samples, rooted at the goal, and find the robot's route.

        Args:
            world: where to plan; with the obstacles it holds now.
            goal, robot: `[d]`, positions in the world's box.
            nodes: how many nodes, the goal included; 0 grows nothing yet.
            seed: equal seeds give equal trees.
            padding: metres kept from every obstacle, at least.
            epsilon: a node is consistent while its neighbours know its cost up to this; each hop
                of a way may then cost that much more than the least.
            reach: longest edge; by default 0.15 of the box's longest side.
            radius_factor: of the shrinking radius; 1 is the bound of Karaman and Frazzoli (2011)
                for the optimality of random graphs, smaller is faster.
            horizon: clearances are known up to here, metres, and a padding below it is fast; by
                default the larger of twice the padding and 0.025 of the box's longest side.
            culling: forget running neighbours beyond the shrinking radius, as the paper does. The
                price: ways over forgotten edges are lost, up to 0.1 m of 45 m at 5,000 nodes among
                20 obstacles; repair was not measurably faster there, so it is off.

        Raises:
            ValueError: for a point outside the box, or a number out of its range.
        """
        begun = time.perf_counter()
        self.world = world
        side = float((world.upper - world.lower).max())
        reach = 0.15 * side if reach is None else reach
        padding = checked_padding(padding)
        horizon = max(2 * padding, 0.025 * side) if horizon is None else horizon
        for name, value in (("reach", reach), ("radius_factor", radius_factor)):
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}: must be a positive finite number, got {value}")
        if not (np.isfinite(horizon) and horizon > padding):
            raise ValueError(f"horizon: must be finite and exceed the padding, got {horizon}")
        if not (np.isfinite(epsilon) and epsilon >= 0):
            raise ValueError(f"epsilon: must be a finite number of at least 0, got {epsilon}")
        self._samples = Samples(world.dimension, seed)
        self._roadmap = Roadmap(
            world,
            checked_point(goal, world.lower, world.upper, "goal"),
            padding,
            horizon,
            reach,
            radius_factor,
            culling,
        )
        self._tree = Tree(self._roadmap, 0, epsilon)
        self._approach = Approach(
            self._roadmap, checked_point(robot, world.lower, world.upper, "robot")
        )
        self._route: Route | None = None
        self._blockage: Blockage | None = None
        self._geometry = 0.0
        self.construction = self._grow(_count(nodes, "nodes", 1) - 1, False, begun)

    @property
    def robot(self) -> NDArray[np.float64]:
        """`[d]`, where the robot is."""
        return self._approach.robot.copy()

    @property
    def goal(self) -> NDArray[np.float64]:
        """`[d]`."""
        return self._roadmap.points[self._tree.root].copy()

    @property
    def padding(self) -> float:
        """Metres kept from every obstacle, at least."""
        return self._roadmap.padding

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return len(self._roadmap.points)

    @property
    def route(self) -> Route:
        """The robot's way to the goal.

        Raises:
            SolveError: if there is none; the text says what bars it.
        """
        if self._route is None:
            raise SolveError(Status.INFEASIBLE, str(self._blockage))
        return self._route

    def shortened(self) -> Route:
        """The route with corners left out where that is free and shorter; may take 0.1 s.

        Raises:
            SolveError: if there is no route.
        """
        points = shortest_over_corners(self.world, self.route.points, self.padding)
        cost = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        return Route(points, cost, self.world.certified)

    def grow(self, count: int, to_the_end: bool = False) -> Update:
        """Add samples: anytime improvement."""
        return self._grow(_count(count, "count", 0), to_the_end, time.perf_counter())

    def change(
        self,
        *,
        add: Sequence[Any] = (),
        remove: Sequence[int] = (),
        move: Mapping[int, Motion] | None = None,
        padding: float | None = None,
        robot: ArrayLike | None = None,
        to_the_end: bool = False,
    ) -> Update:
        """Change the world, the padding and the robot's position at once, and repair.

        Args:
            add: obstacles that appear.
            remove: handles of those that vanish.
            move: by handle, a translation (an array or a list `[d]`), or a tuple (translation,
                rotation), see `World.move`.
            padding: the new padding, metres.
            robot: the robot's new position `[d]`.
            to_the_end: repair the whole tree, not only what the robot's route needs.

        Raises:
            ValueError: for bad input. What came before it in the order of the arguments is done,
                and the tree agrees with the world.
        """
        begun = time.perf_counter()
        world, roadmap = self.world, self._roadmap
        steps: list[tuple[Cause, Callable[[], Any]]] = []
        handles: list[int] = []

        def appear(obstacle: Any) -> Any:
            handles.append(world.add(obstacle))
            return roadmap.appear(handles[-1])

        def vanish(handle: int) -> Any:
            world.remove(handle)
            return roadmap.vanish(handle)

        def shift(handle: int, motion: Motion) -> Any:
            translation, rotation = motion if isinstance(motion, tuple) else (motion, 0.0)
            world.move(handle, translation, rotation)
            return roadmap.shift(handle)

        steps += [(Cause.APPEARANCE, lambda o=o: appear(o)) for o in add]
        steps += [(Cause.DISAPPEARANCE, lambda h=h: vanish(h)) for h in remove]
        steps += [
            (Cause.MOVEMENT, lambda h=h, by=by: shift(h, by)) for h, by in (move or {}).items()
        ]
        if padding is not None:
            steps.append((Cause.PADDING, lambda: roadmap.set_padding(checked_padding(padding))))
        causes = [cause for cause, _ in steps]
        changed: list[tuple[NDArray, NDArray]] = []
        try:
            for _, step in steps:
                changed.append(step())
            if robot is not None:
                causes.append(Cause.ROBOT)
                self._approach.move(checked_point(robot, world.lower, world.upper, "robot"))
        finally:
            if changed:
                self._approach.forget()
            self._geometry = time.perf_counter() - begun
            update = self._repair(causes, handles, changed, to_the_end, begun)
        return update

    def appear(self, obstacle: Any, **options: Any) -> Update:
        """An obstacle appears; its handle is in the update's `handles`."""
        return self.change(add=[obstacle], **options)

    def vanish(self, handle: int, **options: Any) -> Update:
        """An obstacle vanishes."""
        return self.change(remove=[handle], **options)

    def shift(
        self,
        handle: int,
        translation: ArrayLike,
        rotation: ArrayLike = 0.0,
        **options: Any,
    ) -> Update:
        """An obstacle moves by `translation` `[d]`, turning about its centre."""
        return self.change(move={handle: (translation, rotation)}, **options)

    def set_padding(self, padding: float, **options: Any) -> Update:
        """All obstacles grow or shrink to the Minkowski sum with a ball of radius `padding`."""
        return self.change(padding=padding, **options)

    def move_robot(self, position: ArrayLike, **options: Any) -> Update:
        """The robot is at `position` `[d]`."""
        return self.change(robot=position, **options)

    def settle(self) -> Update:
        """Repair the whole tree."""
        begun = time.perf_counter()
        self._geometry = 0.0
        return self._repair([Cause.SETTLING], [], [], True, begun)

    def set_goal(self, goal: ArrayLike, to_the_end: bool = False) -> Update:
        """Root the tree at a new goal `[d]`; the graph and its clearances stay."""
        begun = time.perf_counter()
        point = checked_point(goal, self.world.lower, self.world.upper, "goal")
        same = np.flatnonzero((self._roadmap.points == point).all(axis=1))
        if len(same):
            root = int(same[0])
        else:
            root = self.nodes
            self._roadmap.insert(point[None], pull=False)
            self._roadmap.compress(np.append(self._tree.parent, np.int32(-1)))
        self._tree.set_root(root)
        self._approach.forget()
        self._geometry = time.perf_counter() - begun
        return self._repair([Cause.GOAL], [], [], to_the_end, begun)

    def cost_to_go(self, points: ArrayLike, candidates: int = 16) -> NDArray[np.float64]:
        """Length of the way to the goal from `points` `[..., d]`, along a straight line to a node.

        The least over the `candidates` most promising nodes within the connection radius whose
        line is certified free; infinite where there is none (inside padded obstacles, or cut off).

        Raises:
            ValueError: if a point is not finite or has the wrong number of coordinates.
        """
        array = np.asarray(points, dtype=float)
        d = self.world.dimension
        if array.shape[-1:] != (d,) or not np.isfinite(array).all():
            raise ValueError(f"points: must be finite, with {d} coordinates on the last axis")
        flat = np.ascontiguousarray(array.reshape(-1, d))
        nodes, costs = nearest_first(
            self._roadmap.points, self._tree.lmc, flat, self._roadmap.radius, candidates
        )
        out = np.full(len(flat), np.inf)
        open_ = np.arange(len(flat))
        for rank in range(candidates):
            open_ = open_[nodes[open_, rank] >= 0]
            ends = self._roadmap.points[nodes[open_, rank]]
            free = self.world.certify(flat[open_], ends, self.padding)
            out[open_[free]] = costs[open_[free], rank]
            open_ = open_[~free]
        return out.reshape(array.shape[:-1])

    def view(self) -> TreeView:
        """The tree and the graph as they are now."""
        tree, roadmap = self._tree, self._roadmap
        return TreeView(
            roadmap.points.copy(),
            tree.root,
            tree.parent.copy(),
            tree.lmc.copy(),
            tree.g.copy(),
            tree.consistent,
            roadmap.edges.copy(),
            roadmap.lengths.copy(),
            roadmap.blocked.copy(),
            roadmap.lower.copy(),
            roadmap.radius,
        )

    def _grow(self, count: int, to_the_end: bool, begun: float) -> Update:
        lower, upper = self.world.lower, self.world.upper
        samples = lower + self._samples.take(count) * (upper - lower)
        freed = self._roadmap.insert(samples)
        self._tree.grow()
        self._roadmap.compress(self._tree.parent)
        self._approach.forget()
        self._geometry = time.perf_counter() - begun
        none = np.zeros(0, dtype=np.int64)
        return self._repair([Cause.GROWTH], [], [(none, freed)], to_the_end, begun)

    def _repair(
        self,
        causes: Sequence[Cause],
        handles: Sequence[int],
        changed: Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]],
        to_the_end: bool,
        begun: float,
    ) -> Update:
        tree = self._tree
        toggled = np.concatenate(
            [np.zeros(0, dtype=np.int64), *(e for pair in changed for e in pair)]
        )
        blocked, freed = net_changes(np.sort(toggled), self._roadmap.blocked)
        orphans = tree.block(blocked)
        tree.free(freed)
        repaired = 0
        while True:
            done, _ = tree.cascade(self._approach.distance, to_the_end)
            repaired += done
            checking = time.perf_counter()
            sure = self._approach.confirm(tree.lmc)
            self._geometry += time.perf_counter() - checking
            if sure:
                break
        before = self._route
        self._emit()
        after = self._route
        same = (before is None and after is None) or (
            before is not None and after is not None and np.array_equal(before.points, after.points)
        )
        return Update(
            causes=tuple(dict.fromkeys(causes)),
            handles=tuple(handles),
            edges_blocked=len(blocked),
            edges_freed=len(freed),
            orphans=orphans,
            repaired=repaired,
            settled=tree.settled,
            route=after,
            route_changed=not same,
            cost_before=before.cost if before else np.inf,
            blockage=self._blockage,
            geometry_seconds=self._geometry,
            seconds=time.perf_counter() - begun,
        )

    def _emit(self) -> None:
        """Read the robot's route off the tree and have the world certify it once more."""
        begun = time.perf_counter()
        self._route, self._blockage = None, None
        node = self._approach.best(self._tree.lmc)
        if node < 0:
            self._blockage = find_blockage(self._roadmap, self._tree.root, self._approach.robot)
        else:
            ways = self._roadmap.points[self._tree.way(node)]
            points = np.concatenate([self._approach.robot[None], ways])
            points = points[np.append(True, (np.diff(points, axis=0) != 0).any(axis=1))]
            if not self.world.certify(points[:-1], points[1:], self.padding).all():
                raise RuntimeError("the world changed without the planner: use `change`")
            cost = float(self._approach.distance[node] + self._tree.lmc[node])
            self._route = Route(points, cost, self.world.certified)
        self._geometry += time.perf_counter() - begun


def _count(value: int, name: str, least: int) -> int:
    if isinstance(value, bool) or int(value) != value or value < least:
        raise ValueError(f"{name}: must be a whole number of at least {least}, got {value}")
    return int(value)
