"""`zermelo store`: look into a value store, check it, merge others into it, export it, fill it."""

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from ocp.execution import open_door
from ocp.files import atomic_path, write_text
from ocp.query import Query
from ocp.query_family import PAPER_FAMILY
from ocp.query_file import query_from_dict
from ocp.store import Filling, Store, fill
from ocp.store_schema import Entry, Order, StoreError
from ocp.store_solvers import SOLVERS, order
from sims.exit_status import UNSOLVED, reading_input

if TYPE_CHECKING:
    from sims import cli

notes = Console(stderr=True)
WIDTH = 118
"""Columns that a table may fill at least."""
PRELOAD = ("ocp.store_solvers", "ocp.eikonal", "xarray", "zarr")


def run(command: "cli.Store") -> int:
    """Run the command; returns its exit status."""
    action = {"list": _list, "verify": _verify, "merge": _merge, "export": _export, "fill": _fill}
    with reading_input():
        if command.others and command.action not in ("merge", "fill"):
            raise ValueError(f"others: {command.action} takes one store only")
        store = Store(command.store, create=command.action in ("merge", "fill"))
    document, table, status = action[command.action](command, store)
    if command.json:
        print(json.dumps(document))
    else:
        console = Console()
        console.print(table, width=max(console.width, WIDTH))
    return status


Result = tuple[dict[str, Any], Any, int]


def summary(entry: Entry) -> dict[str, Any]:
    """An entry in one line."""
    return {
        "key": entry.key,
        "model": entry.order.query["model"],
        "goal": entry.query.reference[list(entry.query.system.position)].tolist(),
        "obstacles": len(entry.order.query.get("obstacle", ())),
        "solver": entry.order.solver,
        "settings": dict(entry.order.settings),
        "status": entry.solved.status.name,
        "error_estimate": entry.solved.error_estimate,
        "seconds": entry.solved.seconds,
        "code_version": entry.order.code_version,
    }


def _list(_command: "cli.Store", store: Store) -> Result:
    rows, damaged = [], {}
    for key in store:
        try:
            rows.append(summary(store.read(key)))
        except StoreError as error:
            damaged[key] = str(error)
    table = Table(title=f"{store.folder}: {len(rows)} entries")
    for column in ("key", "model", "goal", "obstacles", "solver", "status", "error", "code"):
        table.add_column(column, no_wrap=True)
    for row in rows:
        error = row["error_estimate"]
        table.add_row(
            row["key"][:12],
            row["model"],
            ", ".join(f"{x:.3g}" for x in row["goal"]),
            str(row["obstacles"]),
            row["solver"],
            row["status"],
            "-" if error is None else f"{error:.2%}",
            row["code_version"],
        )
    for problem in damaged.values():
        notes.print(f"damaged: {problem}")
    return {"entries": rows, "damaged": damaged}, table, 0


def _verify(_command: "cli.Store", store: Store) -> Result:
    keys = list(store)
    damaged = {key: why for key in keys if (why := store.verify(key)) is not None}
    text = f"{len(keys) - len(damaged)} of {len(keys)} entries are sound"
    for problem in damaged.values():
        notes.print(f"damaged: {problem}")
    return {"sound": len(keys) - len(damaged), "damaged": damaged}, text, UNSOLVED if damaged else 0


def _merge(command: "cli.Store", store: Store) -> Result:
    with reading_input():
        if not command.others:
            raise ValueError("others: give at least one store to merge in")
        others = [Store(path, create=False) for path in command.others]
        reports = {str(other.folder): store.merge(other) for other in others}
    document = {name: vars(report) for name, report in reports.items()}
    damaged = {k: why for r in reports.values() for k, why in r.damaged.items()}
    for problem in damaged.values():
        notes.print(f"left out: {problem}")
    copied = sum(len(r.copied) for r in reports.values())
    present = sum(len(r.present) for r in reports.values())
    text = f"{copied} entries copied, {present} were there already, {len(damaged)} damaged"
    return document, text, UNSOLVED if damaged else 0


def _export(command: "cli.Store", store: Store) -> Result:
    """Each entry as query file and arrays that need neither zarr nor this software."""
    out = command.out
    with reading_input():
        if out is None:
            raise ValueError("out: export needs a folder, --out DIR")
    assert out is not None
    rows, damaged = [], {}
    for key in store:
        try:
            entry = store.read(key)
        except StoreError as error:
            damaged[key] = str(error)
            notes.print(f"left out: {error}")
            continue
        rows.append(summary(entry))
        write_text(out / f"{key}.toml", query_from_dict(entry.order.query).dumps())
        arrays = {name: array for name, (_, array) in entry.solved.arrays.items()}
        with atomic_path(out / f"{key}.npz") as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]
    write_text(out / "index.json", json.dumps(rows, indent=1) + "\n")
    text = f"{len(rows)} entries exported to {out}"
    return {"entries": rows, "damaged": damaged}, text, UNSOLVED if damaged else 0


def _fill(command: "cli.Store", store: Store) -> Result:
    with reading_input():
        if command.solver not in SOLVERS:
            known = ", ".join(SOLVERS)
            raise ValueError(f"solver: {command.solver!r} is unknown; known are {known}")
        if command.count < 1 and not command.others:
            raise ValueError(f"count: must be at least 1, got {command.count}")
        queries = [Query.load(path) for path in command.others]
        settings = {} if command.nodes is None else {"nodes": command.nodes}
        order(
            queries[0] if queries else PAPER_FAMILY.sample(_rng(command)), command.solver, settings
        )
    total = len(queries) or command.count

    def orders() -> Iterator[Order]:
        rng = _rng(command)
        for k in range(total):
            query = queries[k] if queries else PAPER_FAMILY.sample(rng)
            yield order(query, command.solver, settings)

    with (
        reading_input(),
        open_door(command.workers, command.cluster, PRELOAD) as door,
        Progress(console=notes, transient=True) as progress,
    ):
        bar = progress.add_task(str(store.folder), total=total)

        def notify(filling: Filling) -> None:
            done = len(filling.present) + len(filling.computed) + len(filling.failed)
            progress.update(bar, completed=done)

        filling = fill(store, orders(), door, notify)
    failed = {key: f"{f.kind}: {f.message}" for key, f in filling.failed.items()}
    for key, why in failed.items():
        notes.print(f"failed: {key}: {why}")
    document = {
        "present": len(filling.present),
        "computed": len(filling.computed),
        "replaced": filling.replaced,
        "failed": failed,
        "unsolved": {key: status.name for key, status in filling.unsolved.items()},
    }
    text = (
        f"{len(filling.computed)} computed, {len(filling.present)} were there, "
        f"{len(filling.replaced)} damaged ones replaced, {len(failed)} failed"
    )
    return document, text, UNSOLVED if failed else 0


def _rng(command: "cli.Store") -> np.random.Generator:
    return np.random.default_rng(command.seed)
