"""Drake's DirectCollocation, an independent referee: its costs fall to our optimum."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sims
from ocp.models.drake_collocation import Solver, drake_collocation
from ocp.models.multibody import multibody_model
from ocp.models.robots import robot_file
from ocp.query import Query
from ocp.regulation import regulator, solve_regulation
from ocp.trajectory import SolveError


@pytest.fixture(scope="module")
def swing_up():
    query = Query.load(Path(sims.__file__).parent / "queries" / "pendulum.toml")
    optimum = solve_regulation(query, np.zeros(2))
    keep = optimum.times <= 3.0
    head = replace(
        optimum,
        times=optimum.times[keep],
        states=0.8 * optimum.states[keep],  # no solution: Drake has to find it again
        inputs=0.8 * optimum.inputs[keep],
        costates=None,
        cost_so_far=optimum.cost_so_far[keep],
    )
    return query, optimum.cost, head


def test_the_costs_of_drake_fall_to_ours_with_the_square_of_the_step(swing_up) -> None:
    query, cost, guess = swing_up
    model, P = multibody_model(robot_file("pendulum")), regulator(query).matrix
    gaps = [
        drake_collocation(model, query, guess, P, knots=k, tolerance=1e-5, solver=Solver.SNOPT).cost
        / cost
        - 1
        for k in (61, 121)
    ]
    assert 3.5 < gaps[0] / gaps[1] < 4.5
    assert abs(4 * gaps[1] - gaps[0]) / 3 < 1e-4


def test_a_solve_that_is_cut_short_is_no_answer(swing_up) -> None:
    query, _, guess = swing_up
    model, P = multibody_model(robot_file("pendulum")), regulator(query).matrix
    for solver in Solver:
        with pytest.raises(SolveError):
            drake_collocation(model, query, guess, P, max_iterations=2, solver=solver)
