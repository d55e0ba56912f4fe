"""Checkpoints of training: tensors and plain numbers with the settings that they belong to."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from ocp.files import atomic_path


def save_checkpoint(path: Path, settings: Any, record: dict[str, Any]) -> None:
    """Write `record`, whole or not at all, with a run's settings (a dataclass)."""
    with atomic_path(path) as temporary:
        torch.save({"settings": asdict(settings), **record}, temporary)


def load_checkpoint(path: Path, settings: Any) -> dict[str, Any]:
    """The record of a run with these settings; nothing but tensors and plain data is read.

    Raises:
        ValueError: if it belongs to other settings.
    """
    record: dict[str, Any] = torch.load(path, weights_only=True)
    if record.pop("settings") != asdict(settings):
        raise ValueError(f"{path}: the checkpoint belongs to a run with other settings")
    return record
