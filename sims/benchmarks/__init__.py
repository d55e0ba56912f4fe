"""Benchmarks by name: what `zermelo bench` runs. Each returns a document and tables."""

import importlib
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table

BENCHMARKS: dict[str, str] = {
    "ablation": "what each part of adapt buys, and what a grid does without learning",
    "brackets": "certified brackets of the optimal cost: how many hold, how wide they are",
    "causality-free": "values learned from exact trajectories alone, in five and six dimensions",
    "deadlines": "how late plans are ready against their deadline, over 10,000 calls",
    "exact": "exact costs, closed form, success and time of exact trajectories",
    "execution": "speed-up of two workers, what Dask adds a task, worker deaths survived",
    "faithful": "the paper's meta value learning, as printed and repaired, on fresh queries",
    "grids": "eikonal and set-valued grids: time, value error, closed-loop excess",
    "headline": "every headline time in one run: median, spread, ratio to a reference; memory",
    "lqr": "analytic LQR: Riccati, matrix exponential, collocation and PMP",
    "mpc": "the receding horizon's quadratic cost at the end: what its weight does",
    "navigation": "RRT-Q^X: random dynamic scenarios, rules, crowds, several robots (hours)",
    "orders": "orders of convergence of the grid schemes, on and off the axis",
    "reaction": "how soon adapt's plan is ready, three families, 1, 8 and 20 starts",
    "refmm": "ReFMM: orders, refined against uniform meshes, repair against a new solve",
    "regulation-values": "V of pendulum and cart-pole by grid, PMP, collocation, network; maps",
    "robots": "robots from SDF and URDF: evaluation and transcription, against Drake",
    "robustness": "closed loops under model error, noise, delay and saturation, every method",
    "rrtx": "RRT^X: repair after changes, against growth from scratch, OMPL and the optimum",
    "startup": "processor time and memory of zermelo --help and of each package's import",
    "store": "value store: time and bytes an entry, kills survived",
    "training": "training on two processes against one: time of a step",
    "learning": "adapt on fresh queries of three families against exact costs",
    "learning-curve": "excess and success against time, every method on the same problems",
}
"""Name of the module in this folder, and what it measures."""


@dataclass
class Report:
    """What a benchmark found.

    Attributes:
        figures: everything measured, for JSON.
        tables: the same for reading.
    """

    figures: dict[str, Any] = field(default_factory=dict)
    tables: list["Table"] = field(default_factory=list)


def run_benchmark(name: str, seed: int, out: Path | None) -> Report:
    """Run one benchmark; pictures go to `out`."""
    return importlib.import_module(f"sims.benchmarks.{name.replace('-', '_')}").run(seed, out)


def median_seconds(task: Callable[[], Any], repeats: int = 5) -> float:
    """Median wall time of `task` after one run that is not counted."""
    task()
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        task()
        times.append(time.perf_counter() - begun)
    return statistics.median(times)


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    from importlib.metadata import version

    return {
        "processor": platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "numba", "casadi", "drake")},
    }
