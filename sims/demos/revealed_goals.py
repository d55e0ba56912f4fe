"""Goals revealed one after another while the robot drives (Xu and Zhu, section II-C).

Goals arrive as a Poisson process and are visited in order. As soon as one is known and the leg
before it is planned, its policy is computed, from the state in which that leg will end. The robot
waits only if it gets there before the policy is ready. Computing times are measured; the same
arrivals are gone through with the paper's reaction time.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from learning.meta_planner import MetaPlanner
from ocp.obstacle import Obstacle
from ocp.planning import deadline
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START
from sims.closed_loop import Rollout, rollout
from sims.demos import Demonstration

PAPER_REACTION = 6.82
"""Seconds; Xu and Zhu, Table II, n = 8."""
GOALS = 12
MEAN_GAP = 6.0
"""Seconds between goals, on average; a leg takes about as long."""
BUDGET = 0.05
"""Seconds a policy may take."""
RADIUS = 0.5
OBSTACLES = (
    Obstacle.circle((-1.0, -1.0), 1.0),
    Obstacle.diamond((-2.0, 2.0), 0.8),
    Obstacle.diamond((2.0, -2.0), 0.8),
    Obstacle.circle((1.5, 1.8), 0.9),
)


@dataclass(frozen=True)
class Leg:
    """One goal's story, times in seconds from the beginning.

    Attributes:
        goal: where to.
        revealed: when it became known.
        reaction: how long its policy took to compute.
        loop: the drive there.
    """

    query: Query
    goal: tuple[float, float]
    revealed: float
    reaction: float
    loop: Rollout


def run(seed: int, out: Path | None) -> Demonstration:
    """Drive through all goals, then account for the waiting."""
    rng = np.random.default_rng(seed)
    revealed = np.cumsum(rng.exponential(MEAN_GAP, GOALS))
    legs = _drive(rng, revealed)
    waits, paper_waits = _waits(legs, None), _waits(legs, PAPER_REACTION)
    reached = all(leg.loop.reached for leg in legs)
    table = Table(title=f"{len(legs)} goals, one every {MEAN_GAP:g} s on average")
    for column in ("revealed", "goal", "reaction", "drive", "wait", f"wait at {PAPER_REACTION} s"):
        table.add_column(column, justify="right")
    rows: list[dict[str, Any]] = []
    for leg, wait, paper_wait in zip(legs, waits, paper_waits, strict=True):
        rows.append(
            {
                "revealed_s": leg.revealed,
                "goal": list(leg.goal),
                "reaction_s": leg.reaction,
                "drive_s": leg.loop.trajectory.duration,
                "cost": leg.loop.cost,
                "wait_s": wait,
                "wait_at_paper_reaction_s": paper_wait,
            }
        )
        table.add_row(
            f"{leg.revealed:.1f} s",
            "({:.1f}, {:.1f})".format(*leg.goal),
            f"{leg.reaction * 1e3:.0f} ms",
            f"{leg.loop.trajectory.duration:.1f} s",
            f"{wait * 1e3:.0f} ms",
            f"{paper_wait:.1f} s",
        )
    table.add_row("", "", "", "all", f"{sum(waits) * 1e3:.0f} ms", f"{sum(paper_waits):.1f} s")
    if out is not None:
        _figure(legs, waits, paper_waits, out)
    totals = {"wait_s": sum(waits), "wait_at_paper_reaction_s": sum(paper_waits)}
    return Demonstration({"legs": rows, **totals}, [table], reached)


def _drive(rng: np.random.Generator, revealed: NDArray[np.float64]) -> list[Leg]:
    planner = MetaPlanner.pretrained("general")
    state = np.array(PAPER_START)
    legs: list[Leg] = []
    rehearsed = False
    for time in revealed:
        goal = _goal(rng, state)
        query = Query("unicycle", Goal(goal, RADIUS), OBSTACLES)
        if not rehearsed:  # code is loaded before the robot starts
            planner.plan(replace(query, goal=Goal((3.0, -3.5), RADIUS)), [state], deadline(0.5))
            rehearsed = True
        plan = planner.plan(query, [state], deadline(BUDGET))
        loop = rollout(plan.policy, state)
        legs.append(Leg(query, goal, float(time), plan.reaction_time, loop))
        if not loop.reached:
            break
        state = query.system.wrap(loop.trajectory.states[-1])
        inside = (query.system.lower <= state) & (state <= query.system.upper)
        assert inside.all()  # a goal lies in the domain
    return legs


def _goal(rng: np.random.Generator, state: NDArray[np.float64]) -> tuple[float, float]:
    """A goal clear of the obstacles and of the robot."""
    while True:
        center = rng.uniform(-4.0, 4.0, 2)
        clear = min(float(o.signed_distance(center)) for o in OBSTACLES) > RADIUS
        if clear and np.linalg.norm(center - state[:2]) > 2 * RADIUS:
            return float(center[0]), float(center[1])


def _waits(legs: list[Leg], reaction: float | None) -> list[float]:
    """How long the robot stands for want of a policy, once it is free and the goal is known."""
    waits, free, ready = [], 0.0, 0.0
    for leg in legs:
        ready = max(leg.revealed, ready) + (leg.reaction if reaction is None else reaction)
        could = max(free, leg.revealed)
        begin = max(could, ready)
        waits.append(begin - could)
        free = begin + leg.loop.trajectory.duration
    return waits


def _figure(legs: list[Leg], waits: list[float], paper_waits: list[float], out: Path) -> None:
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import draw_plan, save

    figure, (ground, bars) = plt.subplots(1, 2, figsize=(11, 4.8), layout="constrained")
    draw_plan(ground, legs[-1].query, [leg.loop for leg in legs], [None] * len(legs))
    for k, leg in enumerate(legs, 1):
        ground.annotate(str(k), leg.goal, ha="center", va="center")
    ground.set_title("goals in the order of their arrival")
    numbers = np.arange(1, len(legs) + 1)
    bars.bar(numbers - 0.2, np.maximum(waits, 1e-4), 0.4, label="zermelo")
    bars.bar(numbers + 0.2, np.maximum(paper_waits, 1e-4), 0.4, label="the paper's reaction time")
    bars.set_yscale("log")
    bars.set_xlabel("goal")
    bars.set_ylabel("waiting for a policy (s)")
    bars.legend(frameon=False)
    save(figure, out / "revealed-goals.png")
