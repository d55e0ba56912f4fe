"""The value store: time and bytes an entry, and kills survived while it is filled."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from ocp.query_family import PAPER_FAMILY
from ocp.store import Store
from ocp.store_solvers import carry_out, order
from sims.benchmarks import Report

KILLS = 50
SIZES = (9_000, 60_000, 480_000)
REPEATS = 7
ZERMELO = (sys.executable, "-c", "from sims.cli import main; main()")
"""The command, whatever the path says."""
notes = Console(stderr=True)


@dataclass(frozen=True)
class Kills:
    """What became of a filling that was killed again and again.

    Attributes:
        kills: SIGKILLs sent to the run, with its workers ending after it.
        in_the_work: of these, how many came when entries were being made, not at start-up.
        damaged: entries on disk that did not verify after a kill.
        lost: entries that were there after a kill and are not at the end.
        entries: at the end.
        partial: unfinished folders that kills left, swept by the next run.
    """

    kills: int
    in_the_work: int
    damaged: int
    lost: int
    entries: int
    partial: int


def run(seed: int, _out: Path | None) -> Report:
    """Entries of three sizes; then `KILLS` kills."""
    report = Report()
    rng = np.random.default_rng(seed)
    table = Table(title="An entry of the value store, processor time")
    for column in ("nodes", "solve, ms", "write, ms", "read and check, ms", "kB on disk"):
        table.add_column(column, justify="right")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for nodes in SIZES:
            rows.append(_entry(Path(folder) / str(nodes), rng, nodes))
            table.add_row(
                f"{nodes:,}",
                *(f"{1e3 * rows[-1][name]:.1f}" for name in ("solve_s", "write_s", "read_s")),
                f"{rows[-1]['bytes'] / 1e3:.0f}",
            )
    report.figures["entries"] = rows
    report.tables.append(table)
    with tempfile.TemporaryDirectory() as folder:
        kills = killed_fillings(Path(folder) / "store", KILLS, seed, count=40 * KILLS, nodes=3000)
    report.figures["kills"] = asdict(kills)
    table = Table(title="A store filled by two workers, killed at random moments")
    for name, value in asdict(kills).items():
        table.add_column(name.replace("_", " "), justify="right")
        del value
    table.add_row(*(f"{v:,}" for v in asdict(kills).values()))
    report.tables.append(table)
    return report


def _entry(folder: Path, rng: np.random.Generator, nodes: int) -> dict[str, float]:
    store = Store(folder)
    times: dict[str, list[float]] = {"solve_s": [], "write_s": [], "read_s": []}
    sizes = []
    for _ in range(REPEATS):
        asked = order(PAPER_FAMILY.sample(rng), "eikonal", {"nodes": nodes, "estimate": False})
        marks = [time.process_time()]
        solved = carry_out(asked)
        marks.append(time.process_time())
        key = store.write(asked, solved)
        marks.append(time.process_time())
        store.read(key)
        marks.append(time.process_time())
        for name, spent in zip(times, np.diff(marks), strict=True):
            times[name].append(float(spent))
        sizes.append(sum(p.stat().st_size for p in (folder / key).rglob("*") if p.is_file()))
    medians = {name: float(np.median(spent)) for name, spent in times.items()}
    return {"nodes": nodes, **medians, "bytes": float(np.median(sizes))}


def killed_fillings(folder: Path, kills: int, seed: int, count: int, nodes: int) -> Kills:
    """Fill a store of `count` entries, killing the run `kills` times at random moments.

    Each run is let live until a random number of new entries, and a random part of one, are made;
    some are killed during start-up. After each kill all entries are checked; at last a run is let
    finish.
    """
    rng = np.random.default_rng(seed)
    command = [*ZERMELO, "store", "fill", str(folder), "--json"]
    command += ["--count", str(count), "--nodes", str(nodes), "--workers", "2"]
    Store(folder)
    seen: set[str] = set()
    damaged = partial = in_the_work = 0
    with notes.status("kills") as status:
        for k in range(kills):
            status.update(f"kill {k + 1} of {kills}")
            run = subprocess.Popen(
                command,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            wanted = len(Store(folder)) + int(rng.integers(0, max(2, count // (kills + 1))))
            while run.poll() is None and len(Store(folder)) < min(wanted, count - 1):
                time.sleep(0.002)
            time.sleep(float(rng.uniform(0.0, 0.05)))
            if run.poll() is None:
                run.send_signal(signal.SIGKILL)
            run.wait()
            wait_for_group(run.pid)
            store = Store(folder)
            found = set(store)
            in_the_work += len(found - seen) > 0
            damaged += sum(store.verify(key) is not None for key in found - seen)
            partial += len(list(folder.glob(".partial-*")))
            seen |= found
        status.update("the last run")
        subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
    store = Store(folder)
    damaged += sum(store.verify(key) is not None for key in store)
    return Kills(kills, in_the_work, damaged, len(seen - set(store)), len(store), partial)


def wait_for_group(group: int) -> None:
    """Until the workers of a killed run have noticed that it is gone."""
    for _ in range(10_000):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.001)
    raise RuntimeError("workers of a killed run are still there after 10 s")
