"""Executors: speed-up of two workers, what a door costs a task, worker deaths survived."""

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ocp.execution import Door, completed, open_door
from ocp.query_family import PAPER_FAMILY
from ocp.store import Store, fill
from ocp.store_solvers import carry_out, order
from sims.benchmarks import Report

SOLVES, NODES = 48, 60_000
TRIFLES = 500
DEATHS = 10
PRELOAD = ("ocp.store_solvers", "ocp.eikonal", "xarray", "zarr")
notes = Console(stderr=True)


def run(seed: int, _out: Path | None) -> Report:
    """In this process, two local workers, and two Dask workers behind a scheduler on loopback."""
    rng = np.random.default_rng(seed)
    orders = [
        order(PAPER_FAMILY.sample(rng), "eikonal", {"nodes": NODES, "estimate": False})
        for _ in range(SOLVES)
    ]
    rows = []
    with _cluster(2) as address:
        doors: dict[str, Any] = {
            "in this process": {},
            "1 local worker": {"workers": 1, "preload": PRELOAD},
            "2 local workers": {"workers": 2, "preload": PRELOAD},
            "Dask, 2 workers": {"cluster": address},
        }
        for name, options in doors.items():
            with notes.status(name), open_door(**options) as door:
                rows.append({"door": name, **_timed(door, orders)})
    alone = rows[0]
    for row in rows:
        row["speed_up"] = alone["grids_s"] / row["grids_s"]
        row["overhead_s"] = row["trifle_s"] - alone["trifle_s"]
    report = Report({"doors": rows})
    table = Table(title=f"{SOLVES} grids of {NODES:,} nodes, sent back; {TRIFLES} tasks of nothing")
    for column in ("door", "grids/s", "speed-up", "added per task, ms"):
        table.add_column(column, justify="left" if column == "door" else "right")
    for row in rows:
        table.add_row(
            row["door"],
            f"{SOLVES / row['grids_s']:.1f}",
            f"{row['speed_up']:.2f}",
            f"{1e3 * row['overhead_s']:.3f}",
        )
    report.tables.append(table)
    _deaths(report, seed)
    return report


def _timed(door: Door, orders: list[Any]) -> dict[str, float]:
    for _ in completed(door, carry_out, orders[:4]):  # every worker finds its tables loaded
        pass
    begun = time.perf_counter()
    outcomes = list(completed(door, carry_out, orders))
    grids = time.perf_counter() - begun
    if failed := [o.failure for o in outcomes if o.failure]:
        raise RuntimeError(f"{len(failed)} tasks failed, the first: {failed[0]}")
    begun = time.perf_counter()
    for _ in completed(door, abs, range(TRIFLES)):
        pass
    return {"grids_s": grids, "trifle_s": (time.perf_counter() - begun) / TRIFLES}


def _deaths(report: Report, seed: int) -> None:
    """Workers killed again and again while they fill a store."""
    rng = np.random.default_rng(seed)
    orders = [order(PAPER_FAMILY.sample(rng), "eikonal", {"nodes": 9000}) for _ in range(100)]
    with tempfile.TemporaryDirectory() as folder, open_door(2, preload=PRELOAD) as door:
        store = Store(Path(folder) / "store")
        killed: list[int] = []

        def notify(filling: Any) -> None:
            if len(killed) < DEATHS and len(filling.computed) > 8 * len(killed):
                victim = door.submit(os.getpid).result()
                os.kill(victim, signal.SIGKILL)
                killed.append(victim)

        filling = fill(store, orders, door, notify)
        damaged = sum(store.verify(key) is not None for key in store)
    figures = {
        "workers killed": len(killed),
        "orders": len(orders),
        "computed": len(filling.computed),
        "failed": len(filling.failed),
        "damaged": damaged,
    }
    report.figures["deaths"] = figures
    table = Table(title="A store filled while its workers are killed")
    for name in figures:
        table.add_column(name, justify="right")
    table.add_row(*map(str, figures.values()))
    report.tables.append(table)


@contextmanager
def _cluster(workers: int) -> Iterator[str]:
    """The address of a Dask scheduler on loopback, with worker processes of one thread."""
    from distributed import LocalCluster

    options: dict[str, Any] = {"dashboard_address": None, "memory_limit": None}
    made: Any = LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, host="127.0.0.1", **options
    )
    with made as cluster:
        yield cluster.scheduler_address
