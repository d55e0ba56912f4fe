"""The paper's fixed-time problem: two solvers agree, its bias is known, failures are told."""

import numpy as np
import pytest

from ocp.extremals.paper_bvp import paper_bias, shoot_paper_bvp, solve_paper_bvp, terminal_cost
from ocp.pontryagin import exact_trajectory
from ocp.query_family import PAPER_GOALS, PAPER_START, paper_query
from ocp.trajectory import Status


@pytest.fixture(scope="module")
def optimum():
    return exact_trajectory(paper_query((4.0, 4.0)), PAPER_START)


def test_the_published_route_tends_to_the_shooting_answer(optimum) -> None:
    """As the smoothing of Q goes to 0 the values of `solve_bvp` approach that without smoothing."""
    query = paper_query((4.0, 4.0))
    horizon = 1.5 * optimum.duration
    limit = shoot_paper_bvp(query, PAPER_START, optimum, horizon=horizon)
    assert limit.status is Status.SOLVED
    gaps = []
    for smoothing in (0.05, 0.02, 0.005):
        answer = solve_paper_bvp(query, PAPER_START, optimum, horizon=horizon, smoothing=smoothing)
        assert answer.status is Status.SOLVED
        gaps.append(abs(answer.value - limit.value))
    assert gaps[0] > gaps[1] > gaps[2]
    assert gaps[2] < 2e-3


@pytest.mark.parametrize("goal", PAPER_GOALS)
def test_the_bias_lies_between_s_at_the_centre_and_one(goal: tuple[float, float]) -> None:
    """A motion to the centre still pays S there, exp(-1/2) = .607; one that stops at the boundary
    pays 1. No motion reaches the goal more cheaply than the optimum does."""
    bias = paper_bias(paper_query(goal), PAPER_START)
    assert np.exp(-0.5) < bias.value < 1.0
    assert 0.0 <= bias.cost < 5e-3


def test_more_time_costs_less(optimum) -> None:
    query = paper_query((4.0, 4.0))
    values = [
        shoot_paper_bvp(query, PAPER_START, optimum, horizon=factor * optimum.duration).value
        for factor in (1.2, 1.5, 2.0)
    ]
    assert values[0] > values[1] > values[2]


def test_the_terminal_cost_is_the_papers_and_may_overflow() -> None:
    query = paper_query((1.0, 1.0))
    assert terminal_cost(query, [1.5, 1.0, 0.3]) == pytest.approx(1.0)
    assert terminal_cost(query, [1.0, 1.0, 0.3]) == pytest.approx(np.exp(-0.5))
    assert terminal_cost(query, [30.0, 1.0, 0.0]) == np.inf


def test_what_does_not_converge_is_told(optimum) -> None:
    """With the kink of Q kept the collocation scheme runs into its limit of nodes."""
    answer = solve_paper_bvp(
        paper_query((4.0, 4.0)), PAPER_START, optimum, smoothing=0.0, max_nodes=600
    )
    assert answer.status is Status.NOT_CONVERGED
    assert answer.trajectory is None
    assert np.isnan(answer.value)
    assert answer.detail


def test_bad_arguments_are_refused(optimum) -> None:
    query = paper_query((4.0, 4.0))
    with pytest.raises(ValueError, match="smoothing"):
        solve_paper_bvp(query, PAPER_START, optimum, smoothing=-1.0)
    with pytest.raises(ValueError, match="horizon"):
        shoot_paper_bvp(query, PAPER_START, optimum, horizon=-1.0)
