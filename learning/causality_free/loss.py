"""The loss: relative excess of the closed loop, costates, values."""

from dataclasses import dataclass

import torch
from torch import Tensor

from learning.causality_free.network import Weights, value_and_slope
from learning.causality_free.samples import Batch


@dataclass(frozen=True)
class LossWeights:
    """Weights of the loss's parts.

    Attributes:
        excess: of log(1 + excess): the running cost's relative excess, see `samples.py`.
        costate: of the squared relative error of the costate, coordinates in units of the reach.
        value: of the squared error of log V.
    """

    excess: float = 1.0
    costate: float = 0.1
    value: float = 1.0


def errors(weights: Weights, batch: Batch, resting: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
    """Relative excess `[k]`, costate's squared relative error `[k]`, error of log V `[k]`.

    Args:
        weights: of the network.
        batch: the samples, contexts standardised.
        resting: `[q, s + c]`, the network's inputs at every query's equilibrium.
        scale: `[n]`, the family's reach.
    """
    N, slope = value_and_slope(weights, batch.inputs)
    rest, _ = value_and_slope(weights, resting)
    s = batch.slopes.shape[2]
    by_state = (batch.slopes @ slope[:, :s, None])[..., 0]
    gap = N - rest[batch.query] - batch.log_ratio
    # Bounded, so that a value that is far off at first does not rule the costates' errors.
    V = batch.values * torch.exp(gap.clamp(-2.0, 2.0))
    wrong = V[:, None] * (batch.regulator_slope + by_state) - batch.costates
    excess = ((wrong[:, None] @ batch.sensitivity)[:, 0] ** 2).sum(dim=1)
    size = ((batch.costates * scale) ** 2).sum(dim=1)
    return excess, ((wrong * scale) ** 2).sum(dim=1) / size, gap


def loss(
    weights: Weights, batch: Batch, resting: Tensor, scale: Tensor, parts: LossWeights
) -> Tensor:
    """One number to minimise."""
    excess, costate, value = errors(weights, batch, resting, scale)
    return (
        parts.excess * torch.log1p(excess)
        + parts.costate * torch.log1p(costate)
        + parts.value * torch.log1p(value**2)
    ).mean()
