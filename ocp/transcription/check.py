"""The replay of a collocated motion against what it claims."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ocp.extremals.replay import replay
from ocp.query import Query
from ocp.trajectory import SolveError, Status
from ocp.transcription.radau import CollocatedMotion

Array = NDArray[np.float64]

HARD_SPACING = 2e-3  # metres between the points at which clearance is checked
HIT_DEPTH = 1e-4  # metres inside the goal from which a motion counts as crossing it


@dataclass(frozen=True)
class ReplayVerdict:
    """What a replay found.

    Attributes:
        errors: `[k]`, by how much each interval's share of the cost is wrong.
        gap: largest difference of an interval's end state.
        depth: how deep the motion enters hard obstacles, 0 if it does not.
        breached: `[k]`, whether it does so in this interval.
        hit: time of the first hit of the goal before the end, or `None`.
    """

    errors: Array
    gap: float
    depth: float
    breached: NDArray[np.bool_]
    hit: float | None


def judge(motion: CollocatedMotion, ends_at_goal: bool) -> ReplayVerdict:
    """Replay a motion interval by interval.

    A gap in an interval's end state changes the remaining cost by costate times gap.

    Raises:
        SolveError: NOT_CONVERGED if the replay does not.
    """
    query = motion.query
    samples = 64 if query.hard_obstacles else 8
    run = replay(query, motion.piecewise_input, motion.starts, samples)
    if not run.accurate:
        raise SolveError(Status.NOT_CONVERGED, "the replay of a motion did not converge")
    gaps = run.states[:, -1] - motion.states[:, -1]
    following = np.concatenate([motion.start_costates[1:], motion.final_costate[None]])
    errors = run.costs[:, -1] - motion.costs + (gaps * following).sum(axis=-1)
    clearance = _clearance(query, run.states)
    hit = None
    if ends_at_goal:
        inside = query.goal_distance(run.states) < -max(HIT_DEPTH, 2 * float(np.abs(gaps).max()))
        if inside.any():
            hit = float(run.times[inside].min())
    return ReplayVerdict(
        errors,
        float(np.abs(gaps).max()),
        max(0.0, -float(clearance.min())),
        clearance < 0,
        hit,
    )


def _clearance(query: Query, states: Array) -> Array:
    """`[k]`, least clearance of hard obstacles on each interval of `[k, s + 1, n]` states."""
    if not query.hard_obstacles:
        return np.full(len(states), np.inf)
    positions = query.position(states)
    steps = np.linalg.norm(np.diff(positions, axis=1), axis=-1)
    parts = max(1, math.ceil(float(steps.max()) / HARD_SPACING))
    weights = np.linspace(0, 1, parts, endpoint=False)[:, None, None, None]
    fine = (1 - weights) * states[:, :-1] + weights * states[:, 1:]
    return np.minimum(
        query.clearance(fine, hard_only=True).min(axis=(0, 2)),
        query.clearance(states[:, -1], hard_only=True),
    )
