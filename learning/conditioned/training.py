"""Training of the conditioned network: seeded, resumable to the bit, any time.

The loss is what a wrong policy costs. On a time-free query the input's size is known and only its
direction is read off the gradient; at the angle theta from the optimal one, the Hamiltonian is
2 W (1 - cos theta), so the mean of 1 - cos theta along a closed loop is its relative excess cost.
The value itself counts by its relative error.
"""

import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from learning.checkpoint import load_checkpoint, save_checkpoint
from learning.conditioned.data_parallel import ALONE, Crew
from learning.conditioned.training_data import FamilyTensors
from learning.conditioned.value_function import ConditionedNetwork, Widths, value_and_slopes
from learning.conditioned.value_samples import SampleSizes
from learning.settings import from_table
from ocp.query_file import read_toml

KIND = "conditioned"


@dataclass(frozen=True)
class TrainingSettings:
    """Everything that a run depends on.

    Attributes:
        family: name of a family, or a family file.
        data: how much is sampled.
        seed: of data, weights and batches.
        widths: of the network.
        steps: of Adam.
        batch: samples a step.
        rate: the largest learning rate; it rises linearly over the first `warm_up` steps, then
            falls as a cosine to 0.
        warm_up: steps.
        value_weight: of the squared relative error of V against 1 - cos theta.
        held_out: queries at the end of the data that are never trained on.
        checkpoint_steps: between checkpoints.
    """

    family: str
    data: SampleSizes
    seed: int = 0
    widths: Widths = field(default_factory=Widths)
    steps: int = 20_000
    batch: int = 1024
    rate: float = 3e-3
    warm_up: int = 500
    value_weight: float = 2.0
    held_out: int = 20
    checkpoint_steps: int = 1000

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "warm_up", "checkpoint_steps", "held_out"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        if not 0 < self.rate < math.inf or not 0 <= self.value_weight < math.inf:
            raise ValueError("rate, value_weight: must be positive finite numbers")
        if self.data.queries <= self.held_out:
            raise ValueError(f"data.queries: must exceed held_out, got {self.data.queries}")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "TrainingSettings":
        """From a TOML file of kind "conditioned".

        Raises:
            ValueError: naming the field that is wrong, missing or unknown.
            OSError: if the file cannot be read.
        """
        table = read_toml(path)
        if table.pop("kind", None) != KIND:
            raise ValueError(f"{path}: kind: must be {KIND!r}")
        return from_table(cls, table)


@dataclass
class TrainingState:
    """Where a run stands.

    Attributes:
        step: steps done.
        network, optimiser: as they are.
        curve: rows of (step, seconds, loss, direction, value; the last two held out).
        seconds: spent so far.
    """

    step: int
    network: ConditionedNetwork
    optimiser: torch.optim.Adam
    curve: list[tuple[float, ...]]
    seconds: float = 0.0


def loss_parts(
    network: ConditionedNetwork,
    data: FamilyTensors,
    rows: np.ndarray,
    mirrored: np.ndarray | None = None,
    create_graph: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean 1 - cos theta where V is smooth, and mean squared error of log V."""
    V, slopes = value_and_slopes(network, data.batch(rows, mirrored), create_graph)
    picked = torch.from_numpy(rows)
    wanted, smooth = data.slopes[picked], data.smooth[picked]
    cosine = torch.nn.functional.cosine_similarity(slopes, wanted, dim=1, eps=1e-6)
    direction = ((1 - cosine) * smooth).sum() / smooth.sum().clamp(min=1)
    gap = torch.log(V.clamp(min=1e-6)) - torch.log(data.values[picked].clamp(min=1e-6))
    value = torch.nn.functional.huber_loss(gap, torch.zeros_like(gap), delta=0.3)
    return direction, 2 * value


def start(settings: TrainingSettings, data: FamilyTensors) -> TrainingState:
    """A fresh run: seeded weights, features standardised by the data."""
    torch.manual_seed(settings.seed)
    network = ConditionedNetwork(settings.widths)
    with torch.no_grad():
        network.standardise(data.inputs.state, data.inputs.obstacle)
        network.heads.bias.fill_(-2.0)
    return TrainingState(0, network, torch.optim.Adam(network.parameters()), [])


def rate_at(settings: TrainingSettings, step: int) -> float:
    """The learning rate of a step."""
    if step < settings.warm_up:
        return settings.rate * (step + 1) / settings.warm_up
    share = (step - settings.warm_up) / max(1, settings.steps - settings.warm_up)
    return settings.rate * 0.5 * (1 + math.cos(math.pi * min(1.0, share)))


def train(
    settings: TrainingSettings,
    state: TrainingState,
    data: FamilyTensors,
    held_out: FamilyTensors,
    until: Callable[[TrainingState], bool] = lambda _: False,
    crew: Crew = ALONE,
) -> Iterator[TrainingState]:
    """Train on, yielding the state after every `checkpoint_steps` and at the end.

    Each step's samples depend on seed and step only, so a run that was stopped goes on to the same
    weights, and the processes of a crew need not tell one another what they draw.
    """
    begun = time.perf_counter() - state.seconds
    sums = np.zeros(2)
    since = 0
    while state.step < settings.steps and not until(state):
        rng = np.random.default_rng([settings.seed, 1, state.step])
        rows = rng.integers(data.size, size=settings.batch)
        mirrored = rng.random(settings.batch) < 0.5
        for group in state.optimiser.param_groups:
            group["lr"] = rate_at(settings, state.step)
        mine = crew.part()
        direction, value = loss_parts(state.network, data, rows[mine], mirrored[mine])
        # Means over this process's part, weighted so that they add up to the batch's.
        smooth = data.smooth[torch.from_numpy(rows)]
        parts = torch.stack(
            [
                direction * (smooth[mine].sum() / smooth.sum().clamp(min=1)),
                value * (len(rows[mine]) / len(rows)),
            ]
        )
        state.optimiser.zero_grad(set_to_none=True)
        (parts[0] + settings.value_weight * parts[1]).backward()
        crew.sum_gradients(state.network)
        torch.nn.utils.clip_grad_norm_(state.network.parameters(), 1.0)
        state.optimiser.step()
        state.step += 1
        sums += crew.summed(parts.detach()).numpy()
        since += 1
        if state.step % settings.checkpoint_steps == 0 or state.step == settings.steps:
            state.seconds = time.perf_counter() - begun
            rows = np.arange(min(held_out.size, 20_000))
            out_direction, out_value = loss_parts(state.network, held_out, rows, create_graph=False)
            means = sums / since
            state.curve.append(
                (state.step, state.seconds, *means.tolist(), out_direction.item(), out_value.item())
            )
            sums[:], since = 0.0, 0
            yield state


def save(path: Path, settings: TrainingSettings, state: TrainingState) -> None:
    """Everything that a run needs to go on, written whole or not at all."""
    record = {
        "step": state.step,
        "network": state.network.state_dict(),
        "optimiser": state.optimiser.state_dict(),
        "curve": state.curve,
        "seconds": state.seconds,
    }
    save_checkpoint(path, settings, record)


def restored(path: Path, settings: TrainingSettings) -> TrainingState:
    """The state that `save` wrote.

    Raises:
        ValueError: if it belongs to other settings.
    """
    record = load_checkpoint(path, settings)
    network = ConditionedNetwork(settings.widths)
    network.load_state_dict(record["network"])
    optimiser = torch.optim.Adam(network.parameters())
    optimiser.load_state_dict(record["optimiser"])
    return TrainingState(record["step"], network, optimiser, record["curve"], record["seconds"])
