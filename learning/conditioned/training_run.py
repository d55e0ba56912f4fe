"""A training run in a folder: data, checkpoints, curve, weights and their provenance.

The folder holds `data.npz` (sampled once), `checkpoint.pt` (to go on from, to the bit),
`curve.json`, and at the end `weights.safetensors` with `weights.toml`.
"""

import hashlib
import json
import logging
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch

from learning.conditioned import training
from learning.conditioned.data_parallel import ALONE, Crew
from learning.conditioned.network_weights import NetworkWeights
from learning.conditioned.training import TrainingSettings, TrainingState
from learning.conditioned.training_data import family_tensors
from learning.conditioned.value_samples import SampleTask, ValueSamples, digest, sample_query
from learning.shipped import file_hash
from ocp.execution import Door, completed
from ocp.files import atomic_path, write_text
from ocp.query import Query
from ocp.query_file import query_from_dict
from ocp.version import code_version

log = logging.getLogger(__name__)

Samples = list[tuple[Query, ValueSamples]]
CURVE = ("step", "seconds", "direction", "value", "held-out direction", "held-out value")
UNMEASURED_NODES = 1_000
"""`worth_nodes` of a network until a benchmark has measured it: any grid is held to be better."""


def sampled(settings: TrainingSettings, folder: Path, door: Door) -> Samples:
    """The family's samples: from the folder if they are there, else made and kept there.

    Raises:
        RuntimeError: if a query could not be sampled.
    """
    key = _data_key(settings)
    path = folder / f"data-{key}.npz"
    if not path.exists():
        numbers = range(settings.data.queries)
        tasks = [SampleTask(settings.family, settings.data, settings.seed, k) for k in numbers]
        found: dict[int, Any] = {}
        for outcome in completed(door, sample_query, tasks):
            if outcome.failure is not None:
                raise RuntimeError(f"query {outcome.index}: {outcome.failure.message}")
            found[outcome.index] = outcome.answer
            if len(found) % 250 == 0:
                log.info("sampled %d of %d queries", len(found), len(tasks))
        _write(path, [found[k] for k in numbers])
    return _read(path)


def _data_key(settings: TrainingSettings) -> str:
    text = json.dumps([settings.family, asdict(settings.data), settings.seed])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _write(path: Path, samples: list[tuple[dict[str, Any], ValueSamples]]) -> None:
    arrays: dict[str, Any] = {
        f.name: np.concatenate([getattr(s, f.name) for _, s in samples])
        for f in fields(ValueSamples)
    }
    arrays["counts"] = np.array([len(s.values) for _, s in samples])
    arrays["queries"] = np.array(json.dumps([q for q, _ in samples]))
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def _read(path: Path) -> Samples:
    with np.load(path, allow_pickle=False) as file:
        ends = np.cumsum(file["counts"])[:-1]
        columns = [np.split(file[f.name], ends) for f in fields(ValueSamples)]
        queries = json.loads(str(file["queries"]))
    parts = zip(*columns, strict=True)
    return [(query_from_dict(q), ValueSamples(*p)) for q, p in zip(queries, parts, strict=True)]


def run(
    settings: TrainingSettings, folder: Path, door: Door, command: str, crew: Crew = ALONE
) -> Path:
    """Train to the end, from the checkpoint in the folder if there is one.

    Of a crew the leader samples and writes; all must see the same folder.

    Returns:
        The weights' path; `weights.toml` beside it says where they come from.

    Raises:
        ValueError: if the folder's checkpoint belongs to other settings.
        RuntimeError: if a query could not be sampled.
    """
    torch.set_num_threads(1)  # its matrices are too small for more to pay
    checkpoint = folder / "checkpoint.pt"
    resumed = training.restored(checkpoint, settings) if checkpoint.exists() else None
    if not crew.leads:
        crew.wait()
    samples = sampled(settings, folder, door)
    if crew.leads:
        crew.wait()
    known = family_tensors(samples[: -settings.held_out])
    held_out = family_tensors(samples[-settings.held_out :])
    state = resumed or training.start(settings, known)
    for state in training.train(settings, state, known, held_out, crew=crew):  # noqa: B020
        if not crew.leads:
            continue
        training.save(checkpoint, settings, state)
        write_curve(folder / "curve.json", state)
        step, seconds, direction, value, out_direction, out_value = state.curve[-1]
        left = seconds / step * (settings.steps - step)
        log.info(
            "step %d of %d: direction %.2e, value %.2e; held out %.2e, %.2e; %.0f min left",
            *(step, settings.steps, direction, value, out_direction, out_value, left / 60),
        )
    path = folder / "weights.safetensors"
    crew.wait()
    if not crew.leads:
        return path
    arrays = {name: tensor.numpy() for name, tensor in state.network.state_dict().items()}
    NetworkWeights(arrays).save(path)
    provenance = {
        "command": command,
        "weights_sha256": file_hash(path),
        "data_sha256": digest(samples),
        "code_of_ocp": code_version(),
        "code_of_learning": _own_version(),
        "processes": crew.size,
        "worth_nodes": UNMEASURED_NODES,
        "settings": asdict(settings),
        "held_out": dict(zip(CURVE, state.curve[-1], strict=True)),
    }
    write_text(path.with_suffix(".toml"), tomli_w.dumps(provenance))
    return path


def write_curve(path: Path, state: TrainingState) -> None:
    """The training curve as JSON."""
    write_text(path, json.dumps({"columns": CURVE, "rows": state.curve}) + "\n")


def _own_version() -> str:
    """Digest of the modules that make these weights."""
    here = Path(__file__).parent
    names = ("value_function", "query_encoder", "training", "training_data", "value_samples")
    text = b"".join((here / f"{name}.py").read_bytes() for name in names)
    return hashlib.sha256(text).hexdigest()[:16]
