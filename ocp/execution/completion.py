"""Outcomes of many tasks as they come, through workers that die."""

import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import dataclass
from typing import Any

from ocp.execution.doors import Door, InProcess
from ocp.execution.local_processes import LocalProcesses

DEATHS = 2  # workers that a task may kill, alone, before it is given up
REOPENINGS = 5  # of a door in a row without a single answer


@dataclass(frozen=True)
class Failure:
    """Why a task gave no answer.

    Attributes:
        kind: the exception's name, or "WorkerDied".
        message: its text.
        trace: the traceback on the worker; empty where there is none.
    """

    kind: str
    message: str
    trace: str = ""


@dataclass(frozen=True)
class Outcome:
    """A finished task.

    Attributes:
        index: its place among the tasks, from 0.
        task: what was asked.
        answer: what the function returned; `None` if it failed.
        failure: why there is no answer, else `None`.
    """

    index: int
    task: Any
    answer: Any
    failure: Failure | None = None


def completed(
    door: Door, function: Callable[[Any], Any], tasks: Iterable[Any], ahead: int = 2
) -> Iterator[Outcome]:
    """Outcomes of `function(task)` as they finish, in any order, one for every task.

    Tasks are drawn as they are needed, so they may be many. A task whose worker died is tried
    again. When several were running, each is tried alone, so that the blame is certain and no
    other is lost with it; one that kills its worker `DEATHS` times alone fails as "WorkerDied",
    on a cluster as "KilledWorker" once the scheduler gives it up alone. So is one whose answer
    did not arrive: it fails only if it does not arrive alone either.
    Leaving the loop early cancels what has not begun.

    Args:
        door: where to work.
        function: importable by workers; its exceptions become failures.
        tasks: plain data.
        ahead: tasks handed over per worker, so that none waits for the next.

    Raises:
        RuntimeError: if the door breaks over and over without an answer.
        ConnectionError: if a cluster is lost and does not come back.
    """
    numbered = enumerate(tasks)
    suspects: deque[tuple[int, Any]] = deque()
    running: dict[Future, tuple[int, Any]] = {}
    deaths: dict[int, int] = {}
    tried_alone: set[int] = set()
    reopened = 0
    try:
        while True:
            room = 1 if suspects else ahead * door.capacity
            broken = False
            while len(running) < room:
                if suspects:
                    item = suspects.popleft()
                    if not running:
                        tried_alone.add(item[0])
                else:
                    item = next(numbered, None)
                if item is None:
                    break
                try:
                    running[door.submit(_attempt, function, item[1])] = item
                except Exception as error:
                    if not door.lost(error):
                        raise
                    suspects.appendleft(item)
                    broken = True
                    break
                if isinstance(door, InProcess) or suspects:
                    break
            if not running and not broken:
                return
            alone = len(running) == 1
            died: list[tuple[int, Any]] = []
            for future in wait(running, return_when=FIRST_COMPLETED).done if running else ():
                item = running.pop(future)
                error = CancelledError() if future.cancelled() else future.exception()
                if error is None:
                    reopened = 0
                    answer, failure = future.result()
                    yield Outcome(*item, answer, failure)
                elif door.lost(error):
                    died.append(item)
                elif item[0] not in tried_alone:
                    # Not of the task's making, whose own exceptions come as failures. A scheduler
                    # counts a worker's death against all tasks that the worker held, and a client
                    # may stumble over an answer that was lost with it.
                    suspects.append(item)
                else:
                    yield Outcome(*item, None, Failure(type(error).__name__, str(error)))
            if not (died or broken):
                continue
            died += running.values()  # they share its fate
            running.clear()
            reopened += 1
            if reopened > REOPENINGS and not alone:
                raise RuntimeError(f"the workers were lost {reopened} times without an answer")
            door.reopen()
            for index, task in sorted(died, key=lambda item: item[0]):
                if alone and isinstance(door, LocalProcesses):
                    deaths[index] = deaths.get(index, 0) + 1
                if deaths.get(index, 0) >= DEATHS:
                    reopened = 0
                    yield Outcome(index, task, None, Failure("WorkerDied", f"{DEATHS} times"))
                else:
                    suspects.append((index, task))
    finally:
        for future in running:
            future.cancel()


def _attempt(function: Callable[[Any], Any], task: Any) -> tuple[Any, Failure | None]:
    """Answer or failure as plain data: an exception that does not unpickle would break a pool."""
    try:
        return function(task), None
    except Exception as error:
        return None, Failure(type(error).__name__, str(error), traceback.format_exc())
