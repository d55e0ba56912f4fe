"""Network weights on disk: safetensors with a checksum, refused if anything does not fit."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from ocp.files import atomic_path

CHECKSUM = "sha256"


def save_tensors(
    path: str | os.PathLike[str], tensors: Mapping[str, Tensor], record: Mapping[str, Any]
) -> None:
    """Write tensors and a record (anything that JSON holds), whole or not at all."""
    contiguous = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
    text = json.dumps(record)
    header = {"record": text, CHECKSUM: _checksum(contiguous, text)}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(contiguous, header))


def load_tensors(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `save_tensors` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, or a number in it is not finite.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path}: is damaged or no safetensors file: {error}") from error
    text = header.get("record", "")
    if header.get(CHECKSUM) != _checksum(tensors, text):
        raise ValueError(f"{path}: is damaged: its checksum does not match its content")
    for name, tensor in tensors.items():
        if not torch.isfinite(tensor).all():
            raise ValueError(f"{path}: {name} holds a number that is not finite")
    return tensors, json.loads(text)


def checked_shapes(
    tensors: Mapping[str, Tensor], names: list[str], shapes: list[tuple[int, ...]], path: object
) -> tuple[Tensor, ...]:
    """The tensors called `names`, which must have `shapes`.

    Raises:
        ValueError: if one is missing or has another shape.
    """
    for name, shape in zip(names, shapes, strict=True):
        if name not in tensors:
            raise ValueError(f"{path}: {name} is missing")
        if tuple(tensors[name].shape) != shape:
            raise ValueError(
                f"{path}: {name} must have shape {shape}, got {tuple(tensors[name].shape)}"
            )
    return tuple(tensors[name] for name in names)


def _checksum(tensors: Mapping[str, Tensor], text: str) -> str:
    found = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()
