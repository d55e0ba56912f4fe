"""RRT-Q^X: random dynamic scenarios, the paper's rules and ours, crowds, several robots.

The whole takes some hours of one core; `python -m sims.navigation.study PART --scenarios N` less.
"""

from pathlib import Path
from typing import Any

from sims.benchmarks import Report
from sims.navigation.study import PARTS, Ledger, failures


def run(seed: int, out: Path | None) -> Report:  # noqa: ARG001 (scenarios have seeds of their own)
    """Every part of the study. Runs are kept in `out`/navigation.jsonl and not made twice."""
    ledger = Ledger(None if out is None else out / "navigation.jsonl")
    report = Report()
    for part, count in PARTS.values():
        report.tables += list(part(ledger, count))
    report.tables.append(failures(ledger))
    runs: dict[str, Any] = ledger.runs
    report.figures = {"runs": runs}
    return report
