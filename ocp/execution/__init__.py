"""The one door for parallel work: in this process, in local processes, or on a Dask cluster.

Every door is a `concurrent.futures.Executor`, so `submit` and `map` are the ordinary ones.
`completed` is what long runs use: it yields outcomes as they come and survives workers that die.
Tasks and answers are plain data (text, numbers, numpy arrays), never pydrake or CasADi objects;
the function is one that a worker can import.
"""

from collections.abc import Callable, Sequence

from ocp.execution.cluster import Cluster
from ocp.execution.completion import Failure, Outcome, completed
from ocp.execution.doors import Door, InProcess
from ocp.execution.local_processes import LocalProcesses

__all__ = [
    "Cluster",
    "Door",
    "Failure",
    "InProcess",
    "LocalProcesses",
    "Outcome",
    "completed",
    "open_door",
]


def open_door(
    workers: int = 0,
    cluster: str | None = None,
    preload: Sequence[str] = (),
    initializer: Callable[[], object] | None = None,
) -> Door:
    """The executor for many-query work; a context manager.

    Args:
        workers: local processes; 0 works in this process.
        cluster: a Dask scheduler's address; then `workers` does not count.
        preload: modules that local workers import before they take work.
        initializer: called in each local worker after that.

    Raises:
        ValueError: if `workers` is negative, or the cluster runs another version.
        ConnectionError: if the cluster cannot be reached.
    """
    if workers < 0:
        raise ValueError(f"workers: must not be negative, got {workers}")
    if cluster is not None:
        return Cluster(cluster)
    return LocalProcesses(workers, preload, initializer) if workers else InProcess()
