"""Worker processes on this machine, which end with the process that opened them."""

import importlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

from ocp.execution.doors import Door
from ocp.threads import THREAD_LIMITS

START_SECONDS = 120.0  # for workers to start and import


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
