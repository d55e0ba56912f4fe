"""Features: their derivatives, and the symmetries of the value that they share."""

from dataclasses import replace

import numpy as np
import pytest

from learning.conditioned.query_encoder import (
    ODD_OBSTACLE,
    ODD_STATE,
    QueryEncoder,
    why_not_encodable,
)
from ocp import Goal, Obstacle, Query, SolveError
from ocp.query_family import sample_start

QUERY = Query(
    "unicycle",
    Goal((1.0, 0.5), 0.45),
    (Obstacle.circle((-1.0, 0.3), 0.9), Obstacle.diamond((0.2, 2.0), 0.7)),
)


def states(query, count=40, seed=0):
    rng = np.random.default_rng(seed)
    return np.array([sample_start(query, rng) for _ in range(count)])


def beside_goal(query, gaps, seed=0):
    """States `gaps` metres from the goal, headings within a radian of the way to it or back."""
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(-np.pi, np.pi, len(gaps))
    ray = np.column_stack([np.cos(bearing), np.sin(bearing)])
    place = query.reference[:2] + (query.goal.radius + gaps)[:, None] * ray
    return np.column_stack([place, bearing + rng.uniform(-1, 1, len(gaps))])


def moved(query, place):
    """The query with every position mapped by `place`."""
    obstacles = tuple(
        Obstacle.circle(place(o.center), o.radius)
        if o.shape == "circle"
        else Obstacle.diamond(place(o.center), o.radius)
        for o in query.obstacles
    )
    return replace(
        query, goal=Goal(tuple(place(query.goal.center)), query.goal.radius), obstacles=obstacles
    )


def features(query, x):
    free, state, _, obstacle, _ = QueryEncoder.of(query).encode(x)
    return free[:, 0], state, obstacle


def test_derivatives_are_those_of_the_features():
    """Central differences, whose error is h^2 times a third derivative."""
    x, h = np.concatenate([states(QUERY), beside_goal(QUERY, np.array([0.005, 0.01]))]), 1e-5
    encoder = QueryEncoder.of(QUERY)
    free, _, state_slopes, _, obstacle_slopes = encoder.encode(x)
    for i in range(3):
        step = np.eye(3)[i] * h
        after, before = encoder.encode(x + step), encoder.encode(x - step)
        for k, slopes in ((1, state_slopes[..., i]), (3, obstacle_slopes[..., i])):
            np.testing.assert_allclose((after[k] - before[k]) / (2 * h), slopes, atol=2e-6)
        np.testing.assert_allclose(
            (after[0] - before[0])[:, 0] / (2 * h), free[:, 1 + i], atol=1e-5
        )


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_quarter_turns_and_shifts_change_nothing(turns):
    angle, shift = turns * np.pi / 2, np.array([0.2, -0.3])
    turn = np.round([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    x = states(QUERY)
    other = np.column_stack([x[:, :2] @ turn.T + shift, x[:, 2] + angle])
    there = moved(QUERY, lambda p: turn @ np.array(p) + shift)
    for here, elsewhere in zip(features(QUERY, x), features(there, other), strict=True):
        np.testing.assert_allclose(here, elsewhere, atol=1e-10)


def test_circles_may_be_turned_by_any_angle():
    query = replace(QUERY, obstacles=QUERY.obstacles[:1])
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    x = states(query)
    other = np.column_stack([x[:, :2] @ turn.T, x[:, 2] + 0.7])
    for here, there in zip(
        features(query, x), features(moved(query, lambda p: turn @ p), other), strict=True
    ):
        np.testing.assert_allclose(here, there, atol=1e-10)


def test_turning_the_robot_round_changes_nothing():
    x = states(QUERY)
    for here, there in zip(
        features(QUERY, x), features(QUERY, x + np.array([0, 0, np.pi])), strict=True
    ):
        np.testing.assert_allclose(here, there, atol=1e-10)


def test_a_mirror_changes_the_sign_of_odd_features_only():
    x = states(QUERY)
    there = moved(QUERY, lambda p: np.array(p) * [1, -1])
    _, state, obstacle = features(QUERY, x)
    _, mirrored_state, mirrored_obstacle = features(there, x * [1, -1, -1])
    state[:, ODD_STATE] *= -1
    obstacle[..., ODD_OBSTACLE] *= -1
    np.testing.assert_allclose(state, mirrored_state, atol=1e-10)
    np.testing.assert_allclose(obstacle, mirrored_obstacle, atol=1e-10)


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        (Query("rover", Goal((1.0, 1.0), 0.5)), "unicycle"),
        (replace(QUERY, input_lower=(-1.0, -1.0)), "bounds"),
        (replace(QUERY, obstacles=(Obstacle.circle((0, 0), 0.4, hard=True),)), "hard"),
        (replace(QUERY, obstacles=(Obstacle.polygon([(0, 0), (1, 0), (0, 1)]),)), "polygons"),
        (replace(QUERY, cost=replace(QUERY.cost, obstacle=2.0)), "cost"),
    ],
)
def test_queries_that_the_networks_do_not_know_are_refused(query, reason):
    assert reason in str(why_not_encodable(query))
    with pytest.raises(SolveError, match=reason):
        QueryEncoder.of(query)
