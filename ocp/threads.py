"""Threads: one a library unless the user says otherwise, and a few of our own, always warm.

The matrices here are small and one query occupies one core. A pool of threads a product costs more
than it saves, and ten times more where a neighbour keeps the other core busy.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import TIMEOUT_MAX
from typing import TypeVar

Answer = TypeVar("Answer")

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


@cache
def _steps() -> ThreadPoolExecutor:
    """Threads of their own for `in_time`: its work may wait for that of `warm_workers`."""
    return ThreadPoolExecutor(8, thread_name_prefix="zermelo-step")


def in_time(work: Callable[[], Answer], seconds: float) -> Answer | None:
    """The answer of `work`; `None` if it is not there after `seconds`.

    Work that is late goes on unheeded: it must change nothing but its answer.
    """
    future = _steps().submit(work)
    try:
        return future.result(min(max(0.0, seconds), TIMEOUT_MAX))
    except TimeoutError:
        if future.done():  # it ended in this very moment, or with a TimeoutError of its own
            return future.result()
        future.cancel()
        return None
