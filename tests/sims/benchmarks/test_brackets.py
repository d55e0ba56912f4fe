"""The bracket benchmark: what counts as a motion that beats the optimum, and a small run."""

import pytest

from ocp import exact_trajectory
from ocp.query_family import PAPER_START, paper_query
from sims.benchmarks.brackets import beats, run


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_an_optimal_motion_cut_anywhere_does_not_beat_the_optimum(share: float) -> None:
    """Bellman: the optimal cost from any of its states on is what is left of the motion's."""
    query = paper_query((1.0, 4.0))
    motion = exact_trajectory(query, PAPER_START)
    cut = int(share * len(motion.times))
    spent = float(motion.cost_so_far[cut])
    rest = exact_trajectory(query, motion.states[cut]).cost
    assert not beats(spent, rest, motion.cost)
    assert beats(spent, rest, 1.001 * motion.cost), "a search that missed it by .1 % is found out"


@pytest.mark.slow
def test_a_small_run_finds_every_exact_cost_in_its_bracket() -> None:
    figures = run(seed=3, _out=None, queries=1, starts_each=6).figures["brackets"]
    assert figures["brackets"] + figures["no rollout reached"] == 6
    assert figures["held against exact costs"] > 0
    for wrong in ("lower above upper", "lower above exact"):
        assert figures[wrong] == 0
    assert figures["upper below exact: the search missed an optimum"] == 0
    assert 0 < figures["median gap"] < 0.05
