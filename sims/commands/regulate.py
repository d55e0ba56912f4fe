"""The command `zermelo regulate`: `sims.regulation.regulate` at the terminal."""

import json
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from sims.exit_status import UNSOLVED, reading_input

if TYPE_CHECKING:
    from sims import cli


def run(command: "cli.Regulate") -> int:
    """Run the command; returns its exit status: 3 if the learner did not converge."""
    from sims.regulation.regulate import LEARNERS, regulate
    from sims.regulation.system_file import SystemFile

    with reading_input():
        if command.learner not in LEARNERS:
            known = ", ".join(LEARNERS)
            raise ValueError(f"learner: {command.learner!r} is unknown; known are {known}")
        SystemFile.load(command.system)
    document = regulate(command.system, command.learner, command.seed, command.out)
    if command.json:
        print(json.dumps(document))
    else:
        Console().print(_table(command.system.stem, document))
        if command.out is not None:
            Console(stderr=True).print(f"picture and data: {command.out}")
    return 0 if document["converged"] else UNSOLVED


def _table(name: str, document: dict[str, Any]) -> Table:
    table = Table(title=f"{name}: {document['learner']}")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for key, value in document.items():
        if key != "learner":
            shown = "-" if value is None else f"{value:.6g}" if isinstance(value, float) else value
            table.add_row(key.replace("_", " "), str(shown))
    return table
