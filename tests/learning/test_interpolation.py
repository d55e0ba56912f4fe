"""Section III-A2: the network interpolates a coarse solution."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from learning.config import DataSettings, LossSettings, NetworkSettings
from learning.faithful_data import supervision
from learning.interpolation import InterpolationSettings, fitted, interpolated_value
from learning.losses import Derivative, Reduction
from learning.value_network import Activation
from ocp.compiled.batch import optimal_inputs
from ocp.query_family import paper_query

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
    return interpolated_value(QUERY, SETTINGS)


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
    first, losses = fitted(QUERY, data, short)
    again, _ = fitted(QUERY, data, short)
    assert np.median(losses[-10:]) < 0.5 * np.median(losses[:10])
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    other, _ = fitted(QUERY, data, replace(short, seed=1))
    assert not torch.equal(first[0], other[0])
