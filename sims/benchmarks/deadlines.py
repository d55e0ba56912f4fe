"""Deadlines: when `plan` returns against when it was told to, over many calls."""

import gc
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ocp.planning import deadline, plan
from ocp.query_family import PAPER_FAMILY
from sims.benchmarks import Report
from sims.closed_loop import rollouts
from sims.methods import METHODS

CALLS = 10_000
DEADLINES = (0.01, 0.02, 0.05, 0.1)
CONTENDERS = ("eikonal", "adapt")
GRACE = 0.005
"""Seconds after the deadline that still count as kept."""
JUDGED = 25
"""Every so many calls the plan's closed loop is run, outside the measured time."""
notes = Console(stderr=True)


def run(seed: int, out: Path | None, calls: int = CALLS) -> Report:
    """`calls` of each method, deadlines in turn, fresh queries and starts."""
    report = Report()
    table = Table(title=f"Lateness over {calls:,} calls a method (negative: early)")
    columns = ("method", "deadline, ms", "calls", "median, ms", "99 %", "99.9 %", "worst")
    for column in (*columns, "within 5 ms", "reached"):
        table.add_column(column, justify="left" if column == "method" else "right")
    rows = []
    for method in CONTENDERS:
        rows += _soak(method, np.random.default_rng(seed), calls)
    for row in rows:
        table.add_row(
            row["method"],
            f"{1e3 * row['deadline_s']:.0f}",
            f"{row['calls']:,}",
            *(f"{1e3 * row[name]:.2f}" for name in ("median_s", "q99_s", "q999_s", "worst_s")),
            f"{row['within_grace']:.2%}",
            f"{row['reached']} of {row['judged']}",
        )
    report.figures["rows"] = rows
    report.tables.append(table)
    if out is not None:
        _figure(rows, out)
    return report


def _soak(method: str, rng: np.random.Generator, calls: int) -> list[dict[str, Any]]:
    chosen = METHODS[method]
    for seconds in DEADLINES:
        chosen.rehearse(PAPER_FAMILY.sample(rng), seconds)
    late: dict[float, list[float]] = {seconds: [] for seconds in DEADLINES}
    reached = dict.fromkeys(DEADLINES, 0)
    judged = dict.fromkeys(DEADLINES, 0)
    gc.collect()
    with notes.status(method) as status:
        for k in range(calls):
            if k % 100 == 0:
                status.update(f"{method}: call {k:,} of {calls:,}")
            seconds = DEADLINES[k % len(DEADLINES)]
            query, start = PAPER_FAMILY.sample_with_start(rng)
            begun = time.perf_counter()
            answer = plan(chosen.planner_for(seconds), query, [start], deadline(seconds))
            late[seconds].append(time.perf_counter() - begun - seconds)
            if (k // len(DEADLINES)) % JUDGED == 0:
                judged[seconds] += 1
                reached[seconds] += rollouts(answer.policy, [start])[0].reached
    return [
        {
            "method": method,
            "deadline_s": seconds,
            "calls": len(times),
            "median_s": float(np.median(times)),
            "q99_s": float(np.quantile(times, 0.99)),
            "q999_s": float(np.quantile(times, 0.999)),
            "worst_s": max(times),
            "within_grace": float(np.mean(np.array(times) <= GRACE)),
            "reached": reached[seconds],
            "judged": judged[seconds],
            "distribution_s": np.quantile(times, np.linspace(0, 1, 201)).tolist(),
        }
        for seconds, times in late.items()
    ]


def _figure(rows: list[dict[str, Any]], out: Path) -> None:
    """The distributions: part of calls against lateness."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for row in rows:
        label = f"{row['method']}, {1e3 * row['deadline_s']:.0f} ms"
        style = "-" if row["method"] == CONTENDERS[0] else "--"
        times = 1e3 * np.array(row["distribution_s"])
        axes.plot(times, np.linspace(0, 1, len(times)), style, label=label)
    axes.axvline(1e3 * GRACE, color="0.5", linewidth=1)
    axes.set_xlabel("returned after the deadline (ms)")
    axes.set_ylabel("part of calls")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize="small")
    save(figure, out / "deadlines.png")
