"""The planning methods by name: what `--method` accepts."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ocp.planning import Answer, OneShot, Planner
from ocp.query import Equilibrium, Query
from ocp.query_family import sample_start
from ocp.trajectory import SolveError, Status
from ocp.value import greedy

log = logging.getLogger(__name__)

REHEARSED = 3  # refinements of a rehearsal: one of each kind that a planner knows


@dataclass(frozen=True)
class Method:
    """A method of `zermelo plan`.

    Attributes:
        summary: one line on what it does.
        planner: makes it; imports what it needs.
        period: seconds for which the closed loop holds each input.
        within: makes one that knows its deadline in seconds, if that changes what it does.
    """

    summary: str
    planner: Callable[[], Planner]
    period: float = 0.02
    within: Callable[[float], Planner] | None = None

    def planner_for(self, seconds: float | None) -> Planner:
        """The planner for a deadline, or without one."""
        if seconds is None or self.within is None:
            return self.planner()
        return self.within(seconds)

    def rehearse(self, query: Query, seconds: float | None = None) -> None:
        """Solve a query of the same kind, so that a timed solve finds all compiled code loaded.

        The goal is moved, so that nothing of the query itself is solved.
        """
        system = query.system
        if isinstance(query.goal, Equilibrium):  # others may not be held; but start beside it
            other, start = query, query.reference.copy()
            start[0] += 2.0 * query.goal.radius
        else:
            center = np.array(query.goal.center)
            middle = ((system.lower + system.upper) / 2)[list(system.position)]
            moved = tuple(map(float, center + 0.1 * (middle - center)))
            other = replace(query, goal=replace(query.goal, center=moved))
            start = sample_start(other, np.random.default_rng(0))
        planner = self.planner_for(seconds)
        try:
            state = planner.start(other, [start])
            for _ in range(REHEARSED):
                if state.finished:
                    break
                state = planner.refine(state)
            planner.policy(state)(start)
        except SolveError:
            log.debug("rehearsal of %s ended without an answer", system.name)


def _eikonal(seconds: float | None = None) -> Planner:
    from ocp.eikonal_planner import EikonalPlanner

    return EikonalPlanner(seconds)


def _exact() -> OneShot:
    from ocp.pontryagin import ExactValue
    from ocp.regulation_value import RegulationValue

    def solve(query: Query, starts: Sequence[NDArray[np.float64]]) -> Answer:
        value = RegulationValue(query) if query.is_regulation else ExactValue(query)
        if len(starts):
            value.value(np.array(starts))
        return greedy(query, value), value

    return OneShot(solve)


def _set_valued() -> OneShot:
    from ocp.set_valued import solve_set_valued

    def solve(query: Query, _starts: Sequence[NDArray[np.float64]]) -> Answer:
        solution = solve_set_valued(query)
        return solution.policy(), solution.value

    return OneShot(solve)


def _adapt(seconds: float | None = None) -> Planner:
    from learning.meta_planner import MetaPlanner

    return MetaPlanner.shipped(seconds=seconds)


def _mpc() -> OneShot:
    from ocp.mpc import receding_horizon

    def solve(query: Query, starts: Sequence[NDArray[np.float64]]) -> Answer:
        policy = receding_horizon(query)
        if len(starts):
            policy(np.array(starts))
        return policy, policy.value

    return OneShot(solve)


def _mpc_value() -> OneShot:
    from ocp.eikonal import solve_eikonal
    from ocp.grids.spline import SplineValue
    from ocp.mpc import ValueEnd, receding_horizon

    def solve(query: Query, starts: Sequence[NDArray[np.float64]]) -> Answer:
        value = SplineValue(solve_eikonal(query).value.on_grid)
        policy = receding_horizon(query, ValueEnd.of(query, value))
        if len(starts):
            policy(np.array(starts))
        return policy, policy.value

    return OneShot(solve)


def _interpolation() -> Planner:
    from learning.faithful.interpolation import InterpolationPlanner

    return InterpolationPlanner()


def _value_iteration() -> OneShot:
    from ocp.grids.lookahead import LookaheadPolicy
    from ocp.grids.regulation_grid import solve_regulation_grid

    def solve(query: Query, _starts: Sequence[NDArray[np.float64]]) -> Answer:
        value = solve_regulation_grid(query)
        return LookaheadPolicy(query, value), value

    return OneShot(solve)


def _causality_free() -> Planner:
    from learning.causality_free.planner import CausalityFreePlanner

    return CausalityFreePlanner()


def _refmm() -> Planner:
    from ocp.refmm import Refmm

    return Refmm()


def _trpo() -> OneShot:
    from learning.trpo.policy import TRAINED

    return trained_by_trpo(TRAINED)


def trained_by_trpo(path: Path) -> OneShot:
    """The planner on the weights in a file, for the queries that they were trained on.

    Raises:
        FileNotFoundError: if there is no such file.
    """
    from learning.trpo.policy import RolloutValue, TrpoPolicy, TrpoWeights

    weights = TrpoWeights.load(path)

    def solve(query: Query, _starts: Sequence[NDArray[np.float64]]) -> Answer:
        try:
            policy = TrpoPolicy(query, weights)
        except ValueError as error:
            raise SolveError(Status.NOT_APPLICABLE, str(error)) from error
        return policy, RolloutValue(policy, weights.settings.environment)

    return OneShot(solve)


METHODS: dict[str, Method] = {
    "adapt": Method(
        "a network that knows the query, exact trajectories, then grids", _adapt, within=_adapt
    ),
    "exact": Method("Pontryagin shooting from every state the robot meets", _exact),
    "eikonal": Method(
        "fast marching on a grid, interpolated one-step lookahead", _eikonal, within=_eikonal
    ),
    "value-iteration": Method(
        "to an equilibrium: value iteration on a grid, up to 4 states", _value_iteration
    ),
    "causality-free": Method(
        "to an equilibrium: a network on exact trajectories, a regulator inside", _causality_free
    ),
    "set-valued": Method("the set-valued method of Xu and Zhu on its coarse grid", _set_valued),
    "refmm": Method(
        "repairing fast marching on a mesh refined for the starts, up to 96,000 simplices", _refmm
    ),
    "interpolation": Method(
        "a network fitted to the set-valued solution of this one query", _interpolation
    ),
    "mpc": Method("receding horizon of 2 s, quadratic cost at its end", _mpc, 0.1),
    "mpc-value": Method("receding horizon of 2 s, the eikonal value at its end", _mpc_value, 0.1),
    "trpo": Method("a policy trained by TRPO on the paper's family of queries", _trpo, 0.1),
}


def default_method(query: Query) -> tuple[str, str | None]:
    """The method used where none is asked for, and why it is not `adapt` if it is not."""
    from learning.conditioned.query_encoder import why_not_encodable

    if query.is_regulation:
        return "exact", "the goal is an equilibrium"

    reason = why_not_encodable(query)
    return ("adapt", None) if reason is None else ("eikonal", reason)
