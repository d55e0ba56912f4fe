"""Figure 2 of the RRT-Q^X paper remade, and its animation; `--out` of `zermelo navigate`."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from numpy.typing import NDArray

from ocp.files import atomic_path
from planners.orders import Phase
from planners.solids import Shape, Solid
from sims.navigation.navigate import Navigation
from sims.navigation.record import Moment
from sims.navigation.scenario_file import Scenario
from sims.pictures.planner_figure import padded_outline

Array = NDArray[np.float64]

FRAMES = 6
GIF_EVERY = 2
"""Moments between two pictures of the animation."""
GRID = 90
SOLID, PADDING = "#2B4C7E", "#C9F58C"
TRACK, TARGET, RING = "#C8102E", "#E4002B", "#C8102E"
ROBOTS = ("#C8102E", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#5B3A9E", "#6B6B6B")


def save_pictures(scenario: Scenario, runs: list[Navigation], out: Path) -> None:
    """Write navigate.png, navigate.gif (in the plane) and navigate.html (a Meshcat replay)."""
    from sims.navigation.replay import save_replay

    out.mkdir(parents=True, exist_ok=True)
    if scenario.dimension == 3:
        figure = _draw_space(scenario, runs)
    elif len(runs) > 1:
        figure = _draw_tracks(scenario, runs)
    else:
        figure = draw_frames(scenario, runs[0])
    with atomic_path(out / "navigate.png") as path:
        figure.savefig(path, dpi=130)
    plt.close(figure)
    if scenario.dimension == 2:
        _animate(scenario, runs, out / "navigate.gif")
    save_replay(scenario, runs, out / "navigate.html")


def draw_frames(scenario: Scenario, run: Navigation, count: int = FRAMES) -> Figure:
    """Moments of a run in the plane: what the robot knew, planned and had driven.

    Each with D_kin in the left and D_rob in the right bar; the cost-to-go's bar is below all.
    """
    moments = _spread(run.moments, count)
    columns = (len(moments) + 1) // 2
    figure = plt.figure(figsize=(5.6 * columns, 10.4))
    grid = figure.add_gridspec(
        3, columns, height_ratios=[1, 1, 0.035], hspace=0.16, wspace=0.52,
        left=0.065, right=0.945, top=0.955, bottom=0.06,
    )  # fmt: skip
    scale = _cost_scale(run.moments)
    widest = max(run.navigator.largest_deviation, 1e-3)
    for number, moment in enumerate(moments):
        axes = figure.add_subplot(grid[number // columns, number % columns])
        draw_moment(axes, scenario, run, moment, scale)
        _gauge(axes, -0.16, moment.order.largest_deviation, widest, "largest deviation, m")
        _gauge(axes, 1.04, moment.order.deviation, widest, "deviation, m")
    bar = figure.colorbar(
        ScalarMappable(scale, "viridis"),
        cax=figure.add_subplot(grid[2, :]),
        orientation="horizontal",
    )
    bar.set_label("cost-to-go along straight lines, m")
    return figure


def draw_moment(
    axes: Axes, scenario: Scenario, run: Navigation, moment: Moment, scale: Normalize
) -> None:
    """One moment of a run in the plane."""
    (left, bottom), (right, top) = scenario.lower, scenario.upper
    _background(axes, scenario, moment, scale)
    tree = moment.tree
    child = np.flatnonzero(tree.parent >= 0)
    branches = np.stack([tree.points[child], tree.points[tree.parent[child]]], axis=1)
    axes.add_collection(
        LineCollection(list(branches), colors="#D9D9D9", linewidths=0.3, alpha=0.5, zorder=1)
    )
    for solid in moment.solids:
        _draw_solid(axes, solid, moment.order.padding)
    if moment.route is not None:
        axes.plot(*moment.route.T, color="white", lw=1.8, zorder=5)
    done = run.fine_times <= moment.time + 1e-9
    axes.plot(*run.track[done].T, color=TRACK, lw=2.0, zorder=6)
    ring = Circle(
        tuple(moment.position), scenario.perception_radius, fill=False, ec=RING, ls="--", lw=1.3
    )
    axes.add_patch(ring)
    ring.set_zorder(6)
    d = scenario.dimension
    axes.plot(*moment.order.reference[:d], "o", color=TARGET, mec="white", ms=6, zorder=7)
    axes.plot(*moment.position, "o", color="white", mec="black", ms=7, zorder=8)
    axes.plot(*run.robot.goal, "*", color="#FFD700", mec="black", ms=14, zorder=7)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.tick_params(labelsize=7)
    text = f"t = {moment.time:.1f} s"
    if moment.order.phase is not Phase.DRIVING:
        text += f": {moment.order.phase.value}"
    axes.set_title(text, fontsize=10)


def _draw_solid(axes: Axes, solid: Solid, padding: float) -> None:
    if padding > 0:
        outline = padded_outline(solid, padding)
        axes.add_patch(Polygon(outline, fc=PADDING, ec="#1B7837", lw=0.7, zorder=2))
    if solid.shape is Shape.BALL:
        axes.add_patch(Circle(tuple(solid.center), solid.radius, color=SOLID, lw=0, zorder=3))
    else:
        axes.add_patch(Polygon(solid.vertices, color=SOLID, lw=0, zorder=3))


def _background(axes: Axes, scenario: Scenario, moment: Moment, scale: Normalize) -> None:
    """The tree's cost-to-go, from the nearest nodes along straight lines."""
    from scipy.spatial import KDTree

    known = np.isfinite(moment.tree.cost_to_go)
    if not known.any():
        return
    points, costs = moment.tree.points[known], moment.tree.cost_to_go[known]
    (left, bottom), (right, top) = scenario.lower, scenario.upper
    x, y = np.linspace(left, right, GRID), np.linspace(bottom, top, GRID)
    places = np.stack(np.meshgrid(x, y), axis=-1)
    near: Any = KDTree(points)
    away, index = near.query(places, k=min(6, len(points)))
    value = (away + costs[index]).min(axis=-1)
    axes.pcolormesh(
        x, y, value, cmap="viridis", norm=scale, shading="gouraud", zorder=0, rasterized=True
    )


def _gauge(axes: Axes, at: float, value: float, widest: float, label: str) -> None:
    """A vertical bar beside the axes, filled with colours up to `value`."""
    bar: Any = axes.inset_axes((at, 0.0, 0.035, 1.0))
    levels = np.linspace(0.0, widest, 128)
    shown = np.ma.masked_greater(levels, value)[:, None]
    bar.imshow(shown, origin="lower", aspect="auto", extent=(0, 1, 0, widest), cmap="magma_r",
               vmin=0, vmax=widest)  # fmt: skip
    bar.set(xticks=[], ylim=(0, widest))
    bar.tick_params(labelsize=6)
    side = "left" if at < 0 else "right"
    bar.yaxis.set_ticks_position(side)
    bar.yaxis.set_label_position(side)
    bar.set_ylabel(label, fontsize=7, labelpad=2)


def _cost_scale(moments: list[Moment]) -> Normalize:
    top = max(
        float(np.max(m.tree.cost_to_go[np.isfinite(m.tree.cost_to_go)], initial=0.0))
        for m in moments
    )
    return Normalize(0.0, top)


def _spread(moments: list[Moment], count: int) -> list[Moment]:
    """So many of them, evenly; the last one included."""
    picked = np.unique(np.linspace(0, len(moments) - 1, count).round().astype(int))
    return [moments[k] for k in picked]


def _draw_tracks(scenario: Scenario, runs: list[Navigation]) -> Figure:
    """Several robots: their tracks, and where they were every second."""
    figure, axes = plt.subplots(figsize=(8, 8), layout="constrained")
    for key, solid in {k: s for r in runs for k, s in r.moments[-1].known}.items():
        if key >= 0:
            _draw_solid(axes, solid, 0.0)
    for number, run in enumerate(runs):
        colour = ROBOTS[number % len(ROBOTS)]
        axes.plot(*run.track.T, color=colour, lw=1.6, zorder=4)
        marks = run.track[:: max(1, round(1.0 / (run.fine_times[1] - run.fine_times[0])))]
        axes.plot(*marks.T, ".", color=colour, ms=4, zorder=4)
        axes.plot(*run.robot.goal, "*", color=colour, mec="black", ms=14, zorder=5)
        radius = max(run.robot.radius, 0.15)
        axes.add_patch(Circle(tuple(run.track[-1]), radius, fc=colour, ec="black", zorder=6))
    (left, bottom), (right, top) = scenario.lower, scenario.upper
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="x, m", ylabel="y, m")
    return figure


def _draw_space(scenario: Scenario, runs: list[Navigation]) -> Figure:
    """In space: the obstacles that were seen, and the tracks."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    figure = plt.figure(figsize=(8, 8), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    turns, heights = np.meshgrid(np.linspace(0, 2 * np.pi, 24), np.linspace(0, np.pi, 12))
    sphere = np.stack(
        [np.cos(turns) * np.sin(heights), np.sin(turns) * np.sin(heights), np.cos(heights)]
    )
    for solid in runs[0].moments[-1].solids:
        if solid.shape is Shape.BALL:
            surface = solid.center[:, None, None] + solid.radius * sphere
            axes.plot_surface(*surface, color=SOLID, alpha=0.25, lw=0)
            continue
        from scipy.spatial import ConvexHull

        hull = ConvexHull(solid.vertices)
        faces = Poly3DCollection(solid.vertices[hull.simplices], alpha=0.25, fc=SOLID, lw=0)
        axes.add_collection3d(faces)
    for number, run in enumerate(runs):
        axes.plot(*run.track.T, color=ROBOTS[number % len(ROBOTS)], lw=2.2, zorder=10)
        axes.plot(*run.track[0][:, None], "o", color="white", mec="black", ms=7, zorder=11)
        axes.plot(*run.robot.goal[:, None], "*", color="#FFD700", mec="black", ms=14, zorder=11)
    axes.set(xlabel="x, m", ylabel="y, m", zlabel="z, m")
    for axis, low, high in zip("xyz", scenario.lower, scenario.upper, strict=True):
        axes.set(**{f"{axis}lim": (low, high)})
    axes.set_box_aspect(tuple(scenario.upper - scenario.lower))
    return figure


def _animate(scenario: Scenario, runs: list[Navigation], path: Path) -> None:
    """The first robot's moments as a GIF, in real time; other robots as discs."""
    from matplotlib.animation import PillowWriter

    run = runs[0]
    moments = run.moments[::GIF_EVERY]
    if run.moments[-1] is not moments[-1]:
        moments.append(run.moments[-1])
    scale = _cost_scale(run.moments)
    period = run.moments[1].time - run.moments[0].time if len(run.moments) > 1 else 1.0
    figure, axes = plt.subplots(figsize=(6, 6), layout="constrained")
    writer = PillowWriter(fps=round(1.0 / (GIF_EVERY * period)))
    with atomic_path(path) as temporary, writer.saving(figure, temporary, 80):
        for moment in moments:
            axes.clear()
            draw_moment(axes, scenario, run, moment, scale)
            for number, other in enumerate(runs[1:], 1):
                at = other.track[np.searchsorted(other.fine_times, moment.time - 1e-9)]
                radius = max(other.robot.radius, 0.15)
                colour = ROBOTS[number % len(ROBOTS)]
                axes.add_patch(Circle(tuple(at), radius, fc=colour, ec="black", zorder=6))
            writer.grab_frame()
    plt.close(figure)
