"""OMPL's planners from scratch on our worlds, with our certificates as their validity oracle."""

import math
import time
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from planners.world import World

PEERS = ("RRTstar", "InformedRRTstar", "BITstar", "AORRTC")


class PeersMissingError(RuntimeError):
    """OMPL is not installed."""


@dataclass(frozen=True)
class PeerRun:
    """What a peer did.

    Attributes:
        seconds: until the cost was reached, or until it was stopped.
        cost: of the way found; infinite if none.
        reached: whether the cost asked for was reached.
    """

    seconds: float
    cost: float
    reached: bool


def run_peer(
    name: str,
    world: World,
    start: ArrayLike,
    goal: ArrayLike,
    padding: float,
    target: float,
    limit: float,
    seed: int,
) -> PeerRun:
    """Plan from scratch until a way no longer than `target` is found, or `limit` seconds passed.

    Raises:
        PeersMissingError: if OMPL cannot be imported.
    """
    try:
        base: Any = import_module("ompl.base")
        geometric: Any = import_module("ompl.geometric")
    except ImportError as error:
        raise PeersMissingError(
            "the peers need OMPL, which is optional: pip install 'ompl==2.0.1'"
        ) from error
    _seed_once(seed)
    d = world.dimension
    space = base.RealVectorStateSpace(d)
    bounds = base.RealVectorBounds(d)
    for k in range(d):
        bounds.setLow(k, float(world.lower[k]))
        bounds.setHigh(k, float(world.upper[k]))
    space.setBounds(bounds)
    information = base.SpaceInformation(space)

    def point(state: Any) -> np.ndarray:
        return np.array([[state[k] for k in range(d)]])

    class Certified(base.MotionValidator):
        def checkMotion(self, first: Any, second: Any, *_: Any) -> bool:
            return bool(world.certify(point(first), point(second), padding)[0])

    def valid(state: Any) -> bool:
        here = point(state)
        return bool(world.certify(here, here, padding)[0])

    def state(values: ArrayLike) -> Any:
        made = space.allocState()
        for k, value in enumerate(np.asarray(values, dtype=float)):
            made[k] = float(value)
        return made

    validator = Certified(information)
    information.setStateValidityChecker(valid)
    information.setMotionValidator(validator)
    information.setup()
    problem = base.ProblemDefinition(information)
    problem.setStartAndGoalStates(state(start), state(goal), 1e-6)
    objective = base.PathLengthOptimizationObjective(information)
    objective.setCostThreshold(base.Cost(target))
    problem.setOptimizationObjective(objective)
    planner = getattr(geometric, name)(information)
    planner.setProblemDefinition(problem)
    planner.setup()
    begun = time.perf_counter()

    def enough() -> bool:
        # Asked between iterations: not every planner minds the objective's threshold itself.
        if time.perf_counter() - begun > limit:
            return True
        return problem.hasExactSolution() and problem.getSolutionPath().length() <= target

    planner.solve(base.PlannerTerminationCondition(enough))
    seconds = time.perf_counter() - begun
    cost = math.inf
    if problem.hasExactSolution():
        cost = float(problem.getSolutionPath().length())
    return PeerRun(seconds, cost, cost <= target)


@cache
def _seed_once(seed: int) -> None:
    """OMPL takes a seed once in a process, and none of 0."""
    util: Any = import_module("ompl.util")
    util.setLogLevel(util.LOG_ERROR)
    util.RNG.setSeed(seed + 1)
