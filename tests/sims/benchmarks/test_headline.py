"""The headline benchmark's clock: ratios of processor time, still uneven on busy machines."""

from sims.benchmarks.headline import repeated
from sims.commands.bench_compare import plain_work


def test_the_reference_takes_once_the_reference() -> None:
    row = repeated(plain_work, 5)
    assert row["median_s"] > 0
    assert row["spread"] >= 0
    assert 0.5 < row["over_reference"] < 2.0


def test_three_times_the_work_takes_three_times_as_long() -> None:
    def thrice() -> None:
        for _ in range(3):
            plain_work()

    assert 1.5 < repeated(thrice, 5)["over_reference"] < 6.0
