"""Robots from SDF files: a cart-pole swung up, a quadrotor among obstacles, Drake as the judge."""

import logging
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from ocp.models.multibody import multibody_model
from ocp.oracle import consult
from ocp.query import Query
from ocp.regulation_value import RegulationValue
from ocp.value import greedy
from sims.closed_loop import LoopSettings, Rollout, drake_rollout
from sims.demos import Demonstration

PERIOD = 0.005
"""Seconds for which the motors hold an input."""
MARGIN = 0.03
"""Metres that plans keep from hard obstacles: a loop follows its optimum, but not to the hair."""
ROBOTS: dict[str, tuple[str, tuple[float, ...]]] = {
    "cart-pole": ("cart_pole", (0.0, 0.0, 0.0, 0.0)),
    "quadrotor": ("planar_quadrotor", (-3.0, 0.0, 0.0, 0.0, 0.0, 0.0)),
}
"""Query file, robot file, and the state to start from."""


def run(_seed: int, out: Path | None) -> Demonstration:
    """From the file to the exact motion and the closed loop in Drake's Simulator."""
    logging.getLogger("drake").setLevel(logging.WARNING)
    table = Table(title=f"robots from SDF files; plans keep {1e2 * MARGIN:g} cm from obstacles")
    for column in ("query", "optimal cost", "established", "in Drake", "excess", "clearance"):
        table.add_column(column, justify="left" if column == "query" else "right")
    entries: dict[str, Any] = {}
    loops: dict[str, Rollout] = {}
    for name, (_, start) in ROBOTS.items():
        query = Query.load(str(resources.files("sims") / "queries" / f"{name}.toml"))
        if query.obstacles:
            query = replace(query, robot_radius=query.robot_radius + MARGIN)
        loop, entries[name] = _driven(query, np.array(start))
        loops[name] = loop
        entry = entries[name]
        excess = entry["excess"]
        table.add_row(
            name,
            f"{entry['optimal_cost']:.4f}",
            "yes" if entry["established"] else "no",
            "-" if entry["cost"] is None else f"{entry['cost']:.4f}",
            "-" if excess is None else f"{excess:.2%}",
            "-" if not query.obstacles else f"{1e3 * entry['min_clearance_m']:.1f} mm",
        )
    if out is not None:
        _pictures(loops, out)
    clear = all((e["min_clearance_m"] or 0.0) >= 0.0 for e in entries.values())
    succeeded = clear and all(loop.reached for loop in loops.values())
    return Demonstration({"robots": entries}, [table], succeeded)


def _driven(query: Query, start: NDArray[np.float64]) -> tuple[Rollout, dict[str, Any]]:
    """The policy around the cheapest exact motion, closed in Drake."""
    verdict = consult(query, start)
    assert verdict.best is not None
    value = RegulationValue(query)
    value.add(verdict.best)
    loop = drake_rollout(greedy(query, value), start, LoopSettings(period=PERIOD))
    optimum = verdict.best.cost
    return loop, {
        "optimal_cost": optimum,
        "established": verdict.established,
        "cost": loop.cost,
        "excess": None if loop.cost is None else loop.cost / optimum - 1,
        "reached": loop.reached,
        "min_clearance_m": loop.min_clearance + MARGIN if query.obstacles else None,
    }


def _pictures(loops: dict[str, Rollout], out: Path) -> None:
    import matplotlib.pyplot as plt
    from matplotlib.patches import Circle

    from sims.pictures.plan_figure import GOAL, OBSTACLE, save
    from sims.pictures.skeleton import Skeleton, draw_strobe, save_robot_replay

    figure, axes = plt.subplots(2, 1, figsize=(9.6, 8.4), layout="constrained")
    folder = resources.files("ocp.models.robots")
    for panel, (name, loop) in zip(axes, loops.items(), strict=True):
        query, motion = loop.query, loop.trajectory
        skeleton = Skeleton.of(multibody_model(str(folder / f"{ROBOTS[name][0]}.sdf")))
        draw_strobe(panel, skeleton, motion, count=18)
        panel.set_title(f"{name}: {motion.duration:.1f} s in Drake's Simulator")
        save_robot_replay(skeleton, motion, out / f"{name}.html", query.obstacles)
        for obstacle in query.obstacles:
            at = (obstacle.center[0], obstacle.center[1])
            panel.add_patch(Circle(at, obstacle.radius, color=OBSTACLE, zorder=1))
        if query.obstacles:
            low, high = np.array(panel.get_ylim())
            reach = [o.center[1] + s * o.radius for o in query.obstacles for s in (-1.1, 1.1)]
            panel.set_ylim(min(low, *reach), max(high, *reach))
            panel.plot(*query.goal_position, "*", color=GOAL, mec="black", ms=16, zorder=6)
    save(figure, out / "drake-robot.png")
