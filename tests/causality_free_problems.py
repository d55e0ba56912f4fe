"""Networks and settings that the tests of this room share."""

import numpy as np
import torch

from learning.causality_free.families import RegulationFamily, context
from learning.causality_free.network import Weights, fresh_weights
from learning.causality_free.training import TrainingSettings
from learning.causality_free.value import NetworkValue, embed
from ocp.query import Query


def random_weights(family: RegulationFamily, seed: int, size: float = 0.3, width=16) -> Weights:
    """A network with a last layer that is not 0: what training might end in."""
    rng = np.random.default_rng(seed)
    contexts = np.array([context(family.sample(rng)) for _ in range(5)])
    query = family.sample(rng)
    rest, _ = embed(query, np.zeros((1, query.system.n)), np.array(family.reach))
    generator = torch.Generator().manual_seed(seed)
    inputs = rest.shape[1] + contexts.shape[1]
    fresh = fresh_weights(inputs, (width,) * 3, torch.from_numpy(contexts), generator)
    last = size * torch.randn(width, generator=generator, dtype=torch.float64)
    return Weights(fresh.hidden, last, fresh.context_mean, fresh.context_scale)


def random_value(family: RegulationFamily, seed: int, size: float = 0.3) -> NetworkValue:
    """The value of a random network for a random query of the family."""
    query: Query = family.sample(np.random.default_rng([seed, 7]))
    return NetworkValue(query, random_weights(family, seed, size), np.array(family.reach))


SMALL = TrainingSettings(
    "car",
    queries=5,
    held_out=2,
    motions=(12, 3),
    steps=(400, 100),
    widths=(16, 16),
    batch=128,
    rate=5e-3,
    warm_up=20,
    checkpoint_steps=100,
)
"""A training run of a few seconds."""
