"""Feedback around exact trajectories: neighbouring extremals.

Near an extremal, V(x) = V_k + p_k' d + d' S_k d / 2 with d = x - x_k, where S is V's Hessian along
it, which multiple shooting finds with it. So grad V = p_k + S_k d steers back to the optimum from
wherever the robot is near it. Elsewhere, and in the last centimetres, another policy steers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import int64, types
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.jit import MATRIX, VECTOR, compiled, float64
from ocp.extremals.extremal import SAMPLES, Extremal
from ocp.query import Query
from ocp.value import Policy, Value, greedy

Floats = NDArray[np.float64]
CUBE = float64[:, :, ::1]

WIDTH = 0.3  # of a tube: metres and radians
TRUST = 0.5  # how much of the costate may come from the second order
HANDOVER = 0.05  # metres to the goal: nearer, V is not smooth enough for a second order


@dataclass(frozen=True, eq=False)
class Tubes:
    """Second-order models of V along extremals; a `Value` where `covers`.

    Attributes:
        query: what they solve.
        points: `[p, 2n + 1]`: state, costate and cost-to-go at points of all extremals.
        hessians: `[p, n, n]`.
    """

    query: Query
    points: Floats
    hessians: Floats

    @classmethod
    def around(cls, query: Query, extremals: Sequence[Extremal]) -> "Tubes":
        """The tubes of solved extremals."""
        n = query.system.n
        points, hessians = [np.zeros((0, 2 * n + 1))], [np.zeros((0, n, n))]
        for extremal in extremals:
            motion = extremal.trajectory
            assert motion is not None
            assert motion.costates is not None
            assert extremal.hessians is not None
            count = len(extremal.hessians) * SAMPLES
            rows = np.column_stack([motion.states, motion.costates, motion.cost_to_go])[:count]
            kept = query.goal_distance(motion.states[:count]) > HANDOVER
            share = np.arange(count) / SAMPLES
            low = np.minimum(share.astype(int), len(extremal.hessians) - 1)
            high = np.minimum(low + 1, len(extremal.hessians) - 1)
            part = (share - low)[:, None, None]
            mixed = (1 - part) * extremal.hessians[low] + part * extremal.hessians[high]
            points.append(rows[kept])
            hessians.append(mixed[kept])
        return cls(query, np.concatenate(points), np.concatenate(hessians))

    def value(self, states: ArrayLike) -> Floats:
        """V `[k]` at states `[k, n]`: only where `model` says that a tube covers them."""
        return self.model(states)[0]

    def gradient(self, states: ArrayLike) -> Floats:
        """grad V `[k, n]` at states `[k, n]`, likewise."""
        return self.model(states)[1]

    def model(self, states: ArrayLike) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """V `[k]`, grad V `[k, n]` and whether a tube covers it `[k]`, at states `[k, n]`."""
        rows = np.ascontiguousarray(states, dtype=float)
        values, gradients = np.empty(len(rows)), np.empty_like(rows)
        covered = np.zeros(len(rows), dtype=np.int64)
        _model(
            self.points, self.hessians, self.query.system.period, rows, WIDTH, TRUST, values,
            gradients, covered,
        )  # fmt: skip
        covered[self.query.goal_distance(rows) <= HANDOVER] = 0
        return values, gradients, covered > 0


@dataclass(frozen=True, eq=False)
class TubeValue:
    """V from tubes where they cover, else from `base`."""

    tubes: Tubes
    base: Value

    def value(self, states: ArrayLike) -> Floats:
        """V `[...]` at states `[..., n]`."""
        states = np.asarray(states, dtype=float)
        values, _, covered = self.tubes.model(states.reshape(-1, states.shape[-1]))
        shape = states.shape[:-1]
        return np.where(covered.reshape(shape), values.reshape(shape), self.base.value(states))

    def gradient(self, states: ArrayLike) -> Floats:
        """grad V `[..., n]` at states `[..., n]`."""
        states = np.asarray(states, dtype=float)
        _, gradients, covered = self.tubes.model(states.reshape(-1, states.shape[-1]))
        inside = covered.reshape(*states.shape[:-1], 1)
        return np.where(inside, gradients.reshape(states.shape), self.base.gradient(states))


@dataclass(frozen=True, eq=False)
class TubePolicy:
    """Neighbouring-extremal feedback in tubes, else the policy `base`."""

    tubes: Tubes
    base: Policy

    @property
    def query(self) -> Query:
        return self.tubes.query

    def __call__(self, states: ArrayLike) -> Floats:
        """Inputs `[..., m]` at states `[..., n]`."""
        states = np.asarray(states, dtype=float)
        rows = states.reshape(-1, states.shape[-1])
        covered = self.tubes.model(rows)[2]
        inputs = np.empty((len(rows), self.query.system.m))
        if not covered.all():
            inputs[~covered] = self.base(rows[~covered])
        if covered.any():
            inputs[covered] = greedy(self.query, self.tubes)(rows[covered])
        return inputs.reshape(*states.shape[:-1], -1)


@compiled(types.void(MATRIX, CUBE, VECTOR, MATRIX, float64, float64, VECTOR, MATRIX, int64[::1]))
def _model(points, hessians, period, states, width, trust, values, gradients, covered):
    n = states.shape[1]
    d, best_d = np.empty(n), np.empty(n)
    for row in range(states.shape[0]):
        best, least = -1, width * width
        for k in range(points.shape[0]):
            squared = 0.0
            for i in range(n):
                gap = states[row, i] - points[k, i]
                if period[i] > 0.0:
                    gap -= period[i] * np.floor(gap / period[i] + 0.5)
                d[i] = gap
                squared += gap * gap
                if squared >= least:
                    break
            if squared < least:
                best, least = k, squared
                best_d[:] = d
        values[row] = 0.0
        gradients[row] = 0.0
        if best < 0:
            continue
        value, first, second = points[best, 2 * n], 0.0, 0.0
        for i in range(n):
            bend = 0.0
            for j in range(n):
                bend += hessians[best, i, j] * best_d[j]
            p = points[best, n + i]
            gradients[row, i] = p + bend
            value += (p + 0.5 * bend) * best_d[i]
            first += p * p
            second += bend * bend
        if second <= trust * trust * first and value > 0.0:
            values[row] = value
            covered[row] = 1
