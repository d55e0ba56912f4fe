"""How soon a plan is ready: seconds from the query in memory to the policy, fresh queries.

The queries are those of `learning`, which measures how good the policies are. A plan is checked
from every start asked for, and adapted to them; so it takes longer the more there are.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from learning.meta_planner import MetaPlanner
from ocp.planning import Until, iterations, plan, trajectories
from ocp.query_family import sample_start
from sims.benchmarks import Report
from sims.benchmarks.learning import SEED, families

QUERIES = 25
STARTS = (1, 8, 20)
CASES: dict[str, tuple[bool, Until]] = {
    "network": (False, iterations(0)),
    "network, 8 trajectories": (False, trajectories(8)),
    "adapt, 8 trajectories": (True, trajectories(8)),
}
"""Whether grids are allowed, and when to stop."""


def run(seed: int, _out: Path | None, queries: int = QUERIES) -> Report:
    """One table."""
    figures: dict[str, Any] = {}
    for name, family in families().items():
        weights = "paper" if name == "paper" else "general"
        drawn = []
        for k in range(queries):
            rng = np.random.default_rng([SEED + seed, k])
            query = family.sample(rng)
            drawn.append((query, [sample_start(query, rng) for _ in range(max(STARTS))]))
        for label, (grids, until) in CASES.items():
            planner = MetaPlanner.pretrained(weights, grids)
            for starts in STARTS:
                seconds = []
                for query, all_starts in drawn:
                    begun = time.perf_counter()
                    plan(planner, query, all_starts[:starts], until)
                    once = time.perf_counter() - begun
                    # The first plan of a query also loads tables and code.
                    again = plan(planner, query, all_starts[:starts], until).reaction_time
                    seconds.append(min(once, again))
                figures.setdefault(name, {}).setdefault(label, {})[str(starts)] = {
                    "median_s": float(np.median(seconds)),
                    "quantile_95_s": float(np.quantile(seconds, 0.95)),
                }
    table = Table(title=f"milliseconds to a policy: median (95 %) of {queries} queries")
    table.add_column("family")
    table.add_column("method")
    for starts in STARTS:
        table.add_column(f"{starts} starts" if starts > 1 else "1 start", justify="right")
    for name, rows in figures.items():
        for label, row in rows.items():
            cells = [
                f"{1e3 * f['median_s']:.1f} ({1e3 * f['quantile_95_s']:.1f})" for f in row.values()
            ]
            table.add_row(name, label, *cells)
    return Report({"queries": queries, **figures}, [table])
