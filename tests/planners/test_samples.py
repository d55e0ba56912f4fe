"""Halton's points: exact digits, even cover, seeds."""

import numpy as np
import pytest

from planners.samples import Samples, radical_inverse


def test_digits_are_mirrored_at_the_point() -> None:
    assert radical_inverse(np.arange(1, 6), 2).tolist() == [1 / 2, 1 / 4, 3 / 4, 1 / 8, 5 / 8]
    assert radical_inverse(np.arange(1, 4), 3) == pytest.approx([1 / 3, 2 / 3, 1 / 9])


@pytest.mark.parametrize("dimension", range(2, 8))
def test_points_fill_every_stretch_of_every_axis_evenly(dimension: int) -> None:
    points = Samples(dimension, 0).take(2000)
    assert points.shape == (2000, dimension)
    assert (points >= 0).all()
    assert (points < 1).all()
    for column in points.T:
        counts, _ = np.histogram(column, bins=20, range=(0, 1))
        # 100 expected: a sequence of low discrepancy strays by its logarithm, chance by 10.
        assert np.abs(counts - 100).max() <= 20


def test_points_go_on_where_they_stopped_and_differ_by_seed() -> None:
    once, pieces = Samples(3, 1), Samples(3, 1)
    assert np.array_equal(once.take(9), np.concatenate([pieces.take(4), pieces.take(5)]))
    assert not np.isin(Samples(3, 2).take(9), Samples(3, 1).take(9)).any()
