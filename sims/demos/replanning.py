"""RRT^X among changing obstacles: each change, what it cost to repair, the true optimum beside."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from planners.rrtx import RRTX
from planners.solids import Solid
from planners.update import Update
from planners.world import SceneWorld
from sims.benchmarks.rrtx_maps import HALF, obstacles_20
from sims.benchmarks.visibility_graph import shortest_way
from sims.demos import Demonstration

NODES = 5000
PADDING = 0.2


def run(seed: int, out: Path | None) -> Demonstration:
    """Six changes one after another, from a route of 5,000 nodes on a map of 20 obstacles."""
    _warm_up()
    planner, record = _planner(seed), _Record()
    record.add("grown", planner.construction, planner)
    replay = None
    if out is not None:
        from sims.pictures.planner_replay import PlannerReplay

        replay = PlannerReplay(planner)
        replay.record(0.0)
    added: list[int] = []

    def block(share: float) -> Update:
        update = planner.appear(Solid.ball(_along(planner.route.points, share), 1.0))
        added.extend(update.handles)
        return update

    def ahead(share: float) -> Update:
        return planner.move_robot(_along(planner.route.points, share))

    changes = {
        "a disc of 2 m appears on the route": lambda: block(0.35),
        "another appears on the new route": lambda: block(0.6),
        "the robot moves on": lambda: ahead(0.15),
        "the first disc rolls 3 m aside": lambda: planner.shift(added[0], [2.1, 2.1]),
        "all obstacles are padded to 0.4 m": lambda: planner.set_padding(0.4),
        "the second disc vanishes": lambda: planner.vanish(added[1]),
    }
    pictures = _Pictures() if out is not None else None
    for step, (name, change) in enumerate(changes.items(), 1):
        record.add(name, change(), planner)
        planner.settle()
        if pictures is not None and replay is not None:
            pictures.add(name, planner)
            replay.record(1.5 * step)
    if out is not None and pictures is not None and replay is not None:
        pictures.save(out)
        replay.save(out / "replanning.html")
    return Demonstration({"changes": record.rows}, [record.table()], record.always_routed)


def _planner(seed: int) -> RRTX:
    box, problem = np.full(2, HALF), obstacles_20(seed)
    world = SceneWorld(-box, box, problem.solids)
    return RRTX(world, problem.goal, problem.start, NODES, padding=PADDING, seed=seed)


def _warm_up() -> None:
    """Load every kernel that the demo times."""
    planner = RRTX(SceneWorld([-5, -5], [5, 5]), [4, 4], [-4, -4], 200)
    (handle,) = planner.appear(Solid.ball([0, 0], 1.0)).handles
    planner.shift(handle, [0.5, 0.0])
    planner.set_padding(0.1)
    planner.move_robot([-3.5, -4.0])
    planner.vanish(handle)


def _along(points: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """The point of a polyline `[k, d]` at this share of its length."""
    steps = [float(np.linalg.norm(b - a)) for a, b in pairwise(points)]
    at = np.concatenate([[0.0], np.cumsum(steps)])
    return np.array([np.interp(share * at[-1], at, column) for column in points.T])


class _Record:
    """What each change did."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def add(self, name: str, update: Update, planner: RRTX) -> None:
        world = planner.world
        assert isinstance(world, SceneWorld)
        bounds = (world.lower, world.upper)
        obstacles = world.obstacles.values()
        optimum, _ = shortest_way(
            obstacles, planner.robot, planner.goal, planner.padding, 24, bounds
        )
        length = None if update.route is None else update.route.cost
        self.rows.append(
            {
                "change": name,
                "seconds": update.seconds,
                "orphans": update.orphans,
                "repaired": update.repaired,
                "length_m": length,
                "over_optimum": None if length is None else length / optimum - 1,
            }
        )

    @property
    def always_routed(self) -> bool:
        return all(row["length_m"] is not None for row in self.rows)

    def table(self) -> Table:
        table = Table(title=f"RRT^X, {NODES} nodes, 20 obstacles in 40 m by 40 m")
        for column in ("change", "ms", "orphans", "repaired", "route, m", "over optimum"):
            table.add_column(column, justify="left" if column == "change" else "right")
        for row in self.rows:
            table.add_row(
                row["change"],
                f"{1e3 * row['seconds']:.1f}",
                str(row["orphans"]),
                str(row["repaired"]),
                "-" if row["length_m"] is None else f"{row['length_m']:.3f}",
                "-" if row["over_optimum"] is None else f"{row['over_optimum']:.2%}",
            )
        return table


class _Pictures:
    """One panel a change."""

    def __init__(self) -> None:
        import matplotlib.pyplot as plt

        self._figure, axes = plt.subplots(2, 3, figsize=(14.5, 9.4), layout="constrained")
        self._axes = iter(axes.flat)

    def add(self, name: str, planner: RRTX) -> None:
        from sims.pictures.planner_figure import draw_planner

        panel = next(self._axes)
        draw_planner(panel, planner, colourbar=False)
        panel.set_title(name, fontsize=11)

    def save(self, out: Path) -> None:
        from sims.pictures.plan_figure import save

        self._figure.colorbar(
            self._figure.axes[0].collections[0],
            ax=self._figure.axes,
            label="cost-to-go, m",
            shrink=0.7,
        )
        save(self._figure, out / "replanning.png")
