"""Soaks: the same thing very often. `python -m sims.benchmarks.soak kills --count 50`.

kills: SIGKILL at random moments of `store fill`, `train` and `reproduce`, again and again until a
run comes to its end; what it leaves is to equal, to the last bit, what an uninterrupted run leaves.
deadlines: calls with a deadline, and how late each was. brackets: certified brackets, and how many
contain the exact cost.
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from sims.benchmarks import Report, brackets, deadlines
from sims.benchmarks.store import ZERMELO, killed_fillings, wait_for_group

SLOWEST = 600.0
"""Seconds that an uninterrupted run may take."""
SMALL = """\
kind = "conditioned"
family = "paper"
steps = 200
batch = 128
warm_up = 20
held_out = 2
checkpoint_steps = 10
[data]
queries = 6
states = 100
nodes = 4000
[widths]
member = 8
trunk = 16
heads = 2
"""
"""A training run of seconds, with a checkpoint at every twentieth of it."""
notes = Console(stderr=True)

Result = Callable[[Path], dict[str, Any]]


@dataclass(frozen=True)
class Killed:
    """What became of runs that were killed at random moments.

    Attributes:
        kills: SIGKILLs that met a living process.
        gone_on: of these, how many came after the first traces of work.
        completed: runs that came to their end after kills.
        unequal: of these, whose results differ from those of an uninterrupted run.
        failed: runs that ended in an error, as none should.
    """

    kills: int
    gone_on: int
    completed: int
    unequal: int
    failed: int


def killed_runs(
    command: Callable[[Path], Sequence[str]], result: Result, kills: int, seed: int, work: Path
) -> Killed:
    """Kill a command until `kills` are reached, each time going on in the folder as it is.

    Args:
        command: that writes to a folder and goes on where it was.
        result: of a finished folder, without times.
        kills: wanted.
        seed: of the moments.
        work: an empty folder.

    Raises:
        RuntimeError: if the uninterrupted run fails.
    """
    rng = np.random.default_rng(seed)
    whole = work / "whole"
    whole.mkdir(parents=True)
    begun = time.perf_counter()
    answer = subprocess.run(
        command(whole), capture_output=True, text=True, check=False, timeout=SLOWEST
    )
    span = time.perf_counter() - begun
    if answer.returncode != 0:
        raise RuntimeError(f"the uninterrupted run failed: {answer.stderr[-2000:]}")
    wanted = result(whole)
    done = gone_on = completed = unequal = failed = 0
    while done < kills or completed == 0:
        folder = work / f"trial-{completed + failed}"
        folder.mkdir(exist_ok=True)
        run = subprocess.Popen(
            command(folder),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        begun = time.perf_counter()
        try:
            run.wait(float(rng.uniform(0.0, span)) if done < kills else SLOWEST)
        except subprocess.TimeoutExpired:
            run.send_signal(signal.SIGKILL)
            run.wait()
            wait_for_group(run.pid)
            done += 1
            gone_on += any(path.is_file() for path in folder.rglob("*"))
            continue
        if run.returncode != 0:
            failed += 1
            if failed > 3:
                break
            continue
        completed += 1
        span = min(span, time.perf_counter() - begun)  # the first run may have compiled
        unequal += result(folder) != wanted
    return Killed(done, gone_on, completed, unequal, failed)


def without_times(value: Any) -> Any:
    """A document without its entries that are times."""
    if isinstance(value, dict):
        kept = {k: v for k, v in value.items() if not _is_time(k)}
        return {k: without_times(v) for k, v in kept.items()}
    return [without_times(v) for v in value] if isinstance(value, list) else value


def _is_time(name: str) -> bool:
    return name.endswith("_s") or "seconds" in name or name in ("time", "machine")


def _train(folder: Path) -> list[str]:
    config = folder.parent / "small.toml"
    config.write_text(SMALL, encoding="utf-8")
    return [*ZERMELO, "train", str(config), "--out", str(folder)]


def _trained(folder: Path) -> dict[str, Any]:
    """Weights, data and curve."""
    inner = folder / "small"
    curve = json.loads((inner / "curve.json").read_text(encoding="utf-8"))
    kept = [k for k, name in enumerate(curve["columns"]) if name != "seconds"]
    (data,) = inner.glob("data-*.npz")
    with np.load(data, allow_pickle=False) as file:
        arrays = {name: (array.dtype.str, array.tobytes()) for name, array in file.items()}
    return {
        "weights": (inner / "weights.safetensors").read_bytes(),
        "curve": [[row[k] for k in kept] for row in curve["rows"]],
        "data": arrays,
    }


def _reproduce(folder: Path) -> list[str]:
    return [*ZERMELO, "reproduce", "fig1", "--quick", "--out", str(folder)]


def _reproduced(folder: Path) -> dict[str, Any]:
    """The experiment's document and all parts."""
    paths = [folder / "fig1.json", *sorted((folder / "parts").glob("*.json"))]
    return {
        path.name: without_times(json.loads(path.read_text(encoding="utf-8"))) for path in paths
    }


def kills(seed: int, count: int) -> Report:
    """A third of the kills each for data, training and an experiment."""
    share = -(-count // 3)
    rows: dict[str, dict[str, int]] = {}
    with tempfile.TemporaryDirectory() as made:
        work = Path(made)
        found = killed_runs(_train, _trained, share, seed, work / "train")
        rows["train"] = asdict(found)
        notes.print(rows)
        found = killed_runs(_reproduce, _reproduced, share, seed, work / "reproduce")
        rows["reproduce fig1"] = asdict(found)
        notes.print(rows)
        filled = killed_fillings(work / "store", count - 2 * share, seed, 24 * share, 3000)
        rows["store fill"] = asdict(filled)
    tables = []
    for name, row in rows.items():
        table = Table(title=f"zermelo {name}, killed at random moments")
        for column in row:
            table.add_column(column.replace("_", " "), justify="right")
        table.add_row(*(f"{number:,}" for number in row.values()))
        tables.append(table)
    return Report({"kills": rows}, tables)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; prints one JSON document on standard output, tables on standard error."""
    parser = argparse.ArgumentParser(prog="python -m sims.benchmarks.soak", description=__doc__)
    parser.add_argument("name", choices=("kills", "deadlines", "brackets"))
    parser.add_argument("--count", type=int, required=True, help="kills, calls or brackets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--starts", type=int, default=brackets.STARTS, help="brackets a query")
    asked = parser.parse_args(arguments)
    if asked.count < 3:
        parser.error(f"count: must be at least 3, got {asked.count}")
    if asked.starts < 1:
        parser.error(f"starts: must be at least 1, got {asked.starts}")
    if asked.name == "kills":
        report = kills(asked.seed, asked.count)
    elif asked.name == "deadlines":
        report = deadlines.run(asked.seed, None, asked.count)
    else:
        report = brackets.run(asked.seed, None, -(-asked.count // asked.starts), asked.starts)
    for table in report.tables:
        Console(stderr=True, width=118).print(table)
    print(json.dumps(report.figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
