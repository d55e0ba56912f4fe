"""Functions that workers import: each does one thing, well or badly."""

import os
import signal
import time
from pathlib import Path
from typing import Any


def square(x: float) -> float:
    return x * x


def refuse_seven(x: int) -> int:
    if x == 7:
        raise ValueError("seven is refused")
    return x


def limits(_task: Any) -> dict[str, str | None]:
    from ocp.threads import THREAD_LIMITS

    return {name: os.environ.get(name) for name in THREAD_LIMITS}


def pid(_task: Any) -> int:
    return os.getpid()


def sleep(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def note(task: dict[str, Any]) -> int:
    """Leave one line in a file for each time the task is run; then do what it says.

    Keys: `log` the file, `number` the line, `once` a file whose absence kills the worker,
    `poison` whether to kill it always, `seconds` to sleep.
    """
    with Path(task["log"]).open("a") as file:
        file.write(f"{task['number']}\n")
    once = task.get("once")
    if task.get("poison") or (once is not None and not Path(once).exists()):
        if once is not None:
            Path(once).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(task.get("seconds", 0.0))
    return task["number"]


class UnpicklableError(Exception):
    """An exception that cannot be made again from its text."""

    def __init__(self, number: int, text: str) -> None:
        super().__init__(f"{number} {text}")


def raise_unpicklable(_task: Any) -> None:
    raise UnpicklableError(1, "two")
