"""Work begun on other cores before its turn comes, and taken when it does."""

import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, wait
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from ocp.threads import warm_workers

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Ahead(Generic[Answer]):
    """Numbered tasks under way; the same answers as without, sooner.

    Attributes:
        work: computes the answer of a task.
        under_way: futures by the tasks' numbers.
        since: when each of them was handed over, seconds of `time.perf_counter`.
    """

    work: Callable[[int], Answer]
    under_way: dict[int, Future[Answer]] = field(default_factory=dict)
    since: dict[int, float] = field(default_factory=dict)

    def ready(self, task: int) -> bool:
        """Whether the task's answer is there already."""
        return task in self.under_way and self.under_way[task].done()

    def awaited(self, task: int, seconds: float) -> bool:
        """Whether the answer of a task under way is there within so many seconds."""
        return bool(wait([self.under_way[task]], max(0.0, seconds)).done)

    def begun(self, tasks: Iterable[int], most: int) -> "Ahead[Answer]":
        """With further tasks, in their order, handed to other cores while at most `most` wait."""
        under_way, since = dict(self.under_way), dict(self.since)
        for task in tasks:
            if len(under_way) >= most:
                break
            if task not in under_way:
                under_way[task] = warm_workers().submit(self.work, task)
                since[task] = time.perf_counter()
        return replace(self, under_way=under_way, since=since)

    def without(self, tasks: Iterable[int]) -> "Ahead[Answer]":
        """Without tasks that are no longer wanted."""
        dropped = set(tasks)
        for task in dropped & self.under_way.keys():
            self.under_way[task].cancel()
        left = {i: f for i, f in self.under_way.items() if i not in dropped}
        return replace(self, under_way=left)

    def computed(self, tasks: Iterable[int], enough: Callable[[], bool]) -> "Ahead[Answer]":
        """With those of the tasks that this core gets done before there is `enough`.

        Tasks that another core has begun are passed over.
        """
        under_way = dict(self.under_way)
        for task in tasks:
            if enough():
                break
            mine = under_way.get(task)
            if mine is None or mine.cancel():
                under_way[task] = Future()
                under_way[task].set_result(self.work(task))
        return replace(self, under_way=under_way)

    def taken(self, task: int) -> "tuple[Answer, Ahead[Answer]]":
        """A task's answer, and the others.

        It is computed here if nobody has begun it; else it is waited for, while a later one that
        nobody has begun is computed here.
        """
        rest = dict(self.under_way)
        mine = rest.pop(task, None)
        if mine is None or mine.cancel():
            return self.work(task), replace(self, under_way=rest)
        free = None if mine.done() else next((i for i, f in rest.items() if f.cancel()), None)
        if free is not None:
            rest[free] = Future()
            rest[free].set_result(self.work(free))
        return mine.result(), replace(self, under_way=rest)
