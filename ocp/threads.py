"""How many threads the libraries underneath may start: one, unless the user says otherwise.

The matrices here are small and one query occupies one core. A pool of threads a product costs more
than it saves, and ten times more where a neighbour keeps the other core busy.
"""

import os

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
