"""Weights of a conditioned network as plain arrays, in a safetensors file with its provenance."""

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ocp.files import atomic_path

Single = NDArray[np.float32]

MATRICES = (
    "member_obstacle", "member_state", "member_hidden", "trunk_sum", "trunk_state", "trunk_hidden",
    "heads",
)  # fmt: skip
BIASES = ("member_state", "member_hidden", "trunk_state", "trunk_hidden", "heads")


@dataclass(frozen=True, eq=False)
class NetworkWeights:
    """The arrays of a `ConditionedNetwork`'s state dictionary.

    Attributes:
        arrays: by name.
    """

    arrays: dict[str, Single]

    def __post_init__(self) -> None:
        """Refuse what is no such network."""
        wanted = {f"{m}.weight" for m in MATRICES} | {f"{b}.bias" for b in BIASES}
        wanted |= {f"{side}_{x}" for side in ("state", "obstacle") for x in ("mean", "scale")}
        if set(self.arrays) != wanted:
            raise ValueError(f"weights: not a conditioned network: {sorted(self.arrays)}")
        for name, array in self.arrays.items():
            if not np.isfinite(array).all():
                raise ValueError(f"weights: {name} is not finite")

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """Numbers of state features, obstacle features, member units, trunk units, heads."""
        member, state = self.arrays["member_state.weight"].shape
        heads, trunk = self.arrays["heads.weight"].shape
        obstacle = self.arrays["member_obstacle.weight"].shape[1]
        return np.array([state, obstacle, member, trunk, heads])

    @cached_property
    def packed(self) -> Single:
        """One vector for the compiled network: transposed matrices, biases, matrices.

        Mean and scale of the features are folded into the layers that see them.
        """
        folded = {k: v.astype(float) for k, v in self.arrays.items()}
        for layer, side in (
            ("member_obstacle", "obstacle"),
            ("member_state", "state"),
            ("trunk_state", "state"),
        ):
            W = folded[f"{layer}.weight"] / folded[f"{side}_scale"]
            shift = W @ folded[f"{side}_mean"]
            home = "member_state" if layer == "member_obstacle" else layer
            folded[f"{layer}.weight"] = W
            folded[f"{home}.bias"] = folded[f"{home}.bias"] - shift
        matrices = [folded[f"{name}.weight"] for name in MATRICES]
        parts = [m.T.ravel() for m in matrices]
        parts += [folded[f"{name}.bias"] for name in BIASES]
        parts += [m.ravel() for m in matrices]
        return np.concatenate(parts).astype(np.float32)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a safetensors file, whole or not at all."""
        from safetensors.numpy import save

        with atomic_path(path) as temporary:
            temporary.write_bytes(save(self.arrays))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "NetworkWeights":
        """Read a safetensors file.

        Raises:
            ValueError: if it is damaged, or holds no such network.
            OSError: if it cannot be read.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        try:
            return cls(load_file(path))
        except SafetensorError as error:
            raise ValueError(f"{path}: damaged: {error}") from error
