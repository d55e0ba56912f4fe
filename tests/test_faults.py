"""Work that is cut off, disks that fill up, folders that refuse: nothing lost, nothing wrong."""

import ctypes
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ocp.store import Store
from sims.benchmarks.store import ZERMELO, Kills, killed_fillings

COUNT, NODES = 24, 3000


def fill_command(folder: Path, workers: int = 2, count: int = COUNT) -> list[str]:
    options = f"--count {count} --nodes {NODES} --workers {workers} --json"
    return [*ZERMELO, "store", "fill", str(folder), *options.split()]


def filled(folder: Path, **options: Any) -> subprocess.CompletedProcess:
    return subprocess.run(
        fill_command(folder, **options), capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A store filled without disturbance."""
    folder = tmp_path_factory.mktemp("faults") / "whole"
    answer = filled(folder)
    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout)["computed"] == COUNT
    return Store(folder)


def assert_equal(store: Store, other: Store) -> None:
    """Every entry is sound and has the numbers of the other store's."""
    assert list(store) == list(other)
    for key in store:
        mine, theirs = store.read(key).solved.arrays, other.read(key).solved.arrays
        assert mine.keys() == theirs.keys()
        assert all(np.array_equal(mine[name][1], theirs[name][1]) for name in mine)


# Killed


@pytest.mark.slow
def test_filling_survives_sigkill_at_random_moments(whole: Store, tmp_path: Path) -> None:
    """Parent and workers are killed; every entry on disk is sound, and a rerun adds the rest."""
    kills: Kills = killed_fillings(tmp_path / "killed", kills=3, seed=1, count=COUNT, nodes=NODES)
    assert kills.kills == 3
    assert kills.damaged == 0
    assert kills.lost == 0
    assert kills.entries == COUNT
    assert_equal(Store(tmp_path / "killed"), whole)


def test_a_killed_worker_costs_no_entry(whole: Store, tmp_path: Path) -> None:
    """Only a worker is killed: the run itself goes on to the end."""
    folder = tmp_path / "store"
    run = subprocess.Popen(fill_command(folder), stdout=subprocess.PIPE, text=True)
    victim = _first_worker(run.pid, lambda: len(_entries(folder)) >= 2)
    os.kill(victim, signal.SIGKILL)
    output, _ = run.communicate()
    assert run.returncode == 0
    document = json.loads(output)
    assert document["computed"] == COUNT
    assert document["failed"] == {}
    assert_equal(Store(folder), whole)


def test_what_killed_writers_leave_is_swept(whole: Store, tmp_path: Path) -> None:
    """And what living ones are writing is not."""
    store = Store(shutil.copytree(whole.folder, tmp_path / "store"))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    name = next(iter(store))
    with store._partial() as mine:
        dead = Path(str(mine).replace(f"-{os.getpid()}-", f"-{ended.pid}-"))
        shutil.copytree(store.folder / name, dead / name)
        elsewhere = store.folder / ".partial-another_machine-1-x"
        elsewhere.mkdir()
        assert store.sweep() == 1
        assert mine.exists()
        assert elsewhere.exists()
        assert not dead.exists()


def _entries(folder: Path) -> list[str]:
    return [p.name for p in folder.iterdir() if len(p.name) == 32] if folder.is_dir() else []


def _first_worker(parent: int, ready: Callable[[], bool]) -> int:
    """A worker process of a filling, once `ready`: a child of its fork server."""
    for _ in range(60_000):
        if ready():
            workers = [w for child in _children(parent) for w in _children(child)]
            if workers:
                return workers[0]
        time.sleep(0.001)
    raise AssertionError("no worker was seen in a minute")


def _children(pid: int) -> list[int]:
    try:
        return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except (FileNotFoundError, ProcessLookupError):
        return []


# Disks and folders that refuse


def without_root_powers() -> None:
    """Let permission bits bind this process even if it is root's (Linux: drop CAP_DAC_*)."""
    libc = ctypes.CDLL(None, use_errno=True)
    for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        if os.geteuid() == 0 and libc.prctl(24, capability, 0, 0, 0) != 0:  # PR_CAPBSET_DROP
            raise OSError(ctypes.get_errno(), "prctl")


def test_a_read_only_folder_is_refused(whole: Store, tmp_path: Path) -> None:
    folder = shutil.copytree(whole.folder, tmp_path / "store")
    shutil.rmtree(folder / next(iter(Store(folder))))
    folder.chmod(0o555)
    try:
        answer = subprocess.run(
            fill_command(folder, workers=0),
            capture_output=True,
            text=True,
            check=False,
            preexec_fn=without_root_powers,
        )
    finally:
        folder.chmod(0o755)
    assert answer.returncode == 2, answer.stderr
    assert "Permission denied" in answer.stderr
    assert "Traceback" not in answer.stderr
    store = Store(folder)
    assert len(store) == COUNT - 1
    assert all(store.verify(key) is None for key in store)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 120 KiB, where one may be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=120k", "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("no file system can be mounted here; the limit on file sizes is tested")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_ends_the_run_and_keeps_what_is_whole(small_disk: Path) -> None:
    answer = filled(small_disk / "store")
    assert answer.returncode == 2
    assert "No space left" in answer.stderr
    assert "Traceback" not in answer.stderr
    store = Store(small_disk / "store")
    assert 0 < len(store) < COUNT
    assert all(store.verify(key) is None for key in store)
    store.sweep()
    assert not list(store.folder.glob(".partial-*"))


def test_a_limit_on_file_sizes_is_a_full_disk_too(tmp_path: Path) -> None:
    """Files of at most 2 kB: the metadata fits, a value does not."""
    answer = subprocess.run(
        fill_command(tmp_path / "store", workers=0),
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000)),
    )
    assert answer.returncode == 2
    assert "File too large" in answer.stderr
    assert "Traceback" not in answer.stderr
    assert len(Store(tmp_path / "store")) == 0


# Clocks


def test_a_clock_that_jumps_changes_nothing(whole: Store, tmp_path: Path) -> None:
    """Wall-clock time goes back an hour at every look: the same entries."""
    script = (
        "import sys, time\n"
        "now = [time.time()]\n"
        "def back():\n"
        "    now[0] -= 3600\n"
        "    return now[0]\n"
        "time.time = back\n"
        "from sims.cli import main\n"
        "main()\n"
    )
    arguments = fill_command(tmp_path / "store", workers=0)[3:]
    answer = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr
    assert_equal(Store(tmp_path / "store"), whole)
