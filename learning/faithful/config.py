"""Configuration of meta value learning, read from TOML: every parameter of section IV-B by name."""

import os
import tomllib
from dataclasses import asdict, dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from learning.faithful.losses import Derivative, Lagrangian, Reduction, Structure
from learning.faithful.value_network import Activation
from learning.settings import from_table, word_of
from ocp.query_family import PAPER_FAMILY, QueryFamily
from ocp.set_valued import COARSE, Image

KIND = "faithful"
FAMILIES = {"paper": PAPER_FAMILY}


class Source(Enum):
    """Where training data come from."""

    SET_VALUED = "set-valued"
    """Eq. (7) on a grid (the paper)."""
    EIKONAL = "eikonal"
    """Fast marching, its value and gradient read at the nodes of the same grid."""
    TRAJECTORIES = "trajectories"
    """Exact trajectories from random starts, as in the adaptation."""


def _positive(owner: str, **numbers: float) -> None:
    for name, number in numbers.items():
        if not 0 < number < float("inf"):
            raise ValueError(f"{owner}.{name}: must be a positive finite number, got {number}")


@dataclass(frozen=True)
class DataSettings:
    """Training queries and their data.

    Attributes:
        family: name of the distribution of queries.
        queries: sampled from it.
        source: of optimal values and controls.
        grid: nodes along each axis.
        step: eps of eq. (7), seconds.
        image: the reading of eq. (7).
        trajectories: a query, for that source.
    """

    family: str = "paper"
    queries: int = 60
    source: Source = Source.SET_VALUED
    grid: tuple[int, ...] = COARSE
    step: float = 0.4
    image: Image = Image.NEAREST
    trajectories: int = 64

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise ValueError(
                f"data.family: {self.family!r} is unknown; known are {', '.join(FAMILIES)}"
            )
        _positive("data", queries=self.queries, step=self.step, trajectories=self.trajectories)

    @property
    def distribution(self) -> QueryFamily:
        return FAMILIES[self.family]


@dataclass(frozen=True)
class NetworkSettings:
    """V^NN.

    Attributes:
        hidden: widths of the hidden layers.
        activation: theirs.
        relative: positions relative to the goal's centre instead of absolute (a departure).
        structure: PLAIN (the paper) or BOUND (a departure).
    """

    hidden: tuple[int, ...] = (256, 256, 256)
    activation: Activation = Activation.RELU
    relative: bool = False
    structure: Structure = Structure.PLAIN


@dataclass(frozen=True)
class LossSettings:
    """The Lagrangian (12).

    Attributes:
        multiplier: mu.
        reduction: sums as printed, or means.
        derivative: of V in L_u.
        difference_step: seconds of motion under a unit input, for finite differences.
    """

    multiplier: float = 0.1
    reduction: Reduction = Reduction.SUM
    derivative: Derivative = Derivative.FINITE
    difference_step: float = 0.01

    def __post_init__(self) -> None:
        if not 0 <= self.multiplier < float("inf"):
            raise ValueError(f"loss.multiplier: must be finite and >= 0, got {self.multiplier}")
        _positive("loss", difference_step=self.difference_step)


@dataclass(frozen=True)
class MetaSettings:
    """Algorithm 1.

    Attributes:
        iterations: P.
        batch: queries a minibatch, |T_k|.
        shots: K, samples of the inner step.
        outer_shots: samples that judge it.
        inner_rate: alpha.
        inner_steps: gradient steps before the judgement (the paper: 1).
        outer_rate: beta, of Adam.
        final_rate: the outer rate falls to this fraction of itself, along a cosine.
        second_order: whether the inner step's Hessian is kept, as in (16).
    """

    iterations: int = 10_000
    batch: int = 10
    shots: int = 256
    outer_shots: int = 256
    inner_rate: float = 1e-3
    inner_steps: int = 1
    outer_rate: float = 1e-3
    final_rate: float = 1.0
    second_order: bool = True

    def __post_init__(self) -> None:
        _positive(
            "meta",
            iterations=self.iterations,
            batch=self.batch,
            shots=self.shots,
            outer_shots=self.outer_shots,
            outer_rate=self.outer_rate,
            final_rate=self.final_rate,
        )
        if not 0 <= self.inner_rate < float("inf"):
            raise ValueError(f"meta.inner_rate: must be finite and >= 0, got {self.inner_rate}")
        if self.inner_steps < 0:
            raise ValueError(f"meta.inner_steps: must not be negative, got {self.inner_steps}")


class Optimizer(Enum):
    """How Algorithm 2 steps."""

    GRADIENT = "gradient"
    """Gradient descent with the inner step size (the paper)."""
    ADAM = "adam"
    """Adam, its moments kept from one trajectory to the next (a departure)."""


@dataclass(frozen=True)
class AdaptationSettings:
    """Algorithm 2.

    Attributes:
        trajectories: N at most.
        shots_per_trajectory: K_n / n.
        steps: M, gradient steps a trajectory.
        rate: their size.
        optimizer: what kind of steps.
        interval: Delta t, seconds.
        goal_ratio: |D_g| / |S_D|.
    """

    trajectories: int = 64
    shots_per_trajectory: int = 32
    steps: int = 5
    rate: float = 1e-3
    optimizer: Optimizer = Optimizer.GRADIENT
    interval: float = 0.1
    goal_ratio: float = 0.1

    def __post_init__(self) -> None:
        _positive(
            "adaptation",
            trajectories=self.trajectories,
            shots_per_trajectory=self.shots_per_trajectory,
            steps=self.steps,
            rate=self.rate,
            interval=self.interval,
        )
        if not 0 <= self.goal_ratio < 1:
            raise ValueError(f"adaptation.goal_ratio: must be in [0, 1), got {self.goal_ratio}")


@dataclass(frozen=True)
class Config:
    """A training run of the faithful implementation.

    Attributes:
        seed: of queries, initial weights and minibatches.
    """

    seed: int = 0
    data: DataSettings = DataSettings()
    network: NetworkSettings = NetworkSettings()
    loss: LossSettings = LossSettings()
    meta: MetaSettings = MetaSettings()
    adaptation: AdaptationSettings = AdaptationSettings()

    @property
    def lagrangian(self) -> Lagrangian:
        """The loss that this configuration means."""
        return Lagrangian(
            self.loss.multiplier,
            self.loss.reduction,
            self.loss.derivative,
            self.network.activation,
            self.network.structure,
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Config":
        """Read a configuration file.

        Raises:
            ValueError: if it is no TOML, is of another kind, or holds an unknown or bad field.
            OSError: if it cannot be read.
        """
        try:
            table = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"{path}: is not TOML: {error}") from error
        return cls.from_table(table)

    @classmethod
    def from_table(cls, table: dict[str, Any]) -> "Config":
        """From a parsed file.

        Raises:
            ValueError: naming the field, its value and what would be right.
        """
        table = dict(table)
        kind = table.pop("kind", None)
        if kind != KIND:
            raise ValueError(f'kind: must be "{KIND}", got {kind!r}')
        return from_table(cls, table)

    def table(self) -> dict[str, Any]:
        """What `from_table` reads."""
        return {"kind": KIND} | _plain(asdict(self))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, Enum):
        return word_of(value)
    return list(value) if isinstance(value, tuple) else value
