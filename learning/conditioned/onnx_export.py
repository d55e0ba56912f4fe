"""The conditioned network as ONNX, for runtimes of other languages and chips.

The file holds the learned part: from features of states and obstacles (as `QueryEncoder.encode`
makes them) to the least head, in V = V_free (1 + softplus(n)). A whole policy, with its features
and the exact V_free, is what `ocp.export.export_c` writes.
"""

import os
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from learning.conditioned.network_weights import NetworkWeights
from learning.conditioned.query_encoder import OBSTACLE_FEATURES, STATE_FEATURES
from learning.conditioned.value_function import ConditionedNetwork, Widths
from ocp.files import atomic_path

OPSET = 18


class _LeastHead(nn.Module):
    """One query's obstacles for each state: no list of owners."""

    def __init__(self, network: ConditionedNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, state: Tensor, obstacle: Tensor) -> Tensor:
        """n `[k]` from features `[k, s]` and `[k, o, f]`."""
        k, o = obstacle.shape[0], obstacle.shape[1]
        owner = torch.arange(k).unsqueeze(1).expand(k, o).reshape(-1)
        return self.network(state, obstacle.reshape(k * o, -1), owner).amin(dim=1)


def export_onnx(weights: NetworkWeights, path: str | os.PathLike[str]) -> Path:
    """Write a network's ONNX file: `state` `[k, s]`, `obstacle` `[k, o, f]` -> `n` `[k]`.

    Numbers are in single precision, k and o free, o at least 1.

    Raises:
        ImportError: without the optional packages `onnx` and `onnxscript` (extra `export`).
    """
    _, _, member, trunk, heads = (int(x) for x in weights.sizes)
    network = ConditionedNetwork(Widths(member, trunk, heads))
    network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.arrays.items()})
    example = torch.zeros(2, STATE_FEATURES), torch.zeros(2, 3, OBSTACLE_FEATURES)
    states, obstacles = torch.export.Dim("k", min=1), torch.export.Dim("o", min=1)
    with warnings.catch_warnings():  # about the exporter's own insides
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            _LeastHead(network).eval(),
            example,
            dynamo=True,
            opset_version=OPSET,
            input_names=["state", "obstacle"],
            output_names=["n"],
            dynamic_shapes=({0: states}, {0: states, 1: obstacles}),
            verbose=False,
        )
    assert program is not None
    with atomic_path(path) as temporary:
        program.save(str(temporary), external_data=False)
    return Path(path)
