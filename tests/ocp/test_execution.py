"""Executors: the same outcomes behind every door, and workers may die."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest
import work_for_workers as work
from dask_cluster import DaskCluster

from ocp.execution import Cluster, Door, InProcess, completed, open_door
from ocp.threads import THREAD_LIMITS
from ocp.trajectory import SolveError, Status

TESTS = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    with DaskCluster(tmp_path_factory.mktemp("dask")) as running:
        yield running


@pytest.fixture(scope="module", params=["in process", "local", "cluster"])
def door(request: pytest.FixtureRequest) -> Iterator[Door]:
    if request.param == "cluster":
        address = request.getfixturevalue("cluster").address
        with open_door(cluster=address) as opened:
            yield opened
    else:
        with open_door(2 if request.param == "local" else 0) as opened:
            yield opened


# Laws of every door


def test_each_task_has_one_outcome(door: Door) -> None:
    outcomes = sorted(
        completed(door, work.square, (x / 2 for x in range(50))), key=lambda o: o.index
    )
    assert [o.index for o in outcomes] == list(range(50))
    assert [o.answer for o in outcomes] == [(x / 2) ** 2 for x in range(50)]
    assert all(o.failure is None for o in outcomes)


def test_an_exception_is_its_own_tasks_failure(door: Door) -> None:
    outcomes = {o.index: o for o in completed(door, work.refuse_seven, range(12))}
    failure = outcomes.pop(7).failure
    assert failure is not None
    assert (failure.kind, failure.message) == ("ValueError", "seven is refused")
    assert "refuse_seven" in failure.trace
    assert [outcomes[k].answer for k in sorted(outcomes)] == [k for k in range(12) if k != 7]


def test_an_exception_that_does_not_unpickle_breaks_nothing(door: Door) -> None:
    outcomes = list(completed(door, work.raise_unpicklable, range(3)))
    assert [o.failure.kind for o in outcomes if o.failure] == ["UnpicklableError"] * 3


def test_submit_and_map_are_the_ordinary_ones(door: Door) -> None:
    assert door.submit(work.square, 3).result() == 9
    assert list(door.map(work.square, range(5))) == [0, 1, 4, 9, 16]
    with pytest.raises(ValueError, match="seven"):
        door.submit(work.refuse_seven, 7).result()


def test_no_task_no_outcome(door: Door) -> None:
    assert list(completed(door, work.square, [])) == []


def test_tasks_are_drawn_as_they_are_needed(door: Door) -> None:
    drawn = []

    def tasks() -> Iterator[int]:
        for k in range(10_000):
            drawn.append(k)
            yield k

    for outcome in completed(door, work.square, tasks()):
        if outcome.index >= 20:
            break
    assert len(drawn) < 40 + 8 * door.capacity


# Local processes


def test_workers_are_several_and_run_single_threaded() -> None:
    with open_door(2) as door:
        outcomes = list(completed(door, work.limits, range(4)))
        assert all(o.answer == dict.fromkeys(THREAD_LIMITS, "1") for o in outcomes)
        pids = set(door.map(work.pid, range(50)))
        assert 1 <= len(pids) <= 2
        assert os.getpid() not in pids


def test_modules_are_imported_before_work() -> None:
    with (
        pytest.raises(RuntimeError, match="no_such_module"),
        open_door(1, preload=["no_such_module"]),
    ):
        pass


def test_a_task_that_kills_its_worker_fails_alone(tmp_path: Path) -> None:
    log = tmp_path / "log"
    tasks = [{"log": str(log), "number": k, "poison": k == 5} for k in range(20)]
    with open_door(2) as door:
        outcomes = {o.index: o for o in completed(door, work.note, tasks)}
    assert sorted(outcomes) == list(range(20))
    failure = outcomes.pop(5).failure
    assert failure is not None
    assert failure.kind == "WorkerDied"
    assert [outcomes[k].answer for k in sorted(outcomes)] == sorted(outcomes)
    runs = Counter(map(int, log.read_text().split()))
    assert runs.pop(5) <= 3  # once among others, twice alone
    again = sum(n - 1 for n in runs.values())
    assert again <= 3  # what else was handed to the two workers at that moment


def test_a_worker_killed_once_loses_nothing(tmp_path: Path) -> None:
    log, once = tmp_path / "log", tmp_path / "once"
    tasks = [
        {"log": str(log), "number": k, **({"once": str(once)} if k == 9 else {})} for k in range(20)
    ]
    with open_door(2) as door:
        outcomes = list(completed(door, work.note, tasks))
    assert sorted(o.answer for o in outcomes) == list(range(20))
    assert once.exists()
    assert len(log.read_text().split()) <= 24


def test_workers_end_with_their_parent() -> None:
    """However it ends: here by SIGKILL."""
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import time, work_for_workers as work\n"
        "from ocp.execution import open_door\n"
        "if __name__ == '__main__':\n"
        "    door = open_door(2)\n"
        "    [door.submit(work.sleep, 600) for _ in range(4)]\n"
        "    print(*door._pool._processes, flush=True)\n"
        "    time.sleep(600)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", script, str(TESTS)], stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    pids = [int(p) for p in parent.stdout.readline().split()]
    assert len(pids) == 2
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    for pid in pids:
        for _ in range(1000):
            if not _lives(pid):
                break
            time.sleep(0.01)
        assert not _lives(pid)


def _lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


def test_an_interrupt_ends_the_workers_at_once() -> None:
    begun = time.monotonic()
    pids = []

    def interrupted() -> None:
        with open_door(2) as door:
            pids.append(door.submit(work.pid, 0).result())
            for outcome in completed(door, work.sleep, [0.0, *[600.0] * 5]):
                assert outcome.answer == 0.0
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not any(map(_lives, pids))
    assert time.monotonic() - begun < 300  # not the tasks' own 600 s


@pytest.mark.parametrize("workers", [-1, -5])
def test_a_negative_number_of_workers_is_refused(workers: int) -> None:
    with pytest.raises(ValueError, match="workers"):
        open_door(workers)


def test_no_worker_means_this_process() -> None:
    assert isinstance(open_door(0), InProcess)


def test_a_solve_error_travels() -> None:
    import pickle

    error = pickle.loads(pickle.dumps(SolveError(Status.INFEASIBLE, "walled in")))
    assert error.status is Status.INFEASIBLE
    assert str(error).endswith("walled in")


# Dask


def test_an_unreachable_cluster_is_named() -> None:
    with pytest.raises(ConnectionError, match=r"127\.0\.0\.1:1"):
        Cluster("tcp://127.0.0.1:1", connect_seconds=0.5)


def test_dask_survives_a_killed_worker_and_a_poisoned_task(
    tmp_path: Path, cluster: DaskCluster
) -> None:
    log, once = tmp_path / "log", tmp_path / "once"
    tasks = [{"log": str(log), "number": k, "seconds": 0.01} for k in range(30)]
    tasks[4]["once"] = str(once)
    tasks[11]["poison"] = True
    with open_door(cluster=cluster.address) as door:
        outcomes = {o.index: o for o in completed(door, work.note, tasks)}
    failure = outcomes.pop(11).failure
    assert failure is not None
    assert failure.kind == "KilledWorker"
    assert [outcomes[k].answer for k in sorted(outcomes)] == [k for k in range(30) if k != 11]
    runs = Counter(map(int, log.read_text().split()))
    again = sum(n - 1 for k, n in runs.items() if k != 11)
    assert again <= 4 * 5  # at most what was handed over: four tasks, five deaths


class ScapegoatDoor(Door):
    """Gives up the task it is told to, and at first also the one handed over with it."""

    class GivenUpError(Exception):
        pass

    capacity = 1

    def __init__(self, guilty: int) -> None:
        self.guilty = guilty
        self.tried: list[int] = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        task = args[-1]
        self.tried.append(task)
        future: Future = Future()
        if task == self.guilty or self.tried == [self.guilty, task]:
            future.set_exception(self.GivenUpError())
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def test_a_task_is_given_up_only_after_it_was_tried_alone() -> None:
    door = ScapegoatDoor(guilty=0)
    outcomes = {o.index: o for o in completed(door, work.square, range(6))}
    failure = outcomes.pop(0).failure
    assert failure is not None
    assert failure.kind == "GivenUpError"
    assert [outcomes[k].answer for k in sorted(outcomes)] == [k * k for k in range(1, 6)]
    assert Counter(door.tried) == Counter([0, 0, 1, 1, 2, 3, 4, 5])


@pytest.mark.slow
def test_dask_survives_its_scheduler(tmp_path: Path) -> None:
    """The scheduler is killed and started anew in mid-run; what was unfinished is done again."""
    log = tmp_path / "log"
    tasks = [{"log": str(log), "number": k, "seconds": 0.02} for k in range(40)]
    with DaskCluster(tmp_path) as cluster, open_door(cluster=cluster.address) as door:
        answers = []
        for outcome in completed(door, work.note, tasks):
            answers.append(outcome.answer)
            if len(answers) == 10:
                os.killpg(cluster.scheduler.pid, signal.SIGKILL)
                cluster.scheduler.wait()
                cluster.start_scheduler()
                for _ in range(2):
                    cluster.start_worker()
    assert sorted(answers) == list(range(40))
    assert len(log.read_text().split()) <= 40 + 2 * 2 * 2
