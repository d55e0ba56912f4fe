"""Algorithm 1 of Xu and Zhu: meta value learning.

The meta parameter theta minimises the loss after one gradient step on K samples of a query, eq.
(14). Its gradient (16) is

    mean over queries of (I - alpha H_i) g_i,   H_i = Hessian of L(theta, D_i^1),
                                                g_i = gradient of L(theta_i, D_i^2),

where (I - alpha H) g is a vector-Jacobian product of the step itself: H is symmetric and is never
formed. With more steps the products are chained from the last step to the first.
"""

import json
import logging
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import vjp

from learning.faithful.config import Config
from learning.faithful.data import training_table
from learning.faithful.losses import Lagrangian, Samples, lagrangian_gradient
from learning.faithful.meta_data import FeatureMap, QueryTable
from learning.faithful.value_network import Architecture, Parameters, expanded
from learning.weights import checked_shapes, load_tensors, save_tensors
from ocp.system import System

log = logging.getLogger(__name__)

CHUNK = 2
"""Queries computed at once: as many as keep the layers of a network in the processor's cache."""
SAVE_EVERY = 100
MINIBATCH_STREAM = 2
CHECKPOINT, WEIGHTS = "checkpoint.safetensors", "weights.safetensors"
CURVE_COLUMNS = ("loss_before", "loss_after", "value_after", "control_after")


@dataclass(frozen=True)
class MetaGradient:
    """The gradient (16) over a minibatch.

    Attributes:
        gradient: like the meta parameter.
        losses: `[4]`, means over the queries (`CURVE_COLUMNS`): the Lagrangian of D^1 before the
            inner step, and of D^2 after it with its two terms.
    """

    gradient: Parameters
    losses: Tensor


def inner_steps(
    parameters: Parameters, samples: Samples, form: Lagrangian, rate: float, steps: int
) -> Parameters:
    """Eq. (15): `steps` gradient steps of networks `[q, ...]` on their samples."""
    for _ in range(steps):
        gradient = lagrangian_gradient(parameters, samples, form).gradient
        parameters = tuple(p - rate * g for p, g in zip(parameters, gradient, strict=True))
    return parameters


def meta_gradient(
    parameters: Parameters,
    inner: Samples,
    outer: Samples,
    form: Lagrangian,
    rate: float,
    steps: int = 1,
    second_order: bool = True,
) -> MetaGradient:
    """The gradient of the mean loss after the inner steps.

    Args:
        parameters: theta, without leading axes.
        inner, outer: D^1 and D^2 with a leading axis `q` of queries.
        form: of the loss.
        rate, steps: alpha, and the number of inner steps.
        second_order: if not, the Hessians are left out.
    """
    count = inner.values.shape[0]
    total: list[Tensor] = [torch.zeros_like(p) for p in parameters]
    losses = torch.zeros(len(CURVE_COLUMNS), dtype=parameters[0].dtype)
    for first in range(0, count, CHUNK):
        rows = slice(first, min(first + CHUNK, count))
        part = _chunk_gradient(
            parameters, _rows(inner, rows), _rows(outer, rows), form, rate, steps, second_order
        )
        for sum_, gradient in zip(total, part.gradient, strict=True):
            sum_ += gradient
        losses += part.losses
    return MetaGradient(tuple(t / count for t in total), losses / count)


def _chunk_gradient(
    parameters: Parameters,
    inner: Samples,
    outer: Samples,
    form: Lagrangian,
    rate: float,
    steps: int,
    second_order: bool,
) -> MetaGradient:
    """Sums, not means, over a few queries."""
    fast = expanded(parameters, inner.values.shape[0])
    pulls = []
    before = None

    def gradient(theta: Parameters) -> tuple[Parameters, Tensor]:
        outcome = lagrangian_gradient(theta, inner, form)
        return outcome.gradient, (outcome.value + form.multiplier * outcome.control).detach()

    for _ in range(steps):
        if second_order:
            found: tuple[Any, Any, Any] = vjp(gradient, fast, has_aux=True)  # pyright: ignore[reportAssignmentType]
            direction, pull, loss = found
            pulls.append(pull)
        else:
            direction, loss = gradient(fast)
        before = loss if before is None else before
        fast = tuple(p - rate * d for p, d in zip(fast, direction, strict=True))
    outcome = lagrangian_gradient(fast, outer, form)
    adjoint = outcome.gradient
    for pull in reversed(pulls):
        bent = pull(adjoint)[0]
        adjoint = tuple(a - rate * b for a, b in zip(adjoint, bent, strict=True))
    after = outcome.value + form.multiplier * outcome.control
    losses = torch.stack(
        [
            (after if before is None else before).sum(),
            after.sum(),
            outcome.value.sum(),
            outcome.control.sum(),
        ]
    )
    return MetaGradient(tuple(a.sum(0) for a in adjoint), losses)


def _rows(samples: Samples, rows: slice) -> Samples:
    """Samples of some of the queries."""
    fields = {name: getattr(samples, name)[rows] for name in Samples.__dataclass_fields__}
    return Samples(**(fields | {"rates": samples.rates}))


class MetaTraining:
    """Algorithm 1 as a state that is stepped, stored and resumed.

    A resumed run goes on bit for bit like one that was never interrupted.
    """

    def __init__(self, config: Config, table: QueryTable | None = None) -> None:
        self.config = config
        self.table = table or training_table(config)
        self.architecture = architecture(config)
        generator = torch.Generator().manual_seed(config.seed)
        self.parameters: Parameters = tuple(
            p.requires_grad_() for p in self.architecture.initial_parameters(generator)
        )
        self.rng = np.random.default_rng([config.seed, MINIBATCH_STREAM])
        self.optimizer = torch.optim.Adam(self.parameters, lr=config.meta.outer_rate)
        self.curve: list[list[float]] = []

    @property
    def iteration(self) -> int:
        """Meta-iterations done."""
        return len(self.curve)

    def step(self) -> None:
        """One meta-iteration, lines 7 to 13.

        Raises:
            FloatingPointError: if the loss is not finite any more.
        """
        meta = self.config.meta
        inner, outer = self.table.draw(self.rng, meta.batch, (meta.shots, meta.outer_shots))
        found = meta_gradient(
            tuple(p.detach() for p in self.parameters),
            inner,
            outer,
            self.config.lagrangian,
            meta.inner_rate,
            meta.inner_steps,
            meta.second_order,
        )
        if not torch.isfinite(found.losses).all():
            raise FloatingPointError(
                f"meta-iteration {self.iteration + 1}: the loss is not finite; lower "
                f"meta.inner_rate ({meta.inner_rate:g}) or meta.outer_rate ({meta.outer_rate:g})"
            )
        for p, g in zip(self.parameters, found.gradient, strict=True):
            p.grad = g
        progress = self.iteration / meta.iterations
        fall = meta.final_rate + (1 - meta.final_rate) * (1 + math.cos(math.pi * progress)) / 2
        self.optimizer.param_groups[0]["lr"] = meta.outer_rate * fall
        self.optimizer.step()
        self.curve.append(found.losses.tolist())

    # Storage

    def save(self, path: Path) -> None:
        """Everything that the next step depends on, atomically."""
        tensors = {f"parameter.{i}": p for i, p in enumerate(self.parameters)}
        for i, p in enumerate(self.parameters):
            for name, moment in self.optimizer.state[p].items():
                tensors[f"{name}.{i}"] = moment
        tensors["curve"] = torch.tensor(self.curve, dtype=torch.float64).reshape(
            -1, len(CURVE_COLUMNS)
        )
        record = {
            "config": self.config.table(),
            "data": self.table.digest,
            "generator": self.rng.bit_generator.state,
        }
        save_tensors(path, tensors, record)

    def restore(self, path: Path) -> None:
        """Go on from a stored state.

        Raises:
            ValueError: if it is damaged, or belongs to another configuration or other data.
        """
        tensors, record = load_tensors(path)
        if _resumable(record.get("config", {})) != _resumable(self.config.table()):
            raise ValueError(
                f"{path}: belongs to another configuration; choose another --out, or remove it"
            )
        if record.get("data") != self.table.digest:
            raise ValueError(f"{path}: was made with other data; choose another --out")
        names = [f"parameter.{i}" for i in range(len(self.parameters))]
        stored = checked_shapes(tensors, names, self.architecture.shapes, path)
        with torch.no_grad():
            for p, value in zip(self.parameters, stored, strict=True):
                p.copy_(value)
        for i, p in enumerate(self.parameters):
            self.optimizer.state[p] = {
                name: tensors[f"{name}.{i}"] for name in ("step", "exp_avg", "exp_avg_sq")
            }
        self.curve = tensors["curve"].tolist()
        self.rng.bit_generator.state = record["generator"]


def _resumable(table: dict[str, Any]) -> dict[str, Any]:
    """A configuration without what may change from one part of a run to the next."""
    table = json.loads(json.dumps(table))
    table.pop("adaptation", None)
    meta = table.get("meta", {})
    if meta.get("final_rate") == 1.0:
        meta.pop("iterations", None)  # nothing but the end depends on it
    return table


def architecture(config: Config) -> Architecture:
    """The network that a configuration describes."""
    inputs = FeatureMap(robot(config)).count
    return Architecture(inputs, config.network.hidden, config.network.activation)


def robot(config: Config) -> System:
    """The robot of a configuration's family."""
    return config.data.distribution.sample(np.random.default_rng(0)).system


def train(
    config: Config | str | os.PathLike[str], out: str | os.PathLike[str], resume: bool = True
) -> Path:
    """Run Algorithm 1; the path of the weights.

    Progress is logged; every `SAVE_EVERY` meta-iterations the state is stored in `out`, from which
    the next call goes on if `resume`. `out` then also holds the curve, as JSON.

    Raises:
        ValueError: if the configuration is bad, or what `out` holds does not belong to it.
        FloatingPointError: if training diverges.
    """
    if not isinstance(config, Config):
        config = Config.load(config)
    folder = Path(out)
    training = MetaTraining(config)
    checkpoint = folder / CHECKPOINT
    if resume and checkpoint.exists():
        training.restore(checkpoint)
        log.info("going on from meta-iteration %d", training.iteration)
    began, first = time.perf_counter(), training.iteration
    while training.iteration < config.meta.iterations:
        training.step()
        done = training.iteration
        if done % SAVE_EVERY == 0 or done == config.meta.iterations:
            training.save(checkpoint)
            recent = np.mean(training.curve[-SAVE_EVERY:], axis=0)
            pace = (time.perf_counter() - began) / (done - first)
            log.info(
                "meta-iteration %d of %d: loss %.4g before, %.4g after the inner step; "
                "%.2f s each, %.0f min left",
                done,
                config.meta.iterations,
                recent[0],
                recent[1],
                pace,
                pace * (config.meta.iterations - done) / 60,
            )
    path = folder / WEIGHTS
    save_weights(path, training)
    (folder / "curve.json").write_text(
        json.dumps({"columns": CURVE_COLUMNS, "rows": training.curve}) + "\n", encoding="utf-8"
    )
    return path


def save_weights(path: Path, training: MetaTraining) -> None:
    """The meta parameter with what it was made by."""
    record = {
        "config": training.config.table(),
        "data": training.table.digest,
        "iterations": training.iteration,
    }
    save_tensors(path, {f"parameter.{i}": p for i, p in enumerate(training.parameters)}, record)


@dataclass(frozen=True)
class MetaWeights:
    """A trained meta parameter.

    Attributes:
        config: that it was trained with.
        parameters: theta_meta.
        iterations: done.
    """

    config: Config
    parameters: Parameters
    iterations: int

    @property
    def robot(self) -> System:
        return robot(self.config)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "MetaWeights":
        """From a weights file or a checkpoint.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is damaged or incomplete.
        """
        tensors, record = load_tensors(path)
        if "config" not in record:
            raise ValueError(f"{path}: says no configuration")
        config = Config.from_table(record["config"])
        shapes = architecture(config).shapes
        names = [f"parameter.{i}" for i in range(len(shapes))]
        parameters = checked_shapes(tensors, names, shapes, path)
        iterations = record.get("iterations", len(tensors.get("curve", ())))
        return cls(config, parameters, int(iterations))
