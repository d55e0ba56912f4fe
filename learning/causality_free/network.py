"""The network behind the value: a small smooth map whose gradient is written out.

    N(z) = w' tanh(W_3 tanh(W_2 tanh(W_1 z + b_1) + b_2) + b_3),  z = (state, query) in features.

Forward and backward passes are the same tensor expressions in training and in use, so one
differentiation by torch gives the loss's gradient in the weights.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

Layer = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Weights:
    """Weights of N.

    Attributes:
        hidden: (W `[width, in]`, b `[width]`) of each layer.
        last: w `[width]`.
        context_mean, context_scale: `[c]`, by which queries' contexts are standardised.
    """

    hidden: tuple[Layer, ...]
    last: Tensor
    context_mean: Tensor
    context_scale: Tensor

    def tensors(self) -> dict[str, Tensor]:
        """Everything by name, as it is stored."""
        named = {"last": self.last, "context_mean": self.context_mean}
        named["context_scale"] = self.context_scale
        for i, (W, b) in enumerate(self.hidden):
            named |= {f"hidden.{i}.weight": W, f"hidden.{i}.bias": b}
        return named

    @classmethod
    def of(cls, named: Mapping[str, Tensor]) -> "Weights":
        """The weights that `tensors` named.

        Raises:
            ValueError: if one is missing, or the shapes do not fit one another.
        """
        depth = sum(name.endswith(".weight") for name in named)
        wanted = {"last", "context_mean", "context_scale"}
        wanted |= {f"hidden.{i}.{part}" for i in range(depth) for part in ("weight", "bias")}
        if set(named) != wanted or depth == 0:
            raise ValueError(f"weights: need {sorted(wanted)}, got {sorted(named)}")
        hidden = tuple(
            (named[f"hidden.{i}.weight"], named[f"hidden.{i}.bias"]) for i in range(depth)
        )
        widths = [W.shape[0] for W, _ in hidden]
        for i, (W, b) in enumerate(hidden):
            before = W.shape[1] if i == 0 else widths[i - 1]
            if W.shape != (widths[i], before) or b.shape != (widths[i],):
                raise ValueError(
                    f"weights: hidden.{i} has shapes {tuple(W.shape)}, {tuple(b.shape)}"
                )
        if named["last"].shape != (widths[-1],):
            raise ValueError(f"weights: last has shape {tuple(named['last'].shape)}")
        return cls(hidden, named["last"], named["context_mean"], named["context_scale"])

    @property
    def trained(self) -> list[Tensor]:
        """What training changes."""
        return [t for layer in self.hidden for t in layer] + [self.last]


def fresh_weights(
    inputs: int, widths: tuple[int, ...], contexts: Tensor, generator: torch.Generator
) -> Weights:
    """Random weights: Glorot's in the hidden layers, the last one 0, so that V begins as V_LQR.

    Args:
        inputs: features of state and query together.
        widths: of the hidden layers.
        contexts: `[k, c]`, of the queries trained on.
        generator: of the numbers.
    """
    hidden: list[Layer] = []
    for width in widths:
        bound = (6.0 / (inputs + width)) ** 0.5
        W = torch.rand((width, inputs), generator=generator, dtype=torch.float64)
        b = torch.rand(width, generator=generator, dtype=torch.float64)
        hidden.append((bound * (2 * W - 1), 0.5 * (2 * b - 1)))
        inputs = width
    spread = contexts.std(0)
    scale = torch.where(spread > 1e-9, spread, torch.ones_like(spread))
    return Weights(tuple(hidden), torch.zeros(inputs, dtype=torch.float64), contexts.mean(0), scale)


def activations(weights: Weights, z: Tensor) -> list[Tensor]:
    """Activations `[k, width]` of every hidden layer at inputs `[k, in]`."""
    found, a = [], z
    for W, b in weights.hidden:
        a = torch.tanh(torch.addmm(b, a, W.T))
        found.append(a)
    return found


def value_and_slope(weights: Weights, z: Tensor) -> tuple[Tensor, Tensor]:
    """N `[k]` and dN/dz `[k, in]` at inputs `[k, in]`."""
    layers = activations(weights, z)
    slope = weights.last.expand_as(layers[-1])
    for (W, _), a in zip(reversed(weights.hidden), reversed(layers), strict=True):
        slope = (slope * (1 - a * a)) @ W
    return layers[-1] @ weights.last, slope


def features_and_slopes(weights: Weights, z: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The last hidden layer `[k, width]` and its derivatives `[k, t, width]`.

    Args:
        weights: of the network.
        z: `[k, in]`.
        directions: `[k, t, in]`, of the derivatives.
    """
    a, moved = z, directions
    for W, b in weights.hidden:
        a = torch.tanh(torch.addmm(b, a, W.T))
        moved = (moved @ W.T) * (1 - a * a)[:, None, :]
    return a, moved
