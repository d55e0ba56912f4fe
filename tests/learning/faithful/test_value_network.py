"""V^NN: its derivatives written out are those of automatic differentiation."""

import pytest
import torch
from faithful_references import small_networks

from learning.faithful.value_network import (
    Activation,
    Architecture,
    ForwardPass,
    expanded,
    network,
)

TOLERANCE = 1e-12  # double precision, five layers

FEATURES = torch.randn((3, 6, 4), generator=torch.Generator().manual_seed(7), dtype=torch.float64)


@pytest.mark.parametrize("activation", Activation)
def test_slope_and_curvature_are_the_activations_derivatives(activation: Activation) -> None:
    z = (torch.linspace(-4, 4, 41, dtype=torch.float64) + 0.01).requires_grad_()
    (first,) = torch.autograd.grad(activation(z).sum(), z, create_graph=True)
    assert torch.allclose(activation.slope(z), first, atol=TOLERANCE)
    if activation is not Activation.RELU:
        (second,) = torch.autograd.grad(first.sum(), z)
        assert torch.allclose(activation.curvature(z), second, atol=TOLERANCE)
    else:  # 0 by convention
        assert not activation.curvature(z).any()


@pytest.mark.parametrize("activation", Activation)
def test_the_feature_gradient_is_the_networks(activation: Activation) -> None:
    parameters = small_networks(activation, count=3)
    passed = ForwardPass(parameters, FEATURES, activation)
    assert torch.allclose(passed.outputs, network(parameters, FEATURES, activation))
    x = FEATURES.clone().requires_grad_()
    (expected,) = torch.autograd.grad(network(parameters, x, activation).sum(), x)
    assert torch.allclose(passed.feature_gradient(), expected, atol=TOLERANCE)


@pytest.mark.parametrize("activation", Activation)
@pytest.mark.parametrize("with_slopes", [False, True])
def test_the_parameter_gradient_is_that_of_the_seeded_sum(
    activation: Activation, with_slopes: bool
) -> None:
    parameters = tuple(p.requires_grad_() for p in small_networks(activation, count=3))
    generator = torch.Generator().manual_seed(8)
    seed = torch.randn((3, 6), generator=generator, dtype=torch.float64)
    slope_seed = torch.randn((3, 6, 4), generator=generator, dtype=torch.float64)
    x = FEATURES.clone().requires_grad_()
    outputs = network(parameters, x, activation)
    (slopes,) = torch.autograd.grad(outputs.sum(), x, create_graph=True)
    total = (seed * outputs).sum() + (slope_seed * slopes).sum() * with_slopes
    expected = torch.autograd.grad(total, parameters)
    with torch.no_grad():
        passed = ForwardPass(parameters, FEATURES, activation)
        found = passed.parameter_gradient(seed, slope_seed if with_slopes else None)
    for a, b in zip(found, expected, strict=True):
        assert a.shape == b.shape
        assert torch.allclose(a, b, atol=TOLERANCE)


def test_a_leading_axis_of_equal_networks_changes_nothing() -> None:
    single = small_networks(Activation.SILU)
    batch = ForwardPass(expanded(single, 3), FEATURES, Activation.SILU)
    for i in range(3):
        alone = ForwardPass(single, FEATURES[i], Activation.SILU)
        assert torch.allclose(batch.outputs[i], alone.outputs, atol=TOLERANCE)
        assert torch.allclose(batch.feature_gradient()[i], alone.feature_gradient(), atol=TOLERANCE)


def test_relu_makes_the_gradient_piecewise_constant_and_silu_does_not() -> None:
    near = 1e-9 * torch.ones(4, dtype=torch.float64)
    for activation, constant in ((Activation.RELU, True), (Activation.SILU, False)):
        theta = small_networks(activation)
        gradient = [ForwardPass(theta, FEATURES[0] + d, activation).feature_gradient()
                    for d in (0 * near, near)]  # fmt: skip
        assert torch.equal(gradient[0], gradient[1]) is constant


def test_the_papers_network_has_the_shapes_it_says() -> None:
    shapes = Architecture(4).shapes
    assert shapes == [(256, 4), (256,), (256, 256), (256,), (256, 256), (256,), (1, 256), (1,)]


def test_equal_seeds_make_equal_parameters_within_the_bound() -> None:
    first, second, other = (
        Architecture(4).initial_parameters(torch.Generator().manual_seed(s)) for s in (1, 1, 2)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    assert not torch.equal(first[0], other[0])
    for W, b in zip(first[::2], first[1::2], strict=True):
        bound = W.shape[1] ** -0.5
        assert 0.8 * bound < W.abs().max() <= bound
        assert b.abs().max() <= bound


def test_an_architecture_without_hidden_layers_is_refused() -> None:
    with pytest.raises(ValueError, match="hidden"):
        Architecture(4, ())


def test_reverse_mode_through_the_written_out_gradient_is_the_hessian() -> None:
    """The second-order part of Algorithm 1 differentiates `parameter_gradient`."""
    theta = tuple(p.requires_grad_() for p in small_networks(Activation.SILU))
    passed = ForwardPass(theta, FEATURES[0], Activation.SILU)
    by_hand = passed.parameter_gradient(passed.outputs)  # of half the sum of squares
    loss = 0.5 * (network(theta, FEATURES[0], Activation.SILU) ** 2).sum()
    automatic = torch.autograd.grad(loss, theta, create_graph=True)
    generator = torch.Generator().manual_seed(9)
    along = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in theta]
    products = [torch.autograd.grad(g, theta, along) for g in (by_hand, automatic)]
    for a, b in zip(*products, strict=True):
        assert torch.allclose(a, b, atol=TOLERANCE)
