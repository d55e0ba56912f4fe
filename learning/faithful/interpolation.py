"""Section III-A2 of Xu and Zhu: a network interpolates one query's coarse set-valued solution.

It minimises the Lagrangian (12) over the grid's nodes by minibatches. No query is learned from
another: this is what meta learning is to spare.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from learning.faithful.adam import Moments, adam_step
from learning.faithful.config import DataSettings, LossSettings, NetworkSettings
from learning.faithful.data import supervision
from learning.faithful.losses import Derivative, Lagrangian, Reduction, lagrangian_gradient
from learning.faithful.meta_data import FeatureMap, QueryTable, SampleMap, Supervision, goal_ball
from learning.faithful.network_value import StateNetworkValue
from learning.faithful.value_network import Architecture, Parameters, expanded
from ocp.query import Query
from ocp.trajectory import SolveError, Status
from ocp.value import Policy, Value, greedy

REFINEMENT = 50
"""Steps of Adam between two looks at the clock."""


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
    steps: int = 1500
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


@dataclass(frozen=True)
class Fit:
    """A network part of the way to a query's data; never changed, only replaced.

    Attributes:
        query: what is interpolated.
        table: its data.
        settings: how.
        parameters, moments: of the network, and Adam's.
        losses: the Lagrangian at each step so far.
    """

    query: Query
    table: QueryTable = field(repr=False)
    settings: InterpolationSettings
    parameters: Parameters = field(repr=False)
    moments: Moments | None = field(default=None, repr=False)
    losses: tuple[float, ...] = field(default=(), repr=False)

    @property
    def finished(self) -> bool:
        return len(self.losses) >= self.settings.steps

    @property
    def value(self) -> StateNetworkValue:
        return StateNetworkValue(self.query, self.settings.network, self.parameters)


def begun(query: Query, data: Supervision, settings: InterpolationSettings) -> Fit:
    """Before the first step: the mean value, and no more."""
    features = FeatureMap(query.system, settings.network.relative)
    tensors = SampleMap(features, settings.network.structure, settings.loss.difference_step)
    shape = Architecture(features.count, settings.network.hidden, settings.network.activation)
    parameters = shape.initial_parameters(torch.Generator().manual_seed(settings.seed))
    # V is some ten times larger than a network's first output.
    parameters[-1].fill_(float(data.values.mean()))
    return Fit(query, QueryTable([query], [data], tensors), settings, parameters)


def advanced(fit: Fit, steps: int) -> Fit:
    """`steps` steps on, or to the end."""
    settings, form = fit.settings, fit.settings.lagrangian
    parameters, moments, losses = fit.parameters, fit.moments, list(fit.losses)
    shots = min(settings.batch, len(fit.table.data[0]))
    for step in range(len(losses), min(len(losses) + steps, settings.steps)):
        rng = np.random.default_rng([settings.seed, step])
        (samples,) = fit.table.draw(rng, 1, (shots,))
        outcome = lagrangian_gradient(expanded(parameters, 1), samples, form)
        gradient = tuple(g[0] for g in outcome.gradient)
        rate = settings.rate * (1 - step / settings.steps)
        parameters, moments = adam_step(parameters, gradient, rate, moments)
        losses.append(float((outcome.value + form.multiplier * outcome.control)[0]))
    return replace(fit, parameters=parameters, moments=moments, losses=tuple(losses))


@dataclass(frozen=True)
class InterpolationState:
    """A fit, and how long the last refinement took."""

    fit: Fit
    next_seconds: float = 0.0
    trajectories: int = 0

    @property
    def finished(self) -> bool:
        return self.fit.finished


@dataclass(frozen=True)
class InterpolationPlanner:
    """The interpolating network as a planner; a refinement is `REFINEMENT` steps of Adam."""

    settings: InterpolationSettings = field(default_factory=InterpolationSettings)

    def start(self, query: Query, starts: Sequence[NDArray[np.float64]]) -> InterpolationState:
        """The set-valued solution, and the first steps; `starts` `[n]` are not needed.

        Raises:
            SolveError: if the set-valued method does not apply, or inputs are bounded.
            ValueError: if the grid is too coarse for the goal.
        """
        del starts  # the whole space is interpolated
        goal_ball(query)
        if query.is_bounded:
            raise SolveError(Status.NOT_APPLICABLE, "the losses need unbounded inputs")
        settings = self.settings
        data = supervision(query, settings.data, (settings.seed, 0))
        return self.refine(InterpolationState(begun(query, data, settings)))

    def refine(self, state: InterpolationState) -> InterpolationState:
        began = time.perf_counter()
        fit = advanced(state.fit, REFINEMENT)
        return InterpolationState(fit, time.perf_counter() - began)

    def policy(self, state: InterpolationState) -> Policy:
        return greedy(state.fit.query, state.fit.value)

    def value(self, state: InterpolationState) -> Value:
        return state.fit.value
