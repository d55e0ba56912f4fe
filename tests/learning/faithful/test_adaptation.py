"""Algorithm 2: its data, its steps, and convergence where the value is known in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from faithful_references import aligned_states, aligned_values

from learning.faithful.adaptation import Adaptation, adapt_once, drawn_shots, next_trajectory
from learning.faithful.config import (
    AdaptationSettings,
    Config,
    LossSettings,
    NetworkSettings,
    Optimizer,
)
from learning.faithful.data import sample_map
from learning.faithful.losses import Derivative, Reduction, Structure, lagrangian_gradient
from learning.faithful.meta import MetaWeights, architecture
from learning.faithful.meta_data import along_trajectory, in_goal
from learning.faithful.network_value import StateNetworkValue
from learning.faithful.planner import FaithfulPlanner
from learning.faithful.value_network import Activation
from ocp.compiled.batch import running_costs
from ocp.models.linear import single_integrator
from ocp.planning import iterations, plan, trajectories
from ocp.pontryagin import exact_trajectory
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query
from ocp.trajectory import Status

CONFIG = Config(
    network=NetworkSettings((16, 16), Activation.SILU),
    loss=LossSettings(reduction=Reduction.MEAN, derivative=Derivative.AUTOMATIC),
)
QUERY = paper_query((4.0, 4.0))


def untrained(config: Config) -> MetaWeights:
    generator = torch.Generator().manual_seed(0)
    return MetaWeights(config, architecture(config).initial_parameters(generator), 0)


@pytest.fixture(scope="module")
def motion():
    return exact_trajectory(QUERY, PAPER_START)


def test_samples_along_a_trajectory_are_its_optimal_values_and_controls(motion) -> None:
    data = along_trajectory(QUERY, motion, 0.1)
    assert len(data) == np.ceil(motion.duration / 0.1)
    assert data.values[0] == pytest.approx(motion.cost)
    assert (np.diff(data.values) < 0).all()
    # V falls by the running cost: the trapezoid rule over 0.1 s.
    costs = running_costs(QUERY, data.states, data.inputs)
    fall = -np.diff(data.values)
    assert fall == pytest.approx((costs[1:] + costs[:-1]) / 2 * 0.1, abs=2e-3)


def test_an_unsolved_trajectory_is_no_supervision(motion) -> None:
    with pytest.raises(ValueError, match="NOT_CONVERGED"):
        along_trajectory(QUERY, replace(motion, status=Status.NOT_CONVERGED), 0.1)


def test_goal_samples_fill_the_goal_and_cost_nothing() -> None:
    data = in_goal(QUERY, 4000, np.random.default_rng(0))
    distance = QUERY.goal_distance(data.states) + QUERY.goal.radius
    assert distance.max() <= QUERY.goal.radius
    # uniform over a disc: half of the samples lie within r / sqrt 2 (standard error 0.008)
    inner = (distance < QUERY.goal.radius / np.sqrt(2)).mean()
    assert abs(inner - 0.5) < 0.03
    assert not data.values.any()
    assert not data.inputs.any()


@pytest.mark.parametrize("ratio", [0.0, 0.1, 0.3])
def test_shots_grow_with_the_pool_and_keep_the_goals_share(motion, ratio: float) -> None:
    settings = AdaptationSettings(interval=0.05, goal_ratio=ratio)
    part = along_trajectory(QUERY, motion, settings.interval)
    for n in (1, 2, 4, 8):
        shots = drawn_shots(QUERY, (part,) * n, settings, np.random.default_rng(n))
        assert len(shots) == 32 * n
        share = (QUERY.goal_distance(shots.states) <= 0).mean()
        assert abs(share - ratio) < 4 * np.sqrt(ratio * (1 - ratio) / len(shots)) + 0.01


def test_a_small_pool_is_used_whole(motion) -> None:
    part = along_trajectory(QUERY, motion, 4.0)
    settings = AdaptationSettings(goal_ratio=0.0)
    shots = drawn_shots(QUERY, (part,), settings, np.random.default_rng(0))
    assert len(shots) == len(part) < 32


def test_an_iteration_is_m_gradient_steps_longhand(motion) -> None:
    """Line 17 repeated on the same shots, from where the last iteration ended."""
    first = Adaptation(QUERY, untrained(CONFIG).parameters)
    second = adapt_once(first, CONFIG, 5, motion)
    settings = CONFIG.adaptation
    pool = (along_trajectory(QUERY, motion, settings.interval),)
    assert second.pool[0].values == pytest.approx(pool[0].values)
    # the generator of the first iteration's shots
    rng = np.random.default_rng([5, 4, 1])
    samples = sample_map(CONFIG, QUERY).samples(QUERY, drawn_shots(QUERY, pool, settings, rng))
    theta = first.parameters
    for _ in range(settings.steps):
        gradient = lagrangian_gradient(theta, samples, CONFIG.lagrangian).gradient
        theta = tuple(p - settings.rate * g for p, g in zip(theta, gradient, strict=True))
    for a, b in zip(second.parameters, theta, strict=True):
        assert torch.equal(a, b)
    assert first.iteration == 0
    assert second.iteration == 1


def test_adam_is_torchs() -> None:
    config = replace(CONFIG, adaptation=AdaptationSettings(optimizer=Optimizer.ADAM, steps=7))
    motion = exact_trajectory(QUERY, (2.0, 2.0, 0.5))
    start = Adaptation(QUERY, untrained(config).parameters)
    found = adapt_once(adapt_once(start, config, 0, motion), config, 0, motion)
    theta = tuple(p.clone() for p in start.parameters)
    optimizer = torch.optim.Adam(theta, lr=config.adaptation.rate)
    pool = ()
    for n in (1, 2):
        pool = (*pool, along_trajectory(QUERY, motion, config.adaptation.interval))
        shots = drawn_shots(QUERY, pool, config.adaptation, np.random.default_rng([0, 4, n]))
        samples = sample_map(config, QUERY).samples(QUERY, shots)
        for _ in range(7):
            gradient = lagrangian_gradient(theta, samples, config.lagrangian).gradient
            for p, g in zip(theta, gradient, strict=True):
                p.grad = g
            optimizer.step()
    for a, b in zip(found.parameters, theta, strict=True):
        assert torch.allclose(a, b, atol=1e-6)


def test_divergence_is_said() -> None:
    wild = replace(CONFIG, adaptation=AdaptationSettings(rate=1e20, steps=20))
    motion = exact_trajectory(QUERY, (2.0, 2.0, 0.5))
    with pytest.raises(FloatingPointError, match=r"adaptation\.rate"):
        adapt_once(Adaptation(QUERY, untrained(CONFIG).parameters), wild, 0, motion)


def test_starts_depend_on_seed_and_iteration_alone() -> None:
    here = Adaptation(QUERY, untrained(CONFIG).parameters)
    first, again, other = (next_trajectory(here, seed)[0].start for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_adaptation_converges_to_a_value_known_in_closed_form() -> None:
    """Trajectories that face an unobstructed goal: V = 2 times the integral of sqrt(Q).

    Many small steps on exact motions from aligned states; afterwards V agrees with the closed form
    between them, which no sample showed.
    """
    network = NetworkSettings((32, 32), Activation.SILU, relative=True, structure=Structure.BOUND)
    steps = AdaptationSettings(steps=150, rate=3e-3, optimizer=Optimizer.ADAM)
    config = replace(CONFIG, network=network, adaptation=steps)
    state = Adaptation(QUERY, untrained(config).parameters)
    held_out = np.linspace(0.8, 8.0, 25)
    states, exact = aligned_states((4.0, 4.0), held_out), aligned_values(held_out)

    def error() -> float:
        value = StateNetworkValue(QUERY, network, state.parameters)
        return float(np.abs(value.value(states) - exact).max())

    errors = [error()]
    for distance in (8.2, 6.1, 3.3, 5.0):
        start = aligned_states((4.0, 4.0), np.array([distance]))[0]
        state = adapt_once(state, config, 0, exact_trajectory(QUERY, start))
        errors.append(error())
    assert errors[0] > 0.3 * exact.max()
    assert errors[-1] < 0.015 * exact.max()


# The planner


def test_the_planner_is_anytime_and_leaves_states_alone() -> None:
    config = replace(CONFIG, adaptation=AdaptationSettings(trajectories=2))
    planner = FaithfulPlanner(untrained(config))
    first = planner.start(QUERY, [])
    values = [planner.value(first).value(PAPER_START)]
    second = planner.refine(first)
    third = planner.refine(second)
    assert [s.trajectories for s in (first, second, third)] == [0, 1, 2]
    assert [s.finished for s in (first, second, third)] == [False, False, True]
    assert third.next_seconds > 0
    assert planner.value(first).value(PAPER_START) == values[0]
    assert planner.value(second).value(PAPER_START) != values[0]
    answer = plan(planner, QUERY, [PAPER_START], until=trajectories(1) | iterations(5))
    assert answer.trajectories == 1
    assert answer.policy(np.array(PAPER_START)).shape == (2,)
    assert answer.value.value(PAPER_START) == planner.value(second).value(PAPER_START)


def test_another_robots_query_is_refused() -> None:
    query = Query(single_integrator(2), Goal((0.0, 0.0), 0.5))
    with pytest.raises(ValueError, match="unicycle"):
        FaithfulPlanner(untrained(CONFIG)).start(query, [])


def test_the_value_is_zero_in_the_goal_and_nowhere_negative() -> None:
    for structure in Structure:
        network = NetworkSettings((16, 16), Activation.RELU, structure=structure)
        config = replace(CONFIG, network=network)
        value = StateNetworkValue(QUERY, network, untrained(config).parameters)
        rng = np.random.default_rng(0)
        states = rng.uniform(QUERY.system.lower, QUERY.system.upper, (200, 3))
        assert (value.value(states) >= 0).all()
        inside = in_goal(QUERY, 20, rng)
        assert not value.value(inside.states).any()
        assert not value.gradient(inside.states).any()


@pytest.mark.parametrize("structure", Structure)
@pytest.mark.parametrize("relative", [False, True])
def test_the_gradient_is_the_values_derivative(structure: Structure, relative: bool) -> None:
    network = NetworkSettings((16, 16), Activation.SILU, relative, structure)
    theta = untrained(replace(CONFIG, network=network)).parameters
    theta = (*(p.double() for p in theta[:-1]), theta[-1].double() + 5.0)  # V > 0 everywhere
    value = StateNetworkValue(QUERY, network, theta)
    rng = np.random.default_rng(0)
    states = rng.uniform(QUERY.system.lower, QUERY.system.upper, (50, 3))
    states = states[QUERY.goal_distance(states) > 0.1]
    step = 1e-5
    for i in range(3):
        shift = step * np.eye(3)[i]
        slope = (value.value(states + shift) - value.value(states - shift)) / (2 * step)
        scale = 1 + np.abs(slope)
        assert (np.abs(value.gradient(states)[:, i] - slope) / scale).max() < 5e-3
