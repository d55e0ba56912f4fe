"""Adaptation to a fresh query: the last layer refitted to its exact motions, with a guard.

log V = log V_LQR + w'(phi(x) - phi(x_g)) is linear in the last layer w, and so is the costate where
V is known: one regularised linear least-squares problem, no steps and no rates. How far w may go
from the trained one is chosen by cross-validation over the motions: the policy's excess on those
left out. What is chosen is adopted only if it is better there by more than a standard error, and
lowers the Hamilton-Jacobi residual at held-out states too, where no motion is needed; so the
held-out residual never gets worse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.causality_free.residual import residuals
from learning.causality_free.samples import POINTS, Samples
from learning.causality_free.value import NetworkValue

Array = NDArray[np.float64]

STRENGTHS = (10.0, 1.0, 0.1, 0.01, 1e-3)
"""Of the pull towards the trained weights, relative to what the data say."""
FOLDS = 4
COSTATE_WEIGHT, VALUE_WEIGHT = 0.1, 1.0  # as in the training's loss


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


@dataclass(frozen=True)
class Equations:
    """Linear equations in w, those of each sample together: first `m` of the policy's error.

    Attributes:
        rows: `[k, r, width]`.
        wanted: `[k, r]`.
        weights: `[k, r]`, of their squares.
        inputs: m, how many of the r are of the policy.
    """

    rows: Array
    wanted: Array
    weights: Array
    inputs: int

    def excess(self, w: Array) -> Array:
        """The policy's relative excess `[k]`, see `samples.py`."""
        m = self.inputs
        return ((self.rows[:, :m] @ w - self.wanted[:, :m]) ** 2).sum(axis=1)

    def solve(self, w: Array, strengths: Sequence[float], picked: NDArray[np.bool_]) -> list[Array]:
        """The w's that fit the picked samples, each with a pull towards the present `w`."""
        root = np.sqrt(self.weights[picked])
        rows = (root[..., None] * self.rows[picked]).reshape(-1, len(w))
        gap = (root * (self.wanted[picked] - self.rows[picked] @ w)).ravel()
        normal, right = rows.T @ rows, rows.T @ gap
        size = float(np.trace(normal)) / len(w)
        identity = np.eye(len(w))
        return [w + np.linalg.solve(normal + s * size * identity, right) for s in strengths]


def adapt(
    value: NetworkValue,
    samples: Samples,
    held_out: Array,
    strengths: Sequence[float] = STRENGTHS,
) -> Adapted:
    """Refit the last layer to exact motions of the value's query.

    Args:
        value: with the trained weights.
        samples: of exact motions, `POINTS` a motion.
        held_out: `[k, n]`, states of the guard.
        strengths: to choose from.
    """
    before = guard_score(value, held_out)
    stay = Adapted(value, np.inf, before, before)
    equations, w = equations_of(value, samples), value.weights.last.numpy()
    errors = _left_out_errors(equations, w, strengths)
    best = int(np.argmin(errors.mean(axis=0)))  # the first of equals: staying
    gain = errors[:, 0] - errors[:, best]
    if not gain.mean() > gain.std() / np.sqrt(len(gain)):
        return stay
    strength = strengths[best - 1]
    adapted = refit(value, samples, [strength])[0]
    after = guard_score(adapted, held_out)
    return Adapted(adapted, strength, before, after) if after < before else stay


def _left_out_errors(equations: Equations, w: Array, strengths: Sequence[float]) -> Array:
    """Mean log(1 + excess) of each motion, left out, `[motions, 1 + strengths]`; first of `w`."""
    motion = np.arange(len(equations.wanted)) // POINTS
    errors = np.zeros((int(motion[-1]) + 1 if len(motion) else 1, 1 + len(strengths)))
    for fold in range(FOLDS):
        left_out = motion % FOLDS == fold
        if left_out.any() and not left_out.all():
            for k, fit in enumerate([w, *equations.solve(w, strengths, ~left_out)]):
                excess = np.log1p(equations.excess(fit)[left_out])
                np.add.at(errors[:, k], motion[left_out], excess / POINTS)
    return errors


def refit(value: NetworkValue, samples: Samples, strengths: Sequence[float]) -> list[NetworkValue]:
    """The last layer refitted to `samples`, once for each strength of the pull; no guard."""
    equations, w = equations_of(value, samples), value.weights.last.numpy()
    everything = np.ones(len(samples), dtype=bool)
    return [value.with_last(fit) for fit in equations.solve(w, strengths, everything)]


def guard_score(value: NetworkValue, states: Array) -> float:
    """Mean log(1 + Hamilton-Jacobi residual) at states `[k, n]`."""
    return float(np.log1p(residuals(value.query, value, states)).mean())


def equations_of(value: NetworkValue, samples: Samples) -> Equations:
    """What samples say about the last layer.

    The loss's logarithms weigh an outlier's equations down, as the trained w sees them.
    """
    e, V, p, D = samples.offsets, samples.values, samples.costates, samples.sensitivity
    phi, slopes = value.last_features(value.query.reference + e)
    Pe = e @ value.P
    quadratic = (e * Pe).sum(axis=1)
    log_ratio = np.log(V / quadratic)
    wrong = p - V[:, None] * (2 * Pe / quadratic[:, None])  # = V dphi/dx w at the right w
    slopes = V[:, None, None] * slopes
    scaled = value.scale / np.linalg.norm(p * value.scale, axis=1, keepdims=True)
    blocks = [
        (1.0, np.einsum("knm,knw->kmw", D, slopes), np.einsum("knm,kn->km", D, wrong)),
        (COSTATE_WEIGHT, scaled[..., None] * slopes, scaled * wrong),
        (VALUE_WEIGHT, phi[:, None], log_ratio[:, None]),
    ]
    w = value.weights.last.numpy()
    weights = []
    for weight, rows, wanted in blocks:
        size = 1.0 + ((rows @ w - wanted) ** 2).sum(axis=1, keepdims=True)
        weights.append(np.broadcast_to(weight / size, wanted.shape))
    return Equations(
        np.concatenate([rows for _, rows, _ in blocks], axis=1),
        np.concatenate([wanted for _, _, wanted in blocks], axis=1),
        np.concatenate(weights, axis=1),
        D.shape[2],
    )
