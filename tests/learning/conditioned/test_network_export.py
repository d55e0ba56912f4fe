"""A trained network as C99."""

from pathlib import Path

import numpy as np
import pytest
from c_compiler import compiled_policy, needs_compiler

from learning.conditioned.compiled_network import NetworkPolicy, NetworkValue
from learning.conditioned.pretrained_weights import load_pretrained
from learning.conditioned.query_encoder import QueryEncoder
from ocp.export import export_c
from ocp.obstacle import Obstacle
from ocp.query import Query
from ocp.query_family import paper_query

CIRCLES = Query("unicycle", paper_query((4.0, 4.0)).goal, (Obstacle.circle((1.0, 0.0), 0.9),))
QUERIES = {"diamonds": paper_query((1.0, 4.0)), "circle": CIRCLES}


@needs_compiler
@pytest.mark.parametrize("name", QUERIES)
def test_the_shipped_network_s_policy_is_the_same_in_c(name: str, tmp_path: Path) -> None:
    """Both sum in single precision, but in another order."""
    query = QUERIES[name]
    weights = load_pretrained("general").weights
    policy = NetworkPolicy(NetworkValue(QueryEncoder.of(query), weights))
    states = np.random.default_rng(0).uniform(-5.0, 5.0, (1_000, 3))
    states[:20, :2] = query.goal_position  # in the goal
    found, expected = compiled_policy(export_c(policy, tmp_path))(states), policy(states)
    assert (found[:20] == 0).all()
    size = np.abs(expected).max(axis=1)
    error = np.abs(found - expected).max(axis=1) / np.where(size > 0, size, 1.0)
    assert 0.0 < error.max() < 1e-5
