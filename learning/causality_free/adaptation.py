"""Adaptation to a fresh query: the last layer refitted to its exact motions, with a guard.

log V = log V_LQR + w'(phi(x) - phi(x_g)) is linear in the last layer w, and so is the costate where
V is known: one regularised linear least-squares problem, no steps and no rates. How far w may go
from the trained one is chosen by the Hamilton-Jacobi residual at held-out states, where no motion
is needed; staying is among the choices, so the held-out residual never gets worse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.causality_free.residual import residuals
from learning.causality_free.samples import Samples
from learning.causality_free.value import NetworkValue

Array = NDArray[np.float64]

STRENGTHS = (10.0, 1.0, 0.1, 0.01, 1e-3)
"""Of the pull towards the trained weights, relative to what the data say."""


@dataclass(frozen=True)
class Adapted:
    """The outcome.

    Attributes:
        value: the adapted value, or the trained one.
        strength: of the pull; infinite if the trained weights stayed.
        before, after: mean log(1 + residual) at the held-out states.
    """

    value: NetworkValue
    strength: float
    before: float
    after: float


def adapt(
    value: NetworkValue,
    samples: Samples,
    held_out: Array,
    costate_weight: float = 0.1,
    value_weight: float = 1.0,
    strengths: Sequence[float] = STRENGTHS,
) -> Adapted:
    """Refit the last layer to exact motions of the value's query.

    Args:
        value: with the trained weights.
        samples: of exact motions.
        held_out: `[k, n]`, states of the guard.
        costate_weight, value_weight: as in the training's loss.
        strengths: to choose from.
    """
    rows, wanted = _equations(value, samples, costate_weight, value_weight)
    w = value.weights.last.numpy()
    gap = wanted - rows @ w
    normal, right = rows.T @ rows, rows.T @ gap
    size = float(np.trace(normal)) / len(w)
    guard = [guard_score(value, held_out)]
    candidates = [value]
    for strength in strengths:
        step = np.linalg.solve(normal + strength * size * np.eye(len(w)), right)
        candidates.append(value.with_last(np.asarray(w + step, dtype=float)))
        guard.append(guard_score(candidates[-1], held_out))
    best = int(np.argmin(guard))
    strength = np.inf if best == 0 else strengths[best - 1]
    return Adapted(candidates[best], float(strength), guard[0], guard[best])


def guard_score(value: NetworkValue, states: Array) -> float:
    """Mean log(1 + Hamilton-Jacobi residual) at states `[k, n]`."""
    return float(np.log1p(residuals(value.query, value, states)).mean())


def _equations(
    value: NetworkValue, samples: Samples, costate_weight: float, value_weight: float
) -> tuple[Array, Array]:
    """Rows `[r, width]` and right side `[r]` of the least-squares problem in w."""
    e, V, p, D = samples.offsets, samples.values, samples.costates, samples.sensitivity
    phi, slopes = value.last_features(value.query.reference + e)
    Pe = e @ value.P
    quadratic = (e * Pe).sum(axis=1)
    log_ratio = np.log(V / quadratic)
    wrong = p - V[:, None] * (2 * Pe / quadratic[:, None])  # = V dphi/dx w at the right w
    slopes = V[:, None, None] * slopes
    scaled = value.scale / np.linalg.norm(p * value.scale, axis=1, keepdims=True)
    blocks = [
        (value_weight, phi, log_ratio),
        (1.0, np.einsum("knm,knw->kmw", D, slopes), np.einsum("knm,kn->km", D, wrong)),
        (costate_weight, scaled[..., None] * slopes, scaled * wrong),
    ]
    width = phi.shape[1]
    rows = np.concatenate([np.sqrt(a) * r.reshape(-1, width) for a, r, _ in blocks])
    return rows, np.concatenate([np.sqrt(a) * b.ravel() for a, _, b in blocks])
