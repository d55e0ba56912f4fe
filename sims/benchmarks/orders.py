"""Orders of convergence of the eikonal schemes, on and off the axis, over four grids."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ocp.closed_form import straight_value
from ocp.grid import Grid, GridValue
from ocp.grids.fast_marching import march
from ocp.grids.goal_table import goal_table
from ocp.grids.semi_lagrangian import sweep_time_free
from ocp.oracle import consult
from ocp.query import Goal, Query
from ocp.query_family import paper_query, sample_start
from sims.benchmarks import Report

CELLS = (20, 40, 80, 160)
"""Cells along each side of the box; headings over half a turn in proportion."""
HEADINGS_PER_CELL = 0.315
TRUTHS = 60
notes = Console(stderr=True)


@dataclass(frozen=True)
class Case:
    """States of a query where the value is known.

    Attributes:
        states, values: `[k, n]`, `[k]`.
    """

    name: str
    query: Query
    states: NDArray[np.float64]
    values: NDArray[np.float64]


Solve = Callable[[Query, Grid], NDArray[np.float64]]

SCHEMES: dict[str, Solve] = {
    "fast marching": lambda query, grid: march(query, grid),
    "fast marching, from the ball alone": lambda query, grid: march(query, grid, seed=False),
    "fast marching, fixed relaxation 0.5": lambda query, grid: march(
        query, grid, seed=False, relaxation=0.5
    ),
    "semi-Lagrangian": lambda query, grid: sweep_time_free(query, grid).checked().values,
}
"""With the goal table as a right side the march is exact without obstacles, to rounding."""


def run(seed: int, out: Path | None) -> Report:
    """Errors and times of each scheme on each grid, and the order fitted through them."""
    cases = [_aligned(seed), _off_axis(seed), _among_obstacles(seed)]
    rows = []
    with notes.status("orders") as status:
        for case in cases:
            for scheme in SCHEMES:
                status.update(f"{case.name}: {scheme}")
                rows.append(_measure(case, scheme))
    report = Report({"cells": CELLS, "rows": rows})
    report.tables.append(_table(rows))
    if out is not None:
        _figure(rows, out)
    return report


def _aligned(seed: int) -> Case:
    """Headings along the ray to the goal, facing it or away: the closed form."""
    rng = np.random.default_rng(seed)
    query = Query("unicycle", Goal((0.0, 0.0), 0.5))
    bearing, distance = rng.uniform(-np.pi, np.pi, 200), rng.uniform(1.0, 4.9, 200)
    turned = np.pi * rng.integers(0, 2, 200)
    states = np.column_stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), bearing + turned]
    )
    states = query.system.wrap(states)
    return Case(
        "aligned, closed form", query, states, np.array([straight_value(query, s) for s in states])
    )


def _off_axis(seed: int) -> Case:
    """Random headings without obstacles: the table of exact extremals."""
    rng = np.random.default_rng(seed)
    query = Query("unicycle", Goal((1.0, 0.5), 0.8))
    states = rng.uniform([-5, -5, -np.pi], [5, 5, np.pi], (1500, 3))
    states = states[query.goal_distance(states) > 1.0]
    return Case("off axis, goal table", query, states, goal_table(query, 14.0).value(states))


def _among_obstacles(seed: int) -> Case:
    """Random states among the paper's three obstacles: established optima."""
    rng = np.random.default_rng(seed)
    query = paper_query((1.0, 4.0))
    with notes.status("exact costs among obstacles"):
        verdicts = [consult(query, sample_start(query, rng)) for _ in range(TRUTHS)]
    known = [v for v in verdicts if v.established]
    return Case(
        "among obstacles, PMP and collocation",
        query,
        np.array([v.state for v in known]),
        np.array([v.value for v in known], dtype=float),
    )


def _measure(case: Case, scheme: str) -> dict[str, Any]:
    errors, seconds = [], []
    for cells in CELLS:
        shape = (cells + 1, cells + 1, round(HEADINGS_PER_CELL * cells))
        grid = Grid.of(case.query.system, shape, half_turn=True)
        begun = time.perf_counter()
        values = SCHEMES[scheme](case.query, grid)
        seconds.append(time.perf_counter() - begun)
        found = np.asarray(GridValue(grid, values).value(case.states))
        errors.append(float(np.median(np.abs(found / case.values - 1))))
    slope = np.polyfit(np.log(CELLS), np.log(errors), 1)[0]
    return {
        "case": case.name,
        "scheme": scheme,
        "states": len(case.values),
        "median_errors": errors,
        "seconds": seconds,
        "order": -float(slope),
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="Median relative error of the value; order fitted over four grids")
    for column in ("truth", "scheme", *(f"{c} cells" for c in CELLS), "order"):
        table.add_column(column, justify="left" if column in ("truth", "scheme") else "right")
    for row in rows:
        table.add_row(
            row["case"],
            row["scheme"],
            *(f"{e:.3%}" for e in row["median_errors"]),
            f"{row['order']:.2f}",
        )
    return table


def _figure(rows: list[dict[str, Any]], out: Path) -> None:
    """Error against the spacing and against time, side by side, one row a truth."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    names = list(dict.fromkeys(row["case"] for row in rows))
    spacings = 10 / np.array(CELLS)
    figure, axes = plt.subplots(len(names), 2, figsize=(9.6, 10.2), layout="constrained")
    for name, (left, right) in zip(names, axes, strict=True):
        ends: list[tuple[float, str, Any]] = []
        for row, marker in zip([r for r in rows if r["case"] == name], "os^D", strict=True):
            percent = 100 * np.array(row["median_errors"])
            (line,) = left.loglog(spacings, percent, marker=marker, label=row["scheme"])
            right.loglog(1e3 * np.array(row["seconds"]), percent, marker=marker)
            ends.append((percent[-1], f"{row['order']:.2f}", line.get_color()))
        height = 0.0
        for error, order, colour in sorted(ends):
            height = max(error, 1.6 * height)  # so that no two overlap
            left.text(0.9 * spacings[-1], height, order, ha="right", va="center", color=colour)
        left.set(title=f"{name}; orders", xlabel="spacing (m)")
        left.set_ylabel("median value error (%)")
        left.set_xlim(spacings[-1] / 1.5, spacings[0] * 1.15)
        left.set_xticks(spacings, [f"{s:g}" for s in spacings])
        left.minorticks_off()
        right.set(xlabel="time to solve (ms, one thread)")
        for panel in (left, right):
            panel.grid(which="both", alpha=0.25)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    save(figure, out / "orders.png")
