"""Figures of plans: trajectories over the value's contours."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

from ocp.files import atomic_path
from ocp.query import Query
from ocp.trajectory import Trajectory
from ocp.value import Value
from sims.closed_loop import Rollout

# Colours that stay apart for the colour-blind and in grey (after Okabe and Ito).
CLOSED_LOOP = "#0072B2"
OPTIMUM = "#D55E00"
GOAL = "#009E73"
OBSTACLE = "#5F5F5F"


def draw_plan(
    axes: Axes,
    query: Query,
    rollouts: Sequence[Rollout],
    optima: Sequence[Trajectory | None] = (),
    value: Value | None = None,
) -> None:
    """Draw closed loops, optima, obstacles and goal of a planar query over its value's contours.

    Args:
        axes: where to draw.
        query: with positions in the plane.
        rollouts: drawn solid with heading arrows, dotted where the goal was not reached.
        optima: exact optimal motions, drawn dashed.
        value: its minimum over all coordinates but position is drawn as contours.

    Raises:
        ValueError: if positions do not live in the plane.
    """
    system = query.system
    if len(system.position) != 2:
        raise ValueError(f"figure: {system.name} does not move in the plane")
    x, y = (system.coordinates[i] for i in system.position)
    if value is not None:
        _contours(axes, query, value)
    for obstacle in query.obstacles:
        style = {
            "facecolor": OBSTACLE if obstacle.hard else "none",
            "edgecolor": OBSTACLE,
            "hatch": None if obstacle.hard else "////",
            "linewidth": 1.0,
            "zorder": 2,
        }
        if obstacle.vertices:
            axes.add_patch(Polygon(obstacle.vertices, **style))
        else:
            axes.add_patch(_disc(obstacle.center, obstacle.radius, **style))
    goal = query.goal
    axes.add_patch(
        _disc(tuple(query.goal_position), goal.radius, facecolor=GOAL, edgecolor="black", zorder=3)
    )
    for trajectory in optima:
        if trajectory is not None:
            p = query.position(trajectory.states)
            axes.plot(p[:, 0], p[:, 1], color=OPTIMUM, linestyle=(0, (5, 3)), lw=2.2, zorder=4)
    for rollout in rollouts:
        p = query.position(rollout.trajectory.states)
        line = "-" if rollout.reached else ":"
        axes.plot(p[:, 0], p[:, 1], color=CLOSED_LOOP, linestyle=line, lw=1.4, zorder=5)
        _headings(axes, query, rollout.trajectory)
        axes.plot(*p[0], marker="o", color="white", mec="black", ms=5, zorder=7)
    if query.is_regulation:  # its domain is that of starts, mostly far from what happens
        axes.margins(0.15)
        axes.autoscale_view()
    else:
        axes.set_xlim(x.lower, x.upper)
        axes.set_ylim(y.lower, y.upper)
    axes.set_aspect("equal")
    axes.set_xlabel(f"{x.name} ({x.unit})")
    axes.set_ylabel(f"{y.name} ({y.unit})")


def _disc(center: Sequence[float], radius: float, **style: Any) -> Circle:
    return Circle((center[0], center[1]), radius, **style)


def least_over_other_coordinates(
    query: Query, value: Value, resolution: int = 101
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """V minimised over the coordinates other than position: x `[r]`, y `[r]`, V `[r, r]`."""
    system = query.system
    others = [i for i in range(system.n) if i not in system.position]
    samples = [
        np.linspace(c.lower, c.upper, 24, endpoint=False)
        if c.periodic
        else np.linspace(c.lower, c.upper, 11)
        for c in (system.coordinates[i] for i in others)
    ]
    x, y = (np.linspace(system.lower[i], system.upper[i], resolution) for i in system.position)
    mesh = np.meshgrid(x, y, *samples, indexing="ij")
    states = np.empty((*mesh[0].shape, system.n))
    for column, coordinate in zip(mesh, [*system.position, *others], strict=True):
        states[..., coordinate] = column
    values = np.asarray(value.value(states)).reshape(resolution, resolution, -1)
    return x, y, values.min(axis=-1)


def _contours(axes: Axes, query: Query, value: Value) -> None:
    """V minimised over the coordinates other than position, as lightly filled contours."""
    system = query.system
    x, y, least = least_over_other_coordinates(query, value)
    shown = np.ma.masked_invalid(least)
    filled = axes.contourf(x, y, shown.T, levels=24, cmap="YlGnBu_r", alpha=0.55, zorder=0)
    axes.contour(x, y, shown.T, levels=24, colors="white", linewidths=0.4, zorder=1)
    bar = axes.figure.colorbar(filled, ax=axes, fraction=0.046, pad=0.03)
    others = [c.name for i, c in enumerate(system.coordinates) if i not in system.position]
    bar.set_label("cost-to-go" + (f", least over {' and '.join(others)}" if others else ""))


def _headings(axes: Axes, query: Query, trajectory: Trajectory, count: int = 12) -> None:
    """Arrows at equal distances along the path, along the heading if the robot has one."""
    p = query.position(trajectory.states)
    travelled = np.concatenate([[0.0], np.linalg.norm(np.diff(p, axis=0), axis=1).cumsum()])
    at = np.linspace(0.0, travelled[-1], count)
    index = np.unique(np.searchsorted(travelled, at[:-1]))
    directions = _directions(query, trajectory)[index]
    axes.quiver(
        p[index, 0],
        p[index, 1],
        directions[:, 0],
        directions[:, 1],
        color=CLOSED_LOOP,
        angles="xy",
        pivot="tail",
        scale=26,
        width=0.006,
        zorder=6,
    )


def _directions(query: Query, trajectory: Trajectory) -> NDArray[np.float64]:
    names = [c.name for c in query.system.coordinates]
    if "heading" in names:
        heading = trajectory.states[:, names.index("heading")]
        return np.column_stack([np.cos(heading), np.sin(heading)])
    velocity = np.gradient(query.position(trajectory.states), axis=0)
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    return velocity / np.where(speed > 0, speed, 1.0)


def legend(figure: Figure) -> None:
    """One legend for all panels, below them."""
    handles = [
        Line2D([], [], color=CLOSED_LOOP, label="closed loop (arrows: heading)"),
        Line2D([], [], color=OPTIMUM, linestyle="--", label="exact optimum"),
        Circle((0, 0), facecolor=GOAL, edgecolor="black", label="goal"),
        Polygon([(0, 0)], facecolor="none", edgecolor=OBSTACLE, hatch="////", label="obstacle"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)


def save(figure: Figure, path: Path) -> Path:
    """Write a figure atomically and close it; the suffix chooses the format."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=160)
    plt.close(figure)
    return path


def save_all(figure: Figure, stem: Path, suffixes: Sequence[str] = (".png", ".svg")) -> list[Path]:
    """Write a figure in several formats, each atomically, and close it."""
    paths = [stem.with_name(stem.name + suffix) for suffix in suffixes]
    for path in paths:
        with atomic_path(path) as temporary:
            figure.savefig(temporary, dpi=160)
    plt.close(figure)
    return paths
