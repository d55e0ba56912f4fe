"""The losses of Xu and Zhu, eqs. (9) to (12), and their gradient in the network's parameters.

    L_v = sum (V_hat - V)^2        (9)
    L_u = sum |u_hat - h(grad V)|^2        (11), the violation of (10)
    L   = L_v + mu L_u        (12)

For a control-affine robot and unbounded inputs h is closed, h(grad V)_j = -G_j . grad V / (2 R_j).
So L_u needs the derivatives of V along the columns of G only, not the whole gradient. They come
from differences of V (the paper's choice) or from automatic differentiation: see `Derivative`.

Letters: `q` queries (any leading axes), `k` samples, `m` inputs, `p` features.
"""

from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from learning.faithful.value_network import Activation, ForwardPass, Parameters


class Derivative(Enum):
    """How grad V enters L_u."""

    FINITE = "finite"
    """Forward differences along the columns of G."""
    AUTOMATIC = "automatic"
    """The chain rule."""


class Reduction(Enum):
    """What (9) and (11) do over the samples."""

    SUM = "sum"
    """As printed: the size of a gradient step grows with the number of samples."""
    MEAN = "mean"

    def __call__(self, terms: Tensor) -> Tensor:
        """`[q..., k]` -> `[q...]`."""
        return terms.sum(-1) if self is Reduction.SUM else terms.mean(-1)

    def weight(self, count: int) -> float:
        """Of each of `count` terms."""
        return 1.0 if self is Reduction.SUM else 1.0 / count


class Structure(Enum):
    """How V is made of the network's output N."""

    PLAIN = "plain"
    """V = N, the paper's."""
    BOUND = "bound"
    """V = B (1 + softplus N), B the obstacle-free lower bound of V at the same distance."""


@dataclass(frozen=True)
class Lagrangian:
    """Which form of (12) is meant.

    Attributes:
        multiplier: mu.
        reduction, derivative: see there.
        activation: of the network.
    """

    multiplier: float = 0.1
    reduction: Reduction = Reduction.SUM
    derivative: Derivative = Derivative.FINITE
    activation: Activation = Activation.RELU
    structure: Structure = Structure.PLAIN


@dataclass(frozen=True)
class Samples:
    """Supervision of a query: states with optimal value and control, as tensors.

    Attributes:
        features: `[q..., k, p]` of the states x.
        shifted: `[q..., m, k, p]`, features of x + step G_j(x); for differences.
        directions: `[q..., k, m, p]`, derivative of the features along -G_j / (2 R_j).
        rates: `[m]`: -1 / (2 R_j step), what a difference of V is multiplied by.
        values: `[q..., k]`, V_hat.
        inputs: `[q..., k, m]`, u_hat.
        bound: `[q..., k]`, B; empty for the plain structure.
        bound_slopes: `[q..., k, m]`, derivative of B along -G_j / (2 R_j); likewise.
    """

    features: Tensor
    shifted: Tensor
    directions: Tensor
    rates: Tensor
    values: Tensor
    inputs: Tensor
    bound: Tensor
    bound_slopes: Tensor

    @property
    def count(self) -> int:
        """k."""
        return self.values.shape[-1]


@dataclass(frozen=True)
class Outcome:
    """Loss terms `[q...]` and the gradient of the Lagrangian.

    Attributes:
        value, control: L_v and L_u, reduced.
        gradient: like the parameters.
    """

    value: Tensor
    control: Tensor
    gradient: Parameters


def lagrangian(parameters: Parameters, samples: Samples, form: Lagrangian) -> Tensor:
    """L `[q...]` of networks with parameters `[q..., ...]`; differentiable."""
    value, control = _terms(_Prediction(parameters, samples, form), samples, form)
    return value + form.multiplier * control


def lagrangian_gradient(parameters: Parameters, samples: Samples, form: Lagrangian) -> Outcome:
    """L and its gradient, the chain rule written out; itself differentiable."""
    prediction = _Prediction(parameters, samples, form)
    value, control = _terms(prediction, samples, form)
    weight = 2 * form.reduction.weight(samples.count)
    value_seed = weight * (prediction.values - samples.values)
    input_seed = weight * form.multiplier * (prediction.inputs - samples.inputs)
    return Outcome(value, control, prediction.pulled_back(value_seed, input_seed))


def _terms(prediction: "_Prediction", samples: Samples, form: Lagrangian) -> tuple[Tensor, Tensor]:
    """L_v and L_u."""
    missed = (prediction.values - samples.values) ** 2
    violated = ((prediction.inputs - samples.inputs) ** 2).sum(-1)
    return form.reduction(missed), form.reduction(violated)


class _Prediction:
    """V and h(grad V) at samples, and the way back to the parameters.

    The network gives N and n_j, its derivative along -G_j / (2 R_j). Then V = N and u_j = n_j, or
    V = B (1 + softplus N) and u_j = B_j (1 + softplus N) + B sigmoid(N) n_j, B_j being B's.
    """

    def __init__(self, parameters: Parameters, samples: Samples, form: Lagrangian) -> None:
        self.samples, self.form = samples, form
        k, m = samples.count, samples.inputs.shape[-1]
        differences = form.derivative is Derivative.FINITE
        features = samples.features
        if differences:
            features = torch.cat([features, samples.shifted.flatten(-3, -2)], -2)
        self.pass_ = ForwardPass(parameters, features, form.activation)
        outputs = self.pass_.outputs
        if differences:
            points = outputs.unflatten(-1, (1 + m, k))
            outputs = points[..., 0, :]
            slopes = (points[..., 1:, :] - outputs[..., None, :]).mT * samples.rates
        else:
            gradient = self.pass_.feature_gradient()
            slopes = (samples.directions @ gradient[..., None])[..., 0]
        self.outputs, self.slopes = outputs, slopes
        if form.structure is Structure.PLAIN:
            self.values, self.inputs = outputs, slopes
            return
        self.factor = 1 + torch.nn.functional.softplus(outputs)
        self.bend = torch.sigmoid(outputs)
        self.values = samples.bound * self.factor
        self.inputs = (
            samples.bound_slopes * self.factor[..., None]
            + (samples.bound * self.bend)[..., None] * slopes
        )

    def pulled_back(self, value_seed: Tensor, input_seed: Tensor) -> Parameters:
        """The parameters' gradient, given the loss's in V `[q..., k]` and u `[q..., k, m]`."""
        s = self.samples
        seed, slope_seed = value_seed, input_seed
        if self.form.structure is Structure.BOUND:
            bend = self.bend
            along = s.bound_slopes * bend[..., None]
            along = along + (s.bound * bend * (1 - bend))[..., None] * self.slopes
            seed = value_seed * s.bound * bend + (input_seed * along).sum(-1)
            slope_seed = input_seed * (s.bound * bend)[..., None]
        if self.form.derivative is Derivative.AUTOMATIC:
            feature_seed = (slope_seed[..., None, :] @ s.directions)[..., 0, :]
            return self.pass_.parameter_gradient(seed, feature_seed)
        shifts = (slope_seed * s.rates).mT
        points = torch.cat([(seed - shifts.sum(-2))[..., None, :], shifts], -2)
        return self.pass_.parameter_gradient(points.flatten(-2))
