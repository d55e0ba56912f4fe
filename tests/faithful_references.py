"""Small networks, samples and queries for the tests of meta value learning."""

import numpy as np
import torch
from references import aligned_value
from torch import Tensor

from learning.faithful.losses import Derivative, Lagrangian, Reduction, Samples, Structure
from learning.faithful.value_network import Activation, Architecture, Parameters

FORMS = [
    Lagrangian(0.3, reduction, derivative, activation, structure)
    for reduction in Reduction
    for derivative in Derivative
    for activation in Activation
    for structure in Structure
]
"""Every form of the loss."""


def form_name(form: Lagrangian) -> str:
    """For the names of tests."""
    parts = (form.reduction, form.derivative, form.activation, form.structure)
    return "-".join(p.value for p in parts)


def small_networks(
    activation: Activation, count: int | None = None, features: int = 4
) -> Parameters:
    """Double-precision networks, different ones on a leading axis if `count` is given."""
    shape = Architecture(features, (7, 6, 5), activation)
    made = [
        shape.initial_parameters(torch.Generator().manual_seed(i), torch.float64)
        for i in range(count or 1)
    ]
    return made[0] if count is None else tuple(torch.stack(p) for p in zip(*made, strict=True))


def random_samples(seed: int, queries: int = 3, k: int = 5, m: int = 2, p: int = 4) -> Samples:
    """Samples without meaning; their rates do not depend on the seed."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    return Samples(
        draw(queries, k, p),
        draw(queries, m, k, p),
        draw(queries, k, m, p),
        torch.tensor([-0.5, -0.3], dtype=torch.float64),
        draw(queries, k),
        draw(queries, k, m),
        draw(queries, k).abs(),
        draw(queries, k, m),
    )


def of_query(samples: Samples, i: int) -> Samples:
    """The samples of one query, without the leading axis."""
    fields = {name: getattr(samples, name) for name in Samples.__dataclass_fields__}
    return Samples(**{n: v if n == "rates" else v[i] for n, v in fields.items()})


def aligned_states(center: tuple[float, float], distances: np.ndarray) -> np.ndarray:
    """States south-west of the goal's centre that face it: V is known in closed form there."""
    offset = distances[:, None] / np.sqrt(2) * np.ones(2)
    return np.column_stack([np.array(center) - offset, np.full(len(distances), np.pi / 4)])


def aligned_values(distances: np.ndarray) -> np.ndarray:
    """V there, without obstacles."""
    return np.array([aligned_value(d) for d in distances])
