"""The closed form itself, against an independent quadrature, and its conditions."""

import numpy as np
import pytest
from references import aligned_value

from ocp.closed_form import straight_value
from ocp.cost import RunningCost
from ocp.query import Goal, Query
from ocp.query_family import paper_query
from ocp.trajectory import SolveError, Status

QUERY = paper_query((4.0, 4.0))


@pytest.mark.parametrize("distance", [0.5001, 0.7, 2.0, 8.0])
@pytest.mark.parametrize("turn", [0.0, np.pi])
def test_aligned_headings_of_the_unicycle(distance: float, turn: float) -> None:
    """Facing the goal or away from it: v may be negative."""
    bearing = 0.7
    state = np.array(
        [4 - distance * np.cos(bearing), 4 - distance * np.sin(bearing), bearing + turn]
    )
    assert straight_value(QUERY, state) == pytest.approx(aligned_value(distance), rel=1e-11)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_a_point_robot_always_drives_straight(d: int) -> None:
    query = Query(f"single-integrator-{d}d", Goal((1.0,) * d, 0.5))
    state = np.full(d, -2.0)
    expected = aligned_value(3.0 * np.sqrt(d))
    assert straight_value(query, state) == pytest.approx(expected, rel=1e-11)


def test_input_weights_scale_the_speed() -> None:
    """Four times the weight halves the speed of unit effort and doubles V."""
    heavy = Query("single-integrator-2d", Goal((1.0, 1.0), 0.5), cost=RunningCost(input=(4.0, 4.0)))
    light = Query("single-integrator-2d", Goal((1.0, 1.0), 0.5))
    state = np.array([-3.0, 0.0])
    assert straight_value(heavy, state) == pytest.approx(2 * straight_value(light, state))


def test_zero_in_the_goal() -> None:
    assert straight_value(QUERY, np.array([4.0, 4.2, 1.0])) == 0.0


@pytest.mark.parametrize(
    ("query", "state", "reason"),
    [
        (QUERY, [0.0, 0.0, 0.0], "cannot drive straight"),
        (paper_query((1.0, 1.0)), [-4.0, -4.0, np.pi / 4], "no obstacles"),
        (
            Query("double-integrator-1d", Goal((0.0,), 0.5)),
            [2.0, 0.0],
            "no drift",
        ),
    ],
)
def test_says_when_it_does_not_apply(query: Query, state: list[float], reason: str) -> None:
    with pytest.raises(SolveError, match=reason) as refusal:
        straight_value(query, np.array(state))
    assert refusal.value.status is Status.NOT_APPLICABLE
