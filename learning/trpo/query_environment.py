"""A query, or a family of them, as a Gymnasium environment: the same robot, the same cost.

`gymnasium.make("zermelo/Query-v0", query=query)` after importing this module. The reward of a step
is minus its running cost. With `shaping` w it also has w times the metres gained towards the goal:
a potential, which changes no optimal policy when rewards are not discounted.
"""

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from learning.trpo.robot_batch import Array, EnvironmentSettings, RobotBatch
from ocp.query import Query
from ocp.query_family import PAPER_FAMILY

NAME = "zermelo/Query-v0"


class QueryEnvironment(gymnasium.Env):
    """One robot on its way to the goal. `info["cost"]` is the running cost so far."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, query: Query | None = None, settings: EnvironmentSettings | None = None
    ) -> None:
        """
        Args:
            query: what is asked; by default a new query of the paper's family each episode.
            settings: see `EnvironmentSettings`.
        """
        draw = PAPER_FAMILY.sample if query is None else lambda _rng: query
        self._robots = RobotBatch(draw, 1, settings or EnvironmentSettings(), 0)
        self._cost = 0.0
        size = self._robots.encoder.count
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self._robots.system.m,), np.float32)

    @property
    def query(self) -> Query:
        """The query of this episode."""
        return self._robots.queries[0]

    @property
    def state(self) -> Array:
        """`[n]`, where the robot is."""
        return self._robots.states[0].copy()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """A new episode; `options={"start": state}` sets where it begins."""
        super().reset(seed=seed)
        if seed is not None:
            self._robots.reseed(seed)
        self._robots.reset(0)
        start: Sequence[float] | None = (options or {}).get("start")
        if start is not None:
            query = self.query
            self._robots.reset(0, query, query.check_start(start))
        self._cost = 0.0
        return self._robots.observations()[0], {"cost": 0.0}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold an action for a step."""
        rewards, costs, arrived, late = self._robots.step(np.asarray(action)[None])
        self._cost += float(costs[0])
        observation = self._robots.observations()[0]
        info = {"cost": self._cost}
        return observation, float(rewards[0]), bool(arrived[0]), bool(late[0]), info


if NAME not in gymnasium.registry:
    gymnasium.register(NAME, entry_point=f"{__name__}:QueryEnvironment")
