"""Figure 3 of Xu and Zhu for the faithful implementation, against exact optima."""

from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from learning.faithful.meta import MetaWeights
from learning.faithful.planner import ANYTIME, PRINTED, REPAIRED
from sims.benchmarks import Report
from sims.experiments.faithful_study import COUNTS, Row, evaluate, fresh_trials, table_of

QUERIES, STARTS = 20, 10
SHIPPED = {"as printed": PRINTED, "repaired": REPAIRED, "any-time": ANYTIME}
notes = Console(stderr=True)


def run(seed: int, out: Path | None) -> Report:
    """All shipped weights on the same fresh queries."""
    report = Report()
    with notes.status("exact optima, and the trajectories of the adaptation"):
        trials = fresh_trials(seed, QUERIES, STARTS, max(COUNTS))
    curves = {}
    for name, path in SHIPPED.items():
        weights = MetaWeights.load(path)
        with notes.status(f"{name}: {len(trials)} queries"):
            rows = evaluate(weights, trials)
        curves[name] = rows
        report.figures[name] = {
            "iterations": weights.iterations,
            "rows": [asdict(row) for row in rows],
        }
        title = f"{name}, {weights.iterations} meta-iterations, {len(trials)} fresh queries"
        report.tables.append(table_of(rows, title))
    if out is not None:
        _figure(curves, out)
    return report


def _figure(curves: dict[str, list[Row]], out: Path) -> None:
    """Success and value error against the number of trajectories."""
    import matplotlib.pyplot as plt

    from sims.pictures.plan_figure import save

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.0), layout="constrained")
    for (name, rows), marker in zip(curves.items(), "os^", strict=True):
        counts = [row.trajectories for row in rows]
        left.plot(counts, [100 * row.paper.reached for row in rows], marker, ls="-", label=name)
        errors = [100 * row.value_error if row.value_error is not None else None for row in rows]
        known = [(n, e) for n, e in zip(counts, errors, strict=True) if e is not None]
        right.plot(*zip(*known, strict=True), marker, ls="-", label=name)
    left.axhline(90, color="grey", lw=0.8, ls=":")
    left.annotate("the paper's claim at n = 16", (64, 90), va="bottom", ha="right", fontsize=8)
    left.set_ylabel("starts that reach the goal (%)")
    right.set_ylabel("mean value error over mean value (%)")
    for axes in (left, right):
        axes.set_xscale("symlog", base=2, linthresh=1)
        axes.set_xlabel("trajectories n")
        axes.grid(alpha=0.3)
    left.set_ylim(0, 100)
    right.set_ylim(bottom=0)
    right.legend(frameon=False)
    save(figure, out / "faithful.png")
