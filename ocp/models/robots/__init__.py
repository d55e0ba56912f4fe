"""Robots shipped as files: SDF and URDF, read by Drake."""

from pathlib import Path

_FILES = {path.stem: path for path in sorted(Path(__file__).parent.glob("*.*df"))}
ROBOTS = tuple(_FILES)
"""Their names."""


def robot_file(name: str) -> Path:
    """The file of a shipped robot.

    Raises:
        ValueError: if there is none; the message lists those that are.
    """
    if name not in _FILES:
        raise ValueError(f"robot: {name!r} is not shipped; known are {', '.join(ROBOTS)}")
    return _FILES[name]
