"""Query files: read strictly, written back equal; bad ones are refused by field and value."""

import copy
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ocp.obstacle import Obstacle
from ocp.query import Goal, Query
from ocp.query_family import PAPER_FAMILY, paper_query, sample_start
from ocp.query_file import query_from_dict

GOOD = """
model = "unicycle"
[goal]
center = [1.0, 4]
radius = 0.5
[[obstacle]]
shape = "circle"
center = [-1.0, -1.0]
radius = 1.0
[[obstacle]]
shape = "polygon"
vertices = [[2.0, -2.0], [3.0, -2.0], [2.5, -1.0]]
hard = true
[cost]
input = [1.0, 2.0]
goal_steepness = 2.0
[input]
lower = [-1.0, -inf]
upper = [1.0, inf]
[robot]
radius = 0.1
"""


def load(text: str) -> Query:
    return query_from_dict(tomllib.loads(text))


def test_a_good_file_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "query.toml"
    path.write_text(GOOD)
    query = Query.load(path)
    assert query.goal == Goal((1.0, 4.0), 0.5)
    assert [o.shape for o in query.obstacles] == ["circle", "polygon"]
    assert query.hard_obstacles == query.obstacles[1:]
    assert query.input_weights.tolist() == [1.0, 2.0]
    assert query.is_bounded
    assert not query.is_time_free
    assert query.robot_radius == 0.1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('model = "unicycle"', "", "model: missing"),
        ('"unicycle"', '"unicycles"', "'unicycles' is not registered"),
        ("[goal]\ncenter = [1.0, 4]\nradius = 0.5", "", "goal: missing"),
        ("center = [1.0, 4]", "", "goal.center: missing"),
        ("[1.0, 4]", "[1.0, 4, 2]", "goal.center: unicycle has 2 position coordinates"),
        ("[1.0, 4]", "[1.0, 7]", "goal.center: y = 7 lies outside"),
        ("[1.0, 4]", "[1.0, nan]", "goal.center: must be a number, got nan"),
        ("[1.0, 4]", '"there"', "goal.center: must be a list of numbers"),
        ("radius = 0.5", "radius = -0.5", "goal.radius: must be a positive finite number"),
        ("radius = 0.5", "radius = inf", "goal.radius"),
        ("radius = 0.5", "radius = true", "goal.radius: must be a number"),
        ('"circle"', '"blob"', "obstacle 1.shape: must be circle, diamond or polygon"),
        ("radius = 1.0", "radius = 0.0", "obstacle 1.radius: must be a positive finite number"),
        ("radius = 1.0", "radius = 1.0\nvertices = []", "obstacle 1.vertices: unknown"),
        ("[-1.0, -1.0]", "[-1.0]", "obstacle 1: unicycle has 2 position coordinates"),
        ("[2.5, -1.0]", "[2.5, -2.0]", "obstacle 2.vertices: the polygon must be strictly convex"),
        ("hard = true", 'hard = "yes"', "obstacle 2.hard: must be true or false"),
        ("[1.0, 2.0]", "[1.0, -2.0]", "cost.input: needs 2 positive finite weights"),
        ("[1.0, 2.0]", "[1.0]", "cost.input: needs 2"),
        ("goal_steepness", "steepness", "cost.steepness: unknown"),
        ("lower = [-1.0, -inf]", "lower = [2.0, -inf]", "input.lower: must be below"),
        ("lower = [-1.0, -inf]", "lower = [2.0]", "input.lower: needs 2 numbers"),
        ("radius = 0.1", "radius = -0.1", "robot.radius: must be a finite number >= 0"),
        ("[robot]", "[robots]", "robots: unknown"),
    ],
)
def test_a_bad_file_is_refused_by_field_and_value(old: str, new: str, message: str) -> None:
    assert old in GOOD
    with pytest.raises(ValueError, match=re.escape(message)):
        load(GOOD.replace(old, new, 1))


def test_a_file_that_is_no_toml_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "query.toml"
    path.write_bytes(b"\xff\xfe[goal")
    with pytest.raises(ValueError, match="not a TOML file"):
        Query.load(path)


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ([0.0, 0.0], "needs 3 numbers"),
        ([9.0, 0.0, 0.0], r"start: x = 9 m lies outside \[-5, 5\]"),
        ([np.nan, 0.0, 0.0], "must be finite"),
        ([2.5, -1.7, 0.0], "inside a hard obstacle"),
    ],
)
def test_a_bad_start_is_refused(start: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load(GOOD).check_start(start)


coordinates = st.floats(-4, 4)
obstacles = st.one_of(
    st.builds(
        Obstacle.circle, st.tuples(coordinates, coordinates), st.floats(0.1, 2), st.booleans()
    ),
    st.builds(
        Obstacle.diamond, st.tuples(coordinates, coordinates), st.floats(0.1, 2), st.booleans()
    ),
    st.builds(
        lambda c, r, k, hard: Obstacle.polygon(
            [
                (c[0] + r * np.cos(a), c[1] + r * np.sin(a))
                for a in np.linspace(0, 2 * np.pi, k, endpoint=False)
            ],
            hard,
        ),
        st.tuples(coordinates, coordinates),
        st.floats(0.1, 2),
        st.integers(3, 16),
        st.booleans(),
    ),
)
queries = st.builds(
    lambda center, radius, items, robot: Query(
        "unicycle", Goal(center, radius), tuple(items), robot_radius=robot
    ),
    st.tuples(coordinates, coordinates),
    st.floats(0.1, 1),
    st.lists(obstacles, max_size=4),
    st.floats(0, 0.5),
)


@given(queries)
def test_writing_and_reading_gives_the_same_query(query: Query) -> None:
    """A polygon's centroid is recomputed from its vertices, hence equal to the last bit too."""
    assert load(query.dumps()) == query
    assert copy.deepcopy(query) == query


@given(obstacles, st.tuples(coordinates, coordinates))
def test_the_soft_penalty_is_one_exactly_on_the_boundary(obstacle: Obstacle, toward) -> None:
    """Along any ray from the centre, phi crosses 1 where the signed distance crosses 0."""
    center = np.array(obstacle.center)
    direction = np.array(toward) - center
    if np.linalg.norm(direction) < 1e-3:
        direction = np.array([1.0, 0.0])
    if obstacle.vertices:
        gauge = (obstacle.facets @ direction).max()
        boundary = center + direction / gauge
    else:
        boundary = center + direction * obstacle.radius / np.linalg.norm(direction)
    assert abs(obstacle.signed_distance(boundary)) < 1e-9
    query = Query("single-integrator-2d", Goal((-5.0, -5.0), 1e-3), (obstacle,))
    far_goal = float(Query("single-integrator-2d", query.goal).running_cost(boundary, [0, 0]))
    assert abs(float(query.running_cost(boundary, [0, 0])) - far_goal - 1.0) < 1e-6


@given(obstacles, st.tuples(coordinates, coordinates))
def test_signed_distance_is_the_same_in_casadi(obstacle: Obstacle, point) -> None:
    import casadi as ca

    p = ca.SX.sym("p", 2)  # pyright: ignore
    f = ca.Function("distance", [p], [obstacle.signed_distance_expression(p)])
    expected = float(obstacle.signed_distance(point))
    assert abs(float(f(point)) - expected) < 1e-9


def test_a_diamond_is_the_polygon_with_its_corners() -> None:
    diamond = Obstacle.diamond((2.0, -1.0), 0.8)
    polygon = Obstacle.polygon(diamond.vertices)
    assert polygon.radius == pytest.approx(diamond.radius, abs=1e-15)
    np.testing.assert_allclose(polygon.facets, diamond.facets, atol=1e-15)


def test_the_papers_family() -> None:
    """Section IV-A: which obstacles a goal brings along."""
    assert paper_query((4.0, 4.0)).obstacles == ()
    assert [o.shape for o in paper_query((1.0, 1.0)).obstacles] == ["circle"]
    assert [o.shape for o in paper_query((1.0, 4.0)).obstacles] == ["circle", "diamond", "diamond"]
    assert paper_query((4.0, 1.0)).obstacles == paper_query((1.0, 4.0)).obstacles
    rng = np.random.default_rng(0)
    draws = [PAPER_FAMILY.sample(rng) for _ in range(400)]
    counts = [sum(len(q.obstacles) == k for q in draws) / 400 for k in (0, 1, 3)]
    assert np.allclose(counts, [0.25, 0.25, 0.5], atol=0.08)  # three standard deviations
    again = np.random.default_rng(0)
    assert draws == [PAPER_FAMILY.sample(again) for _ in range(400)]


def test_starts_lie_in_the_domain_and_outside_the_goal() -> None:
    query = load(GOOD)
    rng = np.random.default_rng(1)
    for _ in range(200):
        start = sample_start(query, rng)
        assert query.goal_distance(start) > 0
        np.testing.assert_array_equal(query.check_start(start), start)
