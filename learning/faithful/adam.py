"""Adam (Kingma and Ba, 2015) as a function of its state, with its usual constants.

An anytime method keeps its states, which an optimiser that steps in place would change.
"""

from dataclasses import dataclass

import torch

from learning.faithful.value_network import Parameters

DECAY_FIRST, DECAY_SECOND, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class Moments:
    """Running means of the gradient and of its square, after `steps` steps."""

    first: Parameters
    second: Parameters
    steps: int


def adam_step(
    parameters: Parameters, gradient: Parameters, rate: float, moments: Moments | None
) -> tuple[Parameters, Moments]:
    """The parameters one step on, and the moments; `None` before the first step."""
    if moments is None:
        zeros = tuple(torch.zeros_like(p) for p in parameters)
        moments = Moments(zeros, zeros, 0)
    t = moments.steps + 1
    first = tuple(
        DECAY_FIRST * m + (1 - DECAY_FIRST) * g
        for m, g in zip(moments.first, gradient, strict=True)
    )
    second = tuple(
        DECAY_SECOND * v + (1 - DECAY_SECOND) * g**2
        for v, g in zip(moments.second, gradient, strict=True)
    )
    moved = tuple(
        p - rate * (m / (1 - DECAY_FIRST**t)) / ((v / (1 - DECAY_SECOND**t)).sqrt() + EPSILON)
        for p, m, v in zip(parameters, first, second, strict=True)
    )
    return moved, Moments(first, second, t)
