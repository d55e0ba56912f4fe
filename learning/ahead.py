"""Work begun on other cores before its turn comes, and taken when it does."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from ocp.threads import warm_workers

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Ahead(Generic[Answer]):
    """Numbered tasks under way; the same answers as without, sooner.

    Attributes:
        work: computes the answer of a task.
        under_way: futures by the tasks' numbers.
    """

    work: Callable[[int], Answer]
    under_way: dict[int, Future[Answer]] = field(default_factory=dict)

    def ready(self, task: int) -> bool:
        """Whether the task's answer is there already."""
        return task in self.under_way and self.under_way[task].done()

    def begun(self, tasks: Iterable[int], most: int) -> "Ahead[Answer]":
        """With further tasks, in their order, handed to other cores while at most `most` wait."""
        under_way = dict(self.under_way)
        for task in tasks:
            if len(under_way) >= most:
                break
            if task not in under_way:
                under_way[task] = warm_workers().submit(self.work, task)
        return Ahead(self.work, under_way)

    def without(self, tasks: Iterable[int]) -> "Ahead[Answer]":
        """Without tasks that are no longer wanted."""
        dropped = set(tasks)
        for task in dropped & self.under_way.keys():
            self.under_way[task].cancel()
        return Ahead(self.work, {i: f for i, f in self.under_way.items() if i not in dropped})

    def taken(self, task: int) -> "tuple[Answer, Ahead[Answer]]":
        """A task's answer, and the others.

        It is computed here if nobody has begun it; else it is waited for, while a later one that
        nobody has begun is computed here.
        """
        rest = dict(self.under_way)
        mine = rest.pop(task, None)
        if mine is None or mine.cancel():
            return self.work(task), Ahead(self.work, rest)
        free = None if mine.done() else next((i for i, f in rest.items() if f.cancel()), None)
        if free is not None:
            rest[free] = Future()
            rest[free].set_result(self.work(free))
        return mine.result(), Ahead(self.work, rest)
