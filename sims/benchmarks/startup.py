"""Start-up: processor time and memory of `zermelo --help` and of each package's import."""

import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from rich.table import Table

from sims.benchmarks import Report

REPEATS = 5
PROGRAMS = {
    "zermelo --help": "import sys\nsys.argv = ['zermelo', '--help']\nfrom sims.cli import main\n"
    "try:\n    main()\nexcept SystemExit:\n    pass",
    "import ocp": "import ocp",
    "import ocp.eikonal": "import ocp.eikonal",
    "import ocp.pontryagin": "import ocp.pontryagin",
    "import ocp.store": "import ocp.store",
    "import planners": "import planners",
    "import learning": "import learning",
    "import sims": "import sims",
}
MEASURE = (
    "import json, resource, sys\n"
    "used = resource.getrusage(resource.RUSAGE_SELF)\n"
    "print(json.dumps([used.ru_utime + used.ru_stime, used.ru_maxrss]), file=sys.stderr)\n"
)


def run(_seed: int, _out: Path | None) -> Report:
    """Processor time, which other work on the machine hardly touches, and peak memory."""
    table = Table(title="Start-up, a fresh interpreter each, processor time")
    for column in ("program", "seconds", "peak MB"):
        table.add_column(column, justify="left" if column == "program" else "right")
    rows: dict[str, Any] = {}
    for name, program in PROGRAMS.items():
        seconds, kilobytes = zip(*(_measured(program) for _ in range(REPEATS)), strict=True)
        rows[name] = {"processor_s": statistics.median(seconds), "peak_MB": max(kilobytes) / 1e3}
        table.add_row(name, f"{rows[name]['processor_s']:.2f}", f"{rows[name]['peak_MB']:.0f}")
    return Report({"programs": rows}, [table])


def _measured(program: str) -> tuple[float, float]:
    """Processor seconds and peak kilobytes (Linux) of a program in an interpreter of its own."""
    answer = subprocess.run(
        [sys.executable, "-c", f"{program}\n{MEASURE}"], capture_output=True, text=True, check=True
    )
    seconds, kilobytes = json.loads(answer.stderr.strip().splitlines()[-1])
    return seconds, kilobytes
