"""A Meshcat replay of navigation as one HTML file: it plays by itself and has a time slider."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.files import write_text
from planners.drake_geometry import drake_shape
from planners.solids import Solid
from sims.navigation.navigate import Navigation
from sims.navigation.record import Moment
from sims.navigation.scenario_file import Scenario
from sims.navigation.scene import in_space

Array = NDArray[np.float64]

HEIGHT = 1.0
"""Metres: of obstacles and robots of the plane."""
RATE = 20.0
TREES = 10
"""How many trees are shown over the run: each weighs some 100 kB."""
COLOURS = (
    (0.78, 0.06, 0.18), (0.0, 0.45, 0.70), (0.0, 0.62, 0.45), (0.80, 0.47, 0.65),
    (0.90, 0.62, 0.0), (0.34, 0.71, 0.91), (0.36, 0.23, 0.62), (0.42, 0.42, 0.42),
)  # fmt: skip


def save_replay(scenario: Scenario, runs: list[Navigation], path: Path) -> None:
    """Write the replay of recorded runs."""
    replay = _Replay(scenario)
    for number, run in enumerate(runs):
        replay.add_robot(number, run)
    replay.add_obstacles(runs)
    replay.add_plans(runs[0])
    write_text(path, replay.html())


class _Replay:
    def __init__(self, scenario: Scenario) -> None:
        from pydrake.geometry import Box, Meshcat, MeshcatAnimation, Rgba
        from pydrake.math import RigidTransform

        self._d, self._rgba = scenario.dimension, Rgba
        self._size = float((scenario.upper - scenario.lower).max())
        self._meshcat: Any = Meshcat()
        self._animation: Any = MeshcatAnimation(RATE)
        meshcat = self._meshcat
        for path in ("/Grid", "/Axes"):
            meshcat.SetProperty(path, "visible", False)
        meshcat.SetProperty("/Background", "top_color", [1, 1, 1])
        meshcat.SetProperty("/Background", "bottom_color", [0.93, 0.95, 0.97])
        # Meshcat's point lights light a room, not a field: an even light instead.
        for side in ("NegativeX", "PositiveX"):
            meshcat.SetProperty(f"/Lights/PointLight{side}", "visible", False)
        for light, intensity in (("Ambient", 2.0), ("Directional", 1.0), ("Fill", 0.6)):
            meshcat.SetProperty(f"/Lights/{light}Light/<object>", "intensity", intensity)
        size = scenario.upper - scenario.lower
        middle = (scenario.upper + scenario.lower) / 2
        floor = in_space(middle)
        floor[2] = -0.03 if self._d == 2 else scenario.lower[2]
        meshcat.SetObject("floor", Box(size[0], size[1], 0.05), Rgba(0.96, 0.96, 0.94))
        meshcat.SetTransform("floor", RigidTransform(floor))
        target = in_space(middle)
        tilt = np.array([0.0, -0.47, 0.62]) if self._d == 2 else np.array([0.75, -1.25, 0.6])
        target[1] -= 0.03 * size[1] if self._d == 2 else 0.0
        meshcat.SetCameraPose(target + self._size * tilt, target)

    def html(self) -> str:
        self._meshcat.SetAnimation(self._animation)
        return self._meshcat.StaticHtml()

    def add_robot(self, number: int, run: Navigation) -> None:
        from pydrake.geometry import Sphere
        from pydrake.math import RigidTransform

        colour = self._rgba(*COLOURS[number % len(COLOURS)])
        body = max(run.robot.radius, 0.008 * self._size)
        name = f"robots/{number}"
        self._meshcat.SetObject(name, Sphere(body), colour)
        last = -1
        for time, position in zip(run.fine_times, run.track, strict=True):
            frame = self._animation.frame(time)
            if frame != last:
                self._animation.SetTransform(frame, name, RigidTransform(self._at(position, body)))
                last = frame
        if self._d == 2:
            self._ring(f"{name}/ring", run)
        goal = f"goals/{number}"
        self._meshcat.SetObject(goal, Sphere(0.008 * self._size), self._rgba(1.0, 0.84, 0.0))
        self._meshcat.SetTransform(goal, RigidTransform(self._at(run.robot.goal, 0.1)))
        # The way gone grows with time: a piece a second.
        step = max(1, round(1.0 / float(run.fine_times[1] - run.fine_times[0])))
        for begin in range(0, len(run.track) - 1, step):
            piece = run.track[begin : begin + step + 1 : 4]
            end = self._animation.frame(run.fine_times[min(begin + step, len(run.track) - 1)])
            self._ribbon(f"tracks/{number}/{begin}", piece, colour, 0.09, end)

    def _ring(self, name: str, run: Navigation) -> None:
        """How far the robot sees, dashed; it moves with the robot."""
        turns = np.linspace(0.0, 2 * np.pi, 145)
        radius = run.navigator.settings.perception_radius
        circle = radius * np.column_stack([np.cos(turns), np.sin(turns)])
        starts, ends = self._lift(circle[:-1:2], 0.0), self._lift(circle[1::2], 0.0)
        self._meshcat.SetLineSegments(name, starts, ends, 1.0, self._rgba(0.78, 0.06, 0.18))

    def add_obstacles(self, runs: list[Navigation]) -> None:
        """What the first robot (and each other) knew of, from when to when."""
        shown: dict[int, tuple[Solid, str]] = {}
        for moments in zip(*(r.moments for r in runs), strict=False):
            self._show_known(moments, shown)

    def add_plans(self, run: Navigation) -> None:
        """The first robot's trees and routes."""
        stride = max(1, len(run.moments) // TREES)
        trees = run.moments[::stride]
        for k, moment in enumerate(trees):
            following = trees[k + 1] if k + 1 < len(trees) else None
            self._span(self._tree(f"trees/{k}", moment), moment, following)
        for k, moment in enumerate(run.moments):
            following = run.moments[k + 1] if k + 1 < len(run.moments) else None
            if moment.route is not None and len(moment.route) > 1:
                name = f"routes/{k}"
                self._ribbon(name, moment.route, self._rgba(0.95, 0.55, 0.1), 0.05, None)
                self._span(name, moment, following)

    def _show_known(self, moments: tuple[Moment, ...], shown: dict[int, tuple[Solid, str]]) -> None:
        from pydrake.math import RigidTransform, RotationMatrix

        frame = self._animation.frame(moments[0].time)
        current = set()
        for moment in moments:
            for key, solid in moment.known:
                if key < 0 or key in current:
                    continue
                current.add(key)
                rotation: Any = np.eye(3)
                rotation[: self._d, : self._d] = solid.rotation
                pose = RigidTransform(RotationMatrix(rotation), self._at(solid.center, HEIGHT / 2))
                if key not in shown:
                    name = f"obstacles/{key}"
                    shape = drake_shape(solid, HEIGHT) if self._d == 2 else drake_shape(solid)
                    alpha = 1.0 if self._d == 2 else 0.55
                    self._meshcat.SetObject(name, shape, self._rgba(0.35, 0.45, 0.62, alpha))
                    self._meshcat.SetTransform(name, pose)
                    if frame > 0:
                        self._animation.SetProperty(0, name, "visible", False)
                name = f"obstacles/{key}"
                self._animation.SetProperty(frame, name, "visible", True)
                if key in shown and shown[key][0] is not solid:
                    self._animation.SetTransform(frame, name, pose)
                shown[key] = (solid, name)
        for key, (_, name) in shown.items():
            if key not in current:
                self._animation.SetProperty(frame, name, "visible", False)

    def _tree(self, name: str, moment: Moment) -> str:
        tree = moment.tree
        child = np.flatnonzero(tree.parent >= 0)
        starts, ends = self._lift(tree.points[child]), self._lift(tree.points[tree.parent[child]])
        self._meshcat.SetLineSegments(name, starts, ends, 1.0, self._rgba(0.55, 0.65, 0.78))
        return name

    def _ribbon(
        self, name: str, points: Array, colour: Any, height: float, frame: int | None
    ) -> None:
        """Several lines side by side: one is one pixel wide in a browser."""
        starts, ends = [], []
        width = 0.003 * self._size
        for a, b in pairwise(points):
            along = b - a
            length = float(np.linalg.norm(along))
            if length == 0:
                continue
            across = np.zeros(self._d)
            across[:2] = np.array([-along[1], along[0]]) / max(float(np.hypot(*along[:2])), 1e-9)
            for s in np.linspace(-width, width, 9):
                starts.append(a + s * across)
                ends.append(b + s * across)
        if not starts:
            return
        first, last = self._lift(np.array(starts), height), self._lift(np.array(ends), height)
        self._meshcat.SetLineSegments(name, first, last, 1.0, colour)
        if frame is not None and frame > 0:
            self._animation.SetProperty(0, name, "visible", False)
            self._animation.SetProperty(frame, name, "visible", True)

    def _span(self, name: str, moment: Moment, following: Moment | None) -> None:
        """Show an object from its moment to the following."""
        begin = self._animation.frame(moment.time)
        if begin > 0:
            self._animation.SetProperty(0, name, "visible", False)
        self._animation.SetProperty(begin, name, "visible", True)
        if following is not None:
            self._animation.SetProperty(
                self._animation.frame(following.time), name, "visible", False
            )

    def _at(self, point: Array, height: float) -> Any:
        out = in_space(point)
        if self._d == 2:
            out[2] = height
        return out

    def _lift(self, points: Array, height: float = 0.02) -> Any:
        """`[3, k]`, as Meshcat takes them."""
        if self._d == 3:
            return np.ascontiguousarray(points.T)
        return np.column_stack([points, np.full(len(points), height)]).T.copy()
