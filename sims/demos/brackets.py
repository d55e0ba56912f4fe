"""How near is near? A certified gap: no motion costs less than the bound, one that costs the rest.

The lower bound is a checked subsolution of the Hamilton-Jacobi-Bellman equation, the upper one the
cost of a closed loop that arrives. Neither takes an exact trajectory on trust.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from ocp.bracket import lower_bound
from ocp.eikonal import solve_eikonal
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_family import PAPER_START, paper_query
from sims.closed_loop import rollouts
from sims.demos import Demonstration

GOAL = (1.0, 4.0)
NODES = 60_000
SIDE = 25
HEADING = 0.25 * np.pi


def run(_seed: int, out: Path | None) -> Demonstration:
    """The bracket of a query of the paper, at states all over its box."""
    query = paper_query(GOAL)
    bound = lower_bound(query, nodes=NODES)
    solution = solve_eikonal(query, nodes=NODES)
    x = np.linspace(-4.8, 4.8, SIDE)
    states = np.stack(np.meshgrid(x, x, [HEADING], indexing="ij"), axis=-1).reshape(-1, 3)
    outside = query.goal_distance(states) > 0
    loops = rollouts(solution.policy(), list(states[outside]))
    gaps = np.full(len(states), np.nan)
    gaps[outside] = [
        np.nan if loop.cost is None else bound.bracket(state, loop.cost).gap
        for state, loop in zip(states[outside], loops, strict=True)
    ]
    known = gaps[np.isfinite(gaps)]
    start = np.array(PAPER_START)
    optimum = exact_trajectory(query, start).cost
    lower = float(bound.value(start))
    arrived = sum(loop.reached for loop in loops)
    figures = {
        "states": int(outside.sum()),
        "arrived": arrived,
        "median_gap": float(np.median(known)),
        "gap_95": float(np.quantile(known, 0.95)),
        "lower_at_the_papers_start": lower,
        "exact_at_the_papers_start": optimum,
        "crossed": int((known < 0).sum()),
    }
    table = Table(title="certified: lower bound <= V <= cost of a closed loop")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, figure in figures.items():
        table.add_row(name.replace("_", " "), f"{figure:.5g}")
    if out is not None:
        _map(query, x, gaps.reshape(SIDE, SIDE), out)
    succeeded = arrived == len(loops) and figures["crossed"] == 0 and lower <= optimum
    return Demonstration(figures, [table], succeeded)


def _map(query: Query, x: NDArray[np.float64], gaps: NDArray[np.float64], out: Path) -> None:
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import draw_plan, save

    figure, axes = plt.subplots(figsize=(7.2, 5.8), layout="constrained")
    top = float(np.nanquantile(100 * gaps, 0.98))
    shown = axes.pcolormesh(x, x, 100 * gaps.T, cmap="magma_r", vmin=0, vmax=top)
    figure.colorbar(shown, label="certified gap (%)", extend="max")
    draw_plan(axes, query, [])
    axes.set_title(f"upper over lower bound, less 1; heading {np.degrees(HEADING):.0f}°")
    save(figure, out / "brackets.png")
