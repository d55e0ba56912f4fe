"""What the experiments measure: exact optima, and one plan with its closed loops, as plain data."""

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.oracle import consult
from ocp.planning import Plan, plan
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query
from ocp.trajectory import SolveError, Trajectory
from sims.closed_loop import LoopSettings, Rollout, rollouts
from sims.experiments.contestants import Contestant
from sims.experiments.paper import GOALS
from sims.parts import Parts

log = logging.getLogger(__name__)

Start = Sequence[float]
POINTS = 200  # of a stored path


def truth(parts: Parts, query: Query, start: Start, name: str) -> dict[str, Any]:
    """The optimal cost and motion from a start, as part `name`: `cost` is `None` unless two
    independent exact methods agree on it."""
    config = {"query": query.dumps(), "start": list(start)}
    return parts.get(name, config, lambda: _truth(query, start))


def _truth(query: Query, start: Start) -> dict[str, Any]:
    verdict = consult(query, start)
    if not verdict.established or verdict.best is None:
        return {"cost": None, "path": None, "why": verdict.explanation}
    return {"cost": verdict.value, "path": path(verdict.best), "why": None}


def path(motion: Trajectory) -> list[list[float]]:
    """At most `POINTS` states of a motion, at even arc length in the state space."""
    steps = np.linalg.norm(np.diff(motion.states, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(steps)])
    places = np.linspace(0.0, at[-1], min(POINTS, max(2, len(at))))
    columns = [np.interp(places, at, column) for column in motion.states.T]
    return np.round(np.stack(columns, axis=-1), 5).tolist()


def rehearse(contestant: Contestant, query: Query | None = None) -> None:
    """Load compiled code and weights: solve another query of the same kind, not counted."""
    query = query or paper_query((4.0, 4.0))
    center = tuple(0.98 * float(x) for x in query.goal_position)
    other = replace(query, goal=Goal(center, query.goal.radius))
    try:
        answer = plan(contestant.planner(), other, [PAPER_START], contestant.until)
        answer.policy(np.array(PAPER_START))
    except (SolveError, FloatingPointError):  # the query proper will say so again
        log.debug("rehearsal of %s ended without an answer", contestant.key)


def planned(contestant: Contestant, query: Query, starts: Sequence[Start]) -> tuple[Plan, float]:
    """The plan, and the processor's seconds that it took."""
    begun = time.process_time()
    answer = plan(contestant.planner(), query, [np.array(s) for s in starts], contestant.until)
    return answer, time.process_time() - begun


def loop_report(loop: Rollout, with_path: bool = False) -> dict[str, Any]:
    """A closed loop as plain data."""
    report: dict[str, Any] = {
        "cost": loop.cost,
        "reached": loop.reached,
        "collided": loop.collided,
    }
    if with_path:
        report["path"] = path(loop.trajectory)
    return report


def judged(
    contestant: Contestant, query: Query, starts: Sequence[Start], with_path: bool = False
) -> dict[str, Any]:
    """Plan for the starts and close the loop from each.

    Returns:
        `seconds` by the wall clock and `cpu_seconds` of the plan, `loops` as of `loop_report`, and
        `failure`, why there is no plan.
    """
    try:
        answer, cpu = planned(contestant, query, starts)
        settings = LoopSettings(period=contestant.held)
        loops = rollouts(answer.policy, [np.array(s) for s in starts], settings)
    except (SolveError, FloatingPointError) as error:
        return {"seconds": None, "cpu_seconds": None, "loops": None, "failure": str(error)}
    return {
        "seconds": answer.reaction_time,
        "cpu_seconds": cpu,
        "loops": [loop_report(loop, with_path) for loop in loops],
        "failure": None,
    }


def on_the_four_queries(
    contestant: Contestant, parts: Parts, skip: str | None = None
) -> dict[str, Any]:
    """A row of Tables I and II: costs and times from the paper's start, a query each.

    The plans are parts that both tables share.
    """
    absent = contestant.absent or skip
    row: dict[str, Any] = {
        "key": contestant.key,
        "label": contestant.label,
        "paper_row": contestant.row,
        "note": contestant.note,
        "absent": absent,
        "only": [list(goal) for goal in contestant.only],
        "costs": [None] * len(GOALS),
        "seconds": [None] * len(GOALS),
        "cpu_seconds": [None] * len(GOALS),
        "failures": [],
    }
    if absent is not None:
        return row
    warm = False

    def measured(goal: tuple[float, float]) -> dict[str, Any]:
        nonlocal warm
        if not (warm or contestant.slow):
            rehearse(contestant)
            warm = True
        return judged(contestant, paper_query(goal), [PAPER_START])

    for k, goal in enumerate(GOALS):
        if goal not in contestant.only:
            continue
        name = "plan-{}-{:g}-{:g}".format(contestant.key, *goal)
        answer = parts.get(name, contestant.config, lambda goal=goal: measured(goal))
        if answer["loops"] is None:
            row["failures"].append(answer["failure"])
            continue
        row["costs"][k] = answer["loops"][0]["cost"]
        row["seconds"][k], row["cpu_seconds"][k] = answer["seconds"], answer["cpu_seconds"]
    return row


def optima_of_the_four_queries(parts: Parts) -> list[float | None]:
    """Exact optimal costs from the paper's start."""
    return [
        truth(parts, paper_query(goal), PAPER_START, "truth-{:g}-{:g}".format(*goal))["cost"]
        for goal in GOALS
    ]


def excesses(costs: Sequence[float | None], optima: Sequence[float | None]) -> NDArray[np.float64]:
    """Relative excess costs where both are known."""
    pairs = [(c, o) for c, o in zip(costs, optima, strict=True) if c is not None and o]
    return np.array([c / o - 1 for c, o in pairs])
