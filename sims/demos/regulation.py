"""Q-learning of a plant nobody has a model of, the printed law and exact Riccati beside."""

from importlib import resources
from pathlib import Path
from typing import Any

from rich.table import Table

from sims.demos import Demonstration

SYSTEM = "rover"
LEARNERS = ("q-learning", "paper-literal", "paper-repaired")


def run(seed: int, out: Path | None) -> Demonstration:
    """Two seconds of data from the paper's rover, three laws, one exact gain."""
    from sims.regulation.regulate import HISTORY
    from sims.regulation.regulate import run as regulate
    from sims.regulation.system_file import SystemFile

    system = SystemFile.load(str(resources.files("sims") / "systems" / f"{SYSTEM}.toml"))
    results = {name: regulate(system, name, seed, HISTORY) for name in LEARNERS}
    table = Table(title=f"{SYSTEM}: {system.data_seconds:g} s of data, no model")
    for column in ("law", "gain error", "cost", "optimal cost", "excess", "converged"):
        table.add_column(column, justify="left" if column == "law" else "right")
    reports: dict[str, Any] = {}
    for name, result in results.items():
        report = reports[name] = result.report()
        table.add_row(
            name,
            _short(report["gain_error"], "{:.1e}"),
            _short(report["cost"], "{:.6g}"),
            _short(report["optimal_cost"], "{:.6g}"),
            _short(report["excess"], "{:.1e}"),
            "yes" if report["converged"] else "no",
        )
    if out is not None:
        from sims.pictures.plan_figure import save
        from sims.regulation.figure import draw_regulation

        save(draw_regulation(results["q-learning"]), out / "regulation.png")
    return Demonstration({"laws": reports}, [table], bool(reports["q-learning"]["converged"]))


def _short(number: float | None, form: str) -> str:
    return "-" if number is None else form.format(number)
