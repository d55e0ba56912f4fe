"""Four ways to V: they agree where all apply, each within its own error."""

import numpy as np
import pytest

from ocp.query import Query
from sims.benchmarks import regulation_values as bench

SMALL_SLICE = bench.Slice("pendulum", (0, 1), (0.3, 0.6), 5, (), ((41, 61), (81, 121)))
BRIEF = {
    "queries": 8, "held_out": 2, "motions": (8,), "steps": (1200,), "widths": (24, 24),
    "batch": 256, "warm_up": 50, "checkpoint_steps": 600,
}  # fmt: skip


@pytest.fixture(scope="module")
def values() -> bench.Values:
    query = Query.load(bench.Path(bench.__file__).parent.parent / "queries" / "pendulum.toml")
    return bench.compare(SMALL_SLICE, query, 0, BRIEF)


def test_shooting_and_collocation_agree(values) -> None:
    figures = bench.figures_of(values)["PMP and collocation"]
    assert figures["both"] >= 23
    assert figures["within_1e-4"] >= 0.9
    assert figures["median"] < 2e-5


def test_the_grid_lies_above_by_an_error_that_falls_with_the_cell(values) -> None:
    coarse, fine = (values.error(name) for name in ("grid", "finer grid"))
    assert np.nanmedian(fine) > 0
    assert np.nanmedian(fine) < 0.7 * np.nanmedian(coarse)


def test_the_network_is_nearer_than_the_regulator_in_its_box(values) -> None:
    own, linear = (
        np.nanmean(np.abs(values.error(name)[values.inside]))
        for name in ("network", "linear regulator")
    )
    assert own < linear  # after a few seconds of training; the benchmark trains four times as long
    assert own < 0.02


def test_slices_pass_beside_the_goal() -> None:
    query = Query.load(bench.Path(bench.__file__).parent.parent / "queries" / "cart-pole.toml")
    states = bench.slice_states(bench.SLICES[1], query)
    moved = states - query.reference
    assert (np.abs(moved).max(axis=1) > 0).all()
    assert np.array_equal(moved[:, [0, 2]], np.zeros((81, 2)))
