"""The honest benchmark beside Q-learning: identify A, B (and a constant) and solve Riccati.

Over a window, x' = A x + B u + c integrates to  change of x = A int x + B int u + c int 1: a
regression with n + m (+ 1) unknowns a state instead of n(n+1)/2 + mn, from the same samples and
windows. It is not model-free; it tells what that costs.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from learning.q_learning.quadratic_cost import QuadraticCost
from learning.q_learning.window_regression import quadrature
from ocp.riccati import DifferentialRiccati, LinearQuadratic, differential_riccati

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IdentifiedPlant:
    """x' = A x + B u + c with A `[n, n]`, B `[n, m]`, c `[n]` (zero unless asked for)."""

    A: Array
    B: Array
    c: Array

    def riccati(self, cost: QuadraticCost) -> DifferentialRiccati:
        """The regulator that is optimal for this plant (its constant left aside)."""
        problem = LinearQuadratic(self.A, self.B, cost.M, cost.R)
        return differential_riccati(problem, cost.terminal, cost.horizon)


def identify(
    samples: ArrayLike,
    inputs: ArrayLike,
    sample_period: float,
    window: int = 1,
    affine: bool = False,
) -> IdentifiedPlant:
    """Least squares on the windows of states `[k s + 1, n]` while inputs `[k, m]` were held.

    Raises:
        ValueError: if the shapes do not fit or the data do not determine the plant.
    """
    x, u = np.asarray(samples, dtype=float), np.asarray(inputs, dtype=float)
    if x.ndim != 2 or u.ndim != 2 or len(u) == 0 or (len(x) - 1) % len(u):
        raise ValueError(
            f"samples, inputs: must be k s + 1 states and k inputs, got {x.shape} and {u.shape}"
        )
    substeps = (len(x) - 1) // len(u)
    weights = quadrature(substeps)[0] * sample_period
    n, m = x.shape[1], u.shape[1]
    pieces = np.lib.stride_tricks.sliding_window_view(x, substeps + 1, axis=0)[::substeps]
    hold = substeps * sample_period
    rows = np.column_stack([pieces @ weights, u * hold, np.full(len(u), hold)])
    if not affine:
        rows = rows[:, :-1]
    total = np.vstack([np.zeros(rows.shape[1]), np.cumsum(rows, axis=0)])
    regressors = total[window:] - total[:-window]
    ends = x[::substeps]
    changes = ends[window:] - ends[:-window]
    scale = np.linalg.norm(regressors, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    solution, _, rank, _ = np.linalg.lstsq(regressors / scale, changes, rcond=1e-7)
    if rank < regressors.shape[1]:
        raise ValueError(
            f"samples, inputs: not exciting enough, rank {rank} of {regressors.shape[1]}"
        )
    parameters = (solution / scale[:, None]).T
    c = parameters[:, n + m] if affine else np.zeros(n)
    return IdentifiedPlant(parameters[:, :n].copy(), parameters[:, n : n + m].copy(), c)
