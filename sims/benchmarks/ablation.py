"""What each part of the main method buys, learning above all: it without the part, same problems.

`adapt` is network, exact trajectories with their tubes, a grid, and second guesses: where the
grid's loop is cheaper the exact trajectory is sought beside it too. The rivals without learning are
a grid alone, and a grid with exact trajectories beside its own loops and the same tubes.
"""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.adaptation.motions import solved_grid
from learning.conditioned.tube import TubePolicy, Tubes
from learning.meta_planner import MetaPlanner
from ocp.extremals.extremal import find_extremal
from ocp.planning import iterations, never
from ocp.query import Query
from ocp.value import Policy
from sims.benchmarks import Report
from sims.benchmarks.learning import Solver, compare, eikonal, kept, planned

QUERIES, STARTS = 40, 4


def run(seed: int, out: Path | None, queries: int = QUERIES, starts: int = STARTS) -> Report:
    """A table for both families; with `out` each query is kept as it is finished."""
    report = Report()
    parts = kept("ablation", seed, out)
    for name in ("paper", "general"):
        # Seeds after those of `learning` and `learning-curve`.
        compare(report, parts, name, variants(name), seed + 2, queries, starts)
    return report


def variants(network: str) -> dict[str, Solver]:
    """The main method with less and less of it, then what needs no learning."""
    whole = MetaPlanner.pretrained(network)
    single = MetaPlanner.pretrained(network, suspicion=np.inf)
    alone = MetaPlanner.pretrained(network, grids=False)
    return {
        "adapt, to its end": partial(planned, whole, never()),
        "without second guesses": partial(planned, single, never()),
        "without grids": partial(planned, alone, never()),
        "without tubes": partial(without_tubes, whole),
        "network alone": partial(planned, alone, iterations(0)),
        "no learning: grid of 4,500 nodes, tubes": partial(beside_grid, 4_500),
        "no learning: grid of 18,000 nodes, tubes": partial(beside_grid, 18_000),
        "no learning: grid of 60,000 nodes, tubes": partial(beside_grid, 60_000),
        "no learning: grid of 18,000 nodes": partial(eikonal, 18_000),
    }


def without_tubes(
    planner: MetaPlanner, query: Query, starts: list[NDArray[np.float64]]
) -> tuple[Policy, float]:
    """The base alone steers: network or grid, whichever has the better loops from all starts."""
    begun = time.perf_counter()
    state = planner.start(query, starts)
    while not state.finished:
        state = planner.refine(state)
    untracked = replace(state, extremals=(None,) * len(state.starts))
    return untracked.base.policy, time.perf_counter() - begun


def beside_grid(
    nodes: int, query: Query, starts: list[NDArray[np.float64]]
) -> tuple[Policy, float]:
    """Exact trajectories beside a grid's loops, on one core; its policy off their tubes."""
    begun = time.perf_counter()
    answer = solved_grid(query, np.array(starts), nodes)
    found = [
        find_extremal(query, start, motion)
        for start, motion in zip(starts, answer.motions, strict=True)
        if motion is not None
    ]
    solved = [extremal for extremal in found if extremal.trajectory is not None]
    policy = TubePolicy(Tubes.around(query, solved), answer.policy) if solved else answer.policy
    return policy, time.perf_counter() - begun
