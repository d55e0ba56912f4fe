"""A Dask cluster as an executor."""

import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, CancelledError, Future
from contextlib import suppress
from typing import Any

from ocp.execution.doors import Door
from ocp.version import code_version


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
            versions: Any = self._client.run(code_version, __package__)
            theirs = set(versions.values())
            if theirs != {code_version(__package__)}:
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
