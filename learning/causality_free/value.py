"""The value: the linear regulator's cost times a learned factor that is 1 at the equilibrium.

    V(x) = e' P e exp(N(x) - N(x_g)),   e = x - x_g

e' P e is of second order and the factor 1 + O(|e|), so V's gradient at x_g is 0 and its second
derivative 2 P *whatever the weights*: the greedy policy's linearisation is the linear regulator,
and the closed loop is locally stable by construction. V is positive elsewhere, and its costate is a
gradient. (Nakamura-Zimmerer, Gong and Kang's QRnet, "QRnet: optimal regulator design with
LQR-augmented neural networks", IEEE Control Systems Letters 2021, adds a correction of higher order
to e' P e; the product here is positive too, and makes the relative error what is learned.)
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from learning.causality_free.families import context
from learning.causality_free.foreseen import foreseen
from learning.causality_free.network import Weights, features_and_slopes, value_and_slope
from ocp.query import Query
from ocp.regulation import regulator

Array = NDArray[np.float64]


def embed(query: Query, offsets: Array, scale: Array) -> tuple[Array, Array]:
    """Features `[k, s]` of offsets e `[k, n]`, and their derivatives `[k, n, s]`.

    Coordinates are divided by `scale` `[n]`; in periodic ones sine and cosine take their place.
    Where there are obstacles, what is foreseen of them follows.
    """
    system = query.system
    columns, count = [], len(offsets)
    for i, period in enumerate(system.period):
        x = offsets[:, i]
        if period:
            turn = 2 * np.pi / period
            columns.append((i, np.sin(turn * x), turn * np.cos(turn * x)))
            columns.append((i, np.cos(turn * x), -turn * np.sin(turn * x)))
        else:
            columns.append((i, x / scale[i], np.full(count, 1 / scale[i])))
    features = np.stack([value for _, value, _ in columns], axis=-1)
    slopes = np.zeros((count, system.n, len(columns)))
    for k, (i, _, slope) in enumerate(columns):
        slopes[:, i, k] = slope
    seen, by_state = foreseen(query, offsets)
    return np.hstack([features, seen]), np.concatenate([slopes, by_state], axis=2)


def query_features(weights: Weights, query: Query) -> Tensor:
    """`[c]`, the query as the network sees it: its context, standardised.

    Raises:
        SolveError: NOT_APPLICABLE if it has none, see `context`.
    """
    return (torch.from_numpy(context(query)) - weights.context_mean) / weights.context_scale


@dataclass(frozen=True, eq=False)
class NetworkValue:
    """V of a query; a `Value`.

    Attributes:
        query: with an `Equilibrium` as its goal, of the weights' family.
        weights: of the network.
        scale: `[n]`, by which offsets are divided.
    """

    query: Query
    weights: Weights
    scale: Array

    @cached_property
    def P(self) -> Array:
        """`[n, n]`, of the linear regulator."""
        return regulator(self.query).matrix

    @cached_property
    def told(self) -> Tensor:
        """`[c]`, the query as the network sees it."""
        return query_features(self.weights, self.query)

    def inputs(self, offsets: Array) -> tuple[Tensor, Tensor]:
        """The network's inputs `[k, s + c]` at offsets `[k, n]`; derivatives `[k, n, s + c]`."""
        features, slopes = embed(self.query, offsets, self.scale)
        q = self.told
        z = torch.cat([torch.from_numpy(features), q.expand(len(offsets), -1)], dim=1)
        none = torch.zeros((*slopes.shape[:2], len(q)), dtype=torch.float64)
        return z, torch.cat([torch.from_numpy(slopes), none], dim=2)

    @cached_property
    def at_rest(self) -> float:
        """N(x_g)."""
        z, _ = self.inputs(np.zeros((1, self.query.system.n)))
        return float(value_and_slope(self.weights, z)[0])

    def both(self, states: ArrayLike) -> tuple[Array, Array]:
        """V `[...]` and its gradient `[..., n]` at states `[..., n]`."""
        rows = np.asarray(states, dtype=float)
        n = self.query.system.n
        e = self.query.system.difference(rows, self.query.reference).reshape(-1, n)
        with torch.no_grad():
            z, slopes = self.inputs(e)
            N, slope = value_and_slope(self.weights, z)
            by_state = torch.einsum("ks,kns->kn", slope, slopes).numpy()
            factor = np.exp(N.numpy() - self.at_rest)
        Pe = e @ self.P
        quadratic = (e * Pe).sum(axis=-1)
        gradient = factor[:, None] * (2 * Pe + quadratic[:, None] * by_state)
        return (factor * quadratic).reshape(rows.shape[:-1]), gradient.reshape(rows.shape)

    def value(self, states: ArrayLike) -> Array:
        """V `[...]` at states `[..., n]`."""
        return self.both(states)[0]

    def gradient(self, states: ArrayLike) -> Array:
        """grad V `[..., n]` at states `[..., n]`."""
        return self.both(states)[1]

    def last_features(self, states: Array) -> tuple[Array, Array]:
        """phi - phi(x_g) `[k, width]` and dphi/dx `[k, n, width]` at states `[k, n]`."""
        e = self.query.system.difference(states, self.query.reference)
        with torch.no_grad():
            z, slopes = self.inputs(np.concatenate([e, np.zeros((1, e.shape[1]))]))
            phi, by_state = features_and_slopes(self.weights, z, slopes)
        return (phi[:-1] - phi[-1]).numpy(), by_state[:-1].numpy()

    def with_last(self, last: Array) -> "NetworkValue":
        """The same value with another last layer w `[width]`."""
        return replace(self, weights=replace(self.weights, last=torch.from_numpy(last)))
