"""The conditioned network as ONNX, run by ONNX Runtime."""

from pathlib import Path

import numpy as np
import pytest

from learning.conditioned.compiled_network import NetworkValue
from learning.conditioned.onnx_export import export_onnx
from learning.conditioned.pretrained_weights import load_pretrained
from learning.conditioned.query_encoder import QueryEncoder
from ocp.obstacle import Obstacle
from ocp.query import Query
from ocp.query_family import paper_query

pytest.importorskip("onnx", reason="needs the extra `export`")
pytest.importorskip("onnxscript", reason="needs the extra `export`")
onnxruntime = pytest.importorskip("onnxruntime", reason="needs the extra `export`")


def test_the_value_from_the_onnx_file_is_the_networks(tmp_path: Path) -> None:
    """For any number of states and obstacles: V = V_free (1 + softplus(n))."""
    weights = load_pretrained("general").weights
    session = onnxruntime.InferenceSession(export_onnx(weights, tmp_path / "network.onnx"))
    rng = np.random.default_rng(0)
    one = Query("unicycle", paper_query((4.0, 4.0)).goal, (Obstacle.circle((1.0, 0.0), 0.9),))
    for query, count in ((paper_query((1.0, 4.0)), 1_000), (one, 1), (one, 7)):
        encoder = QueryEncoder.of(query)
        states = rng.uniform(-5.0, 5.0, (count, 3))
        states = states[query.goal_distance(states) > 0.05]
        free, state, _, obstacle, _ = encoder.encode(states)
        given = {"state": state.astype(np.float32), "obstacle": obstacle.astype(np.float32)}
        (n,) = session.run(["n"], given)
        found = free[:, 0] * (1.0 + np.logaddexp(0.0, n.astype(float)))
        np.testing.assert_allclose(found, NetworkValue(encoder, weights).value(states), rtol=1e-5)
