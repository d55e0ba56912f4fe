"""Section III-A2: the network interpolates a coarse solution."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from learning.faithful.config import DataSettings, LossSettings, NetworkSettings
from learning.faithful.data import supervision
from learning.faithful.interpolation import (
    InterpolationPlanner,
    InterpolationSettings,
    advanced,
    begun,
)
from learning.faithful.losses import Derivative, Reduction
from learning.faithful.value_network import Activation
from ocp.compiled.batch import optimal_inputs
from ocp.planning import iterations, plan
from ocp.query_family import paper_query
from ocp.trajectory import SolveError

QUERY = paper_query((4.0, 4.0))
SETTINGS = InterpolationSettings(
    data=DataSettings(grid=(40, 40, 26), step=0.53),
    network=NetworkSettings((48, 48), Activation.SILU),
    loss=LossSettings(3.0, Reduction.MEAN, Derivative.AUTOMATIC),
    steps=500,
    batch=256,
    rate=1e-2,
)


@pytest.fixture(scope="module")
def data():
    return supervision(QUERY, SETTINGS.data, (0, 0))


@pytest.fixture(scope="module")
def value():
    return plan(InterpolationPlanner(SETTINGS), QUERY, until=iterations(100)).value


def test_the_network_comes_near_the_values_it_was_shown(data, value) -> None:
    """In the mean; the goal's cusp is beyond so small a network."""
    outside = QUERY.goal_distance(data.states) > 0
    error = np.abs(value.value(data.states) - data.values)[outside].mean()
    spread = np.abs(data.values - data.values.mean())[outside].mean()
    assert error < 0.15 * spread


def test_the_control_follows_the_one_it_was_shown(data, value) -> None:
    """More than standing still would: L_u is part of the loss."""
    outside = QUERY.goal_distance(data.states) > 0
    states, shown = data.states[outside], data.inputs[outside]
    read = optimal_inputs(QUERY, states, value.gradient(states))
    assert ((read - shown) ** 2).mean() < 0.5 * (shown**2).mean()


def test_the_loss_falls_and_equal_seeds_agree(data) -> None:
    short = replace(SETTINGS, steps=50)
    whole = advanced(begun(QUERY, data, short), 50)
    assert whole.finished
    assert np.median(whole.losses[-10:]) < 0.5 * np.median(whole.losses[:10])
    half = advanced(begun(QUERY, data, short), 20)
    assert not half.finished
    losses = half.losses
    parts = advanced(half, 1000)
    assert half.losses == losses
    assert len(parts.losses) == 50
    for a, b in zip(whole.parameters, parts.parameters, strict=True):
        assert torch.equal(a, b)
    other = advanced(begun(QUERY, data, replace(short, seed=1)), 50)
    assert not torch.equal(whole.parameters[0], other.parameters[0])


def test_bounded_inputs_are_refused() -> None:
    bounded = replace(QUERY, input_lower=(-1.0, -1.0))
    with pytest.raises(SolveError, match="unbounded"):
        InterpolationPlanner(SETTINGS).start(bounded, [])
