"""Supervision for value networks: states with optimal value and control, as numbers and as tensors.

From the set-valued method on a grid (eq. (8)), from exact trajectories sampled every Delta t
(Algorithm 2, line 9), and from the goal, where V = 0 and u = 0 (line 12).
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from learning.faithful.losses import Samples, Structure
from ocp.compiled.batch import rates, state_costs
from ocp.query import Goal, Query
from ocp.system import System
from ocp.trajectory import SolveError, Status, Trajectory

Array = NDArray[np.float64]

BOUND_KNOTS = 2000


@dataclass(frozen=True)
class Supervision:
    """Optimal values `[k]` and controls `[k, m]` of a query at states `[k, n]`."""

    states: Array
    values: Array
    inputs: Array

    @classmethod
    def joined(cls, parts: "Sequence[Supervision]") -> "Supervision":
        """All samples of several, in order."""
        return cls(
            np.concatenate([p.states for p in parts]),
            np.concatenate([p.values for p in parts]),
            np.concatenate([p.inputs for p in parts]),
        )

    def __len__(self) -> int:
        return len(self.values)

    def drawn(self, count: int, rng: np.random.Generator) -> "Supervision":
        """`count` samples without replacement; all of them if there are no more."""
        chosen = rng.choice(len(self), min(count, len(self)), replace=False)
        return Supervision(self.states[chosen], self.values[chosen], self.inputs[chosen])


def along_trajectory(query: Query, motion: Trajectory, interval: float) -> Supervision:
    """Cost-to-go and input every `interval` seconds along an optimal motion, from its start.

    Raises:
        ValueError: if the motion is not a solution; such motions are no supervision.
    """
    if motion.status is not Status.SOLVED:
        raise ValueError(f"motion: must be solved, got {motion.status.name}")
    times = np.arange(0.0, max(motion.duration, interval / 2), interval)

    def at(columns: Array) -> Array:
        return np.column_stack([np.interp(times, motion.times, c) for c in columns.T])

    values = np.interp(times, motion.times, motion.cost_to_go)
    return Supervision(query.system.wrap(at(motion.states)), values, at(motion.inputs))


def in_goal(query: Query, count: int, rng: np.random.Generator) -> Supervision:
    """`count` states uniform in the goal region, where V = 0 and u = 0."""
    system, goal = query.system, goal_ball(query)
    states = rng.uniform(system.lower, system.upper, (count, system.n))
    d = len(system.position)
    offsets = rng.normal(size=(count, d))
    offsets /= np.linalg.norm(offsets, axis=1, keepdims=True)
    radii = goal.radius * rng.uniform(size=(count, 1)) ** (1 / d)
    states[:, list(system.position)] = np.array(goal.center) + radii * offsets
    return Supervision(states, np.zeros(count), np.zeros((count, system.m)))


def goal_ball(query: Query) -> Goal:
    """The goal as a ball of positions.

    Raises:
        SolveError: NOT_APPLICABLE if the query's goal is an equilibrium.
    """
    if not isinstance(query.goal, Goal):
        raise SolveError(Status.NOT_APPLICABLE, "meta value learning needs a goal ball")
    return query.goal


@dataclass(frozen=True)
class FeatureMap:
    """States as a network's inputs: a periodic coordinate as its sine and cosine, others as such.

    Attributes:
        system: whose states.
        relative: whether positions are taken relative to the goal's centre (the paper: not).
    """

    system: System
    relative: bool = False

    @property
    def count(self) -> int:
        """p, the number of features."""
        return self.system.n + sum(c.periodic for c in self.system.coordinates)

    def features(self, states: Array, reference: Array) -> Array:
        """`[..., p]` at states `[..., n]`; `reference` `[..., n]` is the query's."""
        columns = []
        for i, c in enumerate(self.system.coordinates):
            x = states[..., i]
            if c.periodic:
                angle = 2 * np.pi / c.extent * x
                columns += [np.sin(angle), np.cos(angle)]
            else:
                columns.append(x - reference[..., i] if self.relative else x)
        return np.stack(columns, axis=-1)

    def directions(self, states: Array, velocities: Array) -> Array:
        """Rates `[..., p]` of the features at states `[..., n]` moving at `velocities`."""
        states, velocities = np.broadcast_arrays(states, velocities)
        columns = []
        for i, c in enumerate(self.system.coordinates):
            v = velocities[..., i]
            if c.periodic:
                scale = 2 * np.pi / c.extent
                angle = scale * states[..., i]
                columns += [scale * np.cos(angle) * v, -scale * np.sin(angle) * v]
            else:
                columns.append(v)
        return np.stack(columns, axis=-1)

    def state_gradient(self, states: Array, gradient: Array) -> Array:
        """The gradient `[..., n]` in the states, from that in the features `[..., p]`."""
        unit = np.eye(self.system.n)
        moved = self.directions(states[..., None, :], unit)
        return (moved * gradient[..., None, :]).sum(-1)


class DistanceBound:
    """B(d) = 2 times the integral of sqrt(Q) from the goal's boundary to distance d, and B'.

    No motion costs less, whatever its obstacles, if no input of unit effort moves the position
    faster than 1 m/s. Tabulated from the running cost of the query without its obstacles.
    """

    def __init__(self, query: Query) -> None:
        system, goal = query.system, goal_ball(query)
        radius = goal.radius
        free = Query(query.model, goal, (), query.cost)
        d = len(system.position)
        extent = (system.upper - system.lower)[list(system.position)]
        reach = float(np.linalg.norm(extent)) + radius
        # d = r_g + s^2 removes the square root at the boundary.
        root = np.linspace(0.0, np.sqrt(reach), BOUND_KNOTS)
        states = np.zeros((BOUND_KNOTS, system.n))
        states[:, list(system.position)] = np.array(goal.center)
        states[:, system.position[0]] += radius + root**2
        slope = 2 * np.sqrt(np.maximum(state_costs(free, states), 0.0))
        steps = np.diff(root) * (slope[1:] * root[1:] + slope[:-1] * root[:-1])
        self._query, self._d = query, d
        self._distances = root**2
        self._slopes, self._values = slope, np.concatenate([[0.0], np.cumsum(steps)])

    def value(self, states: Array) -> Array:
        """B `[...]` at states `[..., n]`; 0 in the goal."""
        distance = np.maximum(self._query.goal_distance(states), 0.0)
        return np.interp(np.sqrt(distance), np.sqrt(self._distances), self._values)

    def gradient(self, states: Array) -> Array:
        """The gradient `[..., n]` of B."""
        query = self._query
        distance = np.maximum(query.goal_distance(states), 0.0)
        slope = np.interp(np.sqrt(distance), np.sqrt(self._distances), self._slopes)
        offset = query.position(states) - np.array(goal_ball(query).center)
        unit = offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-12)
        gradient = np.zeros(states.shape)
        gradient[..., list(query.system.position)] = slope[..., None] * unit
        return gradient


@lru_cache(maxsize=256)
def distance_bound(query: Query) -> DistanceBound:
    """The bound of a query, tabulated once."""
    return DistanceBound(query)


@dataclass(frozen=True)
class SampleMap:
    """Supervision of one query as tensors that the losses take.

    Attributes:
        features: how states become inputs.
        structure: whether the bound B is needed.
        step: of the differences, seconds of motion under a unit input.
        dtype: of the tensors.
    """

    features: FeatureMap
    structure: Structure = Structure.PLAIN
    step: float = 0.01
    dtype: torch.dtype = torch.float32

    def samples(self, query: Query, data: Supervision) -> Samples:
        """The tensors of one query, without a leading axis.

        Raises:
            SolveError: NOT_APPLICABLE for bounded inputs, where h(grad V) is clipped.
        """
        batch = self.batch([query], [data])
        fields = {name: getattr(batch, name)[0] for name in Samples.__dataclass_fields__}
        return Samples(**(fields | {"rates": batch.rates}))

    def batch(self, queries: Sequence[Query], data: Sequence[Supervision]) -> Samples:
        """The tensors of queries of one robot and equal input weights, as many samples of each.

        Raises:
            SolveError: NOT_APPLICABLE for bounded inputs.
        """
        if any(query.is_bounded for query in queries):
            raise SolveError(Status.NOT_APPLICABLE, "the losses need unbounded inputs")
        fmap, states = self.features, np.stack([d.states for d in data])
        columns = input_columns(queries[0], states)
        rate = -1 / (2 * queries[0].input_weights)
        along = columns * rate[:, None]  # -G_j / (2 R_j)
        shifted = (states[:, :, None, :] + self.step * columns).swapaxes(1, 2)
        references = np.stack([query.reference for query in queries])
        bounds, slopes = np.zeros((len(queries), 0)), np.zeros((len(queries), 0))
        if self.structure is Structure.BOUND:
            exact = [distance_bound(query) for query in queries]
            bounds = np.stack([b.value(x) for b, x in zip(exact, states, strict=True)])
            gradients = np.stack([b.gradient(x) for b, x in zip(exact, states, strict=True)])
            slopes = (along * gradients[:, :, None, :]).sum(-1)
        arrays = (
            fmap.features(states, references[:, None, :]),
            fmap.features(shifted, references[:, None, None, :]),
            fmap.directions(states[:, :, None, :], along),
            rate / self.step,
            np.stack([d.values for d in data]),
            np.stack([d.inputs for d in data]),
            bounds,
            slopes,
        )
        return Samples(*(torch.from_numpy(np.ascontiguousarray(a)).to(self.dtype) for a in arrays))


def input_columns(query: Query, states: Array) -> Array:
    """Columns G_j(x) `[..., m, n]` of the input matrix at states `[..., n]`."""
    m = query.system.m
    shape = (*states.shape[:-1], m)
    rest = rates(query, states, np.zeros(shape))
    unit = [rates(query, states, np.broadcast_to(e, shape)) - rest for e in np.eye(m)]
    return np.stack(unit, axis=-2)


class QueryTable:
    """The training data sets D_i^tr of many queries, from which minibatches are drawn."""

    def __init__(
        self, queries: Sequence[Query], data: Sequence[Supervision], sample_map: SampleMap
    ) -> None:
        if len(queries) != len(data) or not queries:
            raise ValueError(f"data: one set a query, got {len(queries)} and {len(data)}")
        self.queries, self.data, self.map = list(queries), list(data), sample_map

    def draw(self, rng: np.random.Generator, queries: int, counts: Sequence[int]) -> list[Samples]:
        """Samples of a random subset of `queries` queries: one batch for each of `counts`.

        The batches of a query have no sample in common.
        """
        chosen = rng.choice(len(self.queries), queries, replace=False)
        batches: list[list[Supervision]] = [[] for _ in counts]
        for i in chosen:
            data = self.data[i]
            picked = rng.choice(len(data), sum(counts), replace=False)
            start = 0
            for batch, count in zip(batches, counts, strict=True):
                rows = picked[start : start + count]
                batch.append(Supervision(data.states[rows], data.values[rows], data.inputs[rows]))
                start += count
        return [self.map.batch([self.queries[i] for i in chosen], batch) for batch in batches]

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all supervision, 16 digits: two runs with equal digests saw the same data."""
        found = hashlib.sha256()
        for part in self.data:
            for array in (part.states, part.values, part.inputs):
                found.update(np.ascontiguousarray(array).tobytes())
        return found.hexdigest()[:16]
