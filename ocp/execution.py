"""The one door for parallel work: in this process, in local processes, or on a Dask cluster.

Every door is a `concurrent.futures.Executor`, so `submit` and `map` are the ordinary ones.
`completed` is what long runs use: it yields outcomes as they come and survives workers that die.
Tasks and answers are plain data (text, numbers, numpy arrays), never pydrake or CasADi objects;
the function is one that a worker can import.
"""

import importlib
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from ocp.threads import THREAD_LIMITS
from ocp.version import code_version

DEATHS = 2  # workers that a task may kill, alone, before it is given up
REOPENINGS = 5  # of a door in a row without a single answer
START_SECONDS = 120.0  # for workers to start and import


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


class Door(Executor):
    """An executor that says how much work it takes at a time and can be opened anew."""

    capacity: int
    """Workers: tasks that run at the same time."""

    def reopen(self) -> None:
        """Replace what is lost: dead workers, a broken connection."""

    def lost(self, error: BaseException) -> bool:
        """Whether `error` says that the task's worker or the connection died."""
        return isinstance(error, BrokenExecutor)

    def gave_up(self, error: BaseException) -> bool:
        """Whether workers died under the task so often that it was given up, guilty or not."""
        del error  # the task's own, where nobody counts deaths
        return False


class InProcess(Door):
    """Work done here and now, in the calling thread."""

    capacity = 1

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class LocalProcesses(Door):
    """Worker processes on this machine, started and warm when the constructor returns.

    They are forked from a clean server process where the system has one, else spawned: never from
    this process, whose threads a fork would break. They end with this process, however it ends.
    """

    def __init__(
        self,
        workers: int,
        preload: Sequence[str] = (),
        initializer: Callable[[], object] | None = None,
    ) -> None:
        """
        Args:
            workers: how many.
            preload: modules that workers import before they take work.
            initializer: called in each worker after that.

        Raises:
            ValueError: if `workers` is not positive.
            RuntimeError: if workers do not start, as when a module to preload is missing.
        """
        if workers < 1:
            raise ValueError(f"workers: must be at least 1, got {workers}")
        self.capacity = workers
        self._preload = tuple(preload)
        self._initializer = initializer
        self._open()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        return self._pool.submit(fn, *args, **kwargs)

    def reopen(self) -> None:
        self._close(now=True)
        self._open()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._pool.shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            self._leash.close()

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        """Wait for what was submitted; after an error or an interrupt, end the workers at once."""
        self._close(now=kind is not None)

    def _open(self) -> None:
        import multiprocessing

        methods = multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            context.set_forkserver_preload([__name__, *self._preload])
        held, self._leash = context.Pipe(duplex=False)
        started = context.Value("i", 0)
        self._pool = ProcessPoolExecutor(
            self.capacity,
            context,
            _begin,
            (held, started, self._preload, self._initializer),
        )
        try:
            with _limited_threads():
                ready = [
                    self._pool.submit(_everyone_is_here, self.capacity)
                    for _ in range(self.capacity)
                ]
                for future in ready:
                    future.result(2 * START_SECONDS)
        except (BrokenExecutor, TimeoutError) as error:
            self._close(now=True)
            raise RuntimeError(
                f"workers did not start; they import {', '.join(self._preload) or 'nothing'}"
            ) from error
        finally:
            held.close()

    def _close(self, now: bool) -> None:
        if now:
            self._leash.close()
        self._pool.shutdown(wait=True, cancel_futures=now)
        self._leash.close()


class Cluster(Door):
    """A Dask cluster: the same calls, handed to its scheduler.

    Workers must run this very version and should have one thread each, as
    `dask worker ADDRESS --nworkers N --nthreads 1` makes them.
    """

    def __init__(self, address: str, connect_seconds: float = 30.0) -> None:
        """
        Args:
            address: the scheduler's, such as "tcp://127.0.0.1:8786".
            connect_seconds: how long to try to reach it, and to wait for a first worker.

        Raises:
            ConnectionError: if no scheduler answers or it has no workers.
            ValueError: if a worker runs another version of this software.
        """
        self._address = address
        self._seconds = connect_seconds
        self._open()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        return self._executor.submit(fn, *args, **kwargs)

    def lost(self, error: BaseException) -> bool:
        return isinstance(error, (BrokenExecutor, CancelledError, OSError, TimeoutError))

    def gave_up(self, error: BaseException) -> bool:
        """The scheduler counts a worker's death against every task that it held."""
        from distributed.scheduler import KilledWorker

        return isinstance(error, KilledWorker)

    def reopen(self) -> None:
        self._close()
        self._open()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        del cancel_futures  # closing cancels them
        self._executor.shutdown(wait=wait)
        self._close()

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        if kind is None:
            self._executor.shutdown(wait=True)
        self._close()

    def _open(self) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise ConnectionError("--cluster needs dask.distributed: zermelo[cluster]") from error
        until = time.monotonic() + self._seconds
        while True:
            try:
                self._client = Client(self._address, timeout=self._seconds, set_as_default=False)
                break
            except (OSError, TimeoutError, ValueError) as error:
                if time.monotonic() > until or isinstance(error, ValueError):
                    raise ConnectionError(f"cluster {self._address}: {error}") from error
                time.sleep(0.2)
        try:
            self._client.wait_for_workers(1, timeout=max(until - time.monotonic(), 1.0))
            versions: Any = self._client.run(code_version, __name__)
            theirs = set(versions.values())
            if theirs != {code_version(__name__)}:
                raise ValueError(
                    f"cluster {self._address}: its workers run another version of zermelo; "
                    "install this one there"
                )
            threads: Any = self._client.nthreads()
            self.capacity = sum(threads.values())
        except TimeoutError as error:
            self._close()
            raise ConnectionError(f"cluster {self._address}: it has no workers") from error
        except ValueError:
            self._close()
            raise
        self._executor = self._client.get_executor(pure=False)

    def _close(self) -> None:
        with suppress(OSError, TimeoutError):  # a lost scheduler cannot say goodbye
            self._client.close(timeout=5)


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


def completed(
    door: Door, function: Callable[[Any], Any], tasks: Iterable[Any], ahead: int = 2
) -> Iterator[Outcome]:
    """Outcomes of `function(task)` as they finish, in any order, one for every task.

    Tasks are drawn as they are needed, so they may be many. A task whose worker died is tried
    again. When several were running, each is tried alone, so that the blame is certain and no
    other is lost with it; one that kills its worker `DEATHS` times alone fails as "WorkerDied",
    on a cluster as "KilledWorker" once the scheduler gives it up alone.
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
                elif door.gave_up(error) and item[0] not in tried_alone:
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


# In a worker

_started: Any = None


def _begin(
    leash: Any, started: Any, preload: Sequence[str], initializer: Callable[[], object] | None
) -> None:
    global _started
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides what an interrupt ends
    threading.Thread(target=_end_with_parent, args=(leash,), daemon=True).start()
    for name in preload:
        importlib.import_module(name)
    if initializer is not None:
        initializer()
    _started = started
    with started.get_lock():
        started.value += 1


def _end_with_parent(leash: Any) -> None:
    """The leash's other end closes when the parent lets go of it or dies."""
    with suppress(EOFError, OSError):
        leash.recv_bytes()
    os._exit(1)


def _everyone_is_here(workers: int) -> None:
    """Hold this worker until all have begun, so that each is started by a task of its own."""
    until = time.monotonic() + START_SECONDS
    while _started.value < workers:
        if time.monotonic() > until:
            raise TimeoutError(f"{_started.value} of {workers} workers after {START_SECONDS:g} s")
        time.sleep(0.001)


@contextmanager
def _limited_threads() -> Iterator[None]:
    """One task a core, not one a core squared: workers inherit the environment as they start."""
    before = {name: os.environ.get(name) for name in THREAD_LIMITS}
    os.environ.update(dict.fromkeys(THREAD_LIMITS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
