"""An exported policy, compiled by the system's C compiler and called through ctypes."""

import ctypes
import shutil
import subprocess
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from ocp.export import ExportedC

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler: none is on PATH")

WARNINGS = ["-Wall", "-Wextra", "-pedantic", "-Werror", "-Wno-unused"]


def compiled_policy(exported: ExportedC) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """From states `[k, n]` to inputs `[k, m]`."""
    assert COMPILER is not None
    library = exported.source.with_suffix(".so")
    command = [COMPILER, "-std=c99", "-O1", *WARNINGS, "-shared", "-fPIC", str(exported.source)]
    done = subprocess.run([*command, "-o", str(library), "-lm"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[:2000]
    function = getattr(ctypes.CDLL(str(library)), f"{exported.source.stem}_input")
    numbers = ctypes.POINTER(ctypes.c_double)
    function.argtypes, function.restype = [numbers, numbers], None

    def inputs(states: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = np.ascontiguousarray(states, dtype=float)
        out = np.full((len(rows), exported.inputs), np.nan)
        for row, u in zip(rows, out, strict=True):
            function(row.ctypes.data_as(numbers), u.ctypes.data_as(numbers))
        return out

    return inputs
