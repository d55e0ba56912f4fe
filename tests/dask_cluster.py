"""A real Dask cluster on loopback: a scheduler and workers, each a process of its own."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class DaskCluster:
    """Start with `with`; everything it started ends with the block."""

    def __init__(self, folder: Path, workers: int = 2) -> None:
        self.folder, self.count = folder, workers
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"
        self._processes: list[subprocess.Popen] = []

    def __enter__(self) -> "DaskCluster":
        self.scheduler = self.start_scheduler()
        self.workers = [self.start_worker() for _ in range(self.count)]
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._processes):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def start_scheduler(self) -> subprocess.Popen:
        return self._start(
            "dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard"
        )

    def start_worker(self) -> subprocess.Popen:
        """One worker of one thread; its nanny starts it anew when it dies."""
        return self._start(
            "dask_worker",
            self.address,
            *("--host", "127.0.0.1", "--nthreads", "1", "--no-dashboard", "--memory-limit", "0"),
            *("--local-directory", str(self.folder)),
        )

    def _start(self, module: str, *arguments: str) -> subprocess.Popen:
        log = (self.folder / f"{module}-{len(self._processes)}.log").open("wb")
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *arguments],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ
            | {"PYTHONPATH": str(HERE), "DASK_DISTRIBUTED__SCHEDULER__WORK_STEALING": "False"},
            start_new_session=True,
        )
        log.close()
        self._processes.append(process)
        return process
