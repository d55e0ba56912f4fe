"""The command `zermelo navigate`: `sims.navigation.navigate` at the terminal."""

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ocp.files import write_text
from sims.exit_status import UNSOLVED, reading_input

if TYPE_CHECKING:
    from sims import cli
    from sims.navigation.navigate import Navigation


def run(command: "cli.Navigate") -> int:
    """Run the command; returns its exit status: 3 if a robot collided or did not arrive."""
    from sims.navigation.controllers import CONTROLLERS
    from sims.navigation.navigate import document, run
    from sims.navigation.scenario_file import Scenario

    with reading_input():
        if command.controller not in CONTROLLERS:
            known = ", ".join(CONTROLLERS)
            raise ValueError(f"controller: {command.controller!r} is unknown; known are {known}")
        scenario = Scenario.load(command.scenario)
    runs = run(scenario, command.controller, command.seed, record=command.out is not None)
    report = document(runs)
    if command.json:
        print(json.dumps(report))
    else:
        Console().print(_table(command.scenario.stem, report, runs))
    if command.out is not None:
        from sims.navigation.figure import save_pictures

        write_text(command.out / "navigate.json", json.dumps(report, indent=1) + "\n")
        save_pictures(scenario, runs, command.out)
        Console(stderr=True).print(f"pictures and data: {command.out}")
    return 0 if report["reached"] and not report["collided"] else UNSOLVED


def _table(name: str, report: dict[str, Any], runs: "list[Navigation]") -> Table:
    table = Table(title=f"{name}: {runs[0].controller}")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for key, value in report.items():
        if key == "robots":
            continue
        if key == "replans":
            value = len(value)
        shown = "-" if value is None else f"{value:.4g}" if isinstance(value, float) else value
        table.add_row(key.replace("_", " "), str(shown))
    latencies = 1e3 * np.concatenate([r.latencies for r in runs])
    middle, high, worst = np.percentile(latencies, [50, 99, 100])
    period = 1e3 * runs[0].sample_period
    table.add_row(
        "latency a step, ms",
        f"{middle:.1f} median, {high:.1f} at 99 %, {worst:.1f} worst, {period:g} allowed",
    )
    table.add_row("real-time factor", f"{runs[0].fine_times[-1] / runs[0].wall_seconds:.2f}")
    for number, r in enumerate(runs):
        if not r.reached:
            who = f"robot {number}: " if len(runs) > 1 else ""
            table.add_row("not arrived", who + r.failure)
    return table
