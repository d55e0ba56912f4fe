"""Figures of RRT^X in the plane: tree, route, padded obstacles, cost-to-go behind them."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from ocp.files import atomic_path
from planners.rrtx import RRTX
from planners.solids import Shape, Solid
from planners.world import SceneWorld

ROUTE = "#D55E00"
ROBOT = "#FFFFFF"
GOAL = "#009E73"
SOLID = "#3A3A3A"
PADDING = "#C8C8C8"


def draw_planner(axes: Axes, planner: RRTX, resolution: int = 160, colourbar: bool = True) -> None:
    """Draw the planner's tree, route and obstacles over the interpolated cost-to-go.

    The tree is repaired to its end first.

    Args:
        axes: where to draw.
        planner: in the plane.
        resolution: the cost-to-go is interpolated at so many points along each side.
        colourbar: whether to add one.

    Raises:
        ValueError: if the planner's world is no scene of the plane.
    """
    world = planner.world
    if not isinstance(world, SceneWorld) or world.dimension != 2:
        raise ValueError("figure: the planner does not plan in the plane")
    (left, bottom), (right, top) = world.lower, world.upper
    planner.settle()
    x = np.linspace(left, right, resolution)
    y = np.linspace(bottom, top, resolution)
    points = np.stack(np.meshgrid(x, y), axis=-1)
    cost = planner.cost_to_go(points)
    # Under the padding, which is painted over them, colours go on to the edge of the paint.
    margin = planner.padding + float(x[1] - x[0])
    near = np.isfinite(world.distances(points, margin).distance)
    nearest: Any = distance_transform_edt(
        ~np.isfinite(cost), return_distances=False, return_indices=True
    )
    filled = np.where(near & np.isinf(cost), cost[tuple(nearest)], cost)
    shown = np.ma.masked_invalid(filled)
    colours = axes.pcolormesh(x, y, shown, cmap="viridis", shading="gouraud", zorder=0)
    if colourbar:
        axes.figure.colorbar(colours, ax=axes, label="cost-to-go, m", shrink=0.85, pad=0.02)
    view = planner.view()
    child = np.flatnonzero(view.parent >= 0)
    branches = np.stack([view.points[child], view.points[view.parent[child]]], axis=1)
    axes.add_collection(
        LineCollection(list(branches), colors="white", linewidths=0.35, alpha=0.45, zorder=1)
    )
    for solid in world.obstacles.values():
        if planner.padding > 0:
            axes.add_patch(
                Polygon(
                    padded_outline(solid, planner.padding),
                    color=PADDING,
                    linewidth=0,
                    zorder=2,
                )
            )
        if solid.shape is Shape.BALL:
            axes.add_patch(Circle(tuple(solid.center), solid.radius, color=SOLID, zorder=3, lw=0))
        else:
            axes.add_patch(Polygon(solid.vertices, color=SOLID, zorder=3, lw=0))
    update = planner.change()
    if update.route is not None:
        points = update.route.points
        axes.plot(*points.T, color="black", linewidth=3.6, zorder=4, solid_capstyle="round")
        axes.plot(*points.T, color=ROUTE, linewidth=2.2, zorder=5, solid_capstyle="round")
    axes.plot(*planner.robot, "o", color=ROBOT, mec="black", ms=8, zorder=6)
    axes.plot(*planner.goal, "*", color=GOAL, mec="black", ms=15, zorder=6)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")


def save_planner_figure(planner: RRTX, path: Path, title: str = "") -> None:
    """Write `draw_planner` to a picture."""
    figure, axes = plt.subplots(figsize=(8, 7), layout="constrained")
    draw_planner(axes, planner)
    axes.set_title(title)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format=path.suffix[1:])
    plt.close(figure)


def padded_outline(solid: Solid, padding: float) -> NDArray[np.float64]:
    """Outline `[k, 2]` of the Minkowski sum of a solid of the plane and a disc."""
    turns = np.linspace(0, 2 * np.pi, 120)
    directions = np.column_stack([np.cos(turns), np.sin(turns)])
    # The support point in each direction; the corners' arcs come out of it by themselves.
    farthest = solid.vertices[np.argmax(directions @ solid.vertices.T, axis=1)]
    return farthest + (solid.radius + padding) * directions
