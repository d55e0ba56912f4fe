"""Grid solvers: time, value error and closed-loop excess against exact costs, at many sizes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from ocp.eikonal import Scheme, solve_eikonal
from ocp.oracle import consult
from ocp.query import Query
from ocp.query_family import PAPER_FAMILY, PAPER_GOALS, PAPER_START, paper_query, sample_start
from ocp.set_valued import Image, Method, SetValuedSettings, solve_set_valued
from ocp.value import Policy, Value
from sims.benchmarks import Report, median_seconds
from sims.closed_loop import rollout

SIZES = (4_500, 9_000, 18_000, 36_000, 60_000, 240_000, 480_000)
"""Nodes with headings over half a turn; a grid over the whole turn has twice as many."""
QUERIES, STARTS = 12, 6
notes = Console(stderr=True)


@dataclass(frozen=True)
class Truth:
    """Established optimal costs: `values` `[k]` at `states` `[k, n]` of one query."""

    query: Query
    states: NDArray[np.float64]
    values: NDArray[np.float64]


@dataclass(frozen=True)
class Contender:
    """A solver at one setting."""

    name: str
    nodes: int
    solve: Callable[[Query], tuple[Value, Policy]]
    repeats: int = 5


def run(seed: int, out: Path | None) -> Report:
    """Measure every contender on the same queries and states."""
    truths = _truths(seed)
    contenders = _contenders()
    rows = []
    reference = None
    with notes.status("grids") as status:
        for contender in contenders:
            status.update(f"{contender.name}, {contender.nodes} nodes")
            rows.append(_measure(contender, truths))
            if contender.name == "set-valued, value iteration":
                reference = rows[-1]["seconds"]
    assert reference is not None
    for row in rows:
        row["value_iteration_ratio"] = reference / row["seconds"]
    report = Report({"rows": rows, "states": sum(len(t.values) for t in truths)})
    report.tables.append(_table(rows))
    if out is not None:
        _figure(rows, out)
    return report


def _truths(seed: int) -> list[Truth]:
    """Random queries of the paper's family with states whose optimal cost is established."""
    rng = np.random.default_rng(seed)
    truths = []
    with notes.status("exact costs") as status:
        for k in range(QUERIES):
            status.update(f"exact costs, query {k + 1} of {QUERIES}")
            query = PAPER_FAMILY.sample(rng)
            verdicts = [consult(query, sample_start(query, rng)) for _ in range(STARTS)]
            known = [v for v in verdicts if v.established]
            truths.append(
                Truth(
                    query,
                    np.array([v.state for v in known]).reshape(-1, query.system.n),
                    np.array([v.value for v in known], dtype=float),
                )
            )
    return truths


def _contenders() -> list[Contender]:
    def eikonal(scheme: Scheme, nodes: int) -> Contender:
        def solve(query: Query) -> tuple[Value, Policy]:
            solution = solve_eikonal(query, nodes=nodes, scheme=scheme)
            return solution.value, solution.policy()

        return Contender(scheme.name.lower().replace("_", " "), nodes, solve)

    def set_valued(name: str, method: Method, image: Image, repeats: int) -> Contender:
        def solve(query: Query) -> tuple[Value, Policy]:
            solution = solve_set_valued(
                query, settings=SetValuedSettings(image=image), method=method
            )
            return solution.value, solution.policy()

        return Contender(name, 117_740, solve, repeats)

    return [
        set_valued("set-valued, value iteration", Method.JACOBI, Image.NEAREST, 1),
        set_valued("set-valued, label setting", Method.LABEL_SETTING, Image.NEAREST, 5),
        set_valued("set-valued, lateral alpha", Method.LABEL_SETTING, Image.LATERAL, 5),
        *(eikonal(scheme, nodes) for scheme in list(Scheme)[:2] for nodes in SIZES),
    ]


def _measure(contender: Contender, truths: list[Truth]) -> dict[str, Any]:
    seconds = float(
        np.median(
            [
                median_seconds(lambda q=t.query: contender.solve(q), contender.repeats)
                for t in truths[:: 1 if contender.repeats > 1 else 6]
            ]
        )
    )
    errors = []
    for truth in truths:
        value, _ = contender.solve(truth.query)
        errors.append(np.abs(np.asarray(value.value(truth.states)) / truth.values - 1))
    excess = []
    for goal in PAPER_GOALS:
        query = paper_query(goal)
        loop = rollout(contender.solve(query)[1], PAPER_START)
        exact = consult(query, PAPER_START).value
        excess.append(None if loop.cost is None or exact is None else loop.cost / exact - 1)
    return {
        "solver": contender.name,
        "nodes": contender.nodes,
        "seconds": seconds,
        "median_value_error": float(np.median(np.concatenate(errors))),
        "value_error_95": float(np.quantile(np.concatenate(errors), 0.95)),
        "excess_four_queries": excess,
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title="Grid solvers, one thread; excess: the paper's four queries")
    for column in (
        "solver",
        "nodes",
        "ms",
        "times faster",
        "value error",
        "95 %",
        "largest excess",
    ):
        table.add_column(column, justify="left" if column == "solver" else "right")
    for row in rows:
        known = [e for e in row["excess_four_queries"] if e is not None]
        lost = len(row["excess_four_queries"]) - len(known)
        table.add_row(
            row["solver"],
            f"{row['nodes']:,}",
            f"{row['seconds'] * 1e3:.1f}",
            f"{row['value_iteration_ratio']:.1f}",
            f"{row['median_value_error']:.2%}",
            f"{row['value_error_95']:.2%}",
            (f"{max(known):.2%}" if known else "-") + (f" ({lost} lost)" if lost else ""),
        )
    return table


def _figure(rows: list[dict[str, Any]], out: Path) -> None:
    """Value error against time, both eikonal schemes and the set-valued method."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    figure, axes = plt.subplots(figsize=(6.4, 4.6), layout="constrained")
    markers = dict(zip(dict.fromkeys(r["solver"] for r in rows), "sDvo^", strict=False))
    for name, marker in markers.items():
        own = [r for r in rows if r["solver"] == name]
        axes.loglog(
            [r["seconds"] * 1e3 for r in own],
            [100 * r["median_value_error"] for r in own],
            marker=marker,
            label=name,
        )
    axes.set_xlabel("time to solve (ms, one thread)")
    axes.set_ylabel("median value error (%)")
    axes.grid(which="both", alpha=0.3)
    axes.legend(frameon=False)
    save(figure, out / "grids.png")
