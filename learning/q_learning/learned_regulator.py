"""What Q-learning ends with, as functions of time: P, the Q-function's blocks and the gain K."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.q_learning.backward_sweep import interpolate, sweep
from learning.q_learning.quadratic_cost import QuadraticCost
from ocp.trajectory import SolveError, Status

Array = NDArray[np.float64]

SWEEP_TOLERANCE = 1e-10
LARGEST_NODES = 4000


@dataclass(frozen=True, eq=False)
class QFunction:
    """Q(x, u, t) = x' xx x + 2 u' ux x + u' uu u, the paper's (13) without its one half.

    Attributes:
        xx: `[..., n, n]` = dP/dt + P + M + PA + A'P.
        ux: `[..., m, n]` = B'P.
        uu: `[m, m]` = R.
    """

    xx: Array
    ux: Array
    uu: Array

    def value(self, states: ArrayLike, inputs: ArrayLike) -> Array:
        """Q `[...]` at states `[..., n]` and inputs `[..., m]`."""
        x, u = np.asarray(states, dtype=float), np.asarray(inputs, dtype=float)
        return (
            np.einsum("...i,...ij,...j->...", x, self.xx, x)
            + 2.0 * np.einsum("...i,...ij,...j->...", u, self.ux, x)
            + np.einsum("...i,ij,...j->...", u, self.uu, u)
        )

    def gain(self) -> Array:
        """K = uu^-1 ux `[..., m, n]`: u = -K x minimises Q (eq. 14)."""
        return np.asarray(np.linalg.solve(self.uu, self.ux), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class LearnedRegulator:
    """The finite-horizon regulator of a learned map Theta.

    Times run from 0 to the cost's horizon and are clipped to it. With `affine` the last coordinate
    of the learned state is the constant 1: K and P refer to [x, 1], and u = -K x - k.

    Attributes:
        cost: of the learned state (the constant included, if affine).
        theta: `[p, q]`, the learned map (see `window_regression`).
        affine: whether the plant's constant term was learned too.
        times: `[k]`, the sweep's nodes, seconds to go until the horizon.
        nodes: `[k, 3, q]`, there the coefficients of P and their first two rates.
    """

    cost: QuadraticCost
    theta: Array
    affine: bool
    times: Array
    nodes: Array

    @property
    def n(self) -> int:
        """States of the robot."""
        return self.cost.n - self.affine

    def P(self, times: ArrayLike = 0.0) -> Array:
        """P `[..., N, N]` at times `[...]`; N = n, or n + 1 if affine."""
        return matrices(self._coefficients(times)[0], self.cost.n)

    def gain(self, times: ArrayLike = 0.0) -> Array:
        """K `[..., m, n]` at times `[...]`."""
        return self._full_gain(times)[..., : self.n]

    def offset(self, times: ArrayLike = 0.0) -> Array:
        """k `[..., m]` in u = -K x - k; zero unless affine."""
        full = self._full_gain(times)
        return full[..., -1] if self.affine else np.zeros(full.shape[:-1])

    def input(self, states: ArrayLike, times: ArrayLike = 0.0) -> Array:
        """u = -K x - k `[..., m]` at states `[..., n]` and times `[...]`."""
        x = np.asarray(states, dtype=float)
        return -np.einsum("...ij,...j->...i", self.gain(times), x) - self.offset(times)

    def value(self, states: ArrayLike, times: ArrayLike = 0.0) -> Array:
        """The cost-to-go `[...]` from states `[..., n]` at times `[...]`."""
        x = np.asarray(states, dtype=float)
        if self.affine:
            x = np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
        return np.einsum("...i,...ij,...j->...", x, self.P(times), x)

    def q_function(self, times: ArrayLike = 0.0) -> QFunction:
        """The Q-function's blocks at times `[...]` (of the state [x, 1] if affine)."""
        coefficients, rates = self._coefficients(times)
        P_rate = -matrices(rates, self.cost.n)
        P = matrices(coefficients, self.cost.n)
        q = coefficients.shape[-1]
        H = matrices(coefficients @ self.theta[:q].T, self.cost.n)
        return QFunction(P_rate + P + self.cost.M + H, self._ux(coefficients), self.cost.R)

    def _ux(self, coefficients: Array) -> Array:
        q = coefficients.shape[-1]
        flat = 0.5 * coefficients @ self.theta[q:].T
        return flat.reshape(*coefficients.shape[:-1], self.cost.m, self.cost.n)

    def _full_gain(self, times: ArrayLike) -> Array:
        ux = self._ux(self._coefficients(times)[0])
        return np.asarray(np.linalg.solve(self.cost.R, ux), dtype=np.float64)

    def _coefficients(self, times: ArrayLike) -> tuple[Array, Array]:
        """Coefficients of P and their rates by time to go, `[..., q]`, at times `[...]`."""
        clipped = np.clip(np.asarray(times, dtype=float), 0.0, self.cost.horizon)
        to_go = self.cost.horizon - clipped
        values = np.empty((to_go.size, self.nodes.shape[2]))
        rates = np.empty_like(values)
        interpolate(self.times, self.nodes, to_go.ravel(), values, rates)
        shape = (*to_go.shape, self.nodes.shape[2])
        return values.reshape(shape), rates.reshape(shape)


def solve_backward(
    cost: QuadraticCost, theta: Array, affine: bool, tolerance: float = SWEEP_TOLERANCE
) -> LearnedRegulator:
    """Sweep P backward from P_T through the learned map `theta` `[p, q]`.

    Raises:
        SolveError: NOT_CONVERGED if P grows without bound: theta is far from any plant's map.
    """
    mass = coefficients_of(cost.M)
    times, nodes = np.empty(LARGEST_NODES), np.empty((LARGEST_NODES, 3, len(mass)))
    count = sweep(
        np.ascontiguousarray(theta),
        mass,
        np.linalg.inv(cost.R),
        coefficients_of(cost.terminal),
        (cost.n, cost.m),
        float(cost.horizon),
        tolerance,
        times,
        nodes,
    )
    if count < 0:
        raise SolveError(Status.NOT_CONVERGED, "the sweep of P through the learned map grew")
    return LearnedRegulator(cost, theta, affine, times[:count].copy(), nodes[:count].copy())


def coefficients_of(P: Array) -> Array:
    """Coefficients `[q]` of x'P x in the monomials x_i x_j, i <= j."""
    rows, columns = np.triu_indices(len(P))
    return P[rows, columns] * np.where(rows == columns, 1.0, 2.0)


def matrices(coefficients: Array, n: int) -> Array:
    """The symmetric matrices `[..., n, n]` of quadratic forms with coefficients `[..., q]`."""
    rows, columns = np.triu_indices(n)
    values = coefficients * np.where(rows == columns, 1.0, 0.5)
    out = np.zeros((*coefficients.shape[:-1], n, n))
    out[..., rows, columns] = values
    out[..., columns, rows] = values
    return out
