"""The shipped networks of this room: weights, and where they come from.

Beside `causality-free-NAME.safetensors` stands a TOML file of the same name, the provenance:
settings, seed, hash of the data, version of the code, the command, and the figures measured.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.causality_free.families import (
    FAMILIES,
    RegulationFamily,
    context,
    free_coordinates,
    get_family,
)
from learning.causality_free.network import Weights
from learning.causality_free.value import NetworkValue
from learning.shipped import PRETRAINED, file_hash
from learning.weights import load_tensors, save_tensors
from ocp.query import Query
from ocp.trajectory import SolveError, Status

MARGIN = 0.25  # of the range trained on: the ends of a family are drawn seldom


@dataclass(frozen=True, eq=False)
class Pretrained:
    """A trained network.

    Attributes:
        family: what it was trained on.
        weights: of the network.
        model: fingerprint of the robot.
        reference: `[n]`, of a query trained on; where coordinates are not free, the only one known.
        lower, upper: `[c]`, the contexts trained on.
        provenance: everything in the TOML file; empty if there is none.
    """

    family: RegulationFamily
    weights: Weights
    model: str
    reference: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    provenance: dict[str, Any]

    @classmethod
    def of(
        cls, family: RegulationFamily, weights: Weights, queries: Sequence[Query]
    ) -> "Pretrained":
        """What training on `queries` gave."""
        contexts = np.array([context(query) for query in queries])
        lower, upper = contexts.min(axis=0), contexts.max(axis=0)
        model, reference = queries[0].system.fingerprint, queries[0].reference
        return cls(family, weights, model, reference, lower, upper, {})

    def save(self, path: Path) -> None:
        """Write the weights, whole or not at all."""
        record = {
            "family": self.family.name,
            "model": self.model,
            "reference": self.reference.tolist(),
            "lower": self.lower.tolist(),
            "upper": self.upper.tolist(),
        }
        save_tensors(path, self.weights.tensors(), record)

    @classmethod
    def load(cls, path: Path) -> "Pretrained":
        """What `save` wrote, with the provenance beside it if there is one.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is damaged, or is not what the provenance describes.
        """
        tensors, record = load_tensors(path)
        beside = path.with_suffix(".toml")
        told = tomllib.loads(beside.read_text(encoding="utf-8")) if beside.is_file() else {}
        if told and told["weights_sha256"] != file_hash(path):
            raise ValueError(f"{path.name}: damaged: its hash is not the one in {beside.name}")
        reference, lower, upper = (np.array(record[k]) for k in ("reference", "lower", "upper"))
        family, weights = get_family(record["family"]), Weights.of(tensors)
        return cls(family, weights, record["model"], reference, lower, upper, told)

    def why_unknown(self, query: Query) -> str | None:
        """Why the query is not of the family trained on; `None` if it is."""
        if query.system.fingerprint != self.model:
            return f"the network was trained on another robot than {query.system.name}"
        try:
            told = context(query)
        except SolveError as error:
            return error.detail
        foreign = self.family.why_foreign(query)
        if foreign is not None:
            return foreign
        free = free_coordinates(query.system)
        fixed = [i for i in range(query.system.n) if i not in free]
        if np.abs(query.reference - self.reference)[fixed].max() > 1e-9:
            return f"the network knows goals like {self.reference.tolist()} only"
        slack = MARGIN * (self.upper - self.lower) + 1e-9
        if (told < self.lower - slack).any() or (told > self.upper + slack).any():
            return "weights or input limits lie outside the family that the network was trained on"
        return None

    def value(self, query: Query) -> NetworkValue:
        """V of a query.

        Raises:
            SolveError: NOT_APPLICABLE if the query is not of the family.
        """
        reason = self.why_unknown(query)
        if reason is not None:
            raise SolveError(Status.NOT_APPLICABLE, f"causality-free: {reason}")
        return NetworkValue(query, self.weights, np.array(self.family.reach))


def weights_path(name: str) -> Path:
    """Where a family's shipped weights are."""
    return PRETRAINED / f"causality-free-{name}.safetensors"


@cache
def load_pretrained(name: str) -> Pretrained:
    """The shipped network of a family.

    Raises:
        ValueError: if there is none of that name, or its file is damaged.
    """
    get_family(name)
    return Pretrained.load(weights_path(name))


def pretrained_for(query: Query) -> Pretrained:
    """The shipped network that knows a query.

    Raises:
        SolveError: NOT_APPLICABLE, with the reasons, if none does.
    """
    reasons = []
    for name in FAMILIES:
        if weights_path(name).is_file():
            known = load_pretrained(name)
            reason = known.why_unknown(query)
            if reason is None:
                return known
            reasons.append(f"{name}: {reason}")
    raise SolveError(Status.NOT_APPLICABLE, f"causality-free: {'; '.join(reasons)}")
