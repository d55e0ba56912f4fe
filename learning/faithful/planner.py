"""Algorithm 2 as a planner: one refinement is one trajectory and M gradient steps."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.faithful.adaptation import Adaptation, adapt_once
from learning.faithful.meta import MetaWeights
from learning.faithful.meta_data import goal_ball
from learning.faithful.network_value import StateNetworkValue
from learning.shipped import PRETRAINED
from ocp.query import Query
from ocp.value import GradientPolicy, Policy, Value

PRINTED = PRETRAINED / "faithful.safetensors"
"""theta_meta of configs/section-iv-b.toml."""
REPAIRED = PRETRAINED / "repaired.safetensors"
"""theta_meta of configs/repaired.toml."""
ANYTIME = PRETRAINED / "anytime.safetensors"
"""theta_meta of configs/anytime.toml."""


@dataclass(frozen=True)
class FaithfulState:
    """theta_n, and how long an iteration took.

    Attributes:
        adaptation: where Algorithm 2 stands.
        limit: N.
        next_seconds: time of the last iteration, expected of the next.
    """

    adaptation: Adaptation
    limit: int
    next_seconds: float = 0.0

    @property
    def finished(self) -> bool:
        return self.adaptation.iteration >= self.limit

    @property
    def trajectories(self) -> int:
        return self.adaptation.iteration


@dataclass(frozen=True)
class FaithfulPlanner:
    """The paper's planner: the meta value function, adapted trajectory by trajectory.

    As in the paper nothing checks that an iteration improves the policy. Starts are drawn
    uniformly from the robot's domain, whatever starts are asked for.

    Attributes:
        weights: theta_meta and its configuration.
        seed: of starts and shots.
    """

    weights: MetaWeights
    seed: int = 0

    @classmethod
    def pretrained(cls, seed: int = 0) -> "FaithfulPlanner":
        """With the weights that come with the package.

        Raises:
            ValueError: if they are damaged.
        """
        return cls(MetaWeights.load(PRINTED), seed)

    def start(self, query: Query, starts: Sequence[NDArray[np.float64]]) -> FaithfulState:
        """The meta value function itself, for the whole space; `starts` `[n]` are not needed.

        Raises:
            ValueError: if the weights are of another robot.
            SolveError: NOT_APPLICABLE if the goal is no ball.
        """
        del starts  # Algorithm 2 draws its own
        goal_ball(query)
        trained = self.weights.robot
        if query.system.fingerprint != trained.fingerprint:
            raise ValueError(
                f"model: the weights are of the {trained.name}, got {query.system.name}"
            )
        adaptation = Adaptation(query, self.weights.parameters)
        return FaithfulState(adaptation, self.weights.config.adaptation.trajectories)

    def refine(self, state: FaithfulState) -> FaithfulState:
        """One more iteration.

        Raises:
            SolveError: if no trajectory is found.
        """
        begun = time.perf_counter()
        adapted = adapt_once(state.adaptation, self.weights.config, self.seed)
        return FaithfulState(adapted, state.limit, time.perf_counter() - begun)

    def policy(self, state: FaithfulState) -> Policy:
        return GradientPolicy(state.adaptation.query, self.value(state))

    def value(self, state: FaithfulState) -> Value:
        adaptation = state.adaptation
        return StateNetworkValue(
            adaptation.query, self.weights.config.network, adaptation.parameters
        )
