"""First guesses: they begin at the start, end at the goal and pass either side of what blocks."""

import numpy as np
import pytest
from references import BALL_QUERIES, typical_query

from ocp.extremals.guess import default_guesses
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import paper_query

START = np.array([-4.0, -4.0, -np.pi / 4])


@pytest.mark.parametrize(("model", "bounded"), BALL_QUERIES)
def test_guesses_lead_from_start_to_goal_within_the_bounds(model, bounded):
    query = typical_query(model, bounded)
    start = np.full(query.system.n, -2.5)
    guesses = default_guesses(query, start)
    assert guesses
    for guess in guesses:
        assert np.array_equal(guess.start, start)
        assert query.goal_distance(guess.states[-1]) == pytest.approx(0.0, abs=1e-9)
        assert (np.diff(guess.times) > 0).all()
        assert np.isfinite(guess.inputs).all()
        lower, upper = query.input_bounds
        assert (guess.inputs >= lower).all()
        assert (guess.inputs <= upper).all()


def test_a_horizon_is_filled():
    query = typical_query("double-integrator-2d")
    for guess in default_guesses(query, np.full(4, -2.5), horizon=7.0):
        assert guess.duration == pytest.approx(7.0)


def test_the_unicycle_drives_forward_and_backward():
    """Without obstacles: turned to the goal, turned away from it, and slipping."""
    guesses = default_guesses(paper_query((4.0, 4.0)), START)
    headings = sorted(guess.states[-1, 2] for guess in guesses)
    assert headings == pytest.approx([-3 * np.pi / 4, -np.pi / 4, np.pi / 4], abs=0.01)
    turn_and_drive = [g for g in guesses if g.states[-1, 2] != START[2]]
    for guess in turn_and_drive:
        speeds = guess.inputs[:, 0]
        assert (np.sign(guess.states[-1, 2]) * speeds >= -1e-2).all()


def test_turn_and_drive_costs_little_more_than_the_optimum():
    """It is an admissible motion, so not less; 24.4 against the exact 23.30."""
    cheapest = default_guesses(paper_query((4.0, 4.0)), START)[0]
    assert 23.2997 < cheapest.cost < 23.2997 * 1.06


def test_hard_obstacles_are_passed_on_both_sides():
    wall = Obstacle.circle((0.0, 0.0), 1.5, hard=True)
    query = Query("unicycle", Goal((4.0, 4.0), 0.5), (wall,), robot_radius=0.1)
    guesses = default_guesses(query, START, limit=10)
    clear = [g for g in guesses if query.clearance(g.states).min() > 0]
    sides = {float(np.sign((g.states[:, 1] - g.states[:, 0]).sum())) for g in clear}
    assert sides == {-1.0, 1.0}
    assert query.clearance(guesses[0].states).min() > 0


def test_a_start_at_the_centre_of_the_goal_is_no_trouble():
    query = Query("single-integrator-2d", Goal((1.0, 1.0), 0.5))
    (guess,) = default_guesses(query, np.array([1.0, 1.0]), horizon=2.0)
    assert np.isfinite(guess.states).all()
    assert guess.duration == pytest.approx(2.0)
