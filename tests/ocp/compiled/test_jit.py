"""The disk cache of compiled kernels: reused when nothing changed, never stale."""

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import logging, sys
logging.basicConfig(level=logging.INFO, stream=sys.stderr)
import casadi as ca
from ocp.compiled.batch import rates
from ocp.query import Goal, Query
from ocp.system import Coordinate, Input, System

gain = float(sys.argv[1])
x = ca.SX.sym("x", 1)
system = System("edited", (Coordinate("x", "m", -5, 5),), (Input("u", "m/s"),),
                x, ca.SX.zeros(1, 1), ca.SX(gain), (0,))
print(rates(Query(system, Goal((0.0,), 0.5)), [0.0], [1.0])[0])
"""


def run(folder: Path, gain: float) -> tuple[float, bool]:
    """The rate that a fresh process computes, and whether it compiled the robot's kernels."""
    environment = os.environ | {"ZERMELO_CACHE": str(folder)}
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(gain)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return float(result.stdout), "compiling kernels_of_edited" in result.stderr


def test_an_edited_model_never_meets_a_stale_cache(tmp_path: Path) -> None:
    assert run(tmp_path, 1.0) == (1.0, True)
    assert run(tmp_path, 1.0) == (1.0, False)
    assert run(tmp_path, 2.0) == (2.0, True)
    assert run(tmp_path, 1.0) == (1.0, False)
