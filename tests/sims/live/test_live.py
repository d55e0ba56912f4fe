"""The live window: controls are read, policies follow, mistakes are said."""

from collections.abc import Iterator

import pytest

from ocp.query_family import paper_query
from sims.live.window import LiveSession


@pytest.fixture(scope="module")
def session() -> Iterator[LiveSession]:
    window = LiveSession(paper_query((1.0, 4.0)), "eikonal")
    window.refresh()
    yield window
    del window


def test_it_serves_this_machine_only(session: LiveSession) -> None:
    assert session.scene.url.startswith("http://localhost:")


def test_what_it_shows_first_is_the_query_it_was_given(session: LiveSession) -> None:
    assert not session.refresh()
    assert session.shown.cost is not None
    assert session.shown.exact_cost is not None
    assert -1e-4 < session.shown.cost / session.shown.exact_cost - 1 < 0.01


def test_a_moved_slider_is_a_new_plan(session: LiveSession) -> None:
    before = session.shown
    session.scene.meshcat.SetSliderValue("goal x", 4.0)
    assert session.refresh()
    after = session.shown
    assert after.cost is not None
    assert before.cost is not None
    assert after.cost > before.cost + 1
    assert any(label.startswith("excess") for label in after.labels())
    session.scene.meshcat.SetSliderValue("obstacle 0 x", 1.0)
    assert session.refresh()
    assert session.shown.exact_cost != after.exact_cost


def test_what_does_not_fit_is_said_and_can_be_undone(session: LiveSession) -> None:
    meshcat = session.scene.meshcat
    for axis in "xy":
        meshcat.SetSliderValue(f"start {axis}", meshcat.GetSliderValue(f"goal {axis}"))
    session.refresh()
    assert session.shown.cost is None or session.shown.cost == 0
    meshcat.SetSliderValue("start x", -4.0)
    assert session.refresh()
    assert session.shown.complaint == ""
    assert session.shown.cost is not None


def test_the_buttons_change_model_and_method(session: LiveSession) -> None:
    session.model, session.method = "single-integrator-2d", "eikonal"
    assert session.refresh()
    assert session.shown.cost is not None
    assert session.shown.exact_cost is not None
    assert -1e-4 < session.shown.cost / session.shown.exact_cost - 1 < 0.05
    assert not session.finished
