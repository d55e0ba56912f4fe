"""Adaptation: exact where it can be, never worse at the held-out states."""

import numpy as np
import pytest
from causality_free_problems import random_value
from hypothesis import given, settings
from hypothesis import strategies as st

from learning.causality_free.adaptation import adapt, guard_score, refit
from learning.causality_free.exact import exact_trajectories
from learning.causality_free.families import get_family
from learning.causality_free.samples import POINTS, Samples, input_matrices
from learning.causality_free.value import NetworkValue
from ocp.compiled.batch import rates, running_costs
from ocp.regulation import RegulatorValue
from ocp.value import greedy


def of_value(value: NetworkValue, states: np.ndarray) -> Samples:
    """Samples as exact motions would give them if `value` were the truth."""
    query = value.query
    V, p = value.both(states)
    L = running_costs(query, states, greedy(query, value)(states))
    D = input_matrices(query, states) / np.sqrt(query.input_weights)
    e = query.system.difference(states, query.reference)
    return Samples(e, V, p, D / (2 * np.sqrt(L))[:, None, None])


@settings(max_examples=8)
@given(seed=st.integers(0, 1000))
def test_the_held_out_residual_never_gets_worse(seed) -> None:
    """Even with samples that are wrong: then the trained weights stay."""
    family = get_family("car")
    value = random_value(family, seed, 0.1)
    rng = np.random.default_rng(seed)
    states = family.starts(value.query, 40, rng)
    samples = of_value(random_value(family, seed + 1, 1.0), states)
    held_out = family.starts(value.query, 60, rng)
    adapted = adapt(value, samples, held_out)
    assert adapted.before == guard_score(value, held_out)
    assert adapted.after == guard_score(adapted.value, held_out)
    assert adapted.after <= adapted.before
    if np.isinf(adapted.strength):
        assert adapted.value is value


def test_a_last_layer_that_explains_the_data_is_found() -> None:
    family = get_family("car")
    truth = random_value(family, 11, 0.3)
    rng = np.random.default_rng(0)
    samples = of_value(truth, family.starts(truth.query, 300, rng))
    flat = truth.with_last(np.zeros_like(truth.weights.last.numpy()))
    x = family.starts(truth.query, 50, rng)
    # The truth's own residual is no measure here (it is no cost-to-go): one strength, no choice.
    close = _refitted(flat, samples, 1e-12)
    assert np.allclose(close.value(x), truth.value(x), rtol=1e-5)
    far = _refitted(flat, samples, 1e9)
    assert np.allclose(far.value(x), flat.value(x), rtol=1e-5)


def _refitted(value: NetworkValue, samples: Samples, strength: float) -> NetworkValue:
    return refit(value, samples, [strength])[0]


def test_samples_say_what_motions_say() -> None:
    family = get_family("quadrotor")
    query = family.sample(np.random.default_rng(1))
    optimum = exact_trajectories(
        query, [RegulatorValue(query)], family.starts(query, 1, np.random.default_rng(2))
    )[0]
    assert optimum is not None
    samples = Samples.of(query, [optimum])
    assert len(samples) == POINTS
    assert samples.values.max() == pytest.approx(optimum.cost)
    assert np.array_equal(samples.offsets[0], optimum.motion.states[0] - query.reference)
    # |D'd|^2 is the excess of the running cost over L when the costate is off by d.
    x, p = query.reference + samples.offsets[5:6], samples.costates[5:6]
    u = -np.einsum("knm,kn->km", input_matrices(query, x), p) / (2 * query.input_weights)
    u = u + query.reference_input
    d = np.random.default_rng(3).normal(size=x.shape) * 0.1
    moved = u - np.einsum("knm,kn->km", input_matrices(query, x), d) / (2 * query.input_weights)
    H = [running_costs(query, x, v) + (p * rates(query, x, v)).sum(axis=1) for v in (u, moved)]
    expected = np.sum(np.einsum("knm,kn->km", samples.sensitivity[5:6], d) ** 2)
    L = running_costs(query, x, np.clip(u, *query.input_bounds))
    assert float(((H[1] - H[0]) / L)[0]) == pytest.approx(expected, rel=1e-6)


def test_no_motions_give_no_samples() -> None:
    query = get_family("car").sample(np.random.default_rng(0))
    assert len(Samples.of(query, [])) == 0
