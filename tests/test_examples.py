"""The worked examples run, stay short, and do what they say."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.mark.notebook
def test_bring_your_own_robot_swings_it_up_in_drake() -> None:
    path = EXAMPLES / "bring_your_own_robot.py"
    assert len(path.read_text().splitlines()) < 40
    run = subprocess.run([sys.executable, path], capture_output=True, text=True, check=True)
    numbers = re.findall(r"-?\d+\.\d*", run.stdout.split("after 6 s:")[1])
    end = np.array([float(x) for x in numbers])
    np.testing.assert_allclose(np.abs(end), [0.0, np.pi, 0.0, 0.0], atol=0.01)


@pytest.mark.notebook
def test_a_cost_of_ones_own_is_planned_within_a_third_of_a_per_cent() -> None:
    path = EXAMPLES / "own_cost.py"
    run = subprocess.run([sys.executable, path], capture_output=True, text=True, check=True)
    found, exact = (float(x) for x in re.findall(r"\d+\.\d+", run.stdout))
    assert -1e-4 < found / exact - 1 < 3e-3
