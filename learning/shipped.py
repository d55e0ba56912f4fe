"""Where the package keeps what it ships: trained weights and the configurations that make them."""

from pathlib import Path

PRETRAINED = Path(__file__).parent / "pretrained"
CONFIGS = Path(__file__).parent / "configs"
