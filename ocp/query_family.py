"""Families of queries: a distribution to draw planning problems and starts from."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ocp.obstacle import Obstacle
from ocp.query import Goal, Query


@dataclass(frozen=True)
class QueryFamily:
    """A distribution p(X_G, L) of queries with a common robot.

    Attributes:
        name: for records and messages.
        draw: one query from a random generator.
    """

    name: str
    draw: Callable[[np.random.Generator], Query]

    def sample(self, rng: np.random.Generator) -> Query:
        """One query."""
        return self.draw(rng)

    def sample_with_start(self, rng: np.random.Generator) -> tuple[Query, NDArray[np.float64]]:
        """One query and a start `[n]` drawn by `sample_start`."""
        query = self.sample(rng)
        return query, sample_start(query, rng)


def sample_start(query: Query, rng: np.random.Generator) -> NDArray[np.float64]:
    """A state `[n]` uniform in the robot's domain, outside the goal ball and hard obstacles.

    Raises:
        ValueError: if 10,000 draws found none.
    """
    system = query.system
    for _ in range(10_000):
        start = rng.uniform(system.lower, system.upper)
        if query.goal_distance(start) > 0 and query.clearance(start, hard_only=True) >= 0:
            return start
    raise ValueError("start: the goal and hard obstacles leave no room for one")


def paper_query(center: tuple[float, float]) -> Query:
    """The query of Xu and Zhu's family (section IV-A) with its goal at `center` in [0, 5]^2.

    No obstacle if both coordinates exceed 2.5; a circle if neither does; else two diamonds more.
    """
    circle = Obstacle.circle((-1.0, -1.0), 1.0)
    diamonds = tuple(Obstacle.diamond(c, 0.8) for c in ((-2.0, 2.0), (2.0, -2.0)))
    beyond = sum(x > 2.5 for x in center)
    obstacles = {2: (), 0: (circle,), 1: (circle, *diamonds)}[beyond]
    return Query("unicycle", Goal(center, 0.5), obstacles)


def _draw_paper_query(rng: np.random.Generator) -> Query:
    x, y = rng.uniform(0.0, 5.0, 2)
    return paper_query((float(x), float(y)))


PAPER_FAMILY = QueryFamily("paper", _draw_paper_query)
PAPER_GOALS = ((4.0, 4.0), (1.0, 1.0), (1.0, 4.0), (4.0, 1.0))
"""The four queries of the paper's Table I."""
PAPER_START = (-4.0, -4.0, -np.pi / 4)
"""The start of the paper's Table I."""
PAPER_FIGURE_STARTS = (
    (-4.0, 2.0, -0.1 * np.pi),
    (2.5, 2.5, -0.125 * np.pi),
    (2.5, -4.5, -0.5 * np.pi),
    (-4.0, -4.0, -0.25 * np.pi),
    (-3.0, -3.0, 0.25 * np.pi),
    (-2.5, -4.0, 0.25 * np.pi),
)
"""The six starts of the paper's Figure 1."""
