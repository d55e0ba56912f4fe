"""Robots driven at the same time, each with a query of its own, and what a policy sees of them.

The physics and the cost are the compiled kernels'; this is what the Gymnasium environment and the
training of reinforcement learning share.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ocp.compiled.held_inputs import advance, parameter_row, state_costs
from ocp.query import Query
from ocp.query_family import sample_start
from ocp.system import System

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Query]


@dataclass(frozen=True)
class EnvironmentSettings:
    """How a query becomes an environment.

    Attributes:
        step: seconds that an action is held.
        substeps: Runge-Kutta steps in it.
        time_limit: seconds after which an episode is cut off.
        limit: an action of 1 is this input, where the query has no bounds of its own.
        shaping: reward for every metre gained towards the goal.
        slots: obstacles that an observation has room for.
    """

    step: float = 0.1
    substeps: int = 2
    time_limit: float = 40.0
    limit: float = 1.5
    shaping: float = 0.0
    slots: int = 3

    def __post_init__(self) -> None:
        for name in ("step", "substeps", "time_limit", "limit"):
            number = getattr(self, name)
            if not (np.isfinite(number) and number > 0):
                raise ValueError(f"{name}: must be a positive finite number, got {number}")
        if not (np.isfinite(self.shaping) and self.shaping >= 0):
            raise ValueError(f"shaping: must be a finite number >= 0, got {self.shaping}")
        if self.slots < 0:
            raise ValueError(f"slots: must not be negative, got {self.slots}")


class Encoder:
    """What a policy sees: features of the state and of the query, all of order 1.

    The state (periodic coordinates as sine and cosine; in the plane also relative to the goal's
    bearing), the goal, its distance and direction, W, and for each obstacle slot whether there is
    one, its size and where it lies.
    """

    def __init__(self, system: System, settings: EnvironmentSettings) -> None:
        self._system, self._settings = system, settings
        d, periodic = len(system.position), int((system.period > 0).sum())
        self._planar = d == 2
        turned = 2 * periodic * self._planar
        self.count = system.n + periodic + turned + 3 * d + 2 + settings.slots * (2 + d)
        """Number of features."""

    def query_features(self, query: Query) -> Array:
        """Goal and obstacles `[d + slots (2 + d)]`; absolute, in the robot's domain.

        Raises:
            ValueError: if the query is of another robot or has more obstacles than slots.
        """
        system, slots = self._system, self._settings.slots
        if query.system is not system:
            raise ValueError(f"model: the policy is of {system.name}, got {query.system.name}")
        if len(query.obstacles) > slots:
            raise ValueError(
                f"obstacle: the policy knows at most {slots}, the query has {len(query.obstacles)}"
            )
        d = len(system.position)
        records = np.zeros((slots, 2 + d))
        for record, obstacle in zip(records, query.obstacles, strict=False):
            record[:2] = 1.0, obstacle.radius
            record[2:] = obstacle.center
        return np.concatenate([query.goal_position, records.ravel()])

    def features(self, states: Array, queries: Array, costs: Array) -> Array:
        """`[k, count]` for states `[k, n]`, `query_features` `[k, ...]` and W `[k]`."""
        system = self._system
        d, place = len(system.position), list(system.position)
        half = (system.upper - system.lower) / 2
        middle = (system.upper + system.lower) / 2
        columns = []
        scale = half[place]
        goal, slots = queries[:, :d], queries[:, d:].reshape(len(states), -1, 2 + d)
        towards = goal - states[:, place]
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        direction = towards / np.maximum(distance, 1e-9)
        for i in range(system.n):
            x = states[:, i]
            if system.period[i] > 0:
                angle = 2 * np.pi * (x - system.lower[i]) / system.period[i] - np.pi
                columns += [np.sin(angle), np.cos(angle)]
                if self._planar:
                    offset = angle - np.arctan2(towards[:, 1], towards[:, 0])
                    columns += [np.sin(offset), np.cos(offset)]
            else:
                columns.append((x - middle[i]) / half[i])
        relative = (slots[:, :, 2:] - states[:, None, place]) / scale
        present = slots[:, :, :1]
        records = np.concatenate([slots[:, :, :2], present * relative], axis=2)
        return np.column_stack(
            [
                *columns,
                goal / scale,
                towards / scale,
                direction,
                np.log1p(distance),
                np.log1p(costs),
                records.reshape(len(states), -1),
            ]
        )


class RobotBatch:
    """Robots that are driven at the same time, each with a query of its own."""

    def __init__(self, draw: Draw, count: int, settings: EnvironmentSettings, seed: Any) -> None:
        self.settings = settings
        self._draw = draw
        self._rng = np.random.default_rng(seed)
        self.queries = [draw(self._rng) for _ in range(count)]
        self.system = self.queries[0].system
        self.encoder = Encoder(self.system, settings)
        self.states = np.zeros((count, self.system.n))
        self.steps = np.zeros(count, dtype=np.int64)
        self._known: Array = np.array([self.encoder.query_features(q) for q in self.queries])
        self._rows = np.array([parameter_row(q, settings.slots) for q in self.queries])
        self._goals = np.array([q.goal_position for q in self.queries])
        for k in range(count):
            self.reset(k)

    def reset(self, k: int, query: Query | None = None, start: Array | None = None) -> None:
        """Give robot `k` a query and a start, drawn at random unless given."""
        query = query or self._draw(self._rng)
        self.queries[k] = query
        self.states[k] = sample_start(query, self._rng) if start is None else start
        self.steps[k] = 0
        self._known[k] = self.encoder.query_features(query)
        self._rows[k] = parameter_row(query, self.settings.slots)
        self._goals[k] = query.goal_position

    def reseed(self, seed: Any) -> None:
        """Begin the random numbers anew."""
        self._rng = np.random.default_rng(seed)

    def observations(self) -> NDArray[np.float32]:
        """`[k, count]` features of all robots."""
        costs = state_costs(self.queries[0], self._rows, self.states)
        return self.encoder.features(self.states, self._known, costs).astype(np.float32)

    def step(self, actions: Array) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Advance all robots by a step: rewards, running costs, arrivals, cut-offs, each `[k]`."""
        s, query = self.settings, self.queries[0]
        before = self._distances()
        inputs = scaled(query, np.asarray(actions, dtype=float), s.limit)
        self.states, costs, arrived = advance(
            query, self._rows, self.states, inputs, s.step / s.substeps, s.substeps
        )
        gained = before - self._distances()
        self.steps += 1
        late = ~arrived & (self.steps * s.step >= s.time_limit - 1e-9)
        return s.shaping * gained - costs, costs, arrived, late

    def _distances(self) -> Array:
        return np.linalg.norm(self.states[:, list(self.system.position)] - self._goals, axis=1)


def scaled(query: Query, actions: Array, limit: float) -> Array:
    """Inputs `[..., m]` of actions in [-1, 1]: within the query's bounds, else within `limit`."""
    low, high = query.input_bounds
    low = np.where(np.isfinite(low), low, -limit)
    high = np.where(np.isfinite(high), high, limit)
    return low + (np.clip(actions, -1.0, 1.0) + 1) / 2 * (high - low)
