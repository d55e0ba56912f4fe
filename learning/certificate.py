"""When may a plant be called learned? Rank, condition and a claim of the gain's error."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.learned_regulator import LearnedRegulator, solve_backward
from learning.quadratic_cost import QuadraticCost
from learning.window_regression import WindowRegression
from ocp.trajectory import SolveError

Array = NDArray[np.float64]

DRAWS = 8
GRID = 51


@dataclass(frozen=True)
class Excitation:
    """How well the data determine the unknowns, their columns scaled to unit length.

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


def measure_excitation(data: WindowRegression, largest_condition: float) -> Excitation:
    """Rank and condition of the regressors absorbed so far."""
    scaled, _ = _scaled(data)
    values = np.linalg.svd(scaled, compute_uv=False)
    rank = int((values * largest_condition > values[0]).sum()) if values[0] > 0 else 0
    condition = float(values[0] / values[-1]) if values[-1] > 0 else np.inf
    return Excitation(rank, data.p, condition, data.rows)


def learned_map(data: WindowRegression) -> Array:
    """Theta `[p, q]`, the least-squares solution; the rank must be full."""
    scaled, lengths = _scaled(data)
    return np.linalg.solve(scaled, data.rotated[:, : data.q]) / lengths[:, None]


def certify(
    data: WindowRegression,
    cost: QuadraticCost,
    affine: bool,
    largest_condition: float,
    accuracy: float,
    seed: int = 0,
) -> tuple[Certificate, LearnedRegulator | None]:
    """The certificate of the data, and the regulator learned from them if one could be computed."""
    excitation = measure_excitation(data, largest_condition)

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
    theta = learned_map(data)
    try:
        regulator = solve_backward(cost, theta, affine)
    except SolveError as error:
        return short(str(error)), None
    if spare < needed:
        return short(
            f"{data.rows} windows for {data.p} unknowns: at least {data.p + needed} are needed "
            "to judge the fit"
        ), regulator
    claim = _claimed_error(data, regulator, excitation.condition, spare, seed)
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
    data: WindowRegression, regulator: LearnedRegulator, condition: float, spare: float, seed: int
) -> float:
    scaled, lengths = _scaled(data)
    cost, theta, affine = regulator.cost, regulator.theta, regulator.affine
    times = np.linspace(0.0, cost.horizon, GRID)
    reference = regulator.gain(times)

    def change(perturbed: Array) -> float:
        other = solve_backward(cost, perturbed, affine, tolerance=1e-8)
        return relative_gain_error(other.gain(times), reference)

    # Measurement noise enters at a window's two ends; overlapping windows share none of them until
    # one begins where another ends, so the residuals' covariance stands as it is.
    values, vectors = np.linalg.eigh(data.residual / spare)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    noise = np.random.default_rng(seed).standard_normal((DRAWS, data.p, data.q)) @ root.T
    errors = np.linalg.solve(scaled, noise) / lengths[:, None]
    rules = np.linalg.solve(scaled, data.rotated[:, data.q :] @ theta) / lengths[:, None]
    try:
        sampling = change(theta + rules)
        spread = np.array([change(theta + e) for e in errors])
    except SolveError:
        return np.inf
    rounding = condition * np.finfo(float).eps * np.sqrt(data.p)
    return float(np.sqrt(np.mean(spread**2) + sampling**2 + rounding**2))


def _scaled(data: WindowRegression) -> tuple[Array, Array]:
    """The triangular factor with columns of unit length, and their lengths (1 where zero)."""
    lengths = np.linalg.norm(data.triangle, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    return data.triangle / lengths, lengths
