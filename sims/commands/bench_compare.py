"""Two results of `zermelo bench` held against each other: what moved by more than noise.

Times are divided by a reference that each run measures itself (`reference_seconds`), so that a
slower or busier machine does not count as a change. Where a figure was repeated and its spread is
beside it, the spread makes the band of noise.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.table import Table

TIME_NOISE = 0.25
"""Part by which a time, over its run's reference, may differ without having moved."""
FIGURE_NOISE = 0.05
"""Likewise for every other figure."""
SPREAD = "spread"
"""Name of a figure that says how much those beside it vary when repeated, as a part of them."""
SPREADS = 3.0
"""A repeated figure has moved if it differs by more than so many times both spreads together."""
LEAST_NOISE = 0.05
"""But never for less than this."""
TINY = 1e-9
"""Figures of this size count as 0: a rounding error that doubles has not moved."""


@dataclass(frozen=True)
class Move:
    """A figure that differs by more than noise; `None` where one result lacks it."""

    name: str
    before: float | None
    after: float | None
    ratio: float | None


def reference_seconds(repeats: int = 30) -> float:
    """Least time of a fixed amount of plain Python work: the machine's pace, other work aside."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        plain_work()
        times.append(time.perf_counter() - begun)
    return min(times)


def plain_work() -> int:
    """A fixed amount of plain Python: some 10 ms of a 2020s core."""
    total = 0
    for k in range(200_000):
        total += k * k
    return total


def load(path: Path) -> dict[str, Any]:
    """A result of `zermelo bench --json` or `--out`.

    Raises:
        ValueError: if the file holds none.
        OSError: if it cannot be read.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        benchmarks = document["benchmarks"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"compare: {path} is no result of zermelo bench") from error
    if not isinstance(benchmarks, dict):
        raise ValueError(f"compare: {path} is no result of zermelo bench")
    return document


def moves(before: dict[str, Any], after: dict[str, Any]) -> list[Move]:
    """What moved, of the benchmarks that both results hold."""
    pace = 1.0
    if before.get("reference_s") and after.get("reference_s"):
        pace = after["reference_s"] / before["reference_s"]
    found = []
    for name in sorted(set(before["benchmarks"]) & set(after["benchmarks"])):
        old = dict(_figures(before["benchmarks"][name], name))
        new = dict(_figures(after["benchmarks"][name], name))
        for key in sorted(old.keys() | new.keys()):
            if key.rpartition(".")[2] == SPREAD:
                continue
            a, b = old.get(key), new.get(key)
            if a is None or b is None:
                found.append(Move(key, a, b, None))
                continue
            timed = _is_time(key)
            size_a, size_b = (a * pace, b) if timed else (a, b)
            noise = _noise(key, old, new) or (TIME_NOISE if timed else FIGURE_NOISE)
            largest = max(abs(size_a), abs(size_b))
            if largest > TINY and abs(size_a - size_b) > noise * largest:
                found.append(Move(key, a, b, size_b / size_a if size_a else None))
    return found


def _noise(key: str, old: dict[str, float], new: dict[str, float]) -> float | None:
    """From the spreads beside a figure, if both results have them."""
    beside = f"{key.rpartition('.')[0]}.{SPREAD}"
    if beside not in old or beside not in new:
        return None
    return max(LEAST_NOISE, SPREADS * (old[beside] + new[beside]))


def table(found: list[Move], file: Path) -> Table:
    """What moved, for the terminal."""
    result = Table(title=f"Moved by more than noise since {file}" if found else f"As in {file}")
    result.add_column("figure")
    for column in ("before", "after", "ratio, the machine's pace taken out"):
        result.add_column(column, justify="right")
    for move in found:
        numbers = (move.before, move.after, move.ratio)
        result.add_row(move.name, *("-" if x is None else f"{x:.4g}" for x in numbers))
    return result


def _is_time(name: str) -> bool:
    last = name.rpartition(".")[2]
    words = last.replace(",", " ").replace("_", " ").split()
    return bool({"s", "ms", "seconds", "us"} & set(words))


def _figures(table: Any, name: str) -> Iterator[tuple[str, float]]:
    """Every number in nested tables and lists, with its path."""
    if isinstance(table, dict):
        for key, value in table.items():
            yield from _figures(value, f"{name}.{key}")
    elif isinstance(table, list):
        for k, value in enumerate(table):
            yield from _figures(value, f"{name}.{k}")
    elif isinstance(table, int | float) and not isinstance(table, bool):
        yield name, float(table)
