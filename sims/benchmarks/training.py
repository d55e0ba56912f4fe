"""Training on several processes: steps a second with two against one.

Each run is a command of its own, as a user would give it, one thread a process, on the same data.
The time of a step is that between the first and the last checkpoint, so that start-up, sampling
and compilation do not count.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import tomli_w
from rich.console import Console
from rich.table import Table

from learning.conditioned.training import KIND, TrainingSettings
from learning.shipped import CONFIGS
from sims.benchmarks import Report
from sims.benchmarks.store import ZERMELO

CONFIG = CONFIGS / "paper.toml"
STEPS, CHECKPOINT = 240, 40
QUERIES, HELD_OUT = 12, 2
PROCESSES = (1, 2)
LONGEST = 600.0  # seconds of a run
notes = Console(stderr=True)


def run(seed: int, _out: Path | None) -> Report:
    """One row for each number of processes."""
    shipped = TrainingSettings.load(CONFIG)
    settings = replace(
        shipped,
        seed=seed,
        steps=STEPS,
        checkpoint_steps=CHECKPOINT,
        held_out=HELD_OUT,
        data=replace(shipped.data, queries=QUERIES),
    )
    rows = []
    with tempfile.TemporaryDirectory() as folder, notes.status("training") as status:
        config = Path(folder) / "bench.toml"
        config.write_text(tomli_w.dumps({"kind": KIND, **asdict(settings)}), encoding="utf-8")
        for processes in PROCESSES:
            status.update(f"training on {processes}")
            rows.append({"processes": processes, **_timed(config, Path(folder), processes)})
    table = Table(title=f"training, batch {settings.batch}, one thread a process")
    for column in ("processes", "ms a step", "speed-up", "loss of the last row"):
        table.add_column(column, justify="right")
    for row in rows:
        row["speed_up"] = rows[0]["step_s"] / row["step_s"]
        cells = f"{1e3 * row['step_s']:.1f}", f"{row['speed_up']:.2f}", f"{row['direction']:.4e}"
        table.add_row(str(row["processes"]), *cells)
    return Report({"batch": settings.batch, "rows": rows}, [table])


def _timed(config: Path, folder: Path, processes: int) -> dict[str, Any]:
    """Seconds a step of one run, and its last loss.

    Raises:
        RuntimeError: if the run failed.
    """
    launcher: tuple[str, ...] = ()
    if processes > 1:
        torchrun = (sys.executable, "-m", "torch.distributed.run")
        launcher = (*torchrun, "--nproc-per-node", str(processes), "--no-python")
    out = folder / str(processes)
    answer = subprocess.run(
        [*launcher, *ZERMELO, "train", str(config), "--out", str(out), "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST,
    )
    if answer.returncode != 0:
        raise RuntimeError(f"training on {processes} failed: {answer.stderr[-2000:]}")
    rows = json.loads((out / config.stem / "curve.json").read_text(encoding="utf-8"))["rows"]
    first, last = rows[0], rows[-1]
    return {"step_s": (last[1] - first[1]) / (last[0] - first[0]), "direction": last[2]}
