"""What a robot knew and planned, at moments of its run: for pictures."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planners.orders import Order
from planners.rrt_qx import Navigator
from planners.solids import Solid
from planners.update import TreeView

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Moment:
    """One moment.

    Attributes:
        time: seconds.
        position: `[d]`, of the robot.
        order: what the navigator said.
        tree: RRT^X's tree and graph.
        route: `[k, d]`; `None` if there is none.
        known: what the robot knows of, by key; other robots have negative ones.
    """

    time: float
    position: Array
    order: Order
    tree: TreeView
    route: Array | None
    known: list[tuple[int, Solid]]

    @property
    def solids(self) -> list[Solid]:
        """What the robot knows of."""
        return [solid for _, solid in self.known]


class Recorder:
    """Keeps a moment every so many seconds."""

    def __init__(self, every: float) -> None:
        self._every, self._next = every, 0.0
        self.moments: list[Moment] = []

    def look(self, time: float, state: Array, navigator: Navigator, order: Order) -> None:
        """Keep this moment if one is due."""
        if time < self._next - 1e-9:
            return
        self._next = time + self._every
        d = len(navigator.planner.goal)
        route = navigator.planner.route.points if navigator.has_route else None
        self.moments.append(
            Moment(
                time,
                state[:d].copy(),
                order,
                navigator.planner.view(),
                route,
                navigator.perceived.known,
            )
        )
