"""Settings for the whole suite: reproducible hypothesis runs, one thread a process."""

import importlib
import os
from pathlib import Path

from ocp.threads import one_thread_by_default

one_thread_by_default()
os.environ.setdefault("MPLBACKEND", "Agg")

from hypothesis import HealthCheck, settings  # noqa: E402

settings.register_profile(
    "reproducible",
    derandomize=True,
    deadline=None,
    max_examples=30,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("reproducible")


def pytest_configure() -> None:
    """Let every second worker begin with the last module.

    On a fresh machine workers would compile the same functions side by side; so each finds compiled
    what the other has done.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0")
    if int(worker.removeprefix("gw")) % 2:
        root = Path(__file__).resolve().parent.parent
        for room in ("sims", "planners", "learning", "ocp"):
            for path in sorted((root / room).rglob("*.py"), reverse=True):
                if "@compiled(" in path.read_text(encoding="utf-8"):
                    name = path.relative_to(root).with_suffix("").as_posix().replace("/", ".")
                    importlib.import_module(name)
