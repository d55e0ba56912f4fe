"""RRT-Q^X: unknown dynamics among obstacles that come into view, filmed."""

from importlib import resources
from pathlib import Path

from rich.table import Table

from sims.demos import Demonstration

SCENARIO = "figure-2"


def run(seed: int, out: Path | None) -> Demonstration:
    """The paper's field of obstacles; pictures, a GIF and a Meshcat replay go to `out`."""
    from sims.navigation.navigate import document
    from sims.navigation.navigate import run as navigate
    from sims.navigation.scenario_file import Scenario

    scenario = Scenario.load(str(resources.files("sims") / "scenarios" / f"{SCENARIO}.toml"))
    runs = navigate(scenario, "q-learning", seed, record=out is not None)
    report = document(runs)
    table = Table(title=f"{SCENARIO}: a robot that learns to drive, then finds its way")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for key in ("reached", "collided", "duration_s", "length_m", "min_clearance_m", "legs"):
        value = report[key]
        table.add_row(key, f"{value:.4g}" if isinstance(value, float) else str(value))
    table.add_row("replans", str(len(report["replans"])))
    if out is not None:
        from sims.navigation.figure import save_pictures

        save_pictures(scenario, runs, out)
    return Demonstration(report, [table], report["reached"] and not report["collided"])
