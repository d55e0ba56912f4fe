"""The paper's four queries, the exact optimum and the paper's figures beside."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from ocp.query_family import PAPER_FIGURE_STARTS, PAPER_GOALS, PAPER_START, paper_query
from sims.commands.plan import Outcome, number, solve
from sims.demos import Demonstration

PAPER_CLAIMS = {
    (4.0, 4.0): (24.0, 24.9),
    (1.0, 1.0): (17.3, 17.9),
    (1.0, 4.0): (20.1, 20.6),
    (4.0, 1.0): (20.1, 20.5),
}
"""Xu and Zhu, Table I: the benchmark (set-valued, fine grid) and anytime adaptation."""


def run(_seed: int, out: Path | None) -> Demonstration:
    """The paper's four queries from its seven starts, eikonal method, against the exact optimum."""
    starts = [np.array(s) for s in (PAPER_START, *PAPER_FIGURE_STARTS)]
    entries, panels = [], []
    for goal in PAPER_GOALS:
        query = paper_query(goal)
        answer, outcomes = solve(query, starts, "eikonal")
        entries.append(_entry(goal, answer.reaction_time, outcomes))
        panels.append((answer, outcomes))
    table = Table(
        title="Cost from (-4, -4, -pi/4), and the paper's Table I (set-valued fine, adaptation)"
    )
    for column in (
        "goal",
        "exact",
        "eikonal",
        "excess",
        "worst of 7",
        "reaction",
        "paper, fine",
        "paper, n = 8",
    ):
        table.add_column(column, justify="right")
    for entry in entries:
        first = entry["starts"][0]
        worst = max((s["excess"] for s in entry["starts"] if s["excess"] is not None), default=None)
        benchmark, adaptation = PAPER_CLAIMS[tuple(entry["goal"])]
        table.add_row(
            "({:g}, {:g})".format(*entry["goal"]),
            number(first["exact_cost"]),
            number(first["cost"]),
            number(first["excess"], "{:.3%}"),
            number(worst, "{:.3%}"),
            f"{entry['reaction_time_s'] * 1e3:.0f} ms",
            f"{benchmark:.1f}",
            f"{adaptation:.1f}",
        )
    if out is not None:
        _four_panels(panels, out)
    reached = all(s["reached"] for e in entries for s in e["starts"])
    return Demonstration({"queries": entries}, [table], reached)


def _entry(goal: tuple[float, float], reaction: float, outcomes: list[Outcome]) -> dict[str, Any]:
    return {
        "goal": list(goal),
        "reaction_time_s": reaction,
        "starts": [outcome.report() for outcome in outcomes],
    }


def _four_panels(panels: list, out: Path) -> None:
    """One panel a query, as the paper's Figure 1."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import draw_plan, legend, save

    figure, axes = plt.subplots(2, 2, figsize=(10.4, 9.6), layout="constrained")
    for panel, (answer, outcomes), tag in zip(axes.flat, panels, "abcd", strict=True):
        loops, optima = [o.rollout for o in outcomes], [o.exact for o in outcomes]
        draw_plan(panel, answer.query, loops, optima, answer.value)
        panel.set_title("({}) goal ({:g}, {:g})".format(tag, *answer.query.goal.center))
    legend(figure)
    for suffix in (".png", ".svg"):
        save(figure, out / f"four-queries{suffix}")
