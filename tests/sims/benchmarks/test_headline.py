"""The headline benchmark's clock: median and ratio agree with each other, and with twice the work."""

import pytest

from sims.benchmarks.headline import repeated
from sims.commands.bench_compare import plain_work


def test_the_reference_takes_once_the_reference() -> None:
    """Processor time of equal work, one after the other; a busy machine's caches make it uneven."""
    row = repeated(plain_work, 5)
    assert row["median_s"] > 0
    assert row["spread"] >= 0
    assert row["over_reference"] == pytest.approx(1.0, rel=0.5)


def test_three_times_the_work_takes_three_times_as_long() -> None:
    def thrice() -> None:
        for _ in range(3):
            plain_work()

    assert repeated(thrice, 5)["over_reference"] == pytest.approx(3.0, rel=0.5)
