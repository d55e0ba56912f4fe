"""The samples of a family as tensors of features, and batches drawn from them."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.conditioned.query_encoder import (
    OBSTACLE_FEATURES,
    ODD_OBSTACLE,
    ODD_STATE,
    STATE_FEATURES,
    QueryEncoder,
)
from learning.conditioned.value_function import Batch
from learning.conditioned.value_samples import ValueSamples, input_directions
from ocp.query import Query


@dataclass(frozen=True)
class FamilyTensors:
    """All samples of a family in features, derivatives along the `m` directions of the inputs.

    Attributes:
        inputs: everything that the network is given; `owner` counts rows of all samples.
        first: `[k + 1]`, where each sample's obstacles begin in `inputs.obstacle`.
        values: `[k]`.
        slopes: `[k, m]`.
        smooth: `[k]`.
    """

    inputs: Batch
    first: NDArray[np.int64]
    values: Tensor
    slopes: Tensor
    smooth: Tensor

    @property
    def size(self) -> int:
        return len(self.values)

    def batch(self, rows: NDArray[np.int64], mirrored: NDArray[np.bool_] | None = None) -> Batch:
        """The inputs of some samples, those `mirrored` as seen in a mirror."""
        counts = self.first[rows + 1] - self.first[rows]
        owner = np.repeat(np.arange(len(rows)), counts)
        starts = np.repeat(self.first[rows] - np.concatenate([[0], np.cumsum(counts)[:-1]]), counts)
        members = torch.from_numpy(starts + np.arange(len(owner)))
        picked, owners = torch.from_numpy(rows), torch.from_numpy(owner)
        x = self.inputs
        state, state_slopes = x.state[picked], x.state_slopes[picked]
        obstacle, obstacle_slopes = x.obstacle[members], x.obstacle_slopes[members]
        if mirrored is not None:
            sign = torch.from_numpy(np.where(mirrored, -1.0, 1.0).astype(np.float32))
            for k in ODD_STATE:
                state[:, k] *= sign
                state_slopes[:, k] *= sign[:, None]
            for k in ODD_OBSTACLE:
                obstacle[:, k] *= sign[owners]
                obstacle_slopes[:, k] *= sign[owners][:, None]
        return Batch(x.free[picked], state, state_slopes, obstacle, obstacle_slopes, owners)


def family_tensors(samples: list[tuple[Query, ValueSamples]]) -> FamilyTensors:
    """Encode samples, in single precision."""
    parts: dict[str, list[NDArray]] = {name: [] for name in Batch.__dataclass_fields__}
    counts, known = [], []
    done = 0
    for query, s in samples:
        free, state, state_slopes, obstacle, obstacle_slopes = QueryEncoder.of(query).encode(
            s.states
        )
        directions = input_directions(query, s.states)
        k, o = obstacle.shape[:2]
        flat = (k * o, OBSTACLE_FEATURES)
        m = directions.shape[-1]
        parts["free"].append(
            np.concatenate([free[:, :1], np.einsum("kn,knm->km", free[:, 1:], directions)], axis=1)
        )
        parts["state"].append(state)
        parts["state_slopes"].append(np.einsum("ksn,knm->ksm", state_slopes, directions))
        parts["obstacle"].append(obstacle.reshape(flat))
        along = np.einsum("kofn,knm->kofm", obstacle_slopes, directions)
        parts["obstacle_slopes"].append(along.reshape(*flat, m))
        parts["owner"].append(np.repeat(np.arange(done, done + k), o))
        counts.append(np.full(k, o))
        known.append((s.values, s.slopes, s.smooth))
        done += k
    tensors = {
        name: torch.from_numpy(
            np.concatenate(arrays).astype(np.int64 if name == "owner" else np.float32)
        )
        for name, arrays in parts.items()
    }
    assert tensors["state"].shape[1] == STATE_FEATURES
    values, slopes, smooth = (np.concatenate(column) for column in zip(*known, strict=True))
    return FamilyTensors(
        Batch(**tensors),
        np.concatenate([[0], np.cumsum(np.concatenate(counts))]),
        torch.from_numpy(values.astype(np.float32)),
        torch.from_numpy(slopes.astype(np.float32)),
        torch.from_numpy(smooth),
    )
