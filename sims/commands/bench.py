"""`zermelo bench`: run benchmarks and print what they measured."""

import json
from typing import TYPE_CHECKING, Any

from rich.console import Console

from ocp.files import write_text
from sims.benchmarks import BENCHMARKS, machine, run_benchmark
from sims.commands.bench_compare import load, moves, reference_seconds, table
from sims.exit_status import reading_input

if TYPE_CHECKING:
    from sims import cli

WIDTH = 118
"""Columns a table may fill at least: cut headings tell nobody what was measured."""


def run(command: "cli.Bench") -> int:
    """Run the command; returns its exit status."""
    names = command.names or tuple(BENCHMARKS)
    with reading_input():
        for name in names:
            if name not in BENCHMARKS:
                raise ValueError(f"bench: {name!r} is unknown; known are {', '.join(BENCHMARKS)}")
        before = None if command.compare is None else load(command.compare)
    document: dict[str, Any] = {
        "machine": machine(),
        "reference_s": reference_seconds(),
        "seed": command.seed,
        "benchmarks": {},
    }
    for name in names:
        report = run_benchmark(name, command.seed, command.out)
        document["benchmarks"][name] = report.figures
        for shown in report.tables:
            width = max(Console().width, WIDTH)
            Console(stderr=command.json, width=width).print(shown)
    if before is not None and command.compare is not None:
        found = moves(before, document)
        document["moved"] = [vars(move) for move in found]
        console = Console(stderr=command.json)
        console.print(table(found, command.compare), width=max(console.width, WIDTH))
    if command.json:
        print(json.dumps(document))
    if command.out is not None:
        write_text(command.out / "bench.json", json.dumps(document, indent=1) + "\n")
    return 0
