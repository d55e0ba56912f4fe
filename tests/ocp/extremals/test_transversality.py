"""Where extremals end: on the boundary, H = 0, moving inward, and the manifold's tangents."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from references import BALL_QUERIES, typical_query

from ocp.extremals.hamiltonian_flow import flow_layout
from ocp.extremals.shooting import shooting_addresses
from ocp.extremals.transversality import (
    GOAL_AT_REST,
    GOAL_PUSHED,
    Condition,
    exponential_condition,
    goal_boundary,
    goal_condition,
    quadratic_condition,
    terminal_point,
)
from ocp.kernels import kernels, parameters
from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import paper_query


def at(query: Query, condition: Condition, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z = [x, p] on the manifold nearest to `end`, and the tangents there."""
    n = query.system.n
    z, tangents = np.empty(2 * n), np.empty((2 * n, n - 1 if condition.at_goal else n))
    assert terminal_point(
        condition.kind, shooting_addresses(query), parameters(query), flow_layout(query),
        condition.terms, np.array(end, dtype=float), z, tangents,
    )  # fmt: skip
    return z, tangents


def ends(query: Query, count: int = 12) -> np.ndarray:
    """States on the goal's boundary that move inward if they drift."""
    rng = np.random.default_rng(4)
    states = rng.uniform(-1, 1, (count, query.system.n))
    place = list(query.system.position)
    states[:, place] = goal_boundary(query, count)
    if query.system.has_drift:
        normals = states[:, place] - query.goal_position
        states[:, len(place) :] = -2 * normals
    return states


@pytest.mark.parametrize(("model", "bounded"), BALL_QUERIES)
def test_pushed_ends_lie_on_the_boundary_with_h_zero_moving_inward(model, bounded) -> None:
    query = typical_query(model, bounded)
    d, n, k, q = len(query.goal_position), query.system.n, kernels(query), parameters(query)
    condition = goal_condition(query)
    rate = np.empty(2 * n)
    for end in ends(query):
        z, _ = at(query, condition, end)
        normal = (z[:d] - query.goal_position) / query.goal.radius
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-9)
        assert_allclose(z[d:n], end[d:])
        push = float(z[n : n + d] @ normal)
        assert push >= 0
        assert_allclose(z[n:], np.concatenate([push * normal, np.zeros(n - d)]), atol=1e-9)
        if condition.kind == GOAL_PUSHED:
            k.flow(z, q, rate)
            assert k.minimised_hamiltonian(z, q) == pytest.approx(0.0, abs=1e-9 * (1 + push**2))
            assert rate[:d] @ normal < 0


def test_the_condition_is_chosen_by_the_cost_on_the_boundary() -> None:
    assert goal_condition(paper_query((4.0, 4.0))).kind == GOAL_AT_REST
    assert goal_condition(paper_query((0.0, 0.0))).kind == GOAL_PUSHED
    assert goal_condition(typical_query("double-integrator-2d")).kind == GOAL_PUSHED


def test_the_push_of_the_unicycle_in_closed_form() -> None:
    """nu = 2 sqrt(phi) / |n . (cos, sin)|, with phi of the circle written out."""
    query = Query("unicycle", Goal((1.0, 0.0), 0.5), (Obstacle.circle((0.0, 0.0), 0.7),))
    for angle, heading in ((3.0, 2.5), (2.0, -0.5), (-2.4, 0.3)):
        normal = np.array([np.cos(angle), np.sin(angle)])
        place = np.array([1.0, 0.0]) + 0.5 * normal
        z, _ = at(query, goal_condition(query), np.append(place, heading))
        phi = np.exp(-4 * (place @ place - 0.49))
        facing = abs(normal @ [np.cos(heading), np.sin(heading)])
        assert z[3:5] @ normal == pytest.approx(2 * np.sqrt(phi) / facing, rel=1e-6)


@pytest.mark.parametrize(("model", "bounded"), BALL_QUERIES)
@pytest.mark.parametrize("kind", ["goal", "quadratic", "exponential"])
def test_tangents_by_finite_differences(model: str, bounded: bool, kind: str) -> None:
    query = typical_query(model, bounded)
    n = query.system.n
    P = np.diag(np.linspace(1, 2, n)) + 0.1
    condition = {
        "goal": goal_condition(query),
        "quadratic": quadratic_condition(query.reference, P),
        "exponential": exponential_condition(query, 2.0),
    }[kind]
    step = 1e-5
    for end in ends(query, 4):
        z, tangents = at(query, condition, end)
        for tangent in tangents.T:
            ahead = at(query, condition, z[:n] + step * tangent[:n])[0]
            behind = at(query, condition, z[:n] - step * tangent[:n])[0]
            scale = 1 + np.abs(tangent).max()
            assert_allclose(tangent, (ahead - behind) / (2 * step), atol=1e-6 * scale)
