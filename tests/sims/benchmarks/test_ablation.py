"""The ablation: every variant is judged on the same problems, against the same optima."""

import pytest

from sims.benchmarks.ablation import run, variants


@pytest.mark.slow
def test_every_variant_is_judged_and_none_beats_the_optimum() -> None:
    figures = run(seed=0, out=None, queries=1, starts=2).figures
    for name in ("paper", "general"):
        rows = {k: row for k, row in figures[name].items() if k != "optima_missed"}
        assert set(rows) == set(variants(name))
        assert all(row["reached"] == 1.0 for row in rows.values())
        assert all(row["least_excess"] > -2e-3 for row in rows.values())
        # Exact motions from both starts: what is left is held input.
        assert rows["adapt, to its end"]["aggregate_excess"] < 1e-3
