"""Excess and success against the time until a policy is ready, every method on the same problems.

The main method at growing deadlines, with and without grids; the grid solver at every size; and on
the paper's family its competitors: model predictive control, interpolation by a network, and meta
value learning as printed and repaired. Costly ones get fewer of the queries, the first ones.
"""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Table

from learning.faithful.meta import MetaWeights
from learning.faithful.planner import ANYTIME, PRINTED, REPAIRED, FaithfulPlanner
from learning.meta_planner import MetaPlanner
from ocp.planning import deadline, iterations, never
from ocp.trajectory import SolveError
from sims.benchmarks import Report
from sims.benchmarks.learning import (
    Problem,
    Score,
    Solver,
    eikonal,
    families,
    kept,
    notes,
    planned,
    problem,
    shown,
)
from sims.closed_loop import LoopSettings
from sims.methods import METHODS

BUDGETS = (0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
NODES = (1_000, 2_000, 4_500, 9_000, 18_000, 36_000, 60_000, 120_000, 240_000, 480_000)
ADAPTATIONS = (0, 1, 4, 16)  # trajectories of Algorithm 2
QUERIES, STARTS = 60, 4
FEW = 20  # queries for methods that take long
FAITHFUL = {"printed": PRINTED, "repaired": REPAIRED, "any-time": ANYTIME}
STYLES = {
    "adapt": ("o", "#0072B2"),
    "adapt without grids": ("^", "#56B4E9"),
    "eikonal": ("s", "#D55E00"),
    "mpc": ("P", "#009E73"),
    "interpolation": ("v", "#E69F00"),
    "meta learning, printed": ("x", "#CC79A7"),
    "meta learning, repaired": ("D", "#882255"),
    "meta learning, any-time": ("*", "#332288"),
}


@dataclass(frozen=True)
class Point:
    """A method at one setting.

    Attributes:
        label: the method.
        size: its setting: seconds, nodes or trajectories.
        solver: returns its policy and the seconds until that was ready.
        queries: how many of the queries it is given.
        period: seconds for which its inputs are held.
    """

    label: str
    size: float
    solver: Solver
    queries: int = QUERIES
    period: float = LoopSettings.period


def run(seed: int, out: Path | None, queries: int = QUERIES, starts: int = STARTS) -> Report:
    """A table and a figure for each of the two families."""
    report = Report()
    parts = kept("learning-curve", seed, out)
    for name in ("paper", "general"):
        points = _points(name)
        scores, failures = [Score() for _ in points], [0] * len(points)
        warm: set[int] = set()
        for k in range(queries):
            records = parts.get(
                f"{name}-{k}",
                {"starts": starts, "points": [[p.label, p.size] for p in points]},
                lambda name=name, k=k, points=points, warm=warm: _judged(
                    points, problem(families()[name], seed + 1, k, starts), k, warm
                ),
            )
            notes.print(f"{name}: query {k + 1} of {queries}", highlight=False)
            for i, (failed, record) in records.items():
                failures[int(i)] += failed
                scores[int(i)].extend(record)
        rows = [
            {"method": p.label, "size": p.size, "failures": failed, **score.figures()}
            for p, score, failed in zip(points, scores, failures, strict=True)
        ]
        report.figures[name] = rows
        report.tables.append(_table(f"{name}: {queries} queries x {starts} starts", rows))
        if out is not None:
            _draw(name, rows, out)
    return report


def _points(name: str) -> list[Point]:
    planners = {
        "adapt": MetaPlanner.pretrained(name),
        "adapt without grids": MetaPlanner.pretrained(name, grids=False),
    }
    points = [
        Point(label, budget, partial(planned, replace(planner, seconds=budget), deadline(budget)))
        for label, planner in planners.items()
        for budget in BUDGETS
    ]
    points += [Point("eikonal", n, partial(eikonal, n)) for n in NODES]
    if name != "paper":
        return points
    for label, queries in (("mpc", 6), ("interpolation", 2)):
        method = METHODS[label]
        solver = partial(planned, method.planner(), never())
        points.append(Point(label, 0, solver, queries, method.period))
    for label, weights in FAITHFUL.items():
        planner = FaithfulPlanner(MetaWeights.load(weights))
        points += [
            Point(f"meta learning, {label}", n, partial(planned, planner, iterations(n)), FEW)
            for n in ADAPTATIONS
        ]
    return points


def _judged(points: list[Point], posed: Problem, k: int, warm: set[int]) -> dict[str, Any]:
    """Whether each point had no policy for the k-th problem, and its score; by its number."""
    found = {}
    for i, point in enumerate(points):
        if k >= point.queries:
            continue
        score, failed = Score(), False
        try:
            if i not in warm and point.queries >= FEW:
                point.solver(posed.query, posed.starts)  # loads compiled code
                warm.add(i)
            policy, seconds = point.solver(posed.query, posed.starts)
            score.add(posed, policy, seconds, point.period)
        except (SolveError, FloatingPointError):
            failed = True
            score.add_failure(posed)
        found[str(i)] = (failed, score.record())
    return found


def _table(title: str, rows: list[dict[str, Any]]) -> Table:
    table = Table(title=f"{title}, against time")
    for column in ("method", "s, nodes or n", "median ms", "reached", "aggregate", "95 %"):
        table.add_column(column, justify="left" if column == "method" else "right")
    for row in rows:
        table.add_row(
            row["method"],
            f"{row['size']:g}",
            shown(row["reaction_median_s"], "{:.1f}", 1e3),
            shown(row["reached"], "{:.1%}"),
            shown(row["aggregate_excess"], "{:.4%}"),
            shown(row["excess_95"], "{:.3%}"),
        )
    return table


def _draw(name: str, rows: list[dict[str, Any]], out: Path) -> None:
    """Excess above, share that does not reach the goal below, against the same times."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7.0, 6.4), sharex=True, height_ratios=(3, 1), layout="constrained"
    )
    floor = 1e-3
    for label, (marker, colour) in STYLES.items():
        own = [r for r in rows if r["method"] == label and r["reached"] > 0]
        if not own:
            continue
        milliseconds = [1e3 * r["reaction_median_s"] for r in own]
        excess = [max(100 * r["aggregate_excess"], floor) for r in own]
        style: dict[str, Any] = {"marker": marker, "color": colour, "ms": 5, "lw": 1.3}
        above.loglog(milliseconds, excess, label=label, **style)
        below.semilogx(milliseconds, [100 * (1 - r["reached"]) for r in own], **style)
    above.set_ylabel("aggregate excess over the exact cost (%)")
    above.set_ylim(bottom=floor / 1.5)
    below.set_ylabel("not reached (%)")
    below.set_ylim(bottom=0, top=max(5.0, below.get_ylim()[1]))
    below.set_xlabel("policy ready after (ms, median)")
    for axes in (above, below):
        axes.grid(which="major", alpha=0.3)
    above.legend(frameon=False, fontsize=8)
    above.set_title(f"{name} family")
    save(figure, out / f"learning-curve-{name}.png")
