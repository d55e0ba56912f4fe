"""What the weight of the receding horizon's quadratic end does: the paper leaves it open.

On the paper's four queries from its start; excess over the exact cost. With a light end the horizon
is hardly drawn to the goal; with a heavy one the straight way counts for more than the cost.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from ocp.mpc import WEIGHT, QuadraticEnd, receding_horizon
from ocp.pontryagin import exact_trajectory
from ocp.query_family import PAPER_GOALS, PAPER_START, paper_query
from ocp.trajectory import SolveError
from sims.benchmarks import Report
from sims.closed_loop import LoopSettings, rollout

WEIGHTS = (0.03, 0.1, 0.2, WEIGHT, 0.5, 1.0, 3.0)
LOOP = LoopSettings(period=0.1, time_limit=40.0)


def run(_seed: int, _out: Path | None) -> Report:
    """One table: a row for each weight."""
    start = np.array(PAPER_START)
    optima = {goal: exact_trajectory(paper_query(goal), start).cost for goal in PAPER_GOALS}
    rows: list[dict[str, Any]] = []
    for weight in WEIGHTS:
        excess: list[float | None] = []
        begun = time.thread_time()
        for goal in PAPER_GOALS:
            query = paper_query(goal)
            policy = receding_horizon(query, QuadraticEnd.towards_goal(query, weight))
            try:
                cost = rollout(policy, start, LOOP).cost
            except SolveError:
                cost = None
            excess.append(None if cost is None else cost / optima[goal] - 1)
        rows.append({"weight": weight, "excess": excess, "seconds": time.thread_time() - begun})
    table = Table(title="receding horizon of 2 s, weight of the quadratic end: excess, four goals")
    for column in ("weight, 1/m^2", *(f"({x:g}, {y:g})" for x, y in PAPER_GOALS), "mean"):
        table.add_column(column, justify="right")
    for row in rows:
        known = [e for e in row["excess"] if e is not None]
        mean = f"{np.mean(known):.1%}" if len(known) == len(PAPER_GOALS) else "-"
        cells = ["not reached" if e is None else f"{e:.1%}" for e in row["excess"]]
        table.add_row(f"{row['weight']:g}", *cells, mean)
    return Report({"rows": rows}, [table])
