"""The value of regulation that exact motions and their second derivatives make.

Along an optimal motion the second derivatives of V obey a Riccati equation (Bryson and Ho, "Applied
Optimal Control", chapter 6); with them V is known to second order beside the motion too.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import optimal_inputs
from ocp.query import Query
from ocp.regulation import regulator, solve_regulation, state_cost_hessian, step_of
from ocp.system import System
from ocp.trajectory import Trajectory

Array = NDArray[np.float64]

NEAR = 0.05  # of the domain: beyond it a state asks for a motion of its own


@dataclass(frozen=True)
class Expansion:
    """V to second order along one optimal motion of `k` points.

    Attributes:
        motion: with costates.
        hessians: `[k, n, n]`, second derivatives of V at its points.
    """

    motion: Trajectory
    hessians: Array

    @cached_property
    def to_go(self) -> Array:
        """`[k]`, V at the points."""
        return self.motion.cost_to_go


def expand(query: Query, motion: Trajectory) -> Expansion:
    """The second derivatives of V along an optimal motion with costates, by backward integration.

    -dS/dt = H_xx + A'S + S A - K' 2R K,  K = (2R)^-1 (H_ux + G'S), inputs at a bound left out.

    Raises:
        ValueError: if the motion has no costates.
    """
    from scipy.linalg import expm

    if motion.costates is None:
        raise ValueError("motion: needs costates")
    count = max(2, int(np.ceil(motion.duration / step_of(query))) + 1)
    times = np.linspace(0.0, motion.duration, count)

    def sample(values: Array) -> Array:
        columns = values.reshape(len(values), -1).T
        return np.stack([np.interp(times, motion.times, c) for c in columns], axis=-1)

    states, costates = sample(motion.states), sample(motion.costates)
    inputs = optimal_inputs(query, states, costates)
    A, G, Hxx, Hux = _second_order(query, states, inputs, costates)
    middle = [(x[1:] + x[:-1]) / 2 for x in (A, G, Hxx, Hux)]
    free = _share_within(query, query.reference_input - _pull(query, G, costates))
    inverse = free / (2.0 * query.input_weights)
    # The Riccati equation as a linear flow of [X, Y], S = Y X^-1, constant over a step (Davison and
    # Maki 1973): stable however stiff it is, and of second order.
    A, G, Hxx, Hux = middle
    push = G * inverse[:, None, :]
    drift = A - push @ Hux
    bend = Hxx - Hux.transpose(0, 2, 1) @ (inverse[:, :, None] * Hux)
    across = push @ G.transpose(0, 2, 1)
    flow = np.block([[drift, -across], [-bend, -drift.transpose(0, 2, 1)]])
    steps = expm(-(times[1] - times[0]) * flow)
    S = 2.0 * regulator(query).matrix
    n = len(S)
    hessians = np.empty((count, n, n))
    hessians[-1] = S
    for i in range(count - 1, 0, -1):
        both = steps[i - 1] @ np.vstack([np.eye(n), S])
        S = np.linalg.solve(both[:n].T, both[n:].T).T
        S = (S + S.T) / 2
        hessians[i - 1] = S
    costs = np.interp(times, motion.times, motion.cost_so_far)
    return Expansion(Trajectory(times, states, inputs, costates, costs), hessians)


def _pull(query: Query, G: Array, costates: Array) -> Array:
    """(2R)^-1 G'p, `[k, m]`: how far the best unbounded input lies below the one at rest."""
    return np.einsum("knm,kn->km", G, costates) / (2.0 * query.input_weights)


def _share_within(query: Query, wanted: Array) -> Array:
    """`[k - 1, m]`, for what share of each step inputs that go linearly are within the bounds."""
    lower, upper = query.input_bounds
    low, high = np.minimum(wanted[1:], wanted[:-1]), np.maximum(wanted[1:], wanted[:-1])
    width = np.maximum(high - low, 1e-12)
    within = np.minimum(high, upper) - np.maximum(low, lower)
    still = ((low >= lower) & (high <= upper)).astype(float)
    return np.where(high - low < 1e-12, still, np.clip(within / width, 0.0, 1.0))


class RegulationValue:
    """V and grad V from optimal motions and their second derivatives.

    A state farther than `near` of the domain from every known motion is solved for anew, so a
    closed loop that is greedy for this value tracks an optimum and plans again when it is off.
    """

    def __init__(self, query: Query, near: float = NEAR) -> None:
        self.query = query
        self.near = near
        self.expansions: list[Expansion] = []

    def add(self, motion: Trajectory) -> None:
        """Learn an optimal motion."""
        self.expansions.append(expand(self.query, motion))

    def value(self, states: ArrayLike) -> Array:
        """V `[...]` at states `[..., n]`.

        Raises:
            SolveError: if a new motion was needed and not found.
        """
        return self._both(states)[0]

    def gradient(self, states: ArrayLike) -> Array:
        """The costates `[..., n]` at states `[..., n]`.

        Raises:
            SolveError: if a new motion was needed and not found.
        """
        return self._both(states)[1]

    def _both(self, states: ArrayLike) -> tuple[Array, Array]:
        rows = np.asarray(states, dtype=float)
        flat = rows.reshape(-1, rows.shape[-1])
        values, gradients = np.empty(len(flat)), np.empty_like(flat)
        for i, x in enumerate(flat):
            values[i], gradients[i] = self._at(x)
        return values.reshape(rows.shape[:-1]), gradients.reshape(rows.shape)

    def _at(self, x: Array) -> tuple[float, Array]:
        found = [self._from(e, x) for e in self.expansions]
        near = [f for f in found if f[0] <= self.near]
        if not near:
            self.add(solve_regulation(self.query, self.query.system.wrap(x)))
            near = [self._from(self.expansions[-1], x)]
        _, value, gradient = min(near, key=lambda f: f[0])
        return value, gradient

    def _from(self, expansion: Expansion, x: Array) -> tuple[float, float, Array]:
        """Distance as a share of the domain, value and gradient, from the nearest point."""
        system, motion = self.query.system, expansion.motion
        extent = system.upper - system.lower
        gaps = system.difference(x, motion.states)
        sizes = (gaps / extent) ** 2
        i = int(sizes.sum(axis=1).argmin())
        # Between this point and its better neighbour: no jumps from point to point.
        j = i + 1 if i == 0 else i - 1
        if 0 < i < len(gaps) - 1 and sizes[i + 1].sum() < sizes[i - 1].sum():
            j = i + 1
        along = (motion.states[j] - motion.states[i]) / extent
        length = float(along @ along)
        share = float(np.clip((gaps[i] / extent) @ along / length, 0, 1)) if length > 0 else 0.0
        gap = gaps[i] - share * (motion.states[j] - motion.states[i])
        assert motion.costates is not None
        mixed = [(1 - share) * v[i] + share * v[j] for v in (expansion.to_go, motion.costates)]
        S = (1 - share) * expansion.hessians[i] + share * expansion.hessians[j]
        slope = mixed[1] + S @ gap
        value = float(mixed[0] + mixed[1] @ gap + gap @ S @ gap / 2)
        return float(np.sqrt(((gap / extent) ** 2).max())), max(value, 0.0), slope


@lru_cache(maxsize=64)
def _bilinear_parts(system: System) -> ca.Function:
    """(x, u, p) -> A, G, and the second derivatives xx and ux of p'(f + G u)."""
    n, m = system.n, system.m
    u, p = ca.SX.sym("u", m), ca.SX.sym("p", n)  # pyright: ignore[reportArgumentType]
    rate = system.drift + system.input_matrix @ u
    power = ca.dot(p, rate)
    xx = ca.hessian(power, system.state)[0]
    ux = ca.jacobian(ca.gradient(power, u), system.state)
    parts = [ca.jacobian(rate, system.state), system.input_matrix, xx, ux]
    return ca.Function("parts", [system.state, u, p], [ca.densify(part) for part in parts])


def _second_order(
    query: Query, states: Array, inputs: Array, costates: Array
) -> tuple[Array, Array, Array, Array]:
    """A `[k, n, n]`, G `[k, n, m]`, H_xx `[k, n, n]` and H_ux `[k, m, n]` along a motion."""
    count = len(states)
    parts = _bilinear_parts(query.system).map(count)(states.T, inputs.T, costates.T)

    def stacked(part: ca.DM) -> Array:
        whole = np.array(part)
        return whole.reshape(len(whole), count, -1).transpose(1, 0, 2)

    A, G, xx, ux = (stacked(part) for part in parts)
    cost = stacked(state_cost_hessian(query).map(count)(states.T))
    return A, G, xx + cost, ux
