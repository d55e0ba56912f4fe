"""Regulation to an equilibrium: exact motions, their second derivatives, grids, closed loops."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from ocp.cost import RunningCost
from ocp.eikonal import solve_eikonal
from ocp.extremals.fixed_time import solve_fixed_time
from ocp.grid import Grid
from ocp.grids.regulation_grid import solve_regulation_grid
from ocp.oracle import consult
from ocp.query import Equilibrium, Query
from ocp.regulation import RegulatorValue, pmp_regulation, regulator, solve_regulation
from ocp.regulation_value import RegulationValue, expand
from ocp.trajectory import SolveError, Status, Trajectory
from ocp.value import greedy
from sims.closed_loop import rollout

HANGING = np.array([0.0, 0.0])


def regulation(model: str, state: list[float], weights: list[float], radius: float = 0.2) -> Query:
    rows = tuple(tuple(map(float, row)) for row in np.diag(weights))
    return Query(model, Equilibrium(tuple(state), radius), cost=RunningCost(goal=0.0, state=rows))


PENDULUM = regulation("pendulum", [np.pi, 0.0], [5.0, 0.5])
CART = regulation("double-integrator-1d", [1.0, 0.0], [1.0, 0.2])


@pytest.fixture(scope="module")
def swing_up() -> Trajectory:
    """The optimum from hanging, by the minimum principle, from collocation's answer."""
    return pmp_regulation(PENDULUM, solve_regulation(PENDULUM, HANGING))


def test_a_linear_robot_costs_what_riccati_says() -> None:
    """Three methods; the linear regulator is the optimum, so every tail is exact too."""
    start = [-2.0, 0.7]
    verdict = consult(CART, start)
    expected = float(RegulatorValue(CART).value(start))
    assert verdict.established
    for method in ("Riccati", "PMP", "collocation"):
        assert verdict.answers[method].value == pytest.approx(expected, rel=1e-6)


def test_the_swing_up_has_an_established_optimum(swing_up: Trajectory) -> None:
    direct = solve_regulation(PENDULUM, HANGING)
    assert direct.cost == pytest.approx(swing_up.cost, rel=1e-6)
    # The motor is too weak to lift it at once: it first swings, and its bound is met.
    assert np.abs(direct.inputs).max() == pytest.approx(2.5)
    assert PENDULUM.goal_distance(direct.states[-1]) < -0.19


def test_costs_are_what_the_robot_pays(swing_up: Trajectory) -> None:
    """Integrated again with scipy, from the inputs alone, to where the tail begins."""
    from scipy.integrate import solve_ivp

    until = 2.0  # seconds; beyond, an open loop is unstable

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        u = np.interp(t, swing_up.times, swing_up.inputs[:, 0])
        slope = np.array(PENDULUM.system.dynamics(y[:2], u)).ravel()
        return np.append(slope, float(PENDULUM.running_cost(y[:2], u)))

    run = solve_ivp(rate, (0.0, until), [*HANGING, 0.0], rtol=1e-8, atol=1e-8, max_step=0.01)
    paid = np.interp(until, swing_up.times, swing_up.cost_so_far)
    assert run.y[2, -1] == pytest.approx(paid, rel=1e-3)


def test_second_derivatives_equal_those_of_multiple_shooting(swing_up: Trajectory) -> None:
    """At the start; the shooting's come from the variational equations of the whole flow."""
    horizon = 3.0
    keep = swing_up.times <= horizon
    guess = Trajectory(
        swing_up.times[keep],
        swing_up.states[keep],
        swing_up.inputs[keep],
        None if swing_up.costates is None else swing_up.costates[keep],
        swing_up.cost_so_far[keep],
    )
    other = solve_fixed_time(PENDULUM, HANGING, guess.duration, regulator(PENDULUM).P(), guess)
    ours = expand(PENDULUM, swing_up).hessians[0]
    assert_allclose(ours, other.hessian, atol=1e-3 * np.abs(other.hessian).max())


def test_the_expansion_is_of_second_order(swing_up: Trajectory) -> None:
    """Beside the motion it is nearer to the exact value than the tangent plane, by far."""
    value = RegulationValue(PENDULUM)
    value.add(swing_up)
    assert swing_up.costates is not None
    # Hanging, swings to either side cost the same; step to where this one is the cheaper.
    away = -0.02 * np.sign(swing_up.costates[0])
    exact = solve_regulation(PENDULUM, HANGING + away).cost
    plane = swing_up.cost + swing_up.costates[0] @ away
    error = abs(float(value.value(HANGING + away)) / exact - 1)
    assert error < 2e-5
    assert error < 0.2 * abs(plane / exact - 1)


def test_the_closed_loop_costs_hardly_more_than_the_optimum(swing_up: Trajectory) -> None:
    value = RegulationValue(PENDULUM)
    value.add(swing_up)
    loop = rollout(greedy(PENDULUM, value), HANGING)
    assert loop.reached
    assert loop.cost is not None
    assert -1e-3 < loop.cost / swing_up.cost - 1 < 5e-3
    assert len(value.expansions) == 1  # it never strayed


def test_the_grid_lies_above_the_exact_value_by_an_error_of_first_order(
    swing_up: Trajectory,
) -> None:
    """Measured: 5 to 10 % too large at 61 x 81 nodes, 3 to 6 % at 121 x 161.

    Multilinear values of a narrow valley are too large by about V'' h^2 / 8 in a step of about h.
    """
    errors = []
    for shape in ((61, 81), (121, 161)):
        value = solve_regulation_grid(PENDULUM, Grid.of(PENDULUM.system, shape))
        row = []
        for fraction in (0.0, 0.3, 0.6):
            k = int(fraction * np.argmax(swing_up.cost_to_go < 0.1 * swing_up.cost))
            grid_value = float(value.value(PENDULUM.system.wrap(swing_up.states[k])))
            row.append(grid_value / swing_up.cost_to_go[k] - 1)
        errors.append(row)
    coarse, fine = np.array(errors)
    assert (coarse > 0).all()
    assert (fine > 0).all()
    assert coarse.max() < 0.12
    assert (fine < 0.75 * coarse).all()


def test_the_eikonal_method_says_why_it_does_not_apply() -> None:
    with pytest.raises(SolveError, match="no front starts from an equilibrium") as raised:
        solve_eikonal(PENDULUM)
    assert raised.value.status is Status.NOT_APPLICABLE


def test_a_grid_says_what_six_dimensions_would_need() -> None:
    query = regulation("planar_quadrotor", [0.0] * 6, [1.0] * 6)
    with pytest.raises(SolveError, match=r"4\.1e\+09 nodes, 3\.3e\+01 GB"):
        solve_regulation_grid(query)


def test_what_cannot_be_stabilised_is_refused() -> None:
    """A unicycle at rest cannot be moved sideways by any linear law."""
    with pytest.raises(ValueError, match="not stabilisable"):
        regulator(regulation("unicycle", [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]))
