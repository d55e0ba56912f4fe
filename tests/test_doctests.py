"""The examples in docstrings run and give what they say.

Only modules that hold an example are imported, so that the rest costs nothing.
"""

import doctest
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("ocp", "learning", "planners", "sims")
MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for room in ROOMS
    for path in (ROOT / room).rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
CENTRAL = {
    "learning.meta_planner",
    "learning.q_learning.learner",
    "ocp.eikonal",
    "ocp.oracle",
    "ocp.pontryagin",
    "ocp.query",
    "ocp.riccati",
    "planners.rrtx",
    "sims.closed_loop",
}


@pytest.mark.parametrize("module", MODULES)
def test_examples_give_what_they_say(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0


def test_the_central_modules_have_one() -> None:
    assert set(MODULES) >= CENTRAL
