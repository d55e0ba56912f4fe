"""Section III-A2 of Xu and Zhu: a network interpolates one query's coarse set-valued solution.

It minimises the Lagrangian (12) over the grid's nodes by minibatches. No query is learned from
another: this is what meta learning is to spare.
"""

import logging
from dataclasses import dataclass, field

import numpy as np
import torch

from learning.config import DataSettings, LossSettings, NetworkSettings
from learning.faithful_data import supervision
from learning.losses import Derivative, Lagrangian, Reduction, lagrangian_gradient
from learning.meta_data import FeatureMap, QueryTable, SampleMap, Supervision
from learning.network_value import NetworkValue
from learning.value_network import Architecture, Parameters
from ocp.query import Query

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class InterpolationSettings:
    """How the network is fitted; the paper states none of this but mu and the network.

    Attributes:
        data: the coarse solution.
        network: V^NN.
        loss: the Lagrangian; by default means, which Adam cannot tell from sums.
        steps: of Adam.
        batch: nodes a step.
        rate: of Adam, falling to 0 along a line.
        seed: of initial weights and minibatches.
    """

    data: DataSettings = field(default_factory=DataSettings)
    network: NetworkSettings = field(default_factory=NetworkSettings)
    loss: LossSettings = field(
        default_factory=lambda: LossSettings(
            reduction=Reduction.MEAN, derivative=Derivative.AUTOMATIC
        )
    )
    steps: int = 3000
    batch: int = 512
    rate: float = 2e-3
    seed: int = 0

    @property
    def lagrangian(self) -> Lagrangian:
        return Lagrangian(
            self.loss.multiplier,
            self.loss.reduction,
            self.loss.derivative,
            self.network.activation,
            self.network.structure,
        )


def interpolated_value(query: Query, settings: InterpolationSettings | None = None) -> NetworkValue:
    """V^NN fitted to the set-valued solution of `query`.

    Raises:
        SolveError: if the set-valued method does not apply, or inputs are bounded.
        ValueError: if the grid is too coarse for the goal.
    """
    settings = settings or InterpolationSettings()
    data = supervision(query, settings.data, (settings.seed, 0))
    parameters, _ = fitted(query, data, settings)
    return NetworkValue(query, settings.network, parameters)


def fitted(
    query: Query, data: Supervision, settings: InterpolationSettings
) -> tuple[Parameters, list[float]]:
    """Parameters that minimise the Lagrangian over `data`, and the loss of each step."""
    features = FeatureMap(query.system, settings.network.relative)
    tensors = SampleMap(features, settings.network.structure, settings.loss.difference_step)
    table = QueryTable([query], [data], tensors)
    shape = Architecture(features.count, settings.network.hidden, settings.network.activation)
    parameters = shape.initial_parameters(torch.Generator().manual_seed(settings.seed))
    # V is some ten times larger than a network's first output: begin at the mean.
    parameters[-1].fill_(float(data.values.mean()))
    form = settings.lagrangian
    rng = np.random.default_rng(settings.seed)
    optimizer = torch.optim.Adam(parameters, lr=settings.rate)
    losses = []
    for step in range(settings.steps):
        (samples,) = table.draw(rng, 1, (min(settings.batch, len(data)),))
        batched = tuple(p[None] for p in parameters)
        outcome = lagrangian_gradient(batched, samples, form)
        for p, g in zip(parameters, outcome.gradient, strict=True):
            p.grad = g[0]
        optimizer.param_groups[0]["lr"] = settings.rate * (1 - step / settings.steps)
        optimizer.step()
        losses.append(float((outcome.value + form.multiplier * outcome.control)[0]))
    return parameters, losses
