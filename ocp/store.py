"""The value store: one zarr group a query, written whole or not at all, never silently wrong.

The folder is a zarr hierarchy that any zarr or xarray reads; see `store_schema.py` for an entry.
Several processes may write at the same time: an entry is made in a folder of its own and renamed,
and equal keys mean equal content. Every reading compares hashes first.
"""

import json
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ocp.execution import Door, Failure, InProcess, LocalProcesses, completed
from ocp.files import write_text
from ocp.grid import Grid, GridValue
from ocp.store_schema import (
    METADATA,
    SCHEMA,
    Entry,
    Order,
    Solved,
    StoreError,
    attributes,
    check_metadata,
    check_seal,
    order_of,
    seal,
)
from ocp.store_solvers import carry_out
from ocp.trajectory import SolveError, Status

KEY = re.compile(r"[0-9a-f]{32}")
PARTIAL = re.compile(r"\.partial-(?P<host>\w*)-(?P<pid>\d+)-\w*")


class Store:
    """A folder of entries."""

    def __init__(self, folder: str | os.PathLike[str], create: bool = True) -> None:
        """
        Args:
            folder: the store's; made if it does not exist and `create` is true.

        Raises:
            StoreError: if the folder holds something else, or another schema.
            OSError: if it cannot be read or made.
        """
        self.folder = Path(folder)
        root = self.folder / METADATA
        if root.is_file():
            self._check_root(root)
            return
        if self.folder.is_dir() and any(p.name != METADATA for p in self.folder.iterdir()):
            raise StoreError(f"{self.folder}: neither empty nor a store")
        if not create:
            raise StoreError(f"{self.folder}: there is no store")
        self.folder.mkdir(parents=True, exist_ok=True)
        table = {"zarr_format": 3, "node_type": "group", "attributes": {"zermelo_store": SCHEMA}}
        write_text(root, json.dumps(table, indent=2) + "\n")

    def _check_root(self, root: Path) -> None:
        try:
            schema = json.loads(root.read_text(encoding="utf-8"))["attributes"]["zermelo_store"]
        except (ValueError, KeyError, TypeError) as error:
            raise StoreError(f"{self.folder}: a zarr group, but no store of zermelo's") from error
        if schema != SCHEMA:
            made = "a newer" if isinstance(schema, int) and schema > SCHEMA else "another"
            raise StoreError(
                f"{self.folder}: written by {made} version (schema {schema!r}, this one reads "
                f"{SCHEMA}): read it with that version, or fill a new folder"
            )

    # Reading

    def __iter__(self) -> Iterator[str]:
        """The keys of all entries, sound or not, in order."""
        return iter(sorted(p.name for p in self.folder.iterdir() if KEY.fullmatch(p.name)))

    def __contains__(self, order: Order) -> bool:
        """Whether there is an entry; `verify` says whether it is sound."""
        return (self.folder / order.key).is_dir()

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def entries(self) -> Iterator[Entry]:
        """All entries, read one after another.

        Raises:
            StoreError: at an entry that is damaged.
        """
        return map(self.read, self)

    def get(self, order: Order) -> Entry | None:
        """The entry that answers `order`, if there is one.

        Raises:
            StoreError: if it is damaged.
        """
        return self.read(order.key) if order in self else None

    def read(self, key: str) -> Entry:
        """The entry of a key.

        Raises:
            StoreError: if there is none, or it is damaged in any way.
        """
        if not KEY.fullmatch(key):
            raise StoreError(f"key: must be 32 hexadecimal digits, got {key!r}")
        folder = self.folder / key
        if not folder.is_dir():
            raise StoreError(f"{self.folder}: no entry {key}")
        try:
            check_seal(folder)
            check_metadata(folder)
            entry = _read(folder)
        except StoreError as error:
            raise StoreError(f"{self.folder}: entry {key}: {error}") from error
        if entry.key != key:
            raise StoreError(f"{self.folder}: entry {key}: its content has the key {entry.key}")
        return entry

    def verify(self, key: str) -> str | None:
        """What is wrong with an entry; `None` if it is sound."""
        try:
            self.read(key)
        except StoreError as error:
            return str(error)
        return None

    # Writing

    def write(self, order: Order, solved: Solved) -> str:
        """Add an entry; returns its key. One that is there already is kept.

        Raises:
            OSError: if the disk is full or the folder read-only; the store is as before.
        """
        target = self.folder / order.key
        with self._partial() as partial:
            _write(partial / order.key, order, solved)
            seal(partial / order.key)
            self._place(partial / order.key, target)
        return order.key

    def remove(self, key: str) -> None:
        """Take an entry out: at once, so that nobody reads half of it."""
        with self._partial() as partial:
            (self.folder / key).rename(partial / key)

    def merge(self, other: "Store") -> "Merge":
        """Copy the entries of `other` that this store lacks; damaged ones are left and named.

        Raises:
            OSError: if the disk is full or the folder read-only; what was copied is whole.
        """
        merge = Merge()
        for key in other:
            if (self.folder / key).is_dir():
                merge.present.append(key)
            elif problem := other.verify(key):
                merge.damaged[key] = problem
            else:
                with self._partial() as partial:
                    shutil.copytree(other.folder / key, partial / key)
                    check_seal(partial / key)
                    self._place(partial / key, self.folder / key)
                merge.copied.append(key)
        return merge

    def sweep(self) -> int:
        """Remove what killed writers of this machine left behind; returns how many folders."""
        count = 0
        for path in self.folder.iterdir():
            found = PARTIAL.fullmatch(path.name)
            if found and found["host"] == _host() and not _lives(int(found["pid"])):
                shutil.rmtree(path, ignore_errors=True)
                count += 1
        return count

    @contextmanager
    def _partial(self) -> Iterator[Path]:
        """A folder of this process's own in the store, gone when the block ends."""
        prefix = f".partial-{_host()}-{os.getpid()}-"
        folder = tempfile.mkdtemp(dir=self.folder, prefix=prefix)
        try:
            yield Path(folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    @staticmethod
    def _place(made: Path, target: Path) -> None:
        try:
            made.rename(target)
        except OSError:
            if not target.is_dir():  # else another writer was first, with the same content
                raise


@dataclass
class Merge:
    """What became of the entries of the store that was merged in."""

    copied: list[str] = field(default_factory=list)
    present: list[str] = field(default_factory=list)
    damaged: dict[str, str] = field(default_factory=dict)


@dataclass
class Filling:
    """What became of the orders.

    Attributes:
        present: keys that were there already.
        computed: keys of new entries, solved or with the solver's own failure.
        unsolved: of these, the ones that hold the solver's own failure.
        replaced: keys of damaged entries that were computed anew, and what was wrong.
        failed: keys of orders without an entry: the task failed.
    """

    present: list[str] = field(default_factory=list)
    computed: list[str] = field(default_factory=list)
    unsolved: dict[str, Status] = field(default_factory=dict)
    replaced: dict[str, str] = field(default_factory=dict)
    failed: dict[str, Failure] = field(default_factory=dict)


def fill(
    store: Store,
    orders: Iterable[Order],
    door: Door | None = None,
    notify: Callable[[Filling], None] | None = None,
) -> Filling:
    """Compute what is missing from a store, through the execution door.

    Each answer is stored when it comes, so that an end at any moment loses only work in progress.
    Local workers write entries themselves; a cluster's send them, since they may have other disks.

    Args:
        store: where entries go.
        orders: what to have; equal ones count once.
        door: where to work; by default in this process.
        notify: told of the state after each order.

    Raises:
        OSError: if the disk is full or the folder read-only; what was stored is whole.
    """
    door = door or InProcess()
    filling = Filling()
    store.sweep()
    seen: set[str] = set()
    place = str(store.folder.resolve()) if isinstance(door, LocalProcesses) else None

    def missing() -> Iterator[tuple[Order, str | None]]:
        for order in orders:
            if order.key in seen:
                continue
            seen.add(order.key)
            if order in store:
                problem = store.verify(order.key)
                if problem is None:
                    filling.present.append(order.key)
                    continue
                store.remove(order.key)
                filling.replaced[order.key] = problem
            yield order, place

    for outcome in completed(door, fulfil, missing()):
        order = outcome.task[0]
        if outcome.failure is not None:
            filling.failed[order.key] = outcome.failure
        else:
            answer: Fulfilled = outcome.answer
            if answer.problem is not None:
                raise OSError(answer.problem)
            if not answer.stored:
                store.write(order, answer.solved)
            filling.computed.append(order.key)
            if answer.solved.status is not Status.SOLVED:
                filling.unsolved[order.key] = answer.solved.status
        if notify is not None:
            notify(filling)
    return filling


@dataclass(frozen=True)
class Fulfilled:
    """What a worker says of an order.

    Attributes:
        solved: the answer; without its arrays where the worker has stored it.
        stored: whether it has.
        problem: why it could not: the disk is full, or the folder read-only.
    """

    solved: Solved
    stored: bool = False
    problem: str | None = None


def fulfil(task: tuple[Order, str | None]) -> Fulfilled:
    """Carry out an order; store the answer if a folder is given, else return it."""
    order, folder = task
    if folder is None:
        return Fulfilled(carry_out(order))
    store = Store(folder, create=False)
    if order in store:  # done by a worker that died before it could say so
        return Fulfilled(replace(store.read(order.key).solved, arrays={}), stored=True)
    solved = carry_out(order)
    try:
        store.write(order, solved)
    except OSError as error:
        return Fulfilled(replace(solved, arrays={}), problem=str(error))
    return Fulfilled(replace(solved, arrays={}), stored=True)


def grid_value(entry: Entry) -> Any:
    """The value of an entry of the solver "eikonal": a `QueryValue`.

    Raises:
        SolveError: with the entry's status if it holds no value.
        StoreError: if the entry is of another kind.
    """
    from ocp.eikonal import QueryValue

    if entry.solved.status is not Status.SOLVED:
        raise SolveError(entry.solved.status, str(entry.solved.detail.get("why", "")))
    values, detail = entry.array("value"), entry.solved.detail
    axes = ("lower", "upper", "shape", "periodic")
    grid = Grid(*(tuple(detail[name]) for name in axes))
    return QueryValue(entry.query, GridValue(grid, values))


def _write(folder: Path, order: Order, solved: Solved) -> None:
    import xarray

    data = xarray.Dataset(
        {name: (axes, np.asarray(array)) for name, (axes, array) in solved.arrays.items()},
        attrs=attributes(order, solved),
    )
    chunks = {name: {"chunks": a.shape} for name, (_, a) in solved.arrays.items() if a.ndim}
    data.to_zarr(folder, mode="w-", zarr_format=3, consolidated=False, encoding=chunks)


def _read(folder: Path) -> Entry:
    """Raises StoreError if the group is not one of this schema."""
    import xarray

    try:
        with xarray.open_zarr(folder, zarr_format=3, consolidated=False, chunks=None) as data:
            table = data.attrs
            if table["schema"] != SCHEMA:
                raise StoreError(f"schema {table['schema']!r}, this version reads {SCHEMA}")
            arrays = {
                str(name): (tuple(map(str, a.dims)), a.to_numpy())
                for name, a in data.variables.items()
            }
            solved = Solved(
                arrays,
                Status[table["status"]],
                table["error_estimate"],
                table["seconds"],
                json.loads(table["detail"]),
            )
            return Entry(order_of(table), solved)
    except StoreError:
        raise
    except (KeyError, TypeError, ValueError, OSError, RuntimeError) as error:
        raise StoreError(f"not an entry of this schema: {error!r}") from error


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
