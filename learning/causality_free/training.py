"""Training on exact motions, rounds of which go where the network's own residual is largest.

Round 0 starts motions at random; before every later round the network's Hamilton-Jacobi residual
picks half of the new starts among many candidates, and its closed loops are the first guesses.
(Adaptive sampling and costate supervision: Nakamura-Zimmerer, Gong and Kang, "Adaptive deep
learning for high-dimensional Hamilton-Jacobi-Bellman equations", SIAM J. Sci. Comput. 2021.)
Seeded, and resumable to the bit: samples of a step depend on seed and step alone.
"""

import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.causality_free.exact import exact_trajectories
from learning.causality_free.families import RegulationFamily, context, get_family
from learning.causality_free.loss import LossWeights, errors, loss
from learning.causality_free.network import Weights, fresh_weights
from learning.causality_free.residual import largest
from learning.causality_free.samples import Samples, batch_of, resting_inputs
from learning.causality_free.value import NetworkValue, embed
from learning.checkpoint import load_checkpoint, save_checkpoint
from learning.settings import from_table
from ocp.query import Query
from ocp.query_file import read_toml
from ocp.regulation import RegulatorValue

KIND = "causality-free"
CANDIDATES = 32  # states held against the residual for each start that it picks
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingSettings:
    """Everything that a run depends on.

    Attributes:
        family: its name.
        seed: of queries, starts, weights and batches.
        queries: in all.
        held_out: of these, the last ones, never trained on.
        motions: asked for from each query, round by round.
        steps: of Adam, round by round.
        widths: of the hidden layers.
        batch: samples a step.
        rate: the largest learning rate; a linear rise over `warm_up` steps, then a cosine to 0.
        warm_up: steps.
        loss: weights of the loss's parts.
        checkpoint_steps: between checkpoints.
    """

    family: str
    seed: int = 0
    queries: int = 80
    held_out: int = 10
    motions: tuple[int, ...] = (24, 8, 8)
    steps: tuple[int, ...] = (4000, 4000, 8000)
    widths: tuple[int, ...] = (64, 64, 64)
    batch: int = 512
    rate: float = 3e-3
    warm_up: int = 300
    loss: LossWeights = field(default_factory=LossWeights)
    checkpoint_steps: int = 1000

    def __post_init__(self) -> None:
        get_family(self.family)
        for name in ("held_out", "batch", "warm_up", "checkpoint_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        for name in ("motions", "steps", "widths"):
            numbers = getattr(self, name)
            if not numbers or min(numbers) < 1:
                raise ValueError(f"{name}: needs numbers of at least 1, got {list(numbers)}")
        if len(self.motions) != len(self.steps):
            raise ValueError(
                f"steps: needs as many rounds as motions, got {len(self.steps)} and "
                f"{len(self.motions)}"
            )
        if not 0 < self.rate < math.inf:
            raise ValueError(f"rate: must be a positive finite number, got {self.rate}")
        if self.queries <= self.held_out:
            raise ValueError(f"queries: must exceed held_out, got {self.queries}")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "TrainingSettings":
        """From a TOML file of kind "causality-free".

        Raises:
            ValueError: naming the field that is wrong, missing or unknown.
            OSError: if the file cannot be read.
        """
        table = read_toml(path)
        if table.pop("kind", None) != KIND:
            raise ValueError(f"{path}: kind: must be {KIND!r}")
        return from_table(cls, table)

    @property
    def total_steps(self) -> int:
        """Of all rounds."""
        return sum(self.steps)


@dataclass(frozen=True)
class GatherTask:
    """Exact motions of one query, for one round: plain data, for a worker.

    Attributes:
        family, seed, query: which one.
        round: from 0.
        count: of motions asked for.
        weights: of the network so far, by name; `None` before it is trained.
    """

    family: str
    seed: int
    query: int
    round: int
    count: int
    weights: dict[str, Floats] | None


def family_query(family: RegulationFamily, seed: int, number: int) -> Query:
    """The family's query of that number under that seed."""
    return family.sample(np.random.default_rng([seed, number]))


def gather(task: GatherTask) -> Samples:
    """Solve a task; starts from which no exact motion was found are left out."""
    family = get_family(task.family)
    query = family_query(family, task.seed, task.query)
    rng = np.random.default_rng([task.seed, task.query, 1 + task.round])
    regulator_value = RegulatorValue(query)
    if task.weights is None:
        starts, values = family.starts(query, task.count, rng), [regulator_value]
    else:
        weights = Weights.of({name: torch.from_numpy(w) for name, w in task.weights.items()})
        value = NetworkValue(query, weights, np.array(family.reach))
        picked = task.count // 2
        candidates = family.starts(query, CANDIDATES * max(picked, 1), rng)
        starts = np.concatenate(
            [
                largest(query, value, candidates, picked),
                family.starts(query, task.count - picked, rng),
            ]
        )
        values = [value, regulator_value]
    found = exact_trajectories(query, values, starts)
    return Samples.of(query, [optimum for optimum in found if optimum is not None])


def gather_tasks(settings: TrainingSettings, number: int, weights: Weights) -> list[GatherTask]:
    """The tasks of a round: every query; the held-out ones in round 0 alone."""
    known = None
    if number > 0:
        known = {name: t.detach().numpy().copy() for name, t in weights.tensors().items()}
    count = settings.queries if number == 0 else settings.queries - settings.held_out
    family, seed, motions = settings.family, settings.seed, settings.motions[number]
    return [GatherTask(family, seed, k, number, motions, known) for k in range(count)]


@dataclass
class TrainingState:
    """Where a run stands.

    Attributes:
        step: steps done.
        weights, optimiser: as they are.
        rounds: the samples of every round so far, one an asked query.
        curve: rows of (step, seconds, loss, then of the held-out queries: mean excess, its median,
            mean |error of log V|).
        seconds: spent in steps so far.
    """

    step: int
    weights: Weights
    optimiser: torch.optim.Adam
    rounds: list[list[Samples]]
    curve: list[tuple[float, ...]]
    seconds: float = 0.0


Gatherer = Callable[[list[GatherTask]], list[Samples]]


def gather_here(tasks: list[GatherTask]) -> list[Samples]:
    """All tasks in this process."""
    return [gather(task) for task in tasks]


def start(settings: TrainingSettings) -> TrainingState:
    """A fresh run: seeded weights, contexts standardised by the queries trained on."""
    family = get_family(settings.family)
    known = settings.queries - settings.held_out
    contexts = [context(family_query(family, settings.seed, k)) for k in range(known)]
    query = family_query(family, settings.seed, 0)
    rest, _ = embed(query, np.zeros((1, query.system.n)), np.array(family.reach))
    weights = fresh_weights(
        rest.shape[1] + len(contexts[0]),
        settings.widths,
        torch.from_numpy(np.array(contexts)),
        torch.Generator().manual_seed(settings.seed),
    )
    return TrainingState(0, weights, _optimiser(weights), [], [])


def _optimiser(weights: Weights) -> torch.optim.Adam:
    for tensor in weights.trained:
        tensor.requires_grad_(True)
    return torch.optim.Adam(weights.trained)


def rate_at(settings: TrainingSettings, step: int) -> float:
    """The learning rate of a step."""
    rise = min(1.0, (step + 1) / settings.warm_up)
    return settings.rate * rise * 0.5 * (1 + math.cos(math.pi * step / settings.total_steps))


def train(
    settings: TrainingSettings, state: TrainingState, gatherer: Gatherer = gather_here
) -> Iterator[TrainingState]:
    """Train on, yielding the state after every `checkpoint_steps` and at the end.

    A round's motions are gathered when its first step is due, by `gatherer`.
    """
    family = get_family(settings.family)
    known = settings.queries - settings.held_out
    queries = [family_query(family, settings.seed, k) for k in range(settings.queries)]
    scale = torch.from_numpy(np.array(family.reach))
    resting = resting_inputs(family, state.weights, queries)
    ends = np.cumsum(settings.steps)
    while state.step < settings.total_steps:
        number = int(np.searchsorted(ends, state.step, side="right"))
        while len(state.rounds) <= number:
            tasks = gather_tasks(settings, len(state.rounds), state.weights)
            state.rounds.append(gatherer(tasks))
        joined = [Samples.joined([r[k] for r in state.rounds]) for k in range(known)]
        data = batch_of(family, state.weights, queries[:known], joined, images=True)
        held_out = state.rounds[0][known:]
        unseen = batch_of(family, state.weights, queries[known:], held_out, images=False)
        total, since = 0.0, 0
        begun = time.perf_counter() - state.seconds
        while state.step < ends[number]:
            rng = np.random.default_rng([settings.seed, 1 << 20, state.step])
            rows = torch.from_numpy(rng.integers(len(data), size=settings.batch))
            for group in state.optimiser.param_groups:
                group["lr"] = rate_at(settings, state.step)
            wrong = loss(state.weights, data.rows(rows), resting[:known], scale, settings.loss)
            state.optimiser.zero_grad(set_to_none=True)
            wrong.backward()
            state.optimiser.step()
            state.step += 1
            total, since = total + wrong.item(), since + 1
            if state.step % settings.checkpoint_steps == 0 or state.step == ends[number]:
                state.seconds = time.perf_counter() - begun
                excess, _, gap = _errors(state.weights, unseen, resting[known:], scale)
                figures = (excess.mean(), excess.median(), gap.abs().mean())
                state.curve.append(
                    (state.step, state.seconds, total / since, *(float(f) for f in figures))
                )
                total, since = 0.0, 0
                yield state


def _errors(weights: Weights, batch: Any, resting: Tensor, scale: Tensor) -> tuple[Tensor, ...]:
    with torch.no_grad():
        return errors(weights, batch, resting, scale)


def save(path: Path, settings: TrainingSettings, state: TrainingState) -> None:
    """Everything that a run needs to go on, written whole or not at all."""
    record = {
        "step": state.step,
        "weights": {n: t.detach() for n, t in state.weights.tensors().items()},
        "optimiser": state.optimiser.state_dict(),
        "rounds": [
            [[torch.from_numpy(getattr(s, f.name)) for f in fields(Samples)] for s in samples]
            for samples in state.rounds
        ],
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
    weights = Weights.of(record["weights"])
    optimiser = _optimiser(weights)
    optimiser.load_state_dict(record["optimiser"])
    rounds = [
        [Samples(*(t.numpy() for t in arrays)) for arrays in samples]
        for samples in record["rounds"]
    ]
    return TrainingState(
        record["step"], weights, optimiser, rounds, record["curve"], record["seconds"]
    )
