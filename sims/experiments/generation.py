"""Data generation of Algorithm 2, lines 5 and 6: exact trajectories from random starts, by workers.

Each worker takes a start, finds a coarse value of the query for a first guess, and solves the
two-point boundary value problem; nothing is shared, so that time falls with the workers that the
machine has cores for.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from ocp.execution import Door, completed
from ocp.pontryagin import exact_trajectory
from ocp.query import Query
from ocp.query_file import query_from_dict, query_to_dict
from ocp.trajectory import SolveError

PRELOAD = ("sims.experiments.generation",)
SAMPLES = 32  # states of a trajectory, as in the paper: K_n = 32 n


def trajectory_cost(task: dict[str, Any]) -> float | None:
    """The cost of the exact trajectory of a query's table and a start, if there is one."""
    query = query_from_dict(task["query"])
    try:
        return exact_trajectory(query, np.array(task["start"])).cost
    except SolveError:
        return None


def generated(door: Door, query: Query, starts: Sequence[Any]) -> tuple[float, int]:
    """Seconds by the wall clock for the exact trajectories from `starts`, and how many failed."""
    table = query_to_dict(query)
    tasks = [{"query": table, "start": [float(x) for x in s]} for s in starts]
    begun = time.perf_counter()
    outcomes = list(completed(door, trajectory_cost, tasks))
    seconds = time.perf_counter() - begun
    return seconds, sum(o.answer is None for o in outcomes)
