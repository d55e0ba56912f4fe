"""What a network sees of obstacles: their first-order effect on V, in any order, exact slopes."""

from dataclasses import replace

import numpy as np
import pytest

from learning.causality_free.exact import closed_loops, exact_from, exact_trajectories
from learning.causality_free.families import get_family, mirrored
from learning.causality_free.foreseen import foreseen
from learning.causality_free.sidestep import Sidesteps
from ocp.cost import RunningCost
from ocp.obstacle import Obstacle
from ocp.query import Equilibrium, Query
from ocp.regulation import RegulatorValue

FAMILY = get_family("traffic")


def drawn(seed: int, count: int = 6):
    rng = np.random.default_rng(seed)
    query = FAMILY.sample(rng)
    return query, FAMILY.starts(query, count, rng) - query.reference


def test_the_order_of_obstacles_does_not_matter() -> None:
    query, offsets = next(d for d in map(drawn, range(20)) if len(d[0].obstacles) == 3)
    other = replace(query, obstacles=query.obstacles[::-1])
    for a, b in zip(foreseen(query, offsets), foreseen(other, offsets), strict=True):
        assert np.allclose(a, b, rtol=1e-12, atol=1e-12)


def test_features_of_two_obstacles_are_the_sums_of_each() -> None:
    query, offsets = next(d for d in map(drawn, range(20)) if len(d[0].obstacles) == 2)
    alone = [replace(query, obstacles=(o,)) for o in query.obstacles]
    parts = [foreseen(q, offsets)[0] for q in alone]
    # The regulators differ by what the penalties' tails at the goal make of their matrices.
    assert np.allclose(parts[0] + parts[1], foreseen(query, offsets)[0], rtol=1e-3, atol=1e-4)


def test_slopes_are_the_features_derivatives() -> None:
    query, offsets = drawn(1)
    _, slopes = foreseen(query, offsets)
    h = 1e-5
    for i, step in enumerate(h * np.eye(offsets.shape[1])):
        ahead, behind = (foreseen(query, offsets + s * step)[0] for s in (1, -1))
        found = (ahead - behind) / (2 * h)
        assert np.allclose(found, slopes[:, i], rtol=1e-6, atol=1e-7 * np.abs(slopes).max())


def test_a_mirrored_layout_is_seen_mirrored() -> None:
    """The same penalties, the opposite sides: only the integrals of y change their sign."""
    query, offsets = drawn(2)
    signs = np.array(FAMILY.mirror)
    here = foreseen(query, offsets)[0]
    there = foreseen(mirrored(query, signs), offsets * signs)[0]
    assert np.allclose(np.abs(here), np.abs(there), rtol=1e-9, atol=1e-12)
    assert np.allclose(here[:, :6], there[:, :6], rtol=1e-9, atol=1e-12)
    assert np.allclose(here[:, 6:], -there[:, 6:], rtol=1e-9, atol=1e-12)


def test_without_obstacles_there_is_nothing_to_see() -> None:
    query, offsets = drawn(3)
    features, slopes = foreseen(replace(query, obstacles=()), offsets)
    assert features.shape == (6, 0)
    assert slopes.shape == (6, 5, 0)


def integrator(weight: float) -> Query:
    """A linear robot, for which the regulator's motion is optimal without the obstacle."""
    cost = RunningCost(
        goal=0.0, obstacle=weight, obstacle_steepness=6.0,
        state=tuple(map(tuple, np.eye(4).tolist())), input=(0.5, 0.5),
    )  # fmt: skip
    obstacle = Obstacle.circle((1.8, 0.3), 0.4)
    return Query("double-integrator-2d", Equilibrium((0.0,) * 4, 0.1), (obstacle,), cost)


@pytest.mark.parametrize("weight", [1e-2, 1e-3])
def test_the_first_feature_is_the_first_order_change_of_the_value(weight) -> None:
    """(V - V_LQR) / w -> J as w -> 0, the gap of first order in w."""
    query, start = integrator(weight), np.array([2.6, 0.2, -0.5, 0.0])
    regulated = RegulatorValue(query)
    optimum = exact_trajectories(query, [regulated], start)[0]
    assert optimum is not None
    change = (optimum.cost - float(regulated.value(start))) / weight
    expected = foreseen(query, start[None])[0][0, 0]
    assert expected > 0.3
    assert change == pytest.approx(expected, rel=3 * weight + 2e-3)
    assert change < expected * (1 + 2e-3)  # a motion that gives way is cheaper


def test_sidesteps_pass_the_obstacle_on_their_sides() -> None:
    query = integrator(30.0)
    query = replace(query, obstacles=(Obstacle.circle((1.8, 0.0), 0.4),))
    start = np.array([3.2, 0.0, 0.0, 0.0])
    costs = []
    both = Sidesteps(query, passed=[0, 0], sides=[1, -1])
    for side, guess in zip((1, -1), closed_loops(query, both, [start, start]), strict=True):
        assert guess is not None
        found = exact_from(query, guess)
        assert found is not None
        costs.append(found.cost)
        nearest = np.abs(found.motion.states[:, 0] - 1.8).argmin()
        # Left of it on the way to the goal, which lies at -x: y < 0.
        assert np.sign(found.motion.states[nearest, 1]) == -side
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)  # by symmetry
    through = closed_loops(query, RegulatorValue(query), start)[0]
    assert through is not None
    straight = exact_from(query, through)
    assert straight is None or straight.cost > 1.2 * costs[0]
    best = exact_trajectories(query, [RegulatorValue(query)], start)[0]
    assert best is not None
    assert best.cost == pytest.approx(costs[0], rel=1e-9)


def test_a_sidestep_aims_at_the_goal_once_the_obstacle_is_passed() -> None:
    query = integrator(1.0)
    passed = np.array([[0.05, 0.02, 0.1, 0.0], [-3.0, 0.0, 0.1, 0.0]])
    before = np.array([[2.4, 0.3, 0.0, 0.0]])
    linear = RegulatorValue(query)
    assert np.allclose(
        Sidesteps(query, [0, 0], [1, 1]).gradient(passed), linear.gradient(passed), atol=1e-4
    )
    moved = Sidesteps(query, [0], [1]).gradient(before)
    assert np.abs(moved - linear.gradient(before)).max() > 0.5
