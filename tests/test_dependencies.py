"""What is installed is what was pinned, nothing more is pulled in, and it fits together."""

import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

CONSTRAINTS = Path(__file__).parent.parent / "constraints.txt"


def pinned() -> dict[str, str]:
    lines = CONSTRAINTS.read_text(encoding="utf-8").splitlines()
    pins = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pins}


def needed(name: str, extras: frozenset[str], seen: dict[str, str]) -> None:
    """Collect what a distribution needs, directly or not, with its installed version."""
    try:
        found = distribution(name)
    except PackageNotFoundError:
        seen[canonicalize_name(name)] = "not installed"
        return
    for text in found.requires or []:
        requirement = Requirement(text)
        marker = requirement.marker
        if marker is not None and not any(marker.evaluate({"extra": e}) for e in extras | {""}):
            continue
        key = canonicalize_name(requirement.name)
        if key not in seen and key != "zermelo":
            try:
                seen[key] = distribution(requirement.name).version.partition("+")[0]
            except PackageNotFoundError:
                seen[key] = "not installed"
                continue
            needed(requirement.name, frozenset(requirement.extras), seen)


def test_everything_installed_is_pinned_to_its_version():
    seen: dict[str, str] = {}
    needed("zermelo", frozenset({"dev"}), seen)
    pins = pinned()
    assert len(seen) > 50
    assert {k: (v, pins.get(k)) for k, v in seen.items() if pins.get(k) != v} == {}


def test_pins_are_exact():
    for version in pinned().values():
        assert re.fullmatch(r"[0-9][0-9a-z.+]*", version), version


def test_what_is_installed_fits_together():
    answer = subprocess.run(
        [sys.executable, "-m", "pip", "check"], capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stdout
