"""The Hamiltonian flow: against SciPy, across kinks, with tangents, there and back."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from references import ALL_QUERIES, tame_states, typical_query
from scipy.integrate import solve_ivp

from ocp.extremals.hamiltonian_flow import (
    FAILED,
    FINISHED,
    LEFT,
    flow_addresses,
    flow_layout,
    propagate,
)
from ocp.kernels import kernels, parameters
from ocp.query import Query
from ocp.query_family import paper_query

NONE, NO_RECORD = np.empty(0), np.empty((0, 0))

# The first motion crosses an axis of the diamond at (-2, 2), the second the goal's boundary, the
# third neither.
DIAMOND = paper_query((1.0, 4.0)), np.array([-2.4, 3.1, 0.3, -2.2, -0.9, 0.2]), 0.8
GOAL = paper_query((1.0, 1.0)), np.array([0.2, 0.9, 0.1, -2.0, -0.1, 0.0]), 0.8
SMOOTH = paper_query((4.0, 4.0)), np.array([0.0, 0.0, 0.8, -1.4, -1.3, 0.2]), 1.5
CASES = [DIAMOND, GOAL, SMOOTH]
NAMES = ["diamond", "goal", "smooth"]


def carry(
    query: Query, z: np.ndarray, duration: float, tolerance: float = 1e-12, tangents: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """End of [x, p, cost], and the tangents."""
    y = np.append(z, 0.0)
    matrix = np.ascontiguousarray(np.eye(len(z))[:, :tangents])
    ended = propagate(
        flow_addresses(kernels(query)), parameters(query), flow_layout(query), y, matrix, duration,
        tolerance, np.zeros(1), NONE, NO_RECORD,
    )  # fmt: skip
    assert ended == FINISHED
    return y, matrix


def scipy_flow(query: Query, z: np.ndarray, duration: float) -> np.ndarray:
    """[x, p] and the integral of the running cost, by an independent integrator in tiny steps."""
    k, q, n = kernels(query), parameters(query), query.system.n

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        out, u = np.empty(2 * n), np.empty(query.system.m)
        k.flow(y[:-1].copy(), q, out)
        k.optimal_input(y[:-1].copy(), q, u)
        return np.append(out, k.running_cost(np.concatenate([y[:n], u]), q))

    return solve_ivp(
        rate, (0, duration), np.append(z, 0.0), method="DOP853", rtol=1e-11, atol=1e-11,
        max_step=2e-3,
    ).y[:, -1]  # fmt: skip


def test_the_cases_cross_what_they_should() -> None:
    query, z, duration = DIAMOND
    assert (z[0] + 2.0) * (carry(query, z, duration)[0][0] + 2.0) < 0
    query, z, duration = GOAL
    assert query.goal_distance(z[:3]) > 0 > query.goal_distance(carry(query, z, duration)[0][:3])


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_equals_an_independent_integrator(case) -> None:
    """To SciPy's error, which at a kink is of the order of its longest step."""
    query, z, duration = case
    tolerance = 1e-9 if case is SMOOTH else 2e-4
    assert_allclose(carry(query, z, duration)[0], scipy_flow(query, z, duration), atol=tolerance)


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_the_error_follows_the_tolerance_even_across_kinks(case) -> None:
    """Backward, as shooting integrates; forward, steps into the goal see its cost cut off."""
    query, z, duration = case
    end = carry(query, z, duration, 1e-14)[0][:-1]
    for first, time, factor in ((end, -duration, 100), (z, duration, 1000)):
        exact = carry(query, first, time, 1e-14)[0]
        errors = [
            np.abs(carry(query, first, time, tolerance)[0] - exact).max()
            for tolerance in (1e-5, 1e-7, 1e-9, 1e-11)
        ]
        assert (np.array(errors) < factor * np.array([1e-5, 1e-7, 1e-9, 1e-11])).all()
        assert errors[-1] < 1e-3 * errors[0]


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_tangents_are_derivatives_even_across_kinks(case) -> None:
    query, z, duration = case
    for sign in (1, -1):
        first = z if sign == 1 else carry(query, z, duration)[0][:-1]
        tangents = carry(query, first, sign * duration, tangents=6)[1]
        step = 1e-4
        for i, e in enumerate(np.eye(6)):
            ahead = carry(query, first + step * e, sign * duration)[0][:-1]
            behind = carry(query, first - step * e, sign * duration)[0][:-1]
            slope = (ahead - behind) / (2 * step)
            scale = 1 + np.abs(tangents[:, i]).max()
            assert_allclose(tangents[:, i], slope, atol=1e-6 * scale)


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_there_and_back(case) -> None:
    """Backward undoes forward; the cost counts up both ways."""
    query, z, duration = case
    there = carry(query, z, duration)[0]
    back = carry(query, there[:-1], -duration)[0]
    assert_allclose(back[:-1], z, atol=1e-8)
    assert back[-1] == pytest.approx(there[-1], abs=1e-9)
    assert there[-1] > 0


@pytest.mark.parametrize(("model", "bounded"), ALL_QUERIES)
def test_every_robot_conserves_its_hamiltonian(model: str, bounded: bool) -> None:
    query = typical_query(model, bounded)
    rng = np.random.default_rng(3)
    k, q, n = kernels(query), parameters(query), query.system.n
    for _ in range(5):
        z = np.concatenate([tame_states(model, rng, 1, 2.5)[0], rng.normal(size=n)])
        before = k.minimised_hamiltonian(z, q)
        after = k.minimised_hamiltonian(carry(query, z, 0.3)[0][:-1], q)
        assert after == pytest.approx(before, abs=1e-7 * (1 + abs(before)))


def test_limits_and_record_end_the_motion() -> None:
    query, z, duration = SMOOTH
    arguments = flow_addresses(kernels(query)), parameters(query), flow_layout(query)
    whole = carry(query, z, duration)[0]
    free = np.full(3, np.inf)

    y, record = np.append(z, 0.0), np.full((50, 8), np.nan)
    limits = np.concatenate([[whole[-1] / 2], -free, free])
    nothing = np.empty((6, 0))
    assert propagate(*arguments, y, nothing, duration, 1e-12, np.zeros(1), limits, record) == LEFT
    rows = int(np.isfinite(record[:, 0]).sum())
    costs = record[:rows, -1]
    assert costs[-2] <= limits[0] < costs[-1] == y[-1]
    assert_allclose(record[rows - 1, 1:], carry(query, z, record[rows - 1, 0])[0], atol=1e-9)

    y = np.append(z, 0.0)
    box = np.concatenate([[np.inf], -free, [0.3], free[:2]])
    assert propagate(*arguments, y, nothing, duration, 1e-12, np.zeros(1), box, NO_RECORD) == LEFT
    assert y[0] > 0.3

    y, short = np.append(z, 0.0), np.full((3, 8), np.nan)
    assert propagate(*arguments, y, nothing, duration, 1e-12, np.zeros(1), NONE, short) == LEFT
    assert np.isfinite(short).all()


def test_numbers_that_are_not_finite_fail() -> None:
    query, z, duration = SMOOTH
    y = np.append(z, 0.0)
    y[3] = np.nan
    arguments = flow_addresses(kernels(query)), parameters(query), flow_layout(query)
    assert (
        propagate(*arguments, y, np.empty((6, 0)), duration, 1e-9, np.zeros(1), NONE, NO_RECORD)
        == FAILED
    )


def test_a_motion_in_pieces_that_keeps_its_pace_takes_fewer_steps_to_the_same_end() -> None:
    query, z, duration = SMOOTH
    arguments = flow_addresses(kernels(query)), parameters(query), flow_layout(query)
    whole = carry(query, z, duration)[0]
    steps = []
    for kept in (True, False):
        y, pace, count = np.append(z, 0.0), np.zeros(1), 0
        for _ in range(8):
            record = np.full((200, 8), np.nan)
            if not kept:
                pace[0] = 0.0
            ended = propagate(
                *arguments, y, np.empty((6, 0)), duration / 8, 1e-10, pace, NONE, record
            )
            assert ended == FINISHED
            count += int(np.isfinite(record[:, 0]).sum())
        assert_allclose(y, whole, atol=1e-8)
        steps.append(count)
    assert steps[0] < steps[1]
