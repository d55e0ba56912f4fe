"""What exact motions teach: states with their values and costates, ready for the loss.

The loss is what a wrong costate costs. With the costate's error d, the greedy input's error is
-R^-1 G'd / 2 (inputs within their bounds), and the running cost's excess d' G R^-1 G' d / 4: in
units of the running cost L it is |D'd|^2, D = G R^-1/2 / (2 sqrt L), and its mean over a motion,
weighted with cost, is the closed loop's relative excess.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.causality_free.exact import Optimum
from learning.causality_free.families import RegulationFamily, mirrored
from learning.causality_free.network import Weights
from learning.causality_free.value import embed, query_features
from ocp.compiled.batch import optimal_inputs, rates, running_costs
from ocp.query import Query
from ocp.regulation import regulator

Array = NDArray[np.float64]

POINTS = 24  # kept of a motion


@dataclass(frozen=True)
class Samples:
    """Points of exact motions of one query, `POINTS` a motion.

    Attributes:
        offsets: `[k, n]`, x - x_g.
        values: `[k]`, V.
        costates: `[k, n]`, grad V.
        sensitivity: `[k, n, m]`, the D above.
    """

    offsets: Array
    values: Array
    costates: Array
    sensitivity: Array

    @classmethod
    def of(cls, query: Query, optima: Iterable[Optimum]) -> "Samples":
        """`POINTS` of each motion: half evenly in time, half evenly in cost."""
        states, values, costates = [], [], []
        for optimum in optima:
            motion = optimum.motion
            picked = _spread(motion.times, motion.cost_so_far)
            states.append(motion.states[picked])
            values.append(optimum.values[picked])
            assert motion.costates is not None
            costates.append(motion.costates[picked])
        if not states:
            n, m = query.system.n, query.system.m
            return cls(np.zeros((0, n)), np.zeros(0), np.zeros((0, n)), np.zeros((0, n, m)))
        x, V, p = (np.concatenate(parts) for parts in (states, values, costates))
        u = optimal_inputs(query, x, p)
        L = running_costs(query, x, u)
        D = (
            input_matrices(query, x)
            / np.sqrt(query.input_weights)
            / (2 * np.sqrt(L))[:, None, None]
        )
        return cls(query.system.difference(x, query.reference), V, p, D)

    @classmethod
    def joined(cls, parts: Sequence["Samples"]) -> "Samples":
        """All samples of one query together."""
        names = cls.__dataclass_fields__
        return cls(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in names})

    def __len__(self) -> int:
        return len(self.values)


def input_matrices(query: Query, states: Array) -> Array:
    """G `[k, n, m]` at states `[k, n]`."""
    m = query.system.m
    still = rates(query, states, np.zeros((len(states), m)))
    columns = [
        rates(query, states, np.broadcast_to(unit, (len(states), m))) - still for unit in np.eye(m)
    ]
    return np.stack(columns, axis=-1)


def _spread(times: Array, costs: Array) -> NDArray[np.intp]:
    half = POINTS // 2
    in_time = np.linspace(times[0], times[-1], half)
    in_cost = np.linspace(costs[0], costs[-1], POINTS - half, endpoint=False)
    picked = [np.searchsorted(times, in_time), np.searchsorted(costs, in_cost)]
    return np.minimum(np.concatenate(picked), len(times) - 1)


@dataclass(frozen=True)
class Batch:
    """Samples of many queries as tensors; `s` features of the state, `c` of the query.

    Attributes:
        inputs: `[k, s + c]`, of the network.
        slopes: `[k, n, s]`, derivatives of the state's features.
        query: `[k]`, the sample's query.
        log_ratio: `[k]`, log V / V_LQR.
        values: `[k]`, V.
        regulator_slope: `[k, n]`, grad log V_LQR.
        costates: `[k, n]`.
        sensitivity: `[k, n, m]`, see `Samples`.
    """

    inputs: Tensor
    slopes: Tensor
    query: Tensor
    log_ratio: Tensor
    values: Tensor
    regulator_slope: Tensor
    costates: Tensor
    sensitivity: Tensor

    def __len__(self) -> int:
        return len(self.values)

    def rows(self, picked: Tensor) -> "Batch":
        """Some of the samples."""
        return Batch(**{name: getattr(self, name)[picked] for name in self.__dataclass_fields__})


def batch_of(
    family: RegulationFamily,
    weights: Weights,
    queries: Sequence[Query],
    samples: Sequence[Samples],
    images: bool,
) -> Batch:
    """Samples of queries, each with its own; with mirror `images` if the family has them.

    The contexts are standardised as `weights` say.
    """
    parts = []
    scale = np.array(family.reach)
    signs = [np.ones(len(scale))]
    if images and family.mirror:
        signs.append(np.array(family.mirror))
    for i, (query, known) in enumerate(zip(queries, samples, strict=True)):
        P, told = regulator(query).matrix, query_features(weights, query).numpy()
        for sign in signs:
            e = known.offsets * sign
            features, slopes = embed(mirrored(query, sign), e, scale)
            Pe = e @ P
            quadratic = (e * Pe).sum(axis=1)
            parts.append(
                (
                    np.hstack([features, np.tile(told, (len(e), 1))]),
                    slopes,
                    np.full(len(e), i),
                    np.log(known.values / quadratic),
                    known.values,
                    2 * Pe / quadratic[:, None],
                    known.costates * sign,
                    known.sensitivity * sign[:, None],
                )
            )
    return Batch(*(torch.from_numpy(np.concatenate(p)) for p in zip(*parts, strict=True)))


def resting_inputs(family: RegulationFamily, weights: Weights, queries: Sequence[Query]) -> Tensor:
    """`[q, s + c]`, the network's inputs at every query's equilibrium."""
    n = len(family.reach)
    rest = [embed(query, np.zeros((1, n)), np.array(family.reach))[0] for query in queries]
    told = torch.stack([query_features(weights, query) for query in queries])
    return torch.cat([torch.from_numpy(np.concatenate(rest)), told], dim=1)
