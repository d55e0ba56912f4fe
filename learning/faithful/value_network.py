"""V^NN (Xu and Zhu, section III-A2): a multilayer perceptron with its derivatives in closed form.

A network is a tuple of tensors (W_1, b_1, ..., W_M, b_M). Leading axes of the parameters are a
batch of networks, one a query, so that the inner steps of all queries are one computation.
`ForwardPass` writes out what automatic differentiation would do: it needs a third fewer matrix
products where both V and its gradient enter a loss, and can itself be differentiated.

Letters: `q` networks (any leading axes), `k` samples, `p` features.
"""

import math
from dataclasses import dataclass
from enum import Enum
from itertools import pairwise

import torch
from torch import Tensor

Parameters = tuple[Tensor, ...]


class Activation(Enum):
    """sigma of the hidden layers."""

    RELU = "relu"
    """The paper's. The gradient of V is then piecewise constant."""
    SILU = "silu"
    """z / (1 + exp(-z)): smooth."""

    def __call__(self, z: Tensor) -> Tensor:
        return torch.relu(z) if self is Activation.RELU else torch.nn.functional.silu(z)

    def slope(self, z: Tensor) -> Tensor:
        """sigma'(z)."""
        if self is Activation.RELU:
            return torch.relu(z.detach()).sign()  # comparisons are many times slower
        p = torch.sigmoid(z)
        return p * (1 + z * (1 - p))

    def curvature(self, z: Tensor) -> Tensor:
        """sigma''(z)."""
        if self is Activation.RELU:
            return torch.zeros_like(z)
        p = torch.sigmoid(z)
        return p * (1 - p) * (2 + z * (1 - 2 * p))


@dataclass(frozen=True)
class Architecture:
    """The shape of a network.

    Attributes:
        inputs: features.
        hidden: widths of the hidden layers.
        activation: of the hidden layers; the last layer is linear, with one output.
    """

    inputs: int
    hidden: tuple[int, ...] = (256, 256, 256)
    activation: Activation = Activation.RELU

    def __post_init__(self) -> None:
        if self.inputs < 1 or not self.hidden or min(self.hidden) < 1:
            raise ValueError(
                f"hidden: needs at least one layer of positive width, got {list(self.hidden)}"
            )

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """Of the parameters, in order."""
        widths = (self.inputs, *self.hidden, 1)
        return [shape for p, w in pairwise(widths) for shape in ((w, p), (w,))]

    def initial_parameters(
        self, generator: torch.Generator, dtype: torch.dtype = torch.float32
    ) -> Parameters:
        """Weights and biases uniform in +-1 / sqrt(fan in), as torch's own linear layers."""
        bounds = [1 / math.sqrt(shape[1]) for shape in self.shapes[::2] for _ in range(2)]
        return tuple(
            (2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1).to(dtype) * bound
            for shape, bound in zip(self.shapes, bounds, strict=True)
        )


def network(parameters: Parameters, features: Tensor, activation: Activation) -> Tensor:
    """Outputs `[q..., k]` at features `[q..., k, p]`: the definition, which tests differentiate."""
    a = features
    for layer in range(0, len(parameters) - 2, 2):
        a = activation(_affine(a, parameters[layer], parameters[layer + 1]))
    return _affine(a, parameters[-2], parameters[-1])[..., 0]


class ForwardPass:
    """Outputs of networks, and from them derivatives by the chain rule written out.

    With z_l = W_l a_{l-1} + b_l, a_l = sigma(z_l):

        d_l = sigma'(z_l) * (W_{l+1}' d_{l+1})    derivative of the output in z_l
        t_l = sigma'(z_l) * (W_l t_{l-1})         derivative of a_l along features t_0
    """

    def __init__(self, parameters: Parameters, features: Tensor, activation: Activation) -> None:
        """`parameters` with leading axes `q...` and `features` `[q..., k, p]`."""
        self.weights, self.biases = parameters[::2], parameters[1::2]
        self.activation = activation
        self.layers = [features]  # a_0, ..., a_{M-1}
        self.arguments: list[Tensor] = []  # z_1, ..., z_{M-1}
        self.slopes: list[Tensor] = []
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            z = _affine(self.layers[-1], W, b)
            self.arguments.append(z)
            self.slopes.append(activation.slope(z))
            self.layers.append(activation(z))
        self._incoming: list[Tensor] = []
        self._adjoints: list[Tensor] = []

    @property
    def outputs(self) -> Tensor:
        """`[q..., k]`."""
        return _affine(self.layers[-1], self.weights[-1], self.biases[-1])[..., 0]

    def feature_gradient(self) -> Tensor:
        """The gradient of each output in its features, `[q..., k, p]`."""
        return self.adjoints[0] @ self.weights[0]

    @property
    def adjoints(self) -> list[Tensor]:
        """d_1, ..., d_{M-1}."""
        if not self._adjoints:
            incoming = self.weights[-1].expand(*self.layers[-1].shape)  # the derivative in a_l
            for layer in range(len(self.arguments) - 1, -1, -1):
                self._incoming.insert(0, incoming)
                self._adjoints.insert(0, incoming * self.slopes[layer])
                if layer:
                    incoming = self._adjoints[0] @ self.weights[layer]
        return self._adjoints

    def parameter_gradient(self, seed: Tensor, slope_seed: Tensor | None = None) -> Parameters:
        """The gradient in the parameters of sum over k of seed * output + slope_seed . gradient.

        Args:
            seed: `[q..., k]`, derivative of a loss in each output.
            slope_seed: `[q..., k, p]`, derivative of the loss in each feature gradient.
        """
        if slope_seed is None:
            return self._backward(seed[..., None], None)
        if self.activation is Activation.RELU:
            # sigma'' = 0: both parts share the factor d_l, and one product does for both.
            return self._merged(seed[..., None], slope_seed)
        return self._backward(seed[..., None], slope_seed)

    def _merged(self, seed: Tensor, slope_seed: Tensor) -> Parameters:
        gradient: list[Tensor] = []
        t = slope_seed
        for layer, d in enumerate(self.adjoints):
            gradient += [d.mT @ (seed * self.layers[layer] + t), (seed * d).sum(-2)]
            t = self.slopes[layer] * (t @ self.weights[layer].mT)
        last = (seed * self.layers[-1] + t).sum(-2, keepdim=True)
        return (*gradient, last, seed.sum(-2))

    def _backward(self, seed: Tensor, slope_seed: Tensor | None) -> Parameters:
        tangents: list[Tensor] = []  # t_0, ..., t_{M-1}
        bends: list[Tensor] = []  # what sigma'' adds to the adjoint of z_l
        if slope_seed is not None:
            tangents.append(slope_seed)
            assert self.adjoints
            for z, W, s, incoming in zip(
                self.arguments, self.weights, self.slopes, self._incoming, strict=False
            ):
                pushed = tangents[-1] @ W.mT
                bends.append(self.activation.curvature(z) * pushed * incoming)
                tangents.append(s * pushed)
        gradient: list[Tensor] = [seed.sum(-2)]
        last = (seed * self.layers[-1]).sum(-2, keepdim=True)
        gradient.append(last + tangents[-1].sum(-2, keepdim=True) if tangents else last)
        adjoint = seed * self.weights[-1]  # of a_l
        for layer in range(len(self.arguments) - 1, -1, -1):
            through = self.slopes[layer] * adjoint
            if bends:
                through = through + bends[layer]
            product = through.mT @ self.layers[layer]
            if tangents:
                product = product + self.adjoints[layer].mT @ tangents[layer]
            gradient += [through.sum(-2), product]
            if layer:
                adjoint = through @ self.weights[layer]
        return tuple(gradient[::-1])


def _affine(a: Tensor, W: Tensor, b: Tensor) -> Tensor:
    """a W' + b over `[q..., k, p]`."""
    if a.dim() == 3 and W.dim() == 3:
        return torch.baddbmm(b[:, None, :], a, W.mT)
    return a @ W.mT + b[..., None, :]


def expanded(parameters: Parameters, count: int) -> Parameters:
    """`count` networks with the same parameters: a leading axis, without copies."""
    return tuple(p.expand(count, *p.shape) for p in parameters)
