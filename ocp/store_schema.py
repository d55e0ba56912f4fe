"""What a store's entry is: the order that names it, its attributes, its hashes.

An entry is a zarr group (format 3) that xarray reads. Its key is a digest of everything that can
change its numbers: query, solver, settings, the solver's source and this schema.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.query import Query
from ocp.query_file import query_from_dict, query_to_dict
from ocp.trajectory import Status

SCHEMA = 1
METADATA = "zarr.json"
CODECS = frozenset({"bytes", "zstd", "vlen-utf8", "crc32c"})
TYPES = frozenset({"float64", "int64", "bool"})


class StoreError(ValueError):
    """A store or an entry that cannot be trusted; the message says what is wrong and what helps."""


@dataclass(frozen=True)
class Order:
    """What an entry answers: plain data, fit to be sent to workers.

    Attributes:
        query: the tables of its query file.
        solver: a name in `ocp.store_solvers.SOLVERS`.
        settings: all of the solver's settings, defaults filled in.
        code_version: of the solver's sources.
    """

    query: Mapping[str, Any]
    solver: str
    settings: Mapping[str, Any]
    code_version: str

    @cached_property
    def key(self) -> str:
        """32 hexadecimal digits."""
        content = {
            "schema": SCHEMA,
            "query": self.query,
            "solver": self.solver,
            "settings": self.settings,
            "code_version": self.code_version,
        }
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(frozen=True)
class Solved:
    """A solver's answer.

    Attributes:
        arrays: named; each with the names of its axes.
        status: how the solve ended; without success there may be no arrays.
        error_estimate: typical relative error of the values; `None` if unknown.
        seconds: processor time of the solve.
        detail: numbers and texts of the solver's own, for JSON.
    """

    arrays: Mapping[str, tuple[tuple[str, ...], NDArray[Any]]]
    status: Status = Status.SOLVED
    error_estimate: float | None = None
    seconds: float = 0.0
    detail: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Entry:
    """An entry read back, its hashes checked."""

    order: Order
    solved: Solved

    @property
    def key(self) -> str:
        return self.order.key

    @cached_property
    def query(self) -> Query:
        return query_from_dict(self.order.query)

    def array(self, name: str) -> NDArray[Any]:
        """One of the arrays.

        Raises:
            StoreError: if the entry has none of that name.
        """
        if name not in self.solved.arrays:
            known = ", ".join(self.solved.arrays) or "none"
            raise StoreError(f"entry {self.key}: no array {name!r}; it has {known}")
        return self.solved.arrays[name][1]


def plain_query(query: Query) -> dict[str, Any]:
    """A query's tables with numbers in one spelling, so that equal queries have equal keys.

    Raises:
        ValueError: if the model is a `System` of one's own.
    """
    return json.loads(json.dumps(query_to_dict(query_from_dict(query_to_dict(query)))))


def attributes(order: Order, solved: Solved) -> dict[str, Any]:
    """The attributes of an entry's group: plain JSON."""
    return {
        "schema": SCHEMA,
        "model": order.query["model"],
        "query": json.dumps(order.query, sort_keys=True),
        "solver": order.solver,
        "settings": json.dumps(order.settings, sort_keys=True),
        "code_version": order.code_version,
        "status": solved.status.name,
        "error_estimate": solved.error_estimate,
        "seconds": solved.seconds,
        "detail": json.dumps(solved.detail, sort_keys=True),
    }


def order_of(attributes: Mapping[str, Any]) -> Order:
    """The order that an entry's attributes name."""
    return Order(
        json.loads(attributes["query"]),
        attributes["solver"],
        json.loads(attributes["settings"]),
        attributes["code_version"],
    )


def seal(folder: Path) -> None:
    """Note the SHA-256 of every file of an entry, and of its attributes, in its attributes."""
    path = folder / METADATA
    table = json.loads(path.read_text(encoding="utf-8"))
    table["attributes"]["files"] = json.dumps(_hashes(folder))
    table["attributes"]["digest"] = _digest(table)
    path.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")


def check_seal(folder: Path) -> None:
    """Compare every file of an entry with its hash.

    Raises:
        StoreError: naming the first file that is changed, missing or foreign.
    """
    try:
        table = json.loads((folder / METADATA).read_text(encoding="utf-8"))
        written = table["attributes"].pop("digest")
        expected = json.loads(table["attributes"]["files"])
        digest = _digest(table)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise StoreError(f"{METADATA} is damaged: {error!r}") from error
    if digest != written or not isinstance(expected, dict):
        raise StoreError(f"{METADATA} was changed: its hash differs")
    for name, found in _hashes(folder).items():
        if name not in expected:
            raise StoreError(f"{name} is not among the entry's files")
        if found != expected.pop(name):
            raise StoreError(f"{name} was changed: its hash differs")
    if expected:
        raise StoreError(f"{min(expected)} is missing")


def _hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every file but the group's own metadata."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            raise StoreError(f"{name} is a link: an entry holds its own data")
        if path.is_file() and name != METADATA:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def _digest(table: Mapping[str, Any]) -> str:
    """SHA-256 of metadata without its own digest, in one spelling."""
    text = json.dumps(table, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def check_metadata(folder: Path) -> None:
    """Refuse what a store never writes: other formats, codecs that could run code, odd types.

    Raises:
        StoreError: naming the file and what was found.
    """
    for path in sorted(folder.rglob(METADATA)):
        name = path.relative_to(folder).as_posix()
        try:
            table = json.loads(path.read_text(encoding="utf-8"))
            codecs = {codec["name"] for codec in table.get("codecs", [])}
            kind = table.get("data_type", "float64")
            version = table["zarr_format"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StoreError(f"{name} is no zarr metadata") from error
        if version != 3:
            raise StoreError(f"{name}: zarr format must be 3, got {version}")
        if codecs - CODECS:
            raise StoreError(f"{name}: codec {min(codecs - CODECS)} is not one of this schema")
        if kind not in TYPES:
            raise StoreError(f"{name}: data type {kind!r} is not one of this schema")


def finite_or_none(number: float) -> float | None:
    """A number for JSON."""
    return float(number) if np.isfinite(number) else None
