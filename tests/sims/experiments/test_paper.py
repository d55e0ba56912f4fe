"""The paper's tables as data, and what follows from them alone."""

import pytest

from sims.experiments.paper import BENCHMARK, GOALS, TABLE_I, TABLE_II, TABLE_III, mean_excess


@pytest.mark.parametrize(
    ("row", "percent"),
    [
        ("Anytime adaptation", 2.9),
        ("ReFMM (fine grid)", 0.25),
        ("ReFMM (coarse grid)", 4.0),
        ("MPC", 20.9),
        ("TRPO", 11.5),
        ("DNN interpolation", 1.3),
    ],
)
def test_mean_excess_over_the_benchmark(row: str, percent: float) -> None:
    assert 100 * mean_excess(row) == pytest.approx(percent, abs=0.06)


def test_every_row_has_a_cost_for_every_goal() -> None:
    assert all(len(costs) == len(GOALS) for costs in TABLE_I.values())
    assert mean_excess(BENCHMARK) == 0


def test_tables_two_and_three_disagree_about_the_same_eight_trajectories() -> None:
    assert TABLE_II["Anytime adaptation, data generation (n = 8)"] > 6.8
    per_state, states, total = TABLE_III["Causality-free method"]
    assert per_state * states == pytest.approx(total, abs=0.01)
    assert total < 4.4
