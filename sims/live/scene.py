"""What the live window shows: a query, its value, closed loops and the optimum, in Meshcat."""

from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from ocp.query import Query
from ocp.trajectory import Trajectory
from ocp.value import Value
from planners.drake_geometry import drake_shape
from planners.solids import Solid
from sims.pictures.plan_figure import (
    CLOSED_LOOP,
    GOAL,
    OBSTACLE,
    OPTIMUM,
    least_over_other_coordinates,
)

RESOLUTION = 81
LAYERS = {"value": 0.0, "solids": 0.01, "goal": 0.012, "optimum": 0.03, "loop": 0.04, "robot": 0.05}
"""Heights in metres: what is drawn later lies above."""


class LiveScene:
    """A plane seen from above, in a Meshcat server that only this machine can reach."""

    def __init__(self, port: int | None = None) -> None:
        from pydrake.geometry import Meshcat, MeshcatParams
        from pydrake.math import RigidTransform, RotationMatrix

        self.meshcat: Any = Meshcat(MeshcatParams(host="localhost", port=port))
        for path in ("/Grid", "/Axes"):
            self.meshcat.SetProperty(path, "visible", False)
        self.meshcat.SetProperty("/Background", "top_color", [1, 1, 1])
        self.meshcat.SetProperty("/Background", "bottom_color", [1, 1, 1])
        # Even light: what stands nearer to a lamp would else look costlier.
        for lamp in ("PointLightNegativeX", "PointLightPositiveX", "DirectionalLight", "FillLight"):
            self.meshcat.SetProperty(f"/Lights/{lamp}", "visible", False)
        self.meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 3.2)
        turned = RotationMatrix.MakeXRotation(-np.pi / 2)
        # Looking down at the plane; the controls cover the right, so the picture is set left.
        above: Any = [0.0, 0.0, 10.0]
        self.meshcat.Set2dRenderMode(RigidTransform(turned, above), -7.0, 8.5, -5.4, 5.4)

    @property
    def url(self) -> str:
        return self.meshcat.web_url()

    def draw_query(self, query: Query) -> None:
        """The goal and the obstacles, instead of those drawn before."""
        from pydrake.geometry import Cylinder
        from pydrake.math import RigidTransform, RotationMatrix

        self.meshcat.Delete("query")
        self.meshcat.SetObject("query/goal", Cylinder(query.goal.radius, 0.01), _rgba(GOAL))
        center: Any = [*query.goal_position, LAYERS["goal"]]
        self.meshcat.SetTransform("query/goal", RigidTransform(center))
        for k, obstacle in enumerate(query.obstacles):
            solid = Solid.of(obstacle)
            rotation: Any = np.eye(3)
            rotation[:2, :2] = solid.rotation
            place: Any = [*solid.center, LAYERS["solids"]]
            path = f"query/obstacle {k}"
            shade = _rgba(OBSTACLE, 1.0 if obstacle.hard else 0.45)
            self.meshcat.SetObject(path, drake_shape(solid, 0.01), shade)
            self.meshcat.SetTransform(path, RigidTransform(RotationMatrix(rotation), place))

    def draw_value(self, query: Query, value: Value) -> None:
        """V, least over all coordinates but position, as colours in steps like contours."""
        x, y, least = least_over_other_coordinates(query, value, RESOLUTION)
        finite = np.isfinite(least)
        top = float(least[finite].max()) if finite.any() else 1.0
        share = np.where(finite, np.floor(24 * np.where(finite, least, top) / top) / 24, 1.0)
        colours = matplotlib.colormaps["YlGnBu_r"](0.15 + 0.85 * share.ravel())[:, :3]
        corners = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        vertices = np.column_stack([corners, np.full(len(corners), LAYERS["value"])])
        first = (np.arange(len(x) - 1)[:, None] * len(y) + np.arange(len(y) - 1)).ravel()
        up, right = first + 1, first + len(y)
        faces = np.concatenate(
            [np.stack([first, right, up], axis=1), np.stack([right, right + 1, up], axis=1)]
        )
        self.meshcat.SetTriangleColorMesh(
            "value", _columns(vertices), _columns(faces.astype(np.int32)), _columns(colours)
        )

    def draw_motion(self, query: Query, name: str, motion: Trajectory | None) -> None:
        """A motion called `loop` or `optimum`; nothing for `None`, or from a start in the goal."""
        if motion is None or len(motion.states) < 2:
            self.meshcat.Delete(name)
            return
        self._ribbon(
            name, query.position(motion.states), CLOSED_LOOP if name == "loop" else OPTIMUM
        )

    def draw_start(self, query: Query, start: NDArray[np.float64]) -> None:
        """A dot at the robot, with a bar along its heading if it has one."""
        place = np.asarray(query.position(start))
        names = [c.name for c in query.system.coordinates]
        heading = float(start[names.index("heading")]) if "heading" in names else 0.0
        nose = place + 0.45 * np.array([np.cos(heading), np.sin(heading)])
        self._ribbon("robot", np.array([place, nose]), "#000000")

    def _ribbon(self, path: str, points: NDArray[np.float64], colour: str) -> None:
        """One line is one pixel wide in a browser: several side by side make a ribbon."""
        steps = np.diff(points, axis=0, append=2 * points[-1:] - points[-2:-1])
        across = np.stack([-steps[:, 1], steps[:, 0]], axis=1)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        height = LAYERS[path]
        starts, ends = [], []
        for shift in np.linspace(-0.03, 0.03, 7):
            line = np.column_stack([points + shift * across, np.full(len(points), height)])
            starts.append(line[:-1])
            ends.append(line[1:])
        self.meshcat.SetLineSegments(
            path,
            _columns(np.concatenate(starts)),
            _columns(np.concatenate(ends)),
            2.0,
            _rgba(colour),
        )


def _columns(rows: NDArray) -> NDArray:
    """`[3, k]` in column order, as Meshcat takes them."""
    return np.asfortranarray(rows.T)


def _rgba(colour: str, alpha: float = 1.0) -> Any:
    from matplotlib.colors import to_rgb
    from pydrake.geometry import Rgba

    return Rgba(*to_rgb(colour), alpha)
