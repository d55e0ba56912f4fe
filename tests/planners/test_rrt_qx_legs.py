"""Legs, and how close a foretold motion comes to obstacles: against longhand and Drake."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from planners.leg import Leg, along_route, distance_to_segment, distances_to_segment
from planners.leg_clearance import Surroundings
from planners.perceived import Perceived, Sighting
from planners.solids import Solid
from planners.world import SceneWorld

PERIOD = 0.05
FAR_GOAL = np.array([50.0, 50.0])


def leg():
    return Leg(np.array([0.0, 0, 1, 0]), np.array([4.0, 0, 0, 0]), 2, 0.0)


def test_the_initial_distance_is_of_the_whole_state():
    assert leg().initial_distance == pytest.approx(np.sqrt(17))


def test_the_deviation_is_to_the_finite_segment():
    assert leg().deviation(np.array([2.0, 3, 9, 9])) == pytest.approx(3.0)
    assert leg().deviation(np.array([7.0, 4, 0, 0])) == pytest.approx(5.0)
    assert leg().deviation(np.array([-3.0, -4, 0, 0])) == pytest.approx(5.0)


def test_a_leg_without_length_has_a_deviation():
    point = np.zeros(4)
    assert Leg(point, point, 2, 0.0).deviation(np.array([3.0, 4, 0, 0])) == pytest.approx(5.0)


def test_deviations_of_many_points_are_those_of_each():
    points = np.random.default_rng(0).normal(size=(20, 3))
    a, b = points[0], points[1]
    one_by_one = [distance_to_segment(p, a, b) for p in points]
    np.testing.assert_allclose(distances_to_segment(points, a, b), one_by_one)


def test_points_along_a_route_are_at_their_arc_length():
    route = np.array([[0.0, 0], [3, 0], [3, 4]])
    found = along_route(route, np.array([0.0, 1.5, 3.0, 5.0, 7.0, 9.0]))
    np.testing.assert_allclose(found, [[0, 0], [1.5, 0], [3, 0], [3, 2], [3, 4], [3, 4]])


def solids(rng, dimension, count):
    made = []
    for k in range(count):
        center = rng.uniform(-4, 4, dimension)
        if k % 3 == 0:
            made.append(Solid.ball(center, rng.uniform(0.3, 1.0)))
        elif k % 3 == 1 or dimension == 2:
            half = rng.uniform(0.3, 1.0, dimension)
            turn = rng.uniform(0, 2 * np.pi) if dimension == 2 else 0.0
            made.append(Solid.box(center - half, center + half).moved(np.zeros(dimension), turn))
        else:
            made.append(Solid.hull(center + rng.normal(scale=0.6, size=(8, 3))))
    return made


def path(rng, dimension, samples=60):
    """A smooth motion across the scene."""
    a, b, c = rng.uniform(-5, 5, (3, dimension))
    t = np.linspace(0, 1, samples)[:, None]
    return (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c


def true_clearance(path, made, velocities, foresight, growths):
    """Drake's distance at 16 points between samples, obstacle by obstacle."""
    fine = np.linspace(0, len(path) - 1, 16 * (len(path) - 1) + 1)
    times = PERIOD * fine
    least = np.inf
    for solid, velocity, growth in zip(made, velocities, growths, strict=True):
        moving = velocity.any() or growth > 0
        at = np.stack([np.interp(fine, np.arange(len(path)), x) for x in path.T], axis=1)
        at = at - times[:, None] * velocity
        scene = SceneWorld([-20] * path.shape[1], [20] * path.shape[1], [solid])
        away = scene.distances(at).distance - growth * times
        least = min(least, away[times <= foresight + 1e-9].min() if moving else away.min())
    return least


def told(made, velocities=None, growths=None):
    d = made[0].dimension
    around = Surroundings(d)
    none = np.zeros((len(made), d))
    around.update(
        made,
        none if velocities is None else velocities,
        np.zeros(len(made)) if growths is None else growths,
    )
    return around


@given(seed=st.integers(0, 10_000), moving=st.booleans())
def test_in_the_plane_the_clearance_is_bounded_from_below_and_tightly(seed, moving):
    rng = np.random.default_rng(seed)
    made = solids(rng, 2, 5)
    velocities = rng.normal(size=(5, 2)) * moving
    growths = rng.uniform(0, 0.2, 5) * moving
    way = path(rng, 2)
    truth = true_clearance(way, made, velocities, 2.0, growths)
    found = told(made, velocities, growths).clearances(way[None], PERIOD, 2.0)[0]
    # Between cuts at a quarter of a sample's way, half a cut is given away at most (the truth's own
    # samples are a sixteenth apart), and where an obstacle's foresight ends up to a whole sample
    # more is looked at.
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1).max()
    relative = steps + PERIOD * (np.linalg.norm(velocities, axis=1) + growths).max()
    assert (
        truth - (relative if moving else relative * (1 / 8 + 1 / 32)) - 1e-6
        <= found
        <= truth + 1e-6
    )


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_in_space_the_clearance_is_never_too_large(seed):
    rng = np.random.default_rng(seed)
    made = solids(rng, 3, 6)
    way = path(rng, 3)
    truth = true_clearance(way, made, np.zeros((6, 3)), 2.0, np.zeros(6))
    found = told(made).clearances(way[None], PERIOD, 2.0)[0]
    assert found <= truth + 1e-6


def test_the_first_clear_path_is_the_first_of_those_that_are_clear():
    rng = np.random.default_rng(5)
    around = told(solids(rng, 2, 4))
    paths = np.stack([path(rng, 2) for _ in range(30)])
    every = around.clearances(paths, PERIOD, 2.0)
    begin = int(np.argmin(every))
    paths, every = np.roll(paths, -begin, axis=0), np.roll(every, -begin)
    clear = np.flatnonzero(every >= 0.1)
    assert clear[0] > 0
    assert around.first_clear(paths, PERIOD, 2.0, 0.1) == clear[0]
    assert around.first_clear(paths[: clear[0]], PERIOD, 2.0, 0.1) is None


def test_an_obstacle_is_met_where_it_will_be():
    """A disc and a robot whose ways cross: they meet only if both come at the same time."""
    t = PERIOD * np.arange(80)
    robot: Any = np.column_stack([-2.0 + t, np.zeros(80)])
    velocity = np.array([[0.0, 1.0]])
    in_time = told([Solid.ball([0.0, -2.0], 0.3)], velocity)
    too_late = told([Solid.ball([0.0, -4.5], 0.3)], velocity)
    assert in_time.clearances(robot[None], PERIOD, 4.0)[0] < 0
    assert too_late.clearances(robot[None], PERIOD, 4.0)[0] > 1.0
    # Within half a second nothing happens yet.
    assert in_time.clearances(robot[None], PERIOD, 0.5)[0] > 1.0


def test_perception_remembers_what_stands_and_forgets_what_moves():
    perceived = Perceived(FAR_GOAL, 0.5, 5.0, 0.5)
    here = np.zeros(2)
    post, walker = Solid.ball([3.0, 0.0], 0.5), Solid.ball([0.0, 3.0], 0.5)
    for k in range(3):
        walker = walker.moved([0.1, 0.0])
        changes = perceived.look(PERIOD * k, here, [Sighting(1, post), Sighting(2, walker)])
        for key, _ in changes.add:
            perceived.remember(key, key)
    assert perceived.moving
    away = np.array([-20.0, 0.0])
    assert perceived.look(1.0, away, []).remove == [2]
    assert [key for key, _ in perceived.known] == [1]


def test_perception_notices_that_what_stood_is_gone():
    perceived = Perceived(FAR_GOAL, 0.5, 5.0, 0.5)
    post = Solid.ball([3.0, 0.0], 0.5)
    perceived.look(0.0, np.zeros(2), [Sighting(1, post)])
    perceived.remember(1, 11)
    assert perceived.look(0.05, np.zeros(2), []).remove == [11]
    assert perceived.known == []


def test_a_body_that_changes_its_velocity_is_foretold_larger():
    perceived = Perceived(FAR_GOAL, 0.5, 9.0, 0.5)
    here, walker = np.array([3.0, 0.0]), Solid.ball([0.0, 0.0], 0.5)
    still = np.broadcast_to(here, (1, 21, 2))
    found = []
    for step in ([0.0, 0.0], [0.0, 0.05], [0.0, 0.05], [0.03, 0.02]):
        walker = walker.moved(step)
        time = PERIOD * len(found)
        for key, _ in perceived.look(time, here, [Sighting(1, walker)]).add:
            perceived.remember(key, 0)
        perceived.refresh(time)
        found.append(perceived.surroundings.clearances(still, PERIOD, 1.0)[0])
    assert found[0] == pytest.approx(2.5, abs=0.02)
    # It turned towards the robot at 0.6 m/s, and may do more: 0.5 m/s of growth for one second.
    assert found[-1] == pytest.approx(2.5 - 0.03 - 0.6 - 0.5, abs=0.05)


def test_another_robot_on_the_goal_is_kept_from_the_planner_but_not_from_forecasts():
    perceived = Perceived(np.zeros(2), 0.5, 9.0, 0.5)
    other = Solid.ball([0.3, 0.0], 0.3)
    here = np.array([3.0, 0.0])
    assert perceived.look(0.0, here, [Sighting(-1, other, mobile=True)]).add == []
    perceived.refresh(0.0)
    assert perceived.clearance(here) == pytest.approx(2.4)
    gone = other.moved([2.0, 0.0])
    assert [k for k, _ in perceived.look(0.1, here, [Sighting(-1, gone, mobile=True)]).add] == [-1]
    perceived.remember(-1, 5)
    assert perceived.look(0.2, here, [Sighting(-1, other, mobile=True)]).remove == [5]
    # What does not drive by itself is an obstacle wherever it is.
    assert [k for k, _ in perceived.look(0.3, here, [Sighting(2, other)]).add] == [2]
