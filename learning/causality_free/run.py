"""A training run in a folder: checkpoints, curve, weights and their provenance.

The folder holds `checkpoint.pt` (motions included: to go on from, to the bit), `curve.json`, and at
the end `weights.safetensors` with `weights.toml`.
"""

import hashlib
import json
import logging
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
import tomli_w
import torch

from learning.causality_free import training
from learning.causality_free.families import get_family
from learning.causality_free.pretrained import Pretrained
from learning.causality_free.samples import POINTS, Samples
from learning.causality_free.training import GatherTask, TrainingSettings, TrainingState
from learning.shipped import file_hash
from ocp.execution import Door, completed
from ocp.files import write_text
from ocp.version import code_version

log = logging.getLogger(__name__)

CURVE = ("step", "seconds", "loss", "held-out excess", "its median", "held-out value")


def gather_through(door: Door) -> training.Gatherer:
    """Motions gathered through a door: here, in processes, or on a cluster."""

    def gatherer(tasks: list[GatherTask]) -> list[Samples]:
        found: dict[int, Samples] = {}
        for outcome in completed(door, training.gather, tasks):
            if outcome.failure is not None:
                raise RuntimeError(f"query {outcome.index}: {outcome.failure.message}")
            found[outcome.index] = outcome.answer
        solved = sum(len(s) for s in found.values()) // POINTS
        asked = sum(task.count for task in tasks)
        log.info("round %d: %d of %d motions solved", tasks[0].round, solved, asked)
        return [found[k] for k in range(len(tasks))]

    return gatherer


def run(settings: TrainingSettings, folder: Path, door: Door, command: str) -> Path:
    """Train to the end, from the checkpoint in the folder if there is one.

    Returns:
        The weights' path; `weights.toml` beside it says where they come from.

    Raises:
        ValueError: if the folder's checkpoint belongs to other settings.
        RuntimeError: if a query's motions could not be gathered.
    """
    torch.set_num_threads(1)  # its matrices are too small for more to pay
    checkpoint = folder / "checkpoint.pt"
    if checkpoint.exists():
        state = training.restored(checkpoint, settings)
    else:
        state = training.start(settings)
    for state in training.train(settings, state, gather_through(door)):  # noqa: B020
        training.save(checkpoint, settings, state)
        write_text(folder / "curve.json", json.dumps({"columns": CURVE, "rows": state.curve}))
        step, seconds, wrong, excess, median, value = state.curve[-1]
        log.info(
            "step %d of %d (%.0f s): loss %.2e; held out: excess %.2e (median %.1e), value %.2e",
            *(step, settings.total_steps, seconds, wrong, excess, median, value),
        )
    path = folder / "weights.safetensors"
    family = get_family(settings.family)
    known = range(settings.queries - settings.held_out)
    queries = [training.family_query(family, settings.seed, k) for k in known]
    for tensor in state.weights.trained:
        tensor.requires_grad_(False)
    Pretrained.of(family, state.weights, queries).save(path)
    provenance = {
        "command": command,
        "weights_sha256": file_hash(path),
        "data_sha256": digest(state),
        "motions": sum(len(s) for samples in state.rounds for s in samples) // POINTS,
        "code_of_ocp": code_version(),
        "code_of_learning": _own_version(),
        "settings": asdict(settings),
        "held_out": dict(zip(CURVE, state.curve[-1], strict=True)),
    }
    write_text(path.with_suffix(".toml"), tomli_w.dumps(provenance))
    return path


def digest(state: TrainingState) -> str:
    """SHA-256 of all samples."""
    found = hashlib.sha256()
    for samples in state.rounds:
        for s in samples:
            for f in fields(Samples):
                found.update(np.ascontiguousarray(getattr(s, f.name)).tobytes())
    return found.hexdigest()


def _own_version() -> str:
    """Digest of the modules that make these weights."""
    here = Path(__file__).parent
    names = ("exact", "families", "loss", "network", "residual", "samples", "training", "value")
    text = b"".join((here / f"{name}.py").read_bytes() for name in names)
    return hashlib.sha256(text).hexdigest()[:16]
