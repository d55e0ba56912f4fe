"""The robustness benchmark on one query: every disturbance, honest figures."""

import numpy as np

from sims.benchmarks.robustness import CONTENDERS, DISTURBANCES, Trials, run


def test_small_errors_cost_little_and_every_cell_is_filled() -> None:
    """Without disturbance a grid's policy is near the optimum; a smaller input range costs more."""
    chosen = tuple(c for c in CONTENDERS if c.label == "eikonal")
    report = run(0, None, queries=1, starts=2, contenders=chosen)
    rows = report.figures["contenders"]["eikonal"]
    assert set(rows) == set(DISTURBANCES)
    assert all(row["trials"] == 2 for row in rows.values())
    assert rows["none"]["reached"] == 1.0
    assert -1e-3 < rows["none"]["median_excess"] < 0.02
    assert rows["inputs of at most 0.5"]["median_excess"] > rows["none"]["median_excess"] + 0.02
    assert rows["3 periods of delay"]["median_excess"] > rows["1 period of delay"]["median_excess"]
    assert len(report.tables) == 2


def test_no_loop_that_reached_means_no_excess() -> None:
    lost = Trials(costs=[np.nan, np.nan], optima=[3.0, 4.0], new_collisions=[False, True])
    figures = lost.figures()
    assert figures["reached"] == 0.0
    assert figures["median_excess"] is None
    assert figures["new_collisions"] == 0.5
    half = Trials(costs=[np.nan, 4.4], optima=[3.0, 4.0], new_collisions=[False, False]).figures()
    assert half["reached"] == 0.5
    assert half["aggregate_excess"] is not None
    assert abs(half["aggregate_excess"] - 0.1) < 1e-12
