"""numba compilation that says when it compiles, and where compiled code is kept.

Solvers take a robot's kernels as typed function pointers (`KERNEL`, ...), so a solver is compiled
once on a machine, whatever the robot. numba's disk cache does not see edits in *imported* modules:
functions that call one another directly therefore share a file.
"""

import hashlib
import inspect
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import platformdirs
from numba import float64, njit, types

log = logging.getLogger(__name__)

VECTOR = float64[::1]
MATRIX = float64[:, ::1]


def cache_folder() -> Path:
    """Where generated and compiled code is kept: `ZERMELO_CACHE`, or the user's cache folder."""
    chosen = os.environ.get("ZERMELO_CACHE")
    return Path(chosen) if chosen else platformdirs.user_cache_path("zermelo")


def compiled(signature: Any, source_key: str | None = None) -> Callable[[Callable], Any]:
    """Decorator: compile now for `signature`, through numba's disk cache.

    What is compiled releases the interpreter while it runs: it touches arrays alone, so threads may
    run it side by side.

    The first compilation on a machine is announced by a log record of level INFO.
    """

    def decorate(function: Callable) -> Any:
        key = source_key or hashlib.sha256(_file_of(function).read_bytes()).hexdigest()[:16]
        name = f"{function.__module__}.{function.__qualname__}"
        marker = cache_folder() / "compiled" / f"{name}-{key}-{numba.__version__}"
        if not marker.exists():
            log.info("compiling %s (once on this machine)", name)
        dispatcher = njit(signature, cache=True, error_model="numpy", nogil=True)(function)
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()
        return dispatcher

    return decorate


def _file_of(function: Callable) -> Path:
    return Path(inspect.getfile(function))


# The types of the generated kernels (see kernels.py)
KERNEL = types.FunctionType(types.void(VECTOR, VECTOR, VECTOR))
KERNEL_WITH_JACOBIAN = types.FunctionType(types.void(VECTOR, VECTOR, VECTOR, MATRIX))
SCALAR = types.FunctionType(float64(VECTOR, VECTOR))
