"""The meta planner on a query nobody trained it for: policy, value, error against the optimum."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from learning.meta_planner import MetaPlanner
from ocp.eikonal import solve_eikonal
from ocp.planning import Plan, trajectories
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import PAPER_FAMILY, sample_start
from ocp.trajectory import Trajectory
from sims.closed_loop import Rollout, rollouts
from sims.demos import Demonstration

COUNTS = (0, 2, 8)
"""Exact trajectories: none is the network alone."""
STARTS = 8
REFERENCE = 240_000
"""Nodes of the grid behind the map of errors; its own median value error is below 0.1 %."""


def run(seed: int, out: Path | None) -> Demonstration:
    """A random query of the paper's family, planned with more and more exact trajectories."""
    rng = np.random.default_rng([seed, 7])
    query = PAPER_FAMILY.sample(rng)
    starts = [sample_start(query, rng) for _ in range(STARTS)]
    planner = MetaPlanner.shipped()
    planner.plan(PAPER_FAMILY.sample(rng), starts[:1], trajectories(1))  # loads all compiled code
    optima = [exact_trajectory(query, start) for start in starts]
    table = Table(title=f"a fresh query, {STARTS} random starts, against the exact optimum")
    for column in ("trajectories", "policy ready", "mean excess", "worst", "arrived"):
        table.add_column(column, justify="right")
    rows: list[dict[str, Any]] = []
    plans = [planner.plan(query, starts, trajectories(count)) for count in COUNTS]
    driven = [rollouts(plan.policy, starts) for plan in plans]
    for plan, loops in zip(plans, driven, strict=True):
        excesses = [
            loop.cost / optimum.cost - 1
            for loop, optimum in zip(loops, optima, strict=True)
            if loop.cost is not None
        ]
        rows.append(
            {
                "reaction_time_s": plan.reaction_time,
                "trajectories": plan.trajectories,
                "mean_excess": float(np.mean(excesses)) if excesses else None,
                "worst_excess": max(excesses, default=None),
                "reached": sum(loop.reached for loop in loops),
            }
        )
        table.add_row(
            str(plan.trajectories),
            f"{1e3 * plan.reaction_time:.1f} ms",
            f"{np.mean(excesses):.3%}" if excesses else "-",
            f"{max(excesses):.3%}" if excesses else "-",
            f"{rows[-1]['reached']} of {STARTS}",
        )
    if out is not None:
        _figure(query, plans[-1], driven[-1], optima, out)
    succeeded = rows[-1]["reached"] == STARTS
    return Demonstration({"query": query.dumps(), "plans": rows}, [table], succeeded)


def _figure(
    query: Query, plan: Plan, loops: list[Rollout], optima: list[Trajectory], out: Path
) -> None:
    """The closed loops over the value's contours, and where that value is wrong."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import draw_plan, least_over_other_coordinates, legend, save

    figure, axes = plt.subplots(1, 2, figsize=(12.6, 5.6), layout="constrained")
    draw_plan(axes[0], query, loops, optima, plan.value)
    axes[0].set_title(f"policy ready after {1e3 * plan.reaction_time:.0f} ms")
    x, y, found = least_over_other_coordinates(query, plan.value)
    _, _, exact = least_over_other_coordinates(query, solve_eikonal(query, nodes=REFERENCE).value)
    error = _relative(found, exact)
    shown = axes[1].pcolormesh(x, y, error.T, cmap="RdBu_r", vmin=-3, vmax=3, shading="gouraud")
    figure.colorbar(shown, ax=axes[1], label="value over a fine grid's (%)", extend="both")
    draw_plan(axes[1], query, [])
    axes[1].set_title(f"value error: median {np.nanmedian(np.abs(error)):.2f} %")
    legend(figure)
    save(figure, out / "adaptation.png")


def _relative(found: NDArray[np.float64], exact: NDArray[np.float64]) -> NDArray[np.float64]:
    """In percent; NaN where the value itself is small."""
    outside = exact > 0.5
    return np.where(outside, 100 * (found / np.where(outside, exact, 1.0) - 1), np.nan)
