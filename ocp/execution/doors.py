"""What every executor here can do, and the one that works in the calling thread."""

from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import Any


class Door(Executor):
    """An executor that says how much work it takes at a time and can be opened anew."""

    capacity: int
    """Workers: tasks that run at the same time."""

    def reopen(self) -> None:
        """Replace what is lost: dead workers, a broken connection."""

    def lost(self, error: BaseException) -> bool:
        """Whether `error` says that the task's worker or the connection died."""
        return isinstance(error, BrokenExecutor)


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
