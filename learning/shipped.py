"""Where the package keeps what it ships: trained weights and the configurations that make them."""

import hashlib
from pathlib import Path

PRETRAINED = Path(__file__).parent / "pretrained"
CONFIGS = Path(__file__).parent / "configs"


def file_hash(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
