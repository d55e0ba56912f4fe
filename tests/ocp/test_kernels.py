"""Compiled kernels equal the CasADi definitions and finite differences, for every robot."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from references import ALL_QUERIES, typical_query

from ocp.compiled.batch import optimal_inputs, rates, running_costs, state_costs
from ocp.kernels import kernels, parameters
from ocp.query import Query

POINTS = 40


@pytest.fixture(params=ALL_QUERIES, ids=lambda p: f"{p[0]}{'-bounded' if p[1] else ''}")
def query(request: pytest.FixtureRequest) -> Query:
    return typical_query(*request.param)


@pytest.fixture
def points(query: Query) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Random states, costates and inputs."""
    rng = np.random.default_rng(7)
    system = query.system
    reach = np.where([c.periodic for c in system.coordinates], 1.0, 0.7)
    states = reach * rng.uniform(system.lower, system.upper, (POINTS, system.n))
    return states, rng.normal(size=states.shape), rng.normal(size=(POINTS, system.m))


def test_dynamics_and_running_cost_equal_casadi(query: Query, points) -> None:
    states, _, inputs = points
    dynamics = np.array(query.system.dynamics(states.T, inputs.T)).T
    assert_allclose(rates(query, states, inputs), dynamics, rtol=1e-14, atol=1e-14)
    costs = np.array(query.running_cost(states.T, inputs.T)).ravel()
    assert_allclose(running_costs(query, states, inputs), costs, rtol=1e-12)


def test_optimal_input_minimises_the_hamiltonian(query: Query, points) -> None:
    """No input nearby, nor any of many drawn in the admissible box, does better."""
    states, costates, inputs = points
    lower, upper = query.input_bounds
    best = optimal_inputs(query, states, costates)
    assert (best >= lower - 1e-15).all()
    assert (best <= upper + 1e-15).all()

    def hamiltonian(u: np.ndarray) -> np.ndarray:
        return running_costs(query, states, u) + (costates * rates(query, states, u)).sum(-1)

    least = hamiltonian(best)
    for scale in (1e-3, 0.1, 1.0, 10.0):
        for sign in (-1, 1):
            other = np.clip(best + sign * scale * inputs, lower, upper)
            assert (hamiltonian(other) >= least - 1e-12 * (1 + abs(least))).all()


def test_flow_is_the_hamiltonian_vector_field(query: Query, points) -> None:
    """x' = dH/dp and p' = -dH/dx by central differences of the minimised Hamiltonian."""
    k, q, n = kernels(query), parameters(query), query.system.n
    step = 1e-6
    for x, p, _ in zip(*points, strict=True):
        z = np.concatenate([x, p])
        slope = np.array(
            [
                (
                    k.minimised_hamiltonian(z + step * e, q)
                    - k.minimised_hamiltonian(z - step * e, q)
                )
                / (2 * step)
                for e in np.eye(2 * n)
            ]
        )
        flow = np.empty(2 * n)
        k.flow(z, q, flow)
        scale = 1 + abs(k.minimised_hamiltonian(z, q))
        assert_allclose(flow, np.concatenate([slope[n:], -slope[:n]]), atol=1e-8 * scale, rtol=1e-6)


def test_flow_jacobian_equals_automatic_differentiation(query: Query, points) -> None:
    """CasADi differentiates the whole Hamiltonian, obstacles and all, as one expression."""
    system = query.system
    n, m = system.n, system.m
    x, p, u = system.state, ca.SX.sym("p", n), ca.SX.sym("u", m)  # pyright: ignore
    lower, upper = query.input_bounds
    optimum = -(system.input_matrix.T @ p) / (2 * ca.DM(query.input_weights))
    if query.is_bounded:
        optimum = ca.fmin(ca.fmax(optimum, lower), upper)
    hamiltonian = query.running_cost(x, u) + ca.dot(p, system.dynamics(x, u))
    rate = ca.substitute(ca.jacobian(hamiltonian, p).T, u, optimum)
    costate_rate = ca.substitute(-ca.gradient(hamiltonian, x), u, optimum)
    z = ca.vertcat(x, p)
    flow = ca.vertcat(rate, costate_rate)
    oracle = ca.Function("oracle", [z], [flow, ca.jacobian(flow, z)])
    k, q = kernels(query), parameters(query)
    value, jacobian = np.empty(2 * n), np.empty((2 * n, 2 * n))
    for state, costate, _ in zip(*points, strict=True):
        row = np.concatenate([state, costate])
        k.flow_jacobian(row, q, value, jacobian)
        expected, expected_jacobian = oracle(row)
        assert_allclose(value, np.array(expected).ravel(), rtol=1e-10, atol=1e-10)
        assert_allclose(jacobian, np.array(expected_jacobian), rtol=1e-9, atol=1e-9)


def test_state_cost_derivatives_by_finite_differences(query: Query, points) -> None:
    k, q, n = kernels(query), parameters(query), query.system.n
    gradient, hessian = np.empty(n), np.empty((n, n))
    step = 1e-5
    for x in points[0]:
        k.state_cost_derivatives(x, q, gradient, hessian)
        slopes = [
            (k.state_cost(x + step * e, q) - k.state_cost(x - step * e, q)) / (2 * step)
            for e in np.eye(n)
        ]
        scale = 1 + abs(k.state_cost(x, q))
        assert_allclose(gradient, slopes, atol=1e-6 * scale, rtol=1e-5)
        assert_allclose(hessian, hessian.T, atol=1e-12 * scale)


def test_obstacles_are_parameters_of_one_compiled_kernel() -> None:
    with_obstacles = typical_query("unicycle")
    without = replace(with_obstacles, obstacles=())
    assert kernels(without) is kernels(with_obstacles)
    far = state_costs(without, [4.0, -4.0, 0.0])
    assert far < state_costs(with_obstacles, [-1.0, -1.0, 0.0])
