"""Scripted demos, one a capability and one a file; each leaves a figure."""

import importlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from ocp.files import write_text
from sims.exit_status import UNSOLVED, reading_input

if TYPE_CHECKING:
    from sims import cli

DEMOS: dict[str, str] = {
    "adaptation": "the meta planner on a fresh query: policy, value, error against the optimum",
    "brackets": "a certified gap: a bound below every motion, a motion above it",
    "drake-robot": "from SDF files: a cart-pole swung up, a quadrotor among obstacles, in Drake",
    "exact-classes": "several ways round the obstacles, each an extremal; one is the optimum",
    "four-queries": "the four queries of Xu and Zhu's Table I, the exact optimum beside",
    "navigation": "RRT-Q^X: a robot of unknown dynamics among obstacles that come into view",
    "regulation": "Q-learning without a model against exact Riccati, the printed law beside",
    "replanning": "RRT^X repairs its route while obstacles appear, move and vanish",
    "revealed-goals": "goals arrive while the robot drives; it waits for no policy",
}
"""Name of the module in this folder, and what it shows."""


@dataclass(frozen=True)
class Demonstration:
    """What a demo showed.

    Attributes:
        document: everything it found, for JSON.
        tables: the same for reading.
        succeeded: whether all that was asked was solved.
    """

    document: dict[str, Any]
    tables: list[Table] = field(default_factory=list)
    succeeded: bool = True


def run_demo(name: str, seed: int, out: Path | None) -> Demonstration:
    """Run one demo; pictures go to `out`."""
    return importlib.import_module(f"sims.demos.{name.replace('-', '_')}").run(seed, out)


def run(command: "cli.Demo") -> int:
    """Run the command; returns its exit status."""
    with reading_input():
        if command.name not in DEMOS:
            raise ValueError(f"demo: {command.name!r} is unknown; known are {', '.join(DEMOS)}")
    shown = run_demo(command.name, command.seed, command.out)
    document = {"demo": command.name, **shown.document}
    if command.json:
        print(json.dumps(document))
    else:
        for table in shown.tables:
            Console().print(table)
        if command.out is not None:
            Console(stderr=True).print(f"pictures and data: {command.out}")
    if command.out is not None:
        write_text(command.out / f"{command.name}.json", json.dumps(document, indent=1) + "\n")
    return 0 if shown.succeeded else UNSOLVED
