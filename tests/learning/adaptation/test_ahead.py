"""Work ahead of its turn: every answer once, in any order, and nothing begun without leave."""

import threading

from hypothesis import given
from hypothesis import strategies as st

from learning.adaptation.ahead import Ahead


def square(k: int) -> int:
    return k * k


@given(st.lists(st.integers(0, 9), unique=True), st.integers(0, 5), st.data())
def test_the_answers_are_those_of_the_work(
    tasks: list[int], most: int, data: st.DataObject
) -> None:
    ahead = Ahead(square).begun(tasks, most)
    assert len(ahead.under_way) == min(most, len(tasks))
    for task in data.draw(st.permutations(tasks)):
        answer, ahead = ahead.taken(task)
        assert answer == square(task)
        assert task not in ahead.under_way


def test_a_task_is_computed_once_however_it_is_asked_for() -> None:
    counts, lock = dict.fromkeys(range(20), 0), threading.Lock()

    def work(k: int) -> int:
        with lock:
            counts[k] += 1
        return k

    ahead = Ahead(work)
    for k in range(20):
        ahead = ahead.begun(range(k, 20), 3)
        answer, ahead = ahead.taken(k)
        assert answer == k
    assert set(counts.values()) == {1}


def test_while_others_are_busy_a_later_task_is_computed_here() -> None:
    """The task waited for ends only once the caller has done a later one meanwhile."""
    later_done = threading.Event()
    here = threading.get_ident()
    computed_by = {}

    def work(k: int) -> int:
        computed_by[k] = threading.get_ident()
        if k == 0:
            later_done.wait(timeout=30)
        else:
            later_done.set()
        return k

    # One helper at least begins task 0; with more helpers task 1 may be taken by another of them.
    ahead = Ahead(work).begun([0], 1)
    while not ahead.under_way[0].running():
        pass
    ahead = ahead.begun([1], 2)
    answer, ahead = ahead.taken(0)
    assert answer == 0
    assert computed_by[0] != here
    assert ahead.taken(1)[0] == 1


def test_unwanted_tasks_are_forgotten() -> None:
    ahead = Ahead(square).begun([1, 2, 3], 3).without([2, 7])
    assert set(ahead.under_way) == {1, 3}


def test_while_something_is_awaited_tasks_are_computed_here_once() -> None:
    counts: dict[int, int] = {}

    def work(k: int) -> int:
        counts[k] = counts.get(k, 0) + 1
        return k

    ahead = Ahead(work).computed(range(9), lambda: len(counts) >= 4)
    assert all(ahead.ready(k) for k in range(4))
    assert [ahead.taken(k)[0] for k in range(9)] == list(range(9))
    assert set(counts.values()) == {1}


def test_what_is_late_is_not_awaited_longer_than_told() -> None:
    released = threading.Event()
    ahead = Ahead(lambda _: released.wait(60)).begun([3], 1)
    assert not ahead.awaited(3, 0.05)
    released.set()
    assert ahead.awaited(3, 60.0)
