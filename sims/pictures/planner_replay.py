"""A Meshcat replay of planning in a changing plane: obstacles, tree and route come and go."""

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planners.drake_geometry import drake_shape
from planners.rrtx import RRTX
from planners.solids import Solid
from planners.world import SceneWorld

HEIGHT = 1.0


class PlannerReplay:
    """Records a planner's scenes and writes them as one HTML file that needs no server.

    Call `record` after every update; what is no longer there disappears from that time on.
    """

    def __init__(self, planner: RRTX) -> None:
        """Begin a recording of a planner in the plane.

        Raises:
            ValueError: if the planner's world is no scene of the plane.
        """
        from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams, Rgba

        world = planner.world
        if not isinstance(world, SceneWorld) or world.dimension != 2:
            raise ValueError("replay: the planner does not plan in the plane")
        self._planner, self._world = planner, world
        self._meshcat: Any = Meshcat(MeshcatParams(host="localhost"))
        self._animation: Any = MeshcatAnimation(20.0)
        self._rgba = Rgba
        self._shown: dict[str, int] = {}
        self._solids: dict[int, tuple[Solid, str]] = {}
        self._scenes = 0
        self._set_up()

    def record(self, time: float) -> None:
        """Show the planner's obstacles, tree, route and robot from `time` (seconds) on."""
        frame = self._animation.frame(time)
        current = {}
        for handle, solid in self._world.obstacles.items():
            known = self._solids.get(handle)
            path = known[1] if known and known[0] is solid else f"obstacles/{handle} at {frame}"
            if not (known and known[0] is solid):
                self._add_solid(path, solid, frame)
            current[handle] = (solid, path)
        kept = {path for _, path in current.values()}
        for _, path in self._solids.values():
            if path not in kept:
                self._animation.SetProperty(frame, path, "visible", False)
        self._solids = current
        self._scene("tree", frame, self._draw_tree)
        self._scene("route", frame, self._draw_route)
        self._scenes += 1
        self._place("robot", self._planner.robot, frame)

    def save(self, path: Path) -> None:
        """Write the replay as an HTML file that plays by itself."""
        self._meshcat.SetAnimation(self._animation)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self._meshcat.StaticHtml(), encoding="utf-8")

    def _set_up(self) -> None:
        from pydrake.geometry import Box, Cylinder, Sphere
        from pydrake.math import RigidTransform

        meshcat, lower, upper = self._meshcat, self._world.lower, self._world.upper
        meshcat.SetProperty("/Grid", "visible", False)
        meshcat.SetProperty("/Axes", "visible", False)
        meshcat.SetProperty("/Background", "top_color", [1, 1, 1])
        meshcat.SetProperty("/Background", "bottom_color", [0.93, 0.95, 0.97])
        size, middle = upper - lower, (upper + lower) / 2
        meshcat.SetObject("floor", Box(size[0], size[1], 0.05), self._rgba(0.96, 0.96, 0.94))
        meshcat.SetTransform("floor", RigidTransform(_at(middle, -0.05)))
        meshcat.SetObject("robot", Sphere(0.012 * size.max()), self._rgba(0.1, 0.1, 0.1))
        meshcat.SetObject("goal", Cylinder(0.012 * size.max(), 0.3), self._rgba(0, 0.62, 0.45))
        meshcat.SetTransform("goal", RigidTransform(_at(self._planner.goal, 0.15)))
        # Meshcat's point lights stand where they light a room, not a field: an even light instead.
        for side in ("NegativeX", "PositiveX"):
            meshcat.SetProperty(f"/Lights/PointLight{side}", "visible", False)
        for light, intensity in (("Ambient", 2.0), ("Directional", 1.0), ("Fill", 0.6)):
            meshcat.SetProperty(f"/Lights/{light}Light/<object>", "intensity", intensity)
        eye = np.array([middle[0], middle[1] - 0.52 * size[1], 0.68 * size.max()])
        meshcat.SetCameraPose(eye, np.array([middle[0], middle[1] - 0.04 * size[1], 0.0]))

    def _add_solid(self, path: str, solid: Solid, frame: int) -> None:
        from pydrake.math import RigidTransform, RotationMatrix

        rotation: Any = np.eye(3)
        rotation[:2, :2] = solid.rotation
        center: Any = np.array([*solid.center, HEIGHT / 2])
        self._meshcat.SetObject(path, drake_shape(solid, HEIGHT), self._rgba(0.35, 0.43, 0.55, 1))
        self._meshcat.SetTransform(path, RigidTransform(RotationMatrix(rotation), center))
        self._appear(path, frame)

    def _scene(self, name: str, frame: int, draw: Any) -> None:
        """Replace the drawing called `name` from this frame on."""
        old = f"{name}/{self._scenes - 1}"
        if self._scenes:
            self._animation.SetProperty(frame, old, "visible", False)
        path = f"{name}/{self._scenes}"
        draw(path)
        self._appear(path, frame)

    def _appear(self, path: str, frame: int) -> None:
        if frame > 0:
            self._animation.SetProperty(0, path, "visible", False)
        self._animation.SetProperty(frame, path, "visible", True)

    def _draw_tree(self, path: str) -> None:
        view = self._planner.view()
        child = np.flatnonzero(view.parent >= 0)
        starts = _lifted(view.points[child], 0.02)
        ends = _lifted(view.points[view.parent[child]], 0.02)
        self._meshcat.SetLineSegments(path, starts, ends, 1.0, self._rgba(0.25, 0.5, 0.75))

    def _draw_route(self, path: str) -> None:
        update = self._planner.change()
        points = np.zeros((0, 2)) if update.route is None else update.route.points
        # One line is one pixel wide in a browser: several side by side make a ribbon.
        across = np.linspace(-0.12, 0.12, 13)
        starts, ends = [], []
        for a, b in pairwise(points):
            normal = np.array([a[1] - b[1], b[0] - a[0]]) / np.linalg.norm(b - a)
            starts += [a + s * normal for s in across]
            ends += [b + s * normal for s in across]
        if starts:
            first, last = _lifted(np.array(starts), 0.06), _lifted(np.array(ends), 0.06)
            self._meshcat.SetLineSegments(path, first, last, 2.0, self._rgba(0.84, 0.37, 0))

    def _place(self, path: str, point: NDArray[np.float64], frame: int) -> None:
        from pydrake.math import RigidTransform

        self._animation.SetTransform(frame, path, RigidTransform(_at(point, 0.3)))


def _at(point: NDArray[np.float64], height: float) -> Any:
    return np.array([*point, height])


def _lifted(points: NDArray[np.float64], height: float) -> NDArray[np.float64]:
    """`[3, k]`, as Meshcat takes them."""
    return np.column_stack([points, np.full(len(points), height)]).T.copy()


def replay_of_changes(planner: RRTX, changes: Iterable[dict[str, Any]], period: float) -> Any:
    """Record a planner through `changes` (arguments of `RRTX.change`), `period` seconds apart."""
    replay = PlannerReplay(planner)
    planner.settle()
    replay.record(0.0)
    for step, change in enumerate(changes, 1):
        planner.change(**change, to_the_end=True)
        replay.record(step * period)
    return replay
