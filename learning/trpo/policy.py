"""The paper's reinforcement-learning baseline: a policy trained by TRPO (Schulman et al., 2015).

One policy serves a family of queries, which it sees in its observation; the paper trains one a
query and says nothing of its settings. A trained policy is plain weights and needs no library of
reinforcement learning; training does (training.py, the extra `rl`).
"""

import os
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike

from learning.settings import from_table
from learning.shipped import PRETRAINED
from learning.trpo.robot_batch import Array, Encoder, EnvironmentSettings, scaled
from learning.weights import load_tensors, save_tensors
from ocp.compiled.batch import state_costs
from ocp.family_file import load_family
from ocp.query import Query
from ocp.query_file import read_toml
from ocp.value import Policy

KIND = "trpo"
TRAINED = PRETRAINED / "trpo.safetensors"
TRAINED_ALONE = PRETRAINED / "trpo-1-1.safetensors"
"""A policy for one query only, as the paper trains them: the paper's with its goal at (1, 1)."""


@dataclass(frozen=True)
class TrpoSettings:
    """Everything that a training run depends on.

    Attributes:
        family: name of a family, or a family file.
        environment: see `EnvironmentSettings`; its shaping guides training only.
        seed: of queries, starts, weights and noise.
        steps: of a single robot, in all.
        robots: driven at the same time.
        rollout: steps of each robot between two updates.
        hidden: widths of the hidden layers, policy and critic alike.
        discount: gamma.
        gae: lambda of generalised advantage estimation.
        largest_divergence: the trust region, mean Kullback-Leibler divergence.
        critic_rate: learning rate of the critic.
        critic_passes: over the rollout, an update.
    """

    family: str = "paper"
    environment: EnvironmentSettings = field(
        default_factory=lambda: EnvironmentSettings(shaping=2.0)
    )
    seed: int = 0
    steps: int = 983_040
    robots: int = 256
    rollout: int = 64
    hidden: tuple[int, ...] = (128, 128)
    discount: float = 0.998
    gae: float = 0.97
    largest_divergence: float = 0.01
    critic_rate: float = 1e-3
    critic_passes: int = 5

    def __post_init__(self) -> None:
        for name in ("steps", "robots", "rollout", "critic_passes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        for name in ("discount", "gae"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"{name}: must lie in (0, 1], got {getattr(self, name)}")
        for name in ("largest_divergence", "critic_rate"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name}: must be a positive number, got {getattr(self, name)}")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: needs positive widths, got {list(self.hidden)}")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "TrpoSettings":
        """From a TOML file of kind "trpo".

        Raises:
            ValueError: naming the field that is wrong or unknown.
            OSError: if the file cannot be read.
        """
        table = read_toml(path)
        if table.pop("kind", None) != KIND:
            raise ValueError(f"{path}: kind: must be {KIND!r}")
        return from_table(cls, table)


@dataclass(frozen=True, eq=False)
class TrpoWeights:
    """The mean of the Gaussian policy: a network with tanh layers.

    Attributes:
        layers: (matrix `[out, in]`, bias `[out]`) of each.
        settings: of the run that trained it.
        provenance: code, command and figures of that run.
    """

    layers: tuple[tuple[Array, Array], ...]
    settings: TrpoSettings
    provenance: dict[str, Any]

    def __call__(self, features: Array) -> Array:
        """Mean actions `[k, m]` of features `[k, count]`; not clipped."""
        for k, (matrix, bias) in enumerate(self.layers):
            features = features @ matrix.T + bias
            if k + 1 < len(self.layers):
                features = np.tanh(features)
        return features

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write weights with settings and provenance, whole or not at all."""
        tensors = {}
        for k, (matrix, bias) in enumerate(self.layers):
            tensors[f"{k}.matrix"] = torch.from_numpy(matrix.astype(np.float32))
            tensors[f"{k}.bias"] = torch.from_numpy(bias.astype(np.float32))
        record = {"kind": KIND, "settings": asdict(self.settings), **self.provenance}
        save_tensors(path, tensors, record)

    @classmethod
    def load(cls, path: str | os.PathLike[str] = TRAINED) -> "TrpoWeights":
        """What `save` wrote; by default the shipped policy.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged or of another kind.
        """
        tensors, record = load_tensors(path)
        if record.pop("kind", None) != KIND:
            raise ValueError(f"{path}: holds no policy trained by TRPO")
        settings = from_table(TrpoSettings, record.pop("settings"))
        layers = []
        for k in range(len(settings.hidden) + 1):
            names = f"{k}.matrix", f"{k}.bias"
            if not all(name in tensors for name in names):
                raise ValueError(f"{path}: layer {k} is missing")
            matrix, bias = (tensors[name].numpy().astype(float) for name in names)
            layers.append((matrix, bias))
        return cls(tuple(layers), settings, record)


@dataclass(frozen=True, eq=False)
class TrpoPolicy:
    """The trained policy on one query, without noise; 0 in the goal.

    It is meant for inputs held for `weights.settings.environment.step` seconds.
    """

    query: Query
    weights: TrpoWeights

    def __post_init__(self) -> None:
        _ = self._known  # refuses a query that it cannot see

    @staticmethod
    def encoder_of(settings: TrpoSettings) -> Encoder:
        """What a policy trained with `settings` sees."""
        query = load_family(settings.family).sample(np.random.default_rng(0))
        return Encoder(query.system, settings.environment)

    @cached_property
    def _encoder(self) -> Encoder:
        return self.encoder_of(self.weights.settings)

    @cached_property
    def _known(self) -> Array:
        return self._encoder.query_features(self.query)

    def __call__(self, states: ArrayLike) -> Array:
        """Inputs `[..., m]` at states `[..., n]`."""
        states = np.asarray(states, dtype=float)
        n = self.query.system.n
        if states.shape[-1:] != (n,) or not np.isfinite(states).all():
            raise ValueError(f"states: need finite numbers [..., {n}], got shape {states.shape}")
        rows = states.reshape(-1, n)
        seen = np.broadcast_to(self._known, (len(rows), len(self._known)))
        features = self._encoder.features(rows, seen, state_costs(self.query, rows))
        inputs = scaled(self.query, self.weights(features), self.weights.settings.environment.limit)
        inputs = np.where(self.query.goal_distance(rows)[:, None] <= 0, 0.0, inputs)
        return inputs.reshape(*states.shape[:-1], -1)


class RolloutValue:
    """V of a policy: the running cost of its own closed loop, by simulation.

    Attributes:
        policy: whose cost-to-go it is; infinite where it does not reach the goal in time.
    """

    def __init__(self, policy: Policy, settings: EnvironmentSettings) -> None:
        self.policy, self._settings = policy, settings

    def value(self, states: ArrayLike) -> Array:
        """V `[...]` at states `[..., n]`, by simulating all of them together."""
        from ocp.compiled.held_inputs import advance, parameter_row

        query, s = self.policy.query, self._settings
        states = np.asarray(states, dtype=float)
        rows = states.reshape(-1, query.system.n).copy()
        total = np.zeros(len(rows))
        parameter = parameter_row(query, len(query.obstacles))
        going = np.flatnonzero(query.goal_distance(rows) > 0)
        for _ in range(round(s.time_limit / s.step)):
            if not len(going):
                break
            numbers = np.repeat(parameter[None], len(going), axis=0)
            moved, costs, arrived = advance(
                query,
                numbers,
                rows[going],
                self.policy(rows[going]),
                s.step / s.substeps,
                s.substeps,
            )
            rows[going] = moved
            total[going] += costs
            going = going[~arrived]
        total[going] = np.inf
        return total.reshape(states.shape[:-1])

    def gradient(self, states: ArrayLike) -> Array:
        """Central differences of V `[..., n]` over 1e-3 of the domain."""
        system = self.policy.query.system
        states = np.asarray(states, dtype=float)
        widths = 1e-3 * (system.upper - system.lower)
        shifts = np.diag(widths)
        above, below = (self.value(states[..., None, :] + sign * shifts) for sign in (1, -1))
        return (above - below) / (2 * widths)
