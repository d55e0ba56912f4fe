"""The shipped networks: weights, and where they come from.

Beside `NAME.safetensors` stands `NAME.toml`, the provenance: settings, seeds, hash of the data,
version of the code, the command, and the figures measured.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from learning.conditioned.network_weights import NetworkWeights
from learning.shipped import PRETRAINED, file_hash
from ocp.query import Goal, Query
from ocp.query_family import PAPER_FAMILY, paper_query

SHIPPED = ("paper", "general")
MOST_BYTES = 4_000_000


@dataclass(frozen=True, eq=False)
class Pretrained:
    """A shipped network.

    Attributes:
        weights: of the network.
        worth_nodes: of a grid whose policy is as good as the network's, by logarithms from the 95 %
            quantiles of excess of `zermelo bench learning`. (What the total excess adds to them are
            single loops in a wrong class of motions, which a plan tells by their cost.)
        provenance: everything in the TOML file.
    """

    weights: NetworkWeights
    worth_nodes: int
    provenance: dict[str, Any]

    def knows(self, query: Query) -> bool:
        """Whether the query is of the family that the network was trained on, or near enough.

        The network of the paper's family has met its obstacles only; others take any query.
        """
        if self.provenance["settings"]["family"] != PAPER_FAMILY.name:
            return True
        if not isinstance(query.goal, Goal):
            return False
        x, y = query.goal.center[:2]
        if not (0 <= x <= 5 and 0 <= y <= 5):
            return False
        like = paper_query((x, y))
        return query.goal == like.goal and set(query.obstacles) == set(like.obstacles)


@cache
def load_pretrained(name: str) -> Pretrained:
    """The shipped network of a family.

    Raises:
        ValueError: if there is none of that name, or its file does not match its provenance.
    """
    path = PRETRAINED / f"{name}.safetensors"
    if name not in SHIPPED:
        raise ValueError(f"pretrained: {name!r} is unknown; known are {', '.join(SHIPPED)}")
    return read_pretrained(path)


def read_pretrained(path: Path) -> Pretrained:
    """A network from a safetensors file with its provenance beside it.

    Raises:
        ValueError: if the weights are damaged or are not those that the provenance describes.
    """
    provenance = tomllib.loads(path.with_suffix(".toml").read_text(encoding="utf-8"))
    if file_hash(path) != provenance["weights_sha256"]:
        raise ValueError(f"{path.name}: damaged: its hash is not the one in {path.stem}.toml")
    return Pretrained(NetworkWeights.load(path), provenance["worth_nodes"], provenance)
