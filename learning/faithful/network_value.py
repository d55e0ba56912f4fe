"""A trained V^NN, a network of the state alone, as a value of the project."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from learning.faithful.config import NetworkSettings
from learning.faithful.losses import Structure
from learning.faithful.meta_data import DistanceBound, FeatureMap
from learning.faithful.value_network import ForwardPass, Parameters
from ocp.query import Query

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StateNetworkValue:
    """V^NN(x; theta) for a query: 0 in the goal, never below 0.

    Attributes:
        query: what it is to be a value of.
        settings: what the network is.
        parameters: theta.
    """

    query: Query
    settings: NetworkSettings
    parameters: Parameters

    def value(self, states: ArrayLike) -> Array:
        """V `[...]` at states `[..., n]`."""
        states = self._checked(states)
        with torch.no_grad():
            outputs = self._pass(states).outputs.double().numpy().reshape(states.shape[:-1])
        if self.settings.structure is Structure.BOUND:
            outputs = self._bound.value(states) * (1 + np.logaddexp(0.0, outputs))
        return np.where(self.query.goal_distance(states) <= 0, 0.0, np.maximum(outputs, 0.0))

    def gradient(self, states: ArrayLike) -> Array:
        """The gradient `[..., n]` of V at states `[..., n]`; 0 in the goal."""
        states = self._checked(states)
        with torch.no_grad():
            passed = self._pass(states)
            slopes = passed.feature_gradient().double().numpy()
            outputs = passed.outputs.double().numpy().reshape(states.shape[:-1])
        slopes = slopes.reshape(*states.shape[:-1], -1)
        gradient = self._features.state_gradient(states, slopes)
        if self.settings.structure is Structure.BOUND:
            bound, along = self._bound.value(states), self._bound.gradient(states)
            bend = 1 / (1 + np.exp(-outputs))
            gradient = (
                along * (1 + np.logaddexp(0.0, outputs))[..., None]
                + (bound * bend)[..., None] * gradient
            )
        outside = np.asarray(self.query.goal_distance(states) > 0)
        return np.where(outside[..., None], gradient, 0.0)

    def _pass(self, states: Array) -> ForwardPass:
        """Over the states as rows."""
        rows = states.reshape(-1, states.shape[-1])
        features = torch.from_numpy(self._features.features(rows, self.query.reference))
        features = features.to(self.parameters[0].dtype)
        return ForwardPass(self.parameters, features, self.settings.activation)

    def _checked(self, states: ArrayLike) -> Array:
        states = np.asarray(states, dtype=float)
        n = self.query.system.n
        if states.shape[-1:] != (n,) or not np.isfinite(states).all():
            raise ValueError(f"states: need finite numbers [..., {n}], got shape {states.shape}")
        return states

    @cached_property
    def _features(self) -> FeatureMap:
        return FeatureMap(self.query.system, self.settings.relative)

    @cached_property
    def _bound(self) -> DistanceBound:
        return DistanceBound(self.query)
