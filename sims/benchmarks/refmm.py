"""ReFMM: convergence to exact values, refinement against uniform meshes, repair against re-solving.

Every row is the scheme without exact values (plain) or corrected by the exact value without
obstacles (table); each claim is printed for both.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ocp.oracle import consult
from ocp.query import Goal, Query
from ocp.query_family import PAPER_GOALS, PAPER_START, paper_query, sample_start
from ocp.refmm import COARSE, FINE, Refmm, RefmmSettings, solve_refmm, uniform_mesh
from ocp.simplicial.solution import MeshSolution, solve_on_mesh
from sims.benchmarks import Report
from sims.closed_loop import rollout

SIZES = (6_000, COARSE, 48_000, FINE, 192_000)
ORDER_SIZES = (3_000, 12_000, 48_000, 192_000)
"""Uniform meshes, each of four times as many simplices as the one before."""
TRUTHS = 15
"""Random states a query."""
NOTES = Console(stderr=True)


@dataclass(frozen=True)
class Truth:
    """Established optimal costs: `values` `[k]` at `states` `[k, n]` of one query."""

    query: Query
    states: NDArray[np.float64]
    values: NDArray[np.float64]
    at_start: float


def run(seed: int, out: Path | None) -> Report:
    """All parts; the figure goes to `out`."""
    truths = _truths(seed)
    report = Report()
    with NOTES.status("orders") as status:
        orders = _orders(truths)
        rows = []
        for table in (False, True):
            for size in SIZES:
                status.update(f"{size} simplices, {'table' if table else 'plain'}")
                rows += _rows(truths, size, table)
        status.update("label setting and repair")
        causality = [_causality(query, name) for name, query in _causal_cases().items()]
        repairs = [_repairs(table) for table in (False, True)]
        if out is not None:
            status.update("figure")
            _figure(rows, truths[1].query, out)
    report.figures = {"orders": orders, "rows": rows, "causality": causality, "repairs": repairs}
    report.tables += [
        _orders_table(orders), _rows_table(rows), _causality_table(causality),
        _repairs_table(repairs),
    ]  # fmt: skip
    return report


def _truths(seed: int) -> list[Truth]:
    """The paper's four queries: states whose optimal cost is established."""
    rng = np.random.default_rng(seed)
    truths = []
    with NOTES.status("exact costs") as status:
        for goal in PAPER_GOALS:
            status.update(f"exact costs, goal {goal}")
            query = paper_query(goal)
            verdicts = [consult(query, sample_start(query, rng)) for _ in range(TRUTHS)]
            known = [v for v in verdicts if v.established]
            at_start = consult(query, PAPER_START)
            if at_start.value is None or not at_start.established:
                raise ArithmeticError(f"no established cost from the paper's start to {goal}")
            states = np.array([v.state for v in known])
            values = np.array([v.value for v in known], dtype=float)
            truths.append(Truth(query, states, values, at_start.value))
    return truths


def _errors(solution: MeshSolution, truth: Truth) -> NDArray[np.float64]:
    return np.abs(solution.value.value(truth.states) / truth.values - 1)


def _orders(truths: list[Truth]) -> list[dict[str, Any]]:
    """Mean value error on four uniform meshes, and the orders between them, in the spacing."""
    found = []
    for name, which in (("no obstacles", truths[:1]), ("obstacles", truths[1:])):
        for table in (False, True):
            errors, sizes = [], []
            for size in ORDER_SIZES:
                solved = [
                    solve_on_mesh(t.query, uniform_mesh(t.query, size), table=table) for t in which
                ]
                sizes.append(solved[0].mesh.size)
                rows = [_errors(s, t) for s, t in zip(solved, which, strict=True)]
                errors.append(float(np.concatenate(rows).mean()))
            ratio = np.log(np.array(sizes[1:]) / sizes[:-1]) / 3
            orders = np.log(np.array(errors[:-1]) / errors[1:]) / ratio
            found.append(
                {
                    "case": name,
                    "table": table,
                    "simplices": sizes,
                    "mean_error": errors,
                    "orders": orders.tolist(),
                }
            )
    return found


def _rows(truths: list[Truth], size: int, table: bool) -> list[dict[str, Any]]:
    """A uniform mesh, one refined for the whole box, and one refined for the paper's start."""
    start = np.array(PAPER_START)
    settings = RefmmSettings(first=min(6_000, size), last=size, table=table)

    def refined(query: Query, starts: list[NDArray[np.float64]]) -> MeshSolution:
        if size <= settings.first:
            return solve_on_mesh(query, uniform_mesh(query, size), table=table)
        return solve_refmm(query, starts, settings).solution

    kinds = {
        "uniform": lambda q: solve_on_mesh(q, uniform_mesh(q, size), table=table),
        "refined, box": lambda q: refined(q, []),
        "refined, start": lambda q: refined(q, [start]),
    }
    rows = []
    for kind, solve in kinds.items() if size > 6_000 else list(kinds.items())[:1]:
        seconds, errors, excess, simplices = [], [], [], []
        for truth in truths:
            began = time.process_time()
            solution = solve(truth.query)
            seconds.append(time.process_time() - began)
            simplices.append(solution.mesh.size)
            errors.append(_errors(solution, truth))
            cost = rollout(solution.policy(), start).cost
            excess.append(None if cost is None else cost / truth.at_start - 1)
        everything = np.concatenate(errors)
        rows.append(
            {
                "mesh": kind,
                "table": table,
                "asked": size,
                "simplices": int(np.median(simplices)),
                "seconds": float(np.median(seconds)),
                "mean_error": float(everything.mean()),
                "median_error": float(np.median(everything)),
                "error_at_95": float(np.quantile(everything, 0.95)),
                "excess_four_queries": excess,
            }
        )
    return rows


def _causal_cases() -> dict[str, Query]:
    return {
        "isotropic, 2 states": Query("single-integrator-2d", Goal((1.0, 1.0), 0.5)),
        "isotropic, 3 states": Query("single-integrator-3d", Goal((1.0, 1.0, 1.0), 0.8)),
        "unicycle": paper_query((1.0, 1.0)),
    }


def _causality(query: Query, name: str) -> dict[str, Any]:
    """One pass in the order of acceptance, against the repaired values, on one mesh."""
    solution = solve_on_mesh(query, uniform_mesh(query, 24_000), tolerance=1e-9, table=False)
    once, swept = solution.by_label_setting(), solution.by_value_iteration()
    free = (solution.fixed == 0) & np.isfinite(solution.values)
    too_high = once.values[free] / solution.values[free] - 1
    return {
        "case": name,
        "simplices": solution.mesh.size,
        "accepted_again": float(solution.effort.again / free.sum()),
        "updates_one_pass": once.effort.updates,
        "updates_repaired": replace(solution, tolerance=1e-4).from_scratch().effort.updates,
        "label_setting_mean_excess": float(too_high.mean()),
        "label_setting_largest_excess": float(too_high.max()),
        "from_value_iteration": float(abs(swept.values[free] / solution.values[free] - 1).max()),
    }


def _repairs(table: bool) -> dict[str, Any]:
    """Updates of each repair over those of solving the same mesh anew."""
    query = paper_query((1.0, 1.0))
    settings = RefmmSettings(table=table)
    state = Refmm(settings).start(query)
    ratios, sizes = [], []
    while not state.finished:
        state = state.refined()
        last = state.rounds[-1]
        ratios.append(last.effort.updates / state.solution.from_scratch().effort.updates)
        sizes.append(last.simplices)
    corner = abs(state.solution.mesh.vertices[state.solution.mesh.cells][..., :2] + 5.0)
    local = state.solution.refined(np.flatnonzero(corner.sum(axis=2).max(axis=1) < 1.0))
    anew = local.from_scratch().effort.updates
    return {
        "table": table,
        "simplices": sizes,
        "ratios": ratios,
        "local_ratio": local.effort.updates / anew,
    }


def _percent(x: float | None) -> str:
    return "-" if x is None else f"{x:.2%}"


def _scheme(row: dict[str, Any]) -> str:
    return "table" if row["table"] else "plain"


def _filled(title: str, columns: list[str], rows: list[list[str]]) -> Table:
    table = Table(title=title)
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k < 1 else "right")
    for row in rows:
        table.add_row(*row)
    return table


def _orders_table(orders: list[dict[str, Any]]) -> Table:
    sizes = [f"{n:,}" for n in orders[0]["simplices"]]
    rows = [
        [
            f"{o['case']}, {_scheme(o)}",
            *map(_percent, o["mean_error"]),
            ", ".join(f"{p:.2f}" for p in o["orders"]),
        ]
        for o in orders
    ]
    title = "Mean value error against exact costs, uniform meshes of so many simplices"
    return _filled(title, ["case", *sizes, "orders"], rows)


def _rows_table(rows: list[dict[str, Any]]) -> Table:
    lines = []
    for row in rows:
        known = [e for e in row["excess_four_queries"] if e is not None]
        lost = len(row["excess_four_queries"]) - len(known)
        worst = _percent(max(known, default=None)) + (f" ({lost} lost)" if lost else "")
        lines.append(
            [
                f"{_scheme(row)}, {row['mesh']}",
                f"{row['simplices']:,}",
                f"{row['seconds']:.2f}",
                _percent(row["mean_error"]),
                _percent(row["median_error"]),
                _percent(row["error_at_95"]),
                " ".join(map(_percent, row["excess_four_queries"])),
                worst,
            ]
        )
    columns = ["scheme, mesh", "simplices", "s", "mean error", "median", "95 %"]
    title = "The paper's four queries; excess over the exact optimum from the paper's start"
    return _filled(title, [*columns, "excess", "largest"], lines)


def _causality_table(rows: list[dict[str, Any]]) -> Table:
    lines = [
        [
            row["case"],
            f"{row['simplices']:,}",
            _percent(row["accepted_again"]),
            f"{row['updates_repaired'] / row['updates_one_pass']:.2f}",
            _percent(row["label_setting_mean_excess"]),
            _percent(row["label_setting_largest_excess"]),
            f"{row['from_value_iteration']:.1e}",
        ]
        for row in rows
    ]
    columns = [
        "case", "simplices", "accepted again", "updates over one pass", "one pass: mean excess",
        "largest", "repaired against value iteration",
    ]  # fmt: skip
    return _filled("Label setting alone, and with repair (plain scheme)", columns, lines)


def _repairs_table(rows: list[dict[str, Any]]) -> Table:
    lines = [
        [
            _scheme(row),
            ", ".join(
                f"{n // 1000}k {r:.2f}"
                for n, r in zip(row["simplices"], row["ratios"], strict=True)
            ),
            f"{row['local_ratio']:.3f}",
        ]
        for row in rows
    ]
    title = "Updates of a repair over those of a new solve on the same mesh"
    return _filled(title, ["scheme", "rounds of refinement to", "a corner refined"], lines)


def _figure(rows: list[dict[str, Any]], query: Query, out: Path) -> None:
    """Error and excess against size, and a slice of a refined mesh."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    figure, axes = plt.subplots(1, 3, figsize=(13.2, 4.3), layout="constrained")
    styles = {"uniform": ("o", "-"), "refined, box": ("s", "--"), "refined, start": ("^", ":")}
    for table, colour in ((False, "#0072b2"), (True, "#d55e00")):
        for kind, (marker, line) in styles.items():
            own = [r for r in rows if r["table"] is table and r["mesh"] == kind]
            sizes = [r["simplices"] for r in own]
            label = f"{'table' if table else 'plain'}, {kind}"
            worst = [max(e for e in r["excess_four_queries"] if e is not None) for r in own]
            for panel, values in (
                (axes[0], [100 * r["mean_error"] for r in own]),
                (axes[1], [100 * w for w in worst]),
            ):
                panel.loglog(sizes, values, line, marker=marker, color=colour, label=label)
    axes[0].set_ylabel("mean value error (%)")
    axes[1].set_ylabel("largest excess from the paper's start (%)")
    axes[1].plot([COARSE, FINE], [4, 1], "k_", markersize=18, label="4 % and 1 %")
    for panel, tag in zip(axes[:2], "ab", strict=True):
        panel.set_xlabel("simplices")
        panel.set_title(f"({tag})", loc="left")
        panel.grid(which="both", alpha=0.3)
    axes[1].legend(frameon=False, fontsize=7)
    _slice(axes[2], query)
    axes[2].set_title("(c) refined for one start", loc="left")
    for suffix in (".png", ".svg"):
        save(figure, out / f"refmm{suffix}")


def _slice(panel: Any, query: Query) -> None:
    """The smallest leaf over all headings at each position, and the way from the start."""
    from sims.pictures.plan_figure import draw_plan

    start = np.array(PAPER_START)
    solution = solve_refmm(query, [start], RefmmSettings(last=COARSE)).solution
    mesh = solution.mesh
    side, headings = np.linspace(-4.99, 4.99, 161), np.linspace(-np.pi, 0.0, 24, endpoint=False)
    x, y, heading = np.meshgrid(side, side, headings)
    vertices, _ = mesh.locate(np.column_stack([x.ravel(), y.ravel(), heading.ravel()]))
    corners = mesh.vertices[vertices]
    edges = mesh.difference(corners[:, 1:], corners[:, :1])
    sizes = np.cbrt(abs(np.linalg.det(edges))).reshape(x.shape).min(axis=2)
    image = panel.pcolormesh(x[..., 0], y[..., 0], sizes, cmap="Greys_r")
    label = "smallest (6 volume)$^{1/3}$ over headings (m)"
    panel.figure.colorbar(image, ax=panel, label=label)
    draw_plan(panel, query, [rollout(solution.policy(), start)])
