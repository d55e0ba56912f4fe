"""The benchmark of learning: every query kept as it is finished, the figures the same."""

from pathlib import Path

import numpy as np
import pytest

from ocp.query_family import QueryFamily
from sims.benchmarks import learning
from sims.benchmarks.learning import Score

NOT_TIMES = [name for name in learning.FIGURES if not name.startswith("reaction")]


@pytest.fixture
def small(monkeypatch) -> None:
    """One family, and two quick methods of it."""
    paper = learning.families()["paper"]
    monkeypatch.setattr(learning, "families", lambda: {"paper": paper})
    methods = learning.fixed_methods("paper")
    few = {name: methods[name] for name in ("network", "eikonal, 4,500 nodes")}
    monkeypatch.setattr(learning, "fixed_methods", lambda _family: few)


@pytest.mark.usefixtures("small")
def test_a_run_that_was_stopped_goes_on(tmp_path: Path, monkeypatch) -> None:
    """The second query is interrupted; the next run computes that one alone."""
    posed, real = [], learning.problem

    def problem(family: QueryFamily, seed: int, k: int, starts: int) -> learning.Problem:
        posed.append(k)
        if len(posed) == 2:
            raise KeyboardInterrupt
        return real(family, seed, k, starts)

    monkeypatch.setattr(learning, "problem", problem)
    with pytest.raises(KeyboardInterrupt):
        learning.run(0, tmp_path, queries=2, starts=2)
    resumed = learning.run(0, tmp_path, queries=2, starts=2).figures["paper"]
    assert posed == [0, 1, 1]
    whole = learning.run(0, None, queries=2, starts=2).figures["paper"]
    assert resumed.pop("optima_missed") == whole.pop("optima_missed")
    for method, figures in whole.items():
        for name in NOT_TIMES:
            assert resumed[method][name] == figures[name], (method, name)


def test_a_kept_score_is_the_score() -> None:
    """Not reached is NaN among the costs, and null in the file."""
    score = Score([1.0, np.nan], [1.0, 2.0], [False, True], [0.1])
    again = Score()
    again.extend(score.record())
    assert score.record()["costs"] == [1.0, None]
    assert again.figures() == score.figures()


def test_a_loop_cheaper_than_the_optimum_becomes_the_optimum() -> None:
    """For every method; but not within rounding, and not beside the goal."""
    optima = [10.0, 10.0, 0.001]
    dear = Score([10.1, 10.1, 0.001], list(optima), [False] * 3, [])
    cheap = Score([9.0, 9.999, 0.0009], list(optima), [False] * 3, [])
    assert learning.correct_optima([dear, cheap]) == 1
    assert dear.optima == cheap.optima == [9.0, 10.0, 0.001]
