"""Exact motions of a given duration, with a quadratic terminal cost and no goal ball."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.extremals.extremal import SEGMENTS, Precision, find_extremal
from ocp.extremals.guess import default_guesses
from ocp.extremals.transversality import quadratic_condition
from ocp.kernels import kernels, parameters
from ocp.query import Query
from ocp.trajectory import SolveError, Status, Trajectory

Array = NDArray[np.float64]

MAX_SEGMENTS = 400
PRECISION = Precision(step=1e-11)
GROWTH = 1.5  # exponent by which a segment's errors may grow


@dataclass(frozen=True)
class FixedTimeMotion:
    """An optimal motion of a given duration.

    Attributes:
        trajectory: its cost is the running cost alone.
        terminal_cost: (x - x_g)' P_T (x - x_g) at the end.
        hessian: `[n, n]`, second derivatives of V at the start; for a linear robot with quadratic
            cost, twice the solution P(0) of the differential Riccati equation.
        bounds_active: whether the input touches a bound somewhere.
    """

    trajectory: Trajectory
    terminal_cost: float
    hessian: Array
    bounds_active: bool

    @property
    def value(self) -> float:
        """V at the start: running and terminal cost."""
        return self.trajectory.cost + self.terminal_cost


def solve_fixed_time(
    query: Query,
    start: ArrayLike,
    horizon: float,
    terminal_cost: ArrayLike | None = None,
    guess: Trajectory | None = None,
) -> FixedTimeMotion:
    """Minimise running cost over `horizon` seconds plus (x - x_g)' P_T (x - x_g) at the end.

    The goal ball plays no part but in the running cost.

    Args:
        query: the query.
        start: `[n]`, a state in the domain, outside hard obstacles.
        horizon: seconds.
        terminal_cost: P_T `[n, n]`, symmetric positive semidefinite; by default 0.
        guess: a motion of about that duration; by default rough ones, tried in turn. For a linear
            robot with quadratic cost any guess will do.

    Raises:
        ValueError: if an argument does not fit.
        SolveError: NOT_CONVERGED; WRONG_EXTREMAL if the extremal has a conjugate point;
            NOT_APPLICABLE if it touches a hard obstacle.
    """
    start = query.check_start(start)
    if not (np.isfinite(horizon) and horizon > 0):
        raise ValueError(f"horizon: must be a positive finite number of seconds, got {horizon}")
    n = query.system.n
    P = np.zeros((n, n)) if terminal_cost is None else np.asarray(terminal_cost, dtype=float)
    if P.shape != (n, n) or not np.isfinite(P).all() or not np.allclose(P, P.T):
        raise ValueError(f"terminal_cost: must be a symmetric {n} x {n} matrix, got {P.tolist()}")
    if np.linalg.eigvalsh(P).min() < -1e-12 * max(1.0, abs(P).max()):
        raise ValueError(f"terminal_cost: must be positive semidefinite, got {P.tolist()}")
    center = query.reference
    if guess is not None:  # it may end whole turns away
        last = guess.states[-1]
        center = last - query.system.difference(last, center)
    condition = quadratic_condition(center, P)
    guesses = [guess] if guess is not None else default_guesses(query, start, horizon)
    if guess is None:  # along an unstable robot's rough motion the adjoint equation may explode
        guesses.append(replace(guesses[0], costates=0 * guesses[0].states))
    segments = _segments(query, start, horizon)
    extremal = None
    for rough in guesses:
        extremal = find_extremal(
            query,
            start,
            _lasting(rough, horizon),
            condition,
            segments=segments,
            precision=PRECISION,
        )
        if extremal.trajectory is not None and extremal.hessian is not None:
            offset = extremal.trajectory.states[-1] - center
            return FixedTimeMotion(
                extremal.trajectory,
                float(offset @ P @ offset),
                extremal.hessian,
                extremal.bounds_active,
            )
    if extremal is None:
        raise SolveError(Status.NOT_CONVERGED, "there was no guess")
    raise SolveError(extremal.status, extremal.detail)


def _lasting(guess: Trajectory, horizon: float) -> Trajectory:
    """`guess` stretched to the horizon."""
    return replace(guess, times=guess.times * (horizon / guess.duration))


def _segments(query: Query, start: Array, horizon: float) -> int:
    """So many segments that errors grow little in one, judged at the start."""
    n = query.system.n
    rate, jacobian = np.empty(2 * n), np.empty((2 * n, 2 * n))
    z = np.concatenate([start, np.zeros(n)])
    kernels(query).flow_jacobian(z, parameters(query), rate, jacobian)
    fastest = float(abs(np.linalg.eigvals(jacobian)).max())
    return min(MAX_SEGMENTS, max(SEGMENTS, math.ceil(horizon * fastest / GROWTH)))
