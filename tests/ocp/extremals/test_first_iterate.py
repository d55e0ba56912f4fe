"""First iterates of multiple shooting, and the second look at its answers."""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from references import ALL_QUERIES, tame_states, typical_query

from ocp.extremals.extremal import find_extremal
from ocp.extremals.first_iterate import first_nodes, with_costates
from ocp.extremals.second_look import look_again
from ocp.pontryagin import exact_trajectory
from ocp.query_family import PAPER_START, paper_query
from ocp.trajectory import Trajectory

QUERY = paper_query((4.0, 4.0))
EXACT = exact_trajectory(QUERY, PAPER_START)


def thinned(motion: Trajectory, every: int) -> Trajectory:
    """Every so many points of an exact motion; inputs belong to the interval before."""
    middles = (motion.inputs[:-every:every] + motion.inputs[every::every]) / 2
    return Trajectory(
        motion.times[::every],
        motion.states[::every],
        np.concatenate([motion.inputs[:1], middles]),
        None,
        motion.cost_so_far[::every],
    )


def test_along_an_exact_motion_the_adjoint_costates_are_its_own_to_second_order() -> None:
    assert EXACT.costates is not None
    errors = []
    for every in (4, 8):
        costates = with_costates(QUERY, thinned(EXACT, every)).costates
        assert costates is not None
        errors.append(np.abs(costates - EXACT.costates[::every]).max())
    order = np.log2(errors[1] / errors[0])
    assert errors[0] < 0.02 * np.abs(EXACT.costates).max()
    assert 1.6 < order < 2.6


def test_costates_that_are_there_are_kept() -> None:
    assert with_costates(QUERY, EXACT) is EXACT


@pytest.mark.parametrize("model", sorted({name for name, _ in ALL_QUERIES}))
def test_the_adjoint_equation_is_solved_for_every_robot(model: str) -> None:
    """By the implicit midpoint rule, whose Jacobian is here made of the CasADi expressions."""
    query, rng = typical_query(model), np.random.default_rng(0)
    system = query.system
    states = tame_states(model, rng, 8, 0.5)
    guess = Trajectory(
        np.cumsum(rng.uniform(0.01, 0.1, 8)),
        states,
        rng.normal(size=(8, system.m)),
        None,
        0 * states[:, 0],
    )
    costates = with_costates(query, guess).costates
    assert costates is not None
    u = ca.SX.sym("u", system.m)  # pyright: ignore[reportArgumentType]
    rate = system.drift + system.input_matrix @ u
    slope = ca.gradient(query.state_cost_expression(system.state), system.state)
    adjoint = ca.Function("a", [system.state, u], [ca.jacobian(rate, system.state).T, slope])
    assert (costates[-1] == 0).all()
    for k in range(len(costates) - 1):
        middle = (guess.states[k] + guess.states[k + 1]) / 2
        A, c = (np.array(a) for a in adjoint(middle, guess.inputs[k + 1]))
        pulled = c[:, 0] + A @ (costates[k] + costates[k + 1]) / 2
        length = guess.times[k + 1] - guess.times[k]
        scale = np.abs(costates[k : k + 2]).max() + length * np.abs(pulled).max()
        assert_allclose(costates[k] - costates[k + 1], length * pulled, atol=1e-7 * scale)


def test_nodes_lie_on_the_guess_and_share_out_time_and_change_equally() -> None:
    assert EXACT.costates is not None
    fractions, nodes = first_nodes(EXACT, 10)
    z = np.hstack([EXACT.states, EXACT.costates])
    for column, found in zip(z.T, nodes.T, strict=True):
        assert_allclose(found, np.interp(fractions * EXACT.duration, EXACT.times, column))
    changes = np.abs(np.diff(z, axis=0)).sum(axis=1)
    gone = np.interp(
        fractions * EXACT.duration, EXACT.times, np.append(0.0, np.cumsum(changes / changes.sum()))
    )
    assert_allclose(np.diff(gone + fractions), 0.2, atol=1e-12)


def test_a_second_look_finds_what_does_not_fit_together() -> None:
    """A node moved by 1e-3 leaves a gap of that size and a Hamiltonian that is not 0."""
    extremal = find_extremal(QUERY, np.array(PAPER_START), EXACT)
    assert extremal.trajectory is not None
    motion = extremal.trajectory
    assert motion.costates is not None
    fractions = motion.times[::8] / motion.duration
    nodes = np.hstack([motion.states, motion.costates])[::8].copy()
    right = look_again(QUERY, fractions, nodes, motion.duration, 8, 1e-11)
    assert right.gap < 1e-6
    assert np.abs(right.hamiltonians).max() < 1e-6
    assert right.motion.cost == pytest.approx(motion.cost, rel=1e-9)
    assert_allclose(right.motion.times, motion.times, rtol=1e-12)
    nodes[12, 1] += 1e-3
    nodes[12, 4] += 1e-3
    wrong = look_again(QUERY, fractions, nodes, motion.duration, 8, 1e-11)
    assert 1e-4 < wrong.gap < 1e-2
    assert np.abs(wrong.hamiltonians).max() > 1e-5
