"""Model predictive control: an optimal control problem over a short horizon at every instant.

Xu and Zhu (RSS 2022, section IV-C) compare with 20 steps of 0.1 s and "a quadratic function of the
state" as the cost at the end; they do not give its weights. With a value of the query as the cost
at the end, the horizon's motion is a beginning of the optimal one.
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.extremals.guess import default_guesses
from ocp.kernels import parameters
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.transcription.horizon import EndCost, HorizonPlan, HorizonProgram, horizon_program
from ocp.transcription.terms import Structure
from ocp.value import Value

Array = NDArray[np.float64]

NEARBY = 0.03  # of the domain: so near to a known motion, its rest is the first guess
REMEMBERED = 256  # motions that a policy keeps
GUESSES = 4  # rough motions tried where no known one is near
WEIGHT = 0.3
"""Of the quadratic cost at the end, 1/m^2: the least mean excess of `zermelo bench mpc`."""


@dataclass(frozen=True)
class HorizonSettings:
    """The horizon; the defaults are the paper's.

    Attributes:
        steps: how many.
        step: seconds that an input is held.
        max_iterations: of IPOPT, in one solve.
    """

    steps: int = 20
    step: float = 0.1
    max_iterations: int = 200

    def __post_init__(self) -> None:
        if not 1 <= self.steps <= 1000:
            raise ValueError(f"steps: must be between 1 and 1000, got {self.steps}")
        if not (np.isfinite(self.step) and self.step > 0):
            raise ValueError(f"step: must be a positive number of seconds, got {self.step}")
        if self.max_iterations < 1:
            raise ValueError(f"max_iterations: must be at least 1, got {self.max_iterations}")


@dataclass(frozen=True, eq=False)
class QuadraticEnd:
    """(x - x_g)' P (x - x_g).

    Attributes:
        matrix: P `[n, n]`, symmetric positive semidefinite.
        reference: x_g `[n]`.
    """

    matrix: Array
    reference: Array

    @classmethod
    def towards_goal(cls, query: Query, weight: float = WEIGHT) -> "QuadraticEnd":
        """P = `weight` I, but 0 for periodic coordinates, where a quadratic cost would jump.

        Raises:
            ValueError: if the weight is not positive.
        """
        if not (np.isfinite(weight) and weight > 0):
            raise ValueError(f"weight: must be a positive finite number, got {weight}")
        diagonal = np.where(query.system.period > 0, 0.0, weight)
        return cls(np.diag(diagonal), query.reference)

    def derivatives(self, state: Array) -> tuple[float, Array, Array]:
        gap = state - self.reference
        slope = self.matrix @ gap
        return float(gap @ slope), 2 * slope, 2 * self.matrix


@dataclass(frozen=True, eq=False)
class ValueEnd:
    """A value as the cost at the end; its second derivative by differences of the gradient.

    Attributes:
        value: with a gradient that belongs to it (`SplineValue` for a grid's), or Newton stalls.
        widths: `[n]`, of the differences to either side.
    """

    value: Value
    widths: Array

    @classmethod
    def of(cls, query: Query, value: Value, share: float = 1e-4) -> "ValueEnd":
        """Differences over a `share` of the domain."""
        return cls(value, share * (query.system.upper - query.system.lower))

    def derivatives(self, state: Array) -> tuple[float, Array, Array]:
        shifts = np.diag(self.widths)
        points = np.concatenate([state[None], state + shifts, state - shifts])
        slopes = self.value.gradient(points)
        n = len(state)
        second = (slopes[1 : n + 1] - slopes[n + 1 :]) / (2 * self.widths[:, None])
        return float(self.value.value(state)), slopes[0], (second + second.T) / 2


class HorizonValue:
    """The optimal cost over the horizon plus the cost at its end, a value that plans as it goes.

    A state near a motion already known is solved from its rest, others from rough motions; it stays
    in the class of motions that it has found, as a receding horizon does.
    """

    def __init__(self, query: Query, end: EndCost, settings: HorizonSettings) -> None:
        self.query, self.end, self.settings = query, end, settings
        self._known: deque[HorizonPlan] = deque(maxlen=REMEMBERED)
        self._last: tuple[bytes, HorizonPlan] | None = None

    def value(self, states: ArrayLike) -> Array:
        """The cost `[...]` at states `[..., n]`; 0 in the goal.

        Raises:
            SolveError: if no motion was found from a state.
        """
        rows = self.rows(states)
        flat = zip(rows.reshape(-1, rows.shape[-1]), self.at_rest(rows), strict=True)
        costs = [0.0 if arrived else self.motion(x).cost for x, arrived in flat]
        return np.array(costs).reshape(rows.shape[:-1])

    def gradient(self, states: ArrayLike) -> Array:
        """The derivative `[..., n]` of that cost at states `[..., n]`; 0 in the goal.

        Raises:
            SolveError: if no motion was found from a state.
        """
        rows = self.rows(states)
        flat = zip(rows.reshape(-1, rows.shape[-1]), self.at_rest(rows), strict=True)
        slopes = [np.zeros(len(x)) if arrived else self.motion(x).costate for x, arrived in flat]
        return np.array(slopes).reshape(rows.shape)

    def motion(self, state: Array) -> HorizonPlan:
        """The optimal motion over the horizon from `state` `[n]`.

        Raises:
            SolveError: if none was found.
        """
        key = state.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        plan = self._from_known(state)
        if plan is None:
            plan = self._from_scratch(state)
        self._known.append(plan)
        self._last = key, plan
        return plan

    @cached_property
    def _program(self) -> HorizonProgram:
        settings = self.settings
        structure = Structure.of(self.query, settings.steps, 1, False, settings.max_iterations)
        return horizon_program(structure, settings.step)

    def _from_known(self, state: Array) -> HorizonPlan | None:
        """From the known motion that passes nearest, shifted by a step if its second state does."""
        if not self._known:
            return None
        system = self.query.system
        passed = np.array([plan.states[:2] for plan in self._known])
        gaps = np.abs(system.difference(passed, state) / (system.upper - system.lower)).max(axis=-1)
        index, later = np.unravel_index(gaps.argmin(), gaps.shape)
        if gaps[index, later] > NEARBY:
            return None
        plan = self._known[int(index)]
        states, inputs, prices = plan.states[1:], plan.inputs, plan.multipliers
        if later:
            final = self._program.step(states[-1], inputs[-1], parameters(self.query))[0]
            states = np.concatenate([states[1:], np.array(final).T])
            inputs, prices = (np.concatenate([a[1:], a[-1:]]) for a in (inputs, prices))
        here = plan.states[int(later)]
        turns = state - here - system.difference(state, here)
        try:
            return self._program.solve(self.query, state, self.end, states + turns, inputs, prices)
        except SolveError:
            return None  # the rough motions are next

    def _from_scratch(self, state: Array) -> HorizonPlan:
        """The cheapest of the motions that the rough ones lead to."""
        found: list[HorizonPlan] = []
        failure = SolveError(Status.NOT_CONVERGED, "no rough motion to start from")
        for guess in default_guesses(self.query, state, limit=GUESSES):
            states, inputs = self._sampled(guess)
            try:
                found.append(self._program.solve(self.query, state, self.end, states, inputs))
            except SolveError as error:
                failure = error
        if not found:
            raise failure
        return min(found, key=lambda plan: plan.cost)

    def _sampled(self, guess: Trajectory) -> tuple[Array, Array]:
        """The beginning of a motion at the steps; at rest once it has ended."""
        times = self.settings.step * np.arange(self.settings.steps + 1)
        states = [np.interp(times[1:], guess.times, column) for column in guess.states.T]
        inputs = [
            np.interp(times[:-1], guess.times, column, right=0.0) for column in guess.inputs.T
        ]
        return np.stack(states, axis=-1), np.stack(inputs, axis=-1)

    def at_rest(self, rows: Array) -> NDArray[np.bool_]:
        """Which of the states `[..., n]`, flattened, lie in a goal ball, where motions end."""
        inside = self.query.goal_distance(rows) <= 0
        return np.ravel(inside) & (not self.query.is_regulation)

    def rows(self, states: ArrayLike) -> Array:
        """`states` `[..., n]` as finite numbers; raises a ValueError if they are none."""
        rows = np.asarray(states, dtype=float)
        n = self.query.system.n
        if rows.shape[-1:] != (n,) or not np.isfinite(rows).all():
            raise ValueError(f"states: need finite numbers [..., {n}], got shape {rows.shape}")
        return rows


@dataclass(frozen=True, eq=False)
class RecedingHorizonPolicy:
    """The first input of the optimal motion over the horizon; 0 in the goal.

    The input is meant to be held for `value.settings.step` seconds.
    """

    query: Query
    value: HorizonValue

    def __call__(self, states: ArrayLike) -> Array:
        """Inputs `[..., m]` at states `[..., n]`.

        Raises:
            SolveError: if no motion was found from a state.
        """
        rows = self.value.rows(states)
        inside = self.value.at_rest(rows)
        m = self.query.system.m
        inputs = [
            np.zeros(m) if arrived else self.value.motion(x).inputs[0]
            for x, arrived in zip(rows.reshape(-1, rows.shape[-1]), inside, strict=True)
        ]
        return np.array(inputs).reshape(*rows.shape[:-1], m)


def receding_horizon(
    query: Query, end: EndCost | None = None, settings: HorizonSettings | None = None
) -> RecedingHorizonPolicy:
    """Model predictive control of a query.

    Args:
        query: any query.
        end: cost at the horizon's end; by default the quadratic one.
        settings: the horizon; by default the paper's.
    """
    end = end or QuadraticEnd.towards_goal(query)
    return RecedingHorizonPolicy(query, HorizonValue(query, end, settings or HorizonSettings()))
