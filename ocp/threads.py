"""Threads: one a library unless the user says otherwise, and a few of our own, always warm.

The matrices here are small and one query occupies one core. A pool of threads a product costs more
than it saves, and ten times more where a neighbour keeps the other core busy.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache

THREAD_LIMITS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "DRAKE_NUM_THREADS",
)
"""Variables of the environment, read by each library when it is imported."""


def one_thread_by_default() -> None:
    """Limit every library to one thread where the environment does not say how many.

    To be called before anything numerical is imported.
    """
    for name in THREAD_LIMITS:
        os.environ.setdefault(name, "1")


def usable_cores() -> int:
    """How many cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def warm_workers() -> ThreadPoolExecutor:
    """Threads for compiled work beside the caller's: one for each further core, at least one."""
    return ThreadPoolExecutor(max(1, usable_cores() - 1), thread_name_prefix="zermelo")
