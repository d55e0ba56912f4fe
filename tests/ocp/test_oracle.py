"""The oracle: methods that agree establish the truth, and only independent ones count."""

import numpy as np
import pytest
from references import TABLE_ONE_OPTIMA, aligned_value

from ocp.obstacle import Obstacle
from ocp.oracle import TRUTH_TOLERANCE, Answer, Verdict, consult
from ocp.query import Goal, Query
from ocp.query_family import PAPER_GOALS, PAPER_START, paper_query
from ocp.trajectory import Status


@pytest.mark.parametrize("goal", PAPER_GOALS)
def test_the_papers_queries_have_established_optima(goal) -> None:
    verdict = consult(paper_query(goal), PAPER_START)
    assert verdict.established, verdict.explanation
    assert verdict.value == pytest.approx(TABLE_ONE_OPTIMA[goal], abs=5e-5)
    assert verdict.answers["closed form"].status is Status.NOT_APPLICABLE
    assert verdict.best is not None
    assert verdict.value is not None
    assert verdict.best.cost <= verdict.value * (1 + TRUTH_TOLERANCE)


def test_methods_agree_on_values_gradients_and_inputs() -> None:
    """Off cut loci the costate is unique, so independent methods find the same one."""
    verdict = consult(paper_query((4.0, 4.0)), [-2.5, 1.0, 0.4])
    pmp, collocation = verdict.answers["PMP"], verdict.answers["collocation"]
    assert pmp.gradient is not None
    assert collocation.gradient is not None
    assert pmp.input is not None
    assert collocation.input is not None
    scale = np.abs(pmp.gradient).max()
    np.testing.assert_allclose(pmp.gradient, collocation.gradient, atol=1e-3 * scale)
    np.testing.assert_allclose(pmp.input, collocation.input, atol=1e-2)
    assert not verdict.disagreements()


def test_three_methods_agree_where_the_closed_form_holds() -> None:
    start = [4 - 3 * np.cos(0.3), 4 - 3 * np.sin(0.3), 0.3]
    verdict = consult(paper_query((4.0, 4.0)), start)
    assert verdict.established
    assert verdict.answers["closed form"].value == pytest.approx(aligned_value(3.0), rel=1e-10)
    assert verdict.answers["PMP"].value == pytest.approx(aligned_value(3.0), rel=1e-6)
    assert verdict.answers["collocation"].value == pytest.approx(aligned_value(3.0), rel=1e-5)


def test_collocation_alone_establishes_nothing() -> None:
    """Round a hard obstacle that the motion touches, the smooth minimum principle has no answer."""
    wall = Obstacle.circle((0.0, 0.0), 1.0, hard=True)
    query = Query("single-integrator-2d", Goal((3.0, 0.0), 0.5), (wall,), robot_radius=0.6)
    verdict = consult(query, [-3.0, 0.1])
    assert verdict.answers["PMP"].value is None
    assert verdict.answers["collocation"].value is not None
    assert not verdict.established
    assert "only collocation has an answer" in verdict.explanation


def answers(**costs: float | None) -> Verdict:
    given = {name.replace("_", " "): Answer(cost, None) for name, cost in costs.items()}
    return Verdict(np.zeros(1), given)


def test_a_cheaper_answer_unseats_two_that_agree() -> None:
    assert answers(PMP=2.0, collocation=2.0001).established
    assert not answers(PMP=2.0, collocation=2.001).established
    assert not answers(collocation=2.0, collocation_from_PMP=2.0).established
    unseated = answers(PMP=2.0, collocation_from_PMP=2.0, collocation=1.9)
    assert not unseated.established
    assert set(unseated.disagreements()) == {"PMP", "collocation from PMP"}
    assert answers(PMP=None).value is None
    assert not answers(PMP=None).established
