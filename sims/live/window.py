"""`zermelo live`: sliders move goal, obstacles and start; the policy is planned anew at once."""

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from ocp.obstacle import Obstacle
from ocp.planning import deadline, plan, trajectories
from ocp.query import Goal, Query
from ocp.query_family import PAPER_START, paper_query
from ocp.trajectory import SolveError
from sims.closed_loop import LoopSettings, rollout
from sims.exit_status import reading_input
from sims.live.scene import LiveScene
from sims.methods import METHODS, default_method

if TYPE_CHECKING:
    from sims import cli

MODELS = ("unicycle", "single-integrator-2d")
POLL = 0.05
"""Seconds between looks at the controls."""
BUDGET = 0.5
"""Seconds that an anytime method may take."""
STEP = 0.05
STOP = "stop"
notes = Console(stderr=True)


@dataclass(frozen=True)
class Wish:
    """What the controls ask for.

    Attributes:
        model, method: names.
        goal: `(x, y)`.
        obstacles: their centres.
        start: a state of the unicycle; other robots take as many of its coordinates as they have.
    """

    model: str
    method: str
    goal: tuple[float, float]
    obstacles: tuple[tuple[float, float], ...]
    start: tuple[float, float, float]


@dataclass(frozen=True)
class Shown:
    """What the window says about the wish.

    Attributes:
        cost: of the closed loop; `None` if it did not arrive or was not planned.
        exact_cost: `None` where no exact answer was found.
        seconds: until the policy was ready.
        complaint: why there is no policy; empty if there is one.
    """

    cost: float | None = None
    exact_cost: float | None = None
    seconds: float = 0.0
    complaint: str = ""

    def labels(self) -> list[str]:
        """Lines short enough for the controls' panel."""
        if self.complaint:
            return [self.complaint]
        cost = "never arrives" if self.cost is None else f"cost {self.cost:.4f}"
        lines = [f"policy in {1e3 * self.seconds:.0f} ms", cost]
        if self.exact_cost is not None:
            lines.append(f"exact {self.exact_cost:.4f}")
            if self.cost is not None and self.exact_cost > 0:
                lines.append(f"excess {self.cost / self.exact_cost - 1:.3%}")
        else:
            lines.append("exact: not found")
        return lines


class LiveSession:
    """The controls and what they change. `refresh` is to be called again and again.

    Attributes:
        query: what the window began with; its obstacles keep their shapes.
        scene: what is drawn.
        shown: what the window says now.
        finished: whether the stop button was pressed.
    """

    def __init__(self, query: Query, method: str | None = None, port: int | None = None) -> None:
        self.query = query
        self.method = method or default_method(query)[0]
        self.model = str(query.model)
        self.scene = LiveScene(port)
        self.shown = Shown()
        self.finished = False
        self._wish: Wish | None = None
        self._labels: list[str] = []
        self._model_button, self._method_button = "", ""
        self._add_controls()

    def refresh(self) -> bool:
        """Look at the controls; if they ask for something new, plan and draw it. Says whether."""
        meshcat = self.scene.meshcat
        self.finished = meshcat.GetButtonClicks(STOP) > 0
        if meshcat.GetButtonClicks(self._method_button) > 0:
            self.method = _next(self.method, tuple(METHODS))
        if meshcat.GetButtonClicks(self._model_button) > 0:
            self.model = _next(self.model, MODELS)
        wish = self._read()
        if wish == self._wish:
            return False
        self._wish = wish
        self._name_buttons()
        self._show(wish)
        return True

    def _add_controls(self) -> None:
        meshcat, goal = self.scene.meshcat, self.query.goal
        assert isinstance(goal, Goal)
        for name, value in zip(("goal x", "goal y"), goal.center, strict=True):
            meshcat.AddSlider(name, -4.5, 4.5, STEP, value)
        for name, value in zip(("start x", "start y", "start heading"), PAPER_START, strict=True):
            meshcat.AddSlider(name, -4.9, 4.9, STEP, value)
        for k, obstacle in enumerate(self.query.obstacles):
            for axis, value in zip("xy", obstacle.center, strict=True):
                meshcat.AddSlider(f"obstacle {k} {axis}", -4.5, 4.5, STEP, value)
        meshcat.AddButton(STOP)
        self._name_buttons()

    def _name_buttons(self) -> None:
        """A button's name says what is chosen; naming it anew also clears its clicks."""
        meshcat = self.scene.meshcat
        for old in (self._model_button, self._method_button):
            if old:
                meshcat.DeleteButton(old)
        self._model_button = f"model: {self.model}"
        self._method_button = f"method: {self.method}"
        meshcat.AddButton(self._model_button)
        meshcat.AddButton(self._method_button)

    def _read(self) -> Wish:
        def at(name: str) -> float:
            return float(self.scene.meshcat.GetSliderValue(name))

        return Wish(
            self.model,
            self.method,
            (at("goal x"), at("goal y")),
            tuple(
                (at(f"obstacle {k} x"), at(f"obstacle {k} y"))
                for k in range(len(self.query.obstacles))
            ),
            (at("start x"), at("start y"), at("start heading")),
        )

    def _show(self, wish: Wish) -> None:
        scene = self.scene
        try:
            query, start = _query(self.query, wish)
            scene.draw_query(query)
            scene.draw_start(query, start)
            method = METHODS[wish.method]
            until = deadline(BUDGET) | trajectories(8)
            answer = plan(method.planner(), query, [start], until)
        except (SolveError, ValueError) as error:
            for name in ("loop", "optimum"):
                scene.meshcat.Delete(name)
            self._say(Shown(complaint=str(error)))
            return
        loop = rollout(answer.policy, start, LoopSettings(period=method.period))
        scene.draw_value(query, answer.value)
        scene.draw_motion(query, "loop", loop.trajectory)
        exact = _exact(query, start)
        scene.draw_motion(query, "optimum", exact)
        exact_cost = None if exact is None else exact.cost
        self._say(Shown(loop.cost, exact_cost, answer.reaction_time))

    def _say(self, shown: Shown) -> None:
        """Meshcat has no text but the names of controls: buttons that do nothing say it."""
        self.shown, old = shown, self._labels
        self._labels = shown.labels()
        for label in old:
            self.scene.meshcat.DeleteButton(label)
        for label in self._labels:
            self.scene.meshcat.AddButton(label)


def _query(base: Query, wish: Wish) -> tuple[Query, NDArray[np.float64]]:
    """The query and the start that are asked for.

    Raises:
        ValueError: if they do not fit, such as a start in the goal.
    """
    assert isinstance(base.goal, Goal)
    obstacles = tuple(_moved(o, c) for o, c in zip(base.obstacles, wish.obstacles, strict=True))
    goal = replace(base.goal, center=wish.goal)
    query = Query(wish.model, goal, obstacles)
    return query, query.check_start(wish.start[: query.system.n])


def _moved(obstacle: Obstacle, center: tuple[float, float]) -> Obstacle:
    shift = np.array(center) - obstacle.center
    vertices = tuple((x + float(shift[0]), y + float(shift[1])) for x, y in obstacle.vertices)
    return replace(obstacle, center=center, vertices=vertices)


def _exact(query: Query, start: NDArray[np.float64]):
    """The cheapest extremal, drawn beside the policy; `None` where none was found."""
    from ocp.pontryagin import exact_trajectory

    try:
        return exact_trajectory(query, start)
    except SolveError:
        return None


def _next(name: str, names: tuple[str, ...]) -> str:
    return names[(names.index(name) + 1) % len(names)] if name in names else names[0]


def run(command: "cli.Live") -> int:
    """Run the command until the stop button, Ctrl-C, or `--seconds` have passed."""
    with reading_input():
        query = paper_query((1.0, 4.0)) if command.query is None else Query.load(command.query)
        if not isinstance(query.goal, Goal) or len(query.system.position) != 2:
            raise ValueError(f"query: the live window shows the plane, got {query.model}")
        if command.method is not None and command.method not in METHODS:
            raise ValueError(
                f"method: {command.method!r} is unknown; known are {', '.join(METHODS)}"
            )
    session = LiveSession(query, command.method, command.port)
    notes.print(f"live at {session.scene.url} (this machine only); Ctrl-C or its stop button ends")
    began = time.monotonic()
    try:
        while not session.finished:
            if session.refresh():
                notes.print("  ".join(session.shown.labels()))
            if command.seconds is not None and time.monotonic() - began > command.seconds:
                break
            time.sleep(POLL)
    except KeyboardInterrupt:
        notes.print("ended")
    return 0
