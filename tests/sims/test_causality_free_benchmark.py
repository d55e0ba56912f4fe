"""What the shipped networks promise: on fresh queries they reach, at nearly the least cost."""

import pytest

from learning.causality_free.families import FAMILIES
from sims.benchmarks import causality_free


@pytest.mark.parametrize("name", FAMILIES)
def test_shipped_networks_reach_at_nearly_the_exact_cost(name) -> None:
    """Among obstacles the middle loop has to: two of these eight cost a third too much."""
    figures = causality_free._family(FAMILIES[name], seed=7, queries=2, count=4, checked=0)
    excess = "median_excess" if name == "traffic" else "aggregate_excess"
    for method in ("network", "adapted"):
        row = figures[method]
        assert row["reached"] == 1.0
        assert row[excess] < 0.03
        assert row["least_excess"] > -1e-3  # a loop is dearer than the least, but for rounding
    # Among obstacles the search for classes of motions may miss the cheapest of one start.
    assert figures["optima_missed"] <= (1 if name == "traffic" else 0)
    if name != "traffic":
        assert figures["regulator"]["mean_excess"] > 1.5 * figures["network"]["mean_excess"]
    assert figures["without_exact_cost"] == 0.0
    assert figures["trajectories_solved"] >= 1.0


def test_grids_are_out_of_reach() -> None:
    rows = causality_free.grid_needs()["rows"]
    largest = max(rows, key=lambda row: row["nodes"])
    assert (largest["states"], largest["axis_nodes"]) == (6, 61)
    assert largest["nodes"] == 61.0**6
    assert largest["core_hours_a_query"] > 100.0
