"""When may a plant be called learned? Rank, condition and a claim of the gain's error.

Rank and condition are taken in the coordinates in which the visited states are white (their second
moments form the identity), columns scaled to unit length. They then measure the excitation itself:
units, and states that move together, no longer count against it. On ten correlated states this is
worth three to four orders of magnitude.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.q_learning.learned_regulator import LearnedRegulator, matrices, solve_backward
from learning.q_learning.quadratic_cost import QuadraticCost
from learning.q_learning.window_regression import WindowRegression
from ocp.trajectory import SolveError

Array = NDArray[np.float64]

NOT_MOVED = 1e-7
DRAWS = 8
GRID = 51


@dataclass(frozen=True)
class Excitation:
    """How well the data determine the unknowns, in white coordinates.

    Attributes:
        rank: singular values above 1/`largest_condition` of the largest.
        required_rank: the number of unknowns p.
        condition: largest over least singular value; infinite if the least is zero.
        rows: windows behind it.
    """

    rank: int
    required_rank: int
    condition: float
    rows: int


@dataclass(frozen=True)
class Certificate:
    """What is known about a learned gain, from the data alone.

    Attributes:
        excitation: rank and condition of the data.
        gain_error: the claimed error of K over the horizon, sqrt(sum |dK|^2 / sum |K|^2);
            infinite where nothing can be claimed. It is the root of the sum of squares of: the
            effect on K of redrawing Theta from its estimated distribution (noise), the effect of a
            quadrature rule of lower order (sampling), and rounding times the condition number.
        holds: whether the plant counts as learned.
        reason: why it does not; empty if it does.
    """

    excitation: Excitation
    gain_error: float
    holds: bool
    reason: str


@dataclass(frozen=True, eq=False)
class _System:
    """The triangular system in white, scaled columns: factor `[p, p]` = triangle @ change."""

    factor: Array
    change: Array

    def solve(self, right: Array) -> Array:
        """The unknowns of the original columns, `[..., p, k]`, for `right` `[..., p, k]`."""
        return self.change @ np.linalg.solve(self.factor, right)

    def excitation(self, rows: int, largest_condition: float) -> Excitation:
        values = np.linalg.svd(self.factor, compute_uv=False)
        rank = int((values * largest_condition > values[0]).sum()) if values[0] > 0 else 0
        condition = float(values[0] / values[-1]) if values[-1] > 0 else np.inf
        return Excitation(rank, len(values), condition, rows)


def measure_excitation(data: WindowRegression, largest_condition: float) -> Excitation:
    """Rank and condition of the regressors absorbed so far."""
    return _white(data).excitation(data.rows, largest_condition)


def certify(
    data: WindowRegression,
    cost: QuadraticCost,
    affine: bool,
    largest_condition: float,
    accuracy: float,
    seed: int = 0,
) -> tuple[Certificate, LearnedRegulator | None]:
    """The certificate of the data, and the regulator learned from them if one could be computed."""
    system = _white(data)
    excitation = system.excitation(data.rows, largest_condition)

    def short(reason: str) -> Certificate:
        return Certificate(excitation, np.inf, False, reason)

    if excitation.rank < data.p:
        return short(
            f"the data are not exciting enough: rank {excitation.rank} of {data.p} after "
            f"{data.rows} windows (condition {excitation.condition:.1e}, at most "
            f"{largest_condition:.0e}); probe more or longer"
        ), None
    spare = data.effective_rows - data.p
    needed = max(4, data.p // 8)
    theta = system.solve(data.rotated[:, : data.q])
    try:
        regulator = solve_backward(cost, theta, affine)
    except SolveError as error:
        return short(str(error)), None
    if spare < needed:
        return short(
            f"{data.rows} windows for {data.p} unknowns: at least {data.p + needed} are needed "
            "to judge the fit"
        ), regulator
    claim = _claimed_error(data, system, regulator, excitation.condition, spare, seed)
    if not claim <= accuracy:
        return Certificate(
            excitation,
            claim,
            False,
            f"the gain's claimed error {claim:.2g} exceeds {accuracy:.2g}: collect more data",
        ), regulator
    return Certificate(excitation, claim, True, ""), regulator


def relative_gain_error(gains: Array, reference: Array) -> float:
    """sqrt(sum |K - K_ref|^2 / sum |K_ref|^2) of gains `[k, m, n]` on a grid over the horizon."""
    return float(np.linalg.norm(gains - reference) / np.linalg.norm(reference))


def _claimed_error(
    data: WindowRegression,
    system: _System,
    regulator: LearnedRegulator,
    condition: float,
    spare: float,
    seed: int,
) -> float:
    cost, theta, affine = regulator.cost, regulator.theta, regulator.affine
    times = np.linspace(0.0, cost.horizon, GRID)
    reference = regulator.gain(times)

    def change(perturbed: Array) -> float:
        other = solve_backward(cost, perturbed, affine, tolerance=1e-8)
        return relative_gain_error(other.gain(times), reference)

    # Measurement noise at a window's ends is its own, noise in its integrals is shared by all the
    # windows that overlap it. The variance to use lies between 1 and `window` times the residuals';
    # the geometric mean is taken.
    covariance = data.residual * np.sqrt(data.window) / spare
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    noise = np.random.default_rng(seed).standard_normal((DRAWS, data.p, data.q)) @ root.T
    errors = system.solve(noise)
    rules = system.solve(data.rotated[:, data.q :] @ theta)
    try:
        sampling = change(theta + rules)
        spread = np.array([change(theta + e) for e in errors])
    except SolveError:
        return np.inf
    rounding = condition * np.finfo(float).eps * np.sqrt(data.p)
    return float(np.sqrt(np.mean(spread**2) + sampling**2 + rounding**2))


def _white(data: WindowRegression) -> _System:
    n, m, q = data.n, data.m, data.q
    second = matrices(data.moments * np.where(_is_diagonal(n), 1.0, 2.0), n)
    size = np.sqrt(np.diag(second))
    size = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(second / np.outer(size, size))
    # A direction that the states never took is left zero, for the rank to show.
    seen = values > NOT_MOVED**2 * values[-1]
    inverse_root = np.where(seen, 1.0 / np.sqrt(np.where(seen, values, 1.0)), 0.0)
    whitening = inverse_root[:, None] * vectors.T / size
    rows, columns = np.triu_indices(n)
    pairs = np.einsum("ai,bj->abij", whitening, whitening)[rows, columns]
    pairs = (pairs + pairs.transpose(0, 2, 1))[:, rows, columns]
    change = np.zeros((data.p, data.p))
    change[:q, :q] = np.where(_is_diagonal(n), 0.5, 1.0)[:, None] * pairs.T
    for k in range(m):
        block = slice(q + k * n, q + (k + 1) * n)
        change[block, block] = whitening.T
    lengths = np.linalg.norm(data.triangle @ change, axis=0)
    change /= np.where(lengths > 0, lengths, 1.0)
    return _System(data.triangle @ change, change)


def _is_diagonal(n: int) -> NDArray[np.bool_]:
    rows, columns = np.triu_indices(n)
    return rows == columns
