"""Family files: what is drawn, and what is refused."""

from importlib import resources

import numpy as np
import pytest

from ocp.family_file import family_from_dict, load_family, with_obstacle_count
from ocp.query_family import PAPER_FAMILY, paper_query
from ocp.query_file import read_toml


@pytest.fixture
def table():
    return read_toml(resources.files("ocp.families") / "general.toml")  # pyright: ignore[reportArgumentType]


def test_queries_of_the_general_family_keep_its_bounds(table):
    rng = np.random.default_rng(0)
    drawn = [family_from_dict(table).sample(rng) for _ in range(400)]
    counts = {len(q.obstacles) for q in drawn}
    assert counts == set(range(7))
    for query in drawn:
        center = query.goal_position
        assert (abs(center) <= 4.5).all()
        assert 0.3 <= query.goal.radius <= 0.8
        for obstacle in query.obstacles:
            assert 0.4 <= obstacle.radius <= 1.2
            assert obstacle.signed_distance(center) >= 0
    shapes = [o.shape for q in drawn for o in q.obstacles]
    # A share of one half in n draws: six standard deviations.
    assert abs(shapes.count("circle") / len(shapes) - 0.5) < 6 * 0.5 / len(shapes) ** 0.5


def test_a_family_is_named_or_read(table):
    assert load_family("paper") is PAPER_FAMILY
    first = load_family("general").sample(np.random.default_rng(3))
    assert first == family_from_dict(table).sample(np.random.default_rng(3))


def test_a_family_of_one_query():
    """The paper's, by its own description."""
    family = load_family("paper-1-1")
    for seed in range(3):
        assert family.sample(np.random.default_rng(seed)) == paper_query((1.0, 1.0))


def test_more_obstacles_than_the_family_has(table):
    crowded = with_obstacle_count(table, 7, 10)
    rng = np.random.default_rng(0)
    assert {len(crowded.sample(rng).obstacles) for _ in range(100)} == {7, 8, 9, 10}


def test_an_unknown_family_is_refused():
    with pytest.raises(ValueError, match="'mine' is unknown; known are general, paper, paper-1-1"):
        load_family("mine")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extra": 1}, "extra: unknown"),
        ({"goal": {"lower": [0, 0], "upper": [1, 1]}}, "goal.radius: missing"),
        (
            {"goal": {"lower": [2, 0], "upper": [1, 1], "radius": [0.3, 0.4]}},
            "goal.upper: bounds must increase",
        ),
    ],
)
def test_bad_files_are_refused(table, change, message):
    with pytest.raises(ValueError, match=message):
        family_from_dict({**table, **change})
