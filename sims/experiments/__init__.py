"""The tables and figures of Xu and Zhu (RSS 2022), one experiment a file, run again.

An experiment measures in parts that are kept (parts.py), returns a document of plain data, and is
drawn and tabulated from that document alone. Its entries in the paper ledger (ledger.py) say what
the paper claims, what its own tables give when recomputed, and what was found.
"""

import importlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from sims.experiments.sheet import Sheet
from sims.parts import Parts

EXPERIMENTS: dict[str, str] = {
    "table1": "total costs from (-4, -4, -pi/4) to the four goals, every method",
    "table2": "time of every component",
    "table3": "set-valued method and exact trajectories, time and error per state",
    "fig1": "trajectories from the paper's six starts on the four queries",
    "fig2": "cost over the optimum against computation time, every method any time",
    "fig3": "time, success and value error against n on fresh queries; time against obstacles",
    "rrtqx-fig2": "RRT-Q^X among the paper's obstacles (the second paper's figure)",
}
"""Name of the module in this folder, and what it shows."""


@dataclass(frozen=True)
class Setting:
    """How an experiment is run.

    Attributes:
        quick: fewer starts, queries and repetitions, and no method that takes minutes.
        seed: of everything random.
        out: folder of the results.
    """

    quick: bool
    seed: int
    out: Path


@dataclass(frozen=True)
class Entry:
    """One line of the paper ledger.

    Attributes:
        where: of the paper, such as "Table I, MPC, goal (4, 4)".
        claim: what the paper says.
        recomputed: what its own tables give.
        ours: what was found here.
        optimum: the exact optimum, where that is the yardstick.
        remark: one sentence where they differ.
    """

    where: str
    claim: str
    recomputed: str = "-"
    ours: str = "absent"
    optimum: str = "-"
    remark: str = ""


@dataclass
class Findings:
    """What an experiment found.

    Attributes:
        document: plain data for JSON; tables and figures are made of it.
        sheets: its tables, the file's stem first.
    """

    document: dict[str, Any]
    sheets: dict[str, Sheet] = field(default_factory=dict)


class Experiment(Protocol):
    """What a module in this folder offers."""

    def run(self, setting: Setting, parts: Parts) -> Findings:
        """Measure, resuming from the parts that are there."""
        ...

    def draw(self, document: dict[str, Any], out: Path) -> list[Path]:
        """Write figures of what `run` found; none if there is nothing to draw."""
        ...

    def entries(self, document: dict[str, Any]) -> list[Entry]:
        """Lines of the paper ledger."""
        ...


def experiment(name: str) -> Experiment:
    """The experiment called `name`."""
    return importlib.import_module(f"sims.experiments.{name.replace('-', '_')}")  # pyright: ignore[reportReturnType]
