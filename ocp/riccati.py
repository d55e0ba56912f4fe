"""Linear-quadratic regulation: the algebraic and the differential Riccati equation.

The cost is x'M x + u'R u WITHOUT one half, so V = x'P x, the costate is 2 P x and u = -K x with
K = R^-1 B'P. Kontoudis, Xu and Vamvoudakis put 1/2 before every quadratic form, the terminal one
included: P and K are the same, their V and costate are half of ours.

States are measured from `reference`, where the drift must vanish.

Engines: python-control (algebraic); Drake's FiniteHorizonLinearQuadraticRegulator (differential).
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.query import Query
from ocp.system import System
from ocp.trajectory import SolveError, Status

# Drake's error control is absolute; the equation is scaled so that its data are of order 1. Between
# the integrator's steps P is a quintic, whose error is far smaller still.
INTEGRATION_ACCURACY = 1e-11
LARGEST_RESIDUAL = 1e-8
LARGEST_SKEW_GROWTH = 5.0  # as an exponent, over one call of the engine

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, init=False)
class LinearQuadratic:
    """The problem: x' = A x + B u, running cost x'M x + u'R u (x measured from `reference`).

    Attributes:
        A: `[n, n]`.
        B: `[n, m]`.
        M: `[n, n]`, symmetric positive semidefinite.
        R: `[m, m]`, symmetric positive definite.
        reference: `[n]`, the equilibrium to regulate to; 0 by default.

    Raises:
        ValueError: if a matrix has a wrong shape, is not finite or is not definite as stated.
    """

    A: Array
    B: Array
    M: Array
    R: Array
    reference: Array

    def __init__(
        self,
        A: ArrayLike,
        B: ArrayLike,
        M: ArrayLike,
        R: ArrayLike,
        reference: ArrayLike | None = None,
    ) -> None:
        A = _matrix("A", A)
        n = len(A)
        _need_shape("A", A, (n, n))
        B = _matrix("B", B)
        m = B.shape[1]
        _need_shape("B", B, (n, m))
        origin = np.zeros(n) if reference is None else np.array(reference, dtype=float)
        _need_shape("reference", origin, (n,))
        if not np.isfinite(origin).all():
            raise ValueError(f"reference: numbers must be finite, got {origin.tolist()}")
        checked = {
            "A": A,
            "B": B,
            "M": _symmetric("M", M, n, definite=False),
            "R": _symmetric("R", R, m, definite=True),
            "reference": origin,
        }
        for name, array in checked.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    def gain(self, P: ArrayLike) -> Array:
        """K = R^-1 B'P, `[..., m, n]`, of P `[..., n, n]`."""
        return np.asarray(np.linalg.solve(self.R, self.B.T @ np.asarray(P, dtype=float)), float)

    def residual(self, P: ArrayLike) -> Array:
        """M + A'P + P A - P B R^-1 B'P, `[..., n, n]`: 0 (algebraic) or -dP/dt (differential)."""
        P = np.asarray(P, dtype=float)
        return self.M + self.A.T @ P + P @ self.A - P @ self.B @ self.gain(P)

    @classmethod
    def of_query(cls, query: Query) -> "LinearQuadratic":
        """The problem of a query whose only running cost is `cost.state` = M and `cost.input` = R.

        The Riccati value is the cost of regulation to x_g (for ever, or up to the horizon); the
        query's own V stops at the first hit of the goal ball and is smaller.

        Raises:
            SolveError: NOT_APPLICABLE, with the reason, if the query is not of that form.
        """

        def refuse(reason: str) -> SolveError:
            return SolveError(Status.NOT_APPLICABLE, f"Riccati: {reason}")

        if query.cost.state is None:
            raise refuse("the query has no quadratic state cost (cost.state)")
        if query.cost.goal != 0:
            raise refuse("the goal's cost is not quadratic (cost.goal must be 0)")
        if query.obstacles:
            raise refuse("the query has obstacles")
        if query.is_bounded:
            raise refuse("the query's inputs are bounded")
        A, B = linear_dynamics(query.system)
        drift = query.system.dynamics(query.reference, np.zeros(query.system.m))
        if np.abs(np.array(drift)).max() > 1e-12:
            raise refuse(
                f"the drift at the goal {query.reference.tolist()} is not zero: no input-free rest"
            )
        return cls(A, B, np.array(query.cost.state), np.diag(query.input_weights), query.reference)


def linear_dynamics(system: System) -> tuple[Array, Array]:
    """A `[n, n]` (the drift's Jacobian) and B `[n, m]` of a linear or affine robot.

    Raises:
        SolveError: NOT_APPLICABLE if the robot is not linear.
    """
    A = ca.simplify(ca.jacobian(system.drift, system.state))
    B = ca.simplify(system.input_matrix)
    depends = ca.depends_on(ca.vertcat(ca.vec(A), ca.vec(B)), system.state)
    if depends:
        raise SolveError(Status.NOT_APPLICABLE, f"Riccati: {system.name} is not linear")
    return np.array(ca.evalf(A), dtype=float), np.array(ca.evalf(B), dtype=float)


@dataclass(frozen=True)
class QuadraticValue:
    """V(x) = (x - x_g)'P (x - x_g), for P `[n, n]` and x_g `[n]`."""

    P: Array
    reference: Array

    def value(self, states: ArrayLike) -> Array:
        """V `[...]` at states `[..., n]`."""
        offset = np.asarray(states, dtype=float) - self.reference
        return np.einsum("...i,ij,...j->...", offset, self.P, offset)

    def gradient(self, states: ArrayLike) -> Array:
        """2 P (x - x_g), `[..., n]`, at states `[..., n]`."""
        return 2.0 * (np.asarray(states, dtype=float) - self.reference) @ self.P


class Regulator(ABC):
    """A solution of either equation: a Value (at time 0) and its feedback, in terms of P(t)."""

    problem: LinearQuadratic

    @abstractmethod
    def P(self, times: ArrayLike = 0.0) -> Array:
        """P `[..., n, n]` at times `[...]`."""

    def gain(self, times: ArrayLike = 0.0) -> Array:
        """K `[..., m, n]` at times `[...]`."""
        return self.problem.gain(self.P(times))

    def at(self, time: float) -> QuadraticValue:
        """The cost-to-go from `time` on, as a Value."""
        return QuadraticValue(self.P(time), self.problem.reference)

    def value(self, states: ArrayLike, times: ArrayLike = 0.0) -> Array:
        """V `[...]` at states `[..., n]` and times `[...]`."""
        offset = np.asarray(states, dtype=float) - self.problem.reference
        return np.einsum("...i,...ij,...j->...", offset, self.P(times), offset)

    def gradient(self, states: ArrayLike, times: ArrayLike = 0.0) -> Array:
        """The costate 2 P x, `[..., n]`, at states `[..., n]` and times `[...]`."""
        offset = np.asarray(states, dtype=float) - self.problem.reference
        return 2.0 * np.einsum("...ij,...j->...i", self.P(times), offset)

    def input(self, states: ArrayLike, times: ArrayLike = 0.0) -> Array:
        """u = -K x, `[..., m]`, at states `[..., n]` and times `[...]`."""
        offset = np.asarray(states, dtype=float) - self.problem.reference
        return -np.einsum("...ij,...j->...i", self.gain(times), offset)


@dataclass(frozen=True, eq=False)
class AlgebraicRiccati(Regulator):
    """Regulation for ever: the stabilising solution of `residual(P) = 0`.

    Attributes:
        problem: what was solved.
        matrix: P `[n, n]`, the same at every time.
    """

    problem: LinearQuadratic
    matrix: Array

    def P(self, times: ArrayLike = 0.0) -> Array:
        n = self.problem.n
        return np.broadcast_to(self.matrix, (*np.shape(times), n, n))

    @cached_property
    def decay_rate(self) -> float:
        """The closed loop's slowest exponential rate, 1/s."""
        closed_loop = self.problem.A - self.problem.B @ self.gain()
        return float(-np.linalg.eigvals(closed_loop).real.max())


@dataclass(frozen=True, eq=False)
class DifferentialRiccati(Regulator):
    """Regulation up to `horizon`: -dP/dt = `residual(P)`, P(horizon) = `terminal`.

    Attributes:
        problem: what was solved.
        horizon: seconds; times run from 0 to `horizon`.
        terminal: P_T `[n, n]`.
        interpolant: t -> P(t), piecewise quintic between the integrator's steps.
    """

    problem: LinearQuadratic
    horizon: float
    terminal: Array
    interpolant: Any

    def P(self, times: ArrayLike = 0.0) -> Array:
        """P `[..., n, n]` at times `[...]`.

        Raises:
            ValueError: if a time lies outside [0, horizon] (by more than rounding).
        """
        times = np.asarray(times, dtype=float)
        slack = 1e-9 * self.horizon
        if not ((times >= -slack) & (times <= self.horizon + slack)).all():
            raise ValueError(
                f"times: must lie in [0, {self.horizon:g}] s, "
                f"got {times.min():g} to {times.max():g}"
            )
        return self.interpolant(np.clip(times, 0.0, self.horizon))


def algebraic_riccati(problem: LinearQuadratic) -> AlgebraicRiccati:
    """Solve M + A'P + P A - P B R^-1 B'P = 0 for the stabilising P.

    Raises:
        ValueError: if (A, B) is not stabilisable or (A, M) not detectable; the mode is named.
        SolveError: NOT_CONVERGED if the engine's answer does not satisfy the equation.

    Example:
        >>> problem = LinearQuadratic([[0.0]], [[1.0]], [[1.0]], [[1.0]])  # x' = u, cost x^2 + u^2
        >>> round(float(algebraic_riccati(problem).value([2.0])), 9)  # P = 1
        4.0
    """
    import control

    A, B, M = problem.A, problem.B, problem.M
    _need_modes(A, B, "A, B: not stabilisable: no input reaches")
    _need_modes(A.T, M, "A, M: not detectable: the cost M does not see")
    try:
        P, _, _ = control.care(A, B, M, problem.R)
    except (np.linalg.LinAlgError, control.exception.ControlArgument) as error:
        raise SolveError(Status.NOT_CONVERGED, f"algebraic Riccati: {error}") from error
    P = (P + P.T) / 2
    solution = AlgebraicRiccati(problem, P)
    scale = np.abs(M).max() + 2 * np.abs(A.T @ P).max() + np.abs(P @ B @ problem.gain(P)).max()
    residual = np.abs(problem.residual(P)).max()
    if not (residual <= LARGEST_RESIDUAL * scale and solution.decay_rate > 0):
        raise SolveError(
            Status.NOT_CONVERGED,
            f"algebraic Riccati: residual {residual:.1e}, decay rate {solution.decay_rate:.1e}",
        )
    return solution


def differential_riccati(
    problem: LinearQuadratic, terminal: ArrayLike, horizon: float
) -> DifferentialRiccati:
    """Solve -dP/dt = M + A'P + P A - P B R^-1 B'P backward from P(horizon) = `terminal` `[n, n]`.

    Raises:
        ValueError: if `terminal` is not symmetric positive semidefinite or `horizon` not positive.
        SolveError: NOT_CONVERGED if the integrator gave up.
    """
    from pydrake.systems.controllers import (
        FiniteHorizonLinearQuadraticRegulator,
        FiniteHorizonLinearQuadraticRegulatorOptions,
    )
    from pydrake.systems.primitives import LinearSystem
    from scipy.interpolate import BPoly

    n, m = problem.n, problem.m
    end = _symmetric("terminal", terminal, n, definite=False)
    if not (np.isfinite(horizon) and horizon > 0):
        raise ValueError(f"horizon: must be a positive finite number of seconds, got {horizon}")

    # (c M, c R, c P_T) has the solution c P.
    scale = max(np.abs(problem.M).max(), np.abs(end).max())
    if scale == 0:
        zero = np.zeros((2, 3, n, n))
        return DifferentialRiccati(
            problem, float(horizon), end, BPoly.from_derivatives([0.0, horizon], zero)
        )
    matrices: tuple[Any, ...] = (problem.A, problem.B, np.eye(n), np.zeros((n, m)))
    plant = LinearSystem(*matrices)  # Drake's stubs mistype arrays, hence Any
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, np.zeros(m))
    options = FiniteHorizonLinearQuadraticRegulatorOptions()
    config = options.simulator_config
    config.integration_scheme = "runge_kutta5"
    config.accuracy = INTEGRATION_ACCURACY
    config.max_step_size = horizon / 20
    # Drake integrates all n x n entries, and on an unstable plant the skew part of the rounding
    # error grows like exp(2 s t), s the plant's fastest rate: take it out before it matters.
    growth = 2.0 * max(0.0, float(np.linalg.eigvals(problem.A).real.max())) * horizon
    ends = np.linspace(horizon, 0.0, 2 + int(growth / LARGEST_SKEW_GROWTH))
    backward_times, backward_P = [np.array([horizon])], [end[None] / scale]
    for late, early in pairwise(ends):
        options.Qf = backward_P[-1][-1]
        try:
            result = FiniteHorizonLinearQuadraticRegulator(
                plant, context, early, late, problem.M / scale, problem.R / scale, options
            )
        except RuntimeError as error:
            raise SolveError(Status.NOT_CONVERGED, f"differential Riccati: {error}") from error
        drake_solution: Any = result.S
        steps = np.array(drake_solution.get_segment_times())[-2::-1]
        piece = np.array([drake_solution.value(t) for t in steps])
        backward_times.append(steps)
        backward_P.append((piece + piece.transpose(0, 2, 1)) / 2)
    times = np.concatenate(backward_times)[::-1]
    P = scale * np.concatenate(backward_P)[::-1]
    # At the steps both derivatives follow from the equation, so the interpolant can be a quintic;
    # Drake's own is a cubic and loses four digits.
    rate = -problem.residual(P)
    closed_loop = problem.A - problem.B @ problem.gain(P)
    half = rate @ closed_loop
    acceleration = -(half + half.transpose(0, 2, 1))
    interpolant = BPoly.from_derivatives(times, np.stack([P, rate, acceleration], axis=1))
    return DifferentialRiccati(problem, float(horizon), end, interpolant)


def _matrix(name: str, value: ArrayLike) -> Array:
    array = np.array(value, dtype=float)
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"{name}: must be a matrix (rows of numbers), got shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: numbers must be finite, got {array.tolist()}")
    return array


def _need_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name}: must have shape {shape}, got {array.shape}")


def _symmetric(name: str, value: ArrayLike, size: int, definite: bool) -> Array:
    array = _matrix(name, value)
    _need_shape(name, array, (size, size))
    tolerance = 1e-12 * np.abs(array).max()
    if np.abs(array - array.T).max() > tolerance:
        raise ValueError(f"{name}: must be symmetric, got {array.tolist()}")
    array = (array + array.T) / 2
    least = float(np.linalg.eigvalsh(array).min())
    if definite and least <= tolerance:
        raise ValueError(f"{name}: must be positive definite, its least eigenvalue is {least:.3g}")
    if not definite and least < -size * tolerance:
        raise ValueError(
            f"{name}: must be positive semidefinite, its least eigenvalue is {least:.3g}"
        )
    return array


def _need_modes(A: Array, B: Array, complaint: str) -> None:
    """Hautus: [A - s I, B] has full rank at every eigenvalue s of A that does not decay."""
    n = len(A)
    size = np.linalg.norm(np.hstack([A, B]), 2)
    for s in np.linalg.eigvals(A):
        # A defective eigenvalue is known to eps^(1/k) only, hence the generous margins.
        if s.real >= -1e-7 * size:
            pencil = np.hstack([A - s * np.eye(n), B]).astype(complex)
            if np.linalg.svd(pencil, compute_uv=False)[-1] <= 1e-7 * size:
                raise ValueError(f"{complaint} the mode with eigenvalue {s:.4g}")
