"""Settings for the whole suite: reproducible hypothesis runs, one thread a process."""

import os

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
