"""Eqs. (9) to (12): longhand, closed forms, and gradients against finite differences."""

import numpy as np
import pytest
import torch
from faithful_references import (
    FORMS,
    aligned_states,
    aligned_values,
    form_name,
    of_query,
    random_samples,
    small_networks,
)

from learning.faithful.config import NetworkSettings
from learning.faithful.losses import (
    Derivative,
    Lagrangian,
    Reduction,
    Structure,
    lagrangian,
    lagrangian_gradient,
)
from learning.faithful.meta_data import DistanceBound, FeatureMap, SampleMap, Supervision
from learning.faithful.network_value import StateNetworkValue
from learning.faithful.value_network import Activation
from ocp.compiled.batch import rates, running_costs
from ocp.eikonal import solve_eikonal
from ocp.query import Query
from ocp.query_family import paper_query
from ocp.trajectory import SolveError
from ocp.value import GradientPolicy

forms = pytest.mark.parametrize("form", FORMS, ids=form_name)


@forms
def test_the_gradient_matches_finite_differences(form: Lagrangian) -> None:
    """Central differences in random directions: error of order step^2 and rounding / step."""
    theta, samples = small_networks(form.activation, 3), random_samples(0)
    gradient = lagrangian_gradient(theta, samples, form).gradient
    generator = torch.Generator().manual_seed(1)
    for _ in range(3):
        along = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in theta]
        step = 1e-6
        ends = [
            lagrangian(tuple(p + s * d for p, d in zip(theta, along, strict=True)), samples, form)
            for s in (step, -step)
        ]
        expected = (ends[0] - ends[1]) / (2 * step)
        found = sum((g * d).flatten(1).sum(1) for g, d in zip(gradient, along, strict=True))
        assert torch.allclose(found, expected, rtol=1e-6, atol=1e-6)  # pyright: ignore


@forms
def test_the_terms_are_those_of_the_lagrangian(form: Lagrangian) -> None:
    theta, samples = small_networks(form.activation, 3), random_samples(0)
    outcome = lagrangian_gradient(theta, samples, form)
    total = outcome.value + form.multiplier * outcome.control
    assert torch.allclose(total, lagrangian(theta, samples, form))


def test_sums_are_means_times_the_number_of_samples() -> None:
    theta, samples = small_networks(Activation.RELU, 3), random_samples(0)
    forms = [Lagrangian(0.1, r, Derivative.AUTOMATIC) for r in (Reduction.SUM, Reduction.MEAN)]
    total, mean = (lagrangian(theta, samples, f) for f in forms)
    assert torch.allclose(total, samples.count * mean)


def test_a_batch_of_queries_is_each_query_alone() -> None:
    theta, samples = small_networks(Activation.SILU, 3), random_samples(0)
    form = Lagrangian(0.1, Reduction.SUM, Derivative.AUTOMATIC, Activation.SILU)
    together = lagrangian_gradient(theta, samples, form)
    for i in range(3):
        alone = lagrangian_gradient(tuple(p[i] for p in theta), of_query(samples, i), form)
        assert torch.allclose(alone.value, together.value[i])
        assert torch.allclose(alone.gradient[0], together.gradient[0][i])


# On the unicycle


def unicycle_supervision(query: Query, count: int = 40) -> Supervision:
    rng = np.random.default_rng(2)
    system = query.system
    states = rng.uniform(system.lower, system.upper, (count, 3))
    return Supervision(states, rng.normal(size=count), rng.normal(size=(count, 2)))


@pytest.mark.parametrize("structure", Structure)
@pytest.mark.parametrize("relative", [False, True])
def test_the_control_is_the_hamiltonians_minimiser(structure: Structure, relative: bool) -> None:
    """(11) longhand, the control by way of the value object and `optimal_inputs`."""
    query = paper_query((1.0, 4.0))
    data = unicycle_supervision(query)
    settings = NetworkSettings((7, 6, 5), Activation.SILU, relative, structure)
    theta = small_networks(Activation.SILU)
    value = StateNetworkValue(query, settings, theta)
    outside = query.goal_distance(data.states) > 0
    data = Supervision(data.states[outside], data.values[outside], data.inputs[outside])
    expected = ((GradientPolicy(query, value)(data.states) - data.inputs) ** 2).sum()
    samples = SampleMap(FeatureMap(query.system, relative), structure, dtype=torch.float64)
    form = Lagrangian(1.0, Reduction.SUM, Derivative.AUTOMATIC, Activation.SILU, structure)
    outcome = lagrangian_gradient(theta, samples.samples(query, data), form)
    assert float(outcome.control) == pytest.approx(expected, rel=1e-9)


def test_differences_converge_to_the_derivative_at_first_order() -> None:
    query = paper_query((1.0, 4.0))
    data = unicycle_supervision(query)
    theta = small_networks(Activation.SILU)
    errors = []
    for step in (0.02, 0.01, 0.005):
        tensors = SampleMap(FeatureMap(query.system), step=step, dtype=torch.float64)
        samples = tensors.samples(query, data)
        loss = [
            lagrangian_gradient(theta, samples, Lagrangian(1.0, Reduction.SUM, d, Activation.SILU))
            for d in (Derivative.FINITE, Derivative.AUTOMATIC)
        ]
        errors.append(abs(float(loss[0].control - loss[1].control)))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert (np.abs(ratios - 2.0) < 0.1).all()


def test_bounded_inputs_are_refused() -> None:
    query = Query("unicycle", paper_query((4.0, 4.0)).goal, (), input_lower=(-1.0, -1.0))
    with pytest.raises(SolveError, match="unbounded"):
        SampleMap(FeatureMap(query.system)).samples(query, unicycle_supervision(query))


def test_the_exact_value_has_no_loss() -> None:
    """Without an obstacle V = B where the robot faces the goal: a network of output -inf is exact.

    softplus(-40) = 4e-18, so V = B to rounding; on aligned headings the optimal turn rate is 0 and
    the optimal speed sqrt(Q).
    """
    center = (4.0, 4.0)
    query = paper_query(center)
    distances = np.linspace(0.7, 8.0, 12)
    states = aligned_states(center, distances)
    bound = DistanceBound(query)
    assert np.abs(bound.value(states) - aligned_values(distances)).max() < 1e-5
    speed = np.linalg.norm(bound.gradient(states), axis=1) / 2
    data = Supervision(states, aligned_values(distances), np.column_stack([speed, 0 * speed]))
    samples = SampleMap(FeatureMap(query.system), Structure.BOUND, dtype=torch.float64)
    theta = tuple(torch.zeros_like(p) for p in small_networks(Activation.SILU))
    theta = (*theta[:-1], torch.full_like(theta[-1], -40.0))
    form = Lagrangian(1.0, Reduction.MEAN, Derivative.AUTOMATIC, Activation.SILU, Structure.BOUND)
    outcome = lagrangian_gradient(theta, samples.samples(query, data), form)
    assert float(outcome.value) < 1e-9
    assert float(outcome.control) < 1e-9
    # and such a motion lowers B by what it costs: dB/dt = -L, the HJB equation
    moved = rates(query, states, data.inputs)
    fall = (bound.gradient(states) * moved).sum(-1)
    assert fall == pytest.approx(-running_costs(query, states, data.inputs), rel=1e-3)


def test_the_bound_is_below_the_value_and_its_slope_is_its_derivative() -> None:
    query = paper_query((1.0, 4.0))
    bound = DistanceBound(query)
    rng = np.random.default_rng(0)
    states = rng.uniform(query.system.lower, query.system.upper, (300, 3))
    states = states[query.goal_distance(states) > 0.05]
    exact = solve_eikonal(query).value.value(states)
    assert (bound.value(states) <= exact * 1.02).all()  # the grid's own error
    step = 1e-5
    for i in range(2):
        shift = step * np.eye(3)[i]
        slope = (bound.value(states + shift) - bound.value(states - shift)) / (2 * step)
        assert np.abs(slope - bound.gradient(states)[:, i]).max() < 5e-3  # of linear interpolation
    assert not bound.gradient(states)[:, 2].any()
