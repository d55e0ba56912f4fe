"""The conditioned network: its symmetries, its bounds, and its compiled twin."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from learning.conditioned.compiled_network import NetworkPolicy, NetworkValue
from learning.conditioned.network_weights import NetworkWeights
from learning.conditioned.query_encoder import QueryEncoder
from learning.conditioned.value_function import Batch, ConditionedNetwork, Widths, value_and_slopes
from ocp import Goal, Obstacle, Query, greedy
from ocp.query_family import sample_start

OBSTACLES = (
    Obstacle.circle((-1.0, 0.3), 0.9),
    Obstacle.diamond((0.2, 2.0), 0.7),
    Obstacle.circle((2.5, -2.0), 1.1),
)
QUERY = Query("unicycle", Goal((1.0, 0.5), 0.45), OBSTACLES)


def network(seed=0):
    """An untrained network, with features standardised roughly and visible corrections."""
    torch.manual_seed(seed)
    made = ConditionedNetwork(Widths(16, 24, 3)).double()
    with torch.no_grad():
        made.state_mean.normal_()
        made.obstacle_scale.uniform_(0.5, 2.0)
    return made


def compiled(query, made):
    arrays = {k: v.numpy().astype(np.float32) for k, v in made.state_dict().items()}
    return NetworkValue(QueryEncoder.of(query), NetworkWeights(arrays))


def states(query=QUERY, count=100):
    rng = np.random.default_rng(1)
    return np.array([sample_start(query, rng) for _ in range(count)])


def test_the_compiled_network_equals_torch():
    """Single precision in the compiled one: 1e-5 relative, as values and gradients are of order
    1 to 30."""
    made, x = network(), states()
    free, state, state_slopes, obstacle, slopes = QueryEncoder.of(QUERY).encode(x)
    count = len(OBSTACLES)
    tensors = [
        torch.from_numpy(a)
        for a in (
            free,
            state,
            state_slopes,
            obstacle.reshape(len(x) * count, -1),
            slopes.reshape(len(x) * count, -1, 3),
        )
    ]
    owner = torch.arange(len(x)).repeat_interleave(count)
    V, gradient = value_and_slopes(made, Batch(*tensors, owner=owner), create_graph=False)
    values, gradients = compiled(QUERY, made).value_and_gradient(x)
    np.testing.assert_allclose(values, V.detach().numpy(), rtol=1e-5)
    scale = 1e-5 * (1 + np.abs(gradient.detach().numpy()).max(axis=1, keepdims=True))
    assert (np.abs(gradients - gradient.detach().numpy()) < 3 * scale).all()


def test_one_state_and_many_give_the_same():
    value, x = compiled(QUERY, network()), states()
    values, gradients = value.value_and_gradient(x)
    for k in range(0, len(x), 10):
        one, slope = value.value_and_gradient(x[k])
        np.testing.assert_allclose(one, values[k], rtol=1e-6)
        np.testing.assert_allclose(slope, gradients[k], rtol=1e-4, atol=1e-5)


def test_the_gradient_is_that_of_the_value():
    """Central differences; single precision leaves about 1e-7 V / h."""
    value, x, h = compiled(QUERY, network()), states(), 2e-3
    gradients = value.gradient(x)
    for i in range(3):
        step = np.eye(3)[i] * h
        numeric = (value.value(x + step) - value.value(x - step)) / (2 * h)
        # Heads change and headings are tangential somewhere: there V has kinks.
        assert np.median(np.abs(numeric - gradients[:, i])) < 2e-3


def test_the_order_of_obstacles_is_irrelevant():
    made, x = network(), states()
    shuffled = replace(QUERY, obstacles=OBSTACLES[::-1])
    np.testing.assert_allclose(
        compiled(QUERY, made).value(x), compiled(shuffled, made).value(x), rtol=1e-6
    )


def test_the_value_is_never_below_the_one_without_obstacles_and_exact_without_any():
    made, x = network(), states()
    encoder = QueryEncoder.of(QUERY)
    free = encoder.table.value(x)
    assert (compiled(QUERY, made).value(x) >= free).all()
    empty = replace(QUERY, obstacles=())
    np.testing.assert_allclose(compiled(empty, made).value(x), free, rtol=1e-12)


def test_value_and_policy_vanish_in_the_goal():
    value = compiled(QUERY, network())
    inside = np.array([1.1, 0.4, 0.3])
    assert value.value(inside) == 0
    assert (value.gradient(inside) == 0).all()
    assert (NetworkPolicy(value)(inside) == 0).all()


def test_the_compiled_policy_is_the_greedy_one():
    value, x = compiled(QUERY, network()), states()
    np.testing.assert_allclose(NetworkPolicy(value)(x), greedy(QUERY, value)(x), rtol=1e-9)


def test_damaged_weights_are_refused(tmp_path):
    weights = compiled(QUERY, network()).weights
    path = tmp_path / "weights.safetensors"
    weights.save(path)
    again = NetworkWeights.load(path)
    np.testing.assert_array_equal(again.packed, weights.packed)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match="damaged"):
        NetworkWeights.load(path)
    broken = dict(weights.arrays)
    broken["heads.bias"] = broken["heads.bias"] * np.nan
    with pytest.raises(ValueError, match=r"heads\.bias is not finite"):
        NetworkWeights(broken)
