"""The planning methods by name: what `--method` accepts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ocp.planning import Answer, OneShot, Planner
from ocp.query import Query
from ocp.value import greedy


@dataclass(frozen=True)
class Method:
    """A method of `zermelo plan`.

    Attributes:
        summary: one line for help and error messages.
        make: the planner; imports what it needs.
        rehearse: solve a small version of the query, so that compiled code is loaded.
    """

    summary: str
    make: Callable[[], Planner]
    rehearse: Callable[[Query], None]

    @cached_property
    def planner(self) -> Planner:
        return self.make()


def _eikonal(nodes: int) -> OneShot:
    from ocp.eikonal import solve_eikonal

    def solve(query: Query, _starts: Sequence[NDArray[np.float64]]) -> Answer:
        solution = solve_eikonal(query, nodes=nodes)
        return solution.policy(), solution.value

    return OneShot(solve)


def _exact() -> OneShot:
    from ocp.pontryagin import ExactValue

    def solve(query: Query, starts: Sequence[NDArray[np.float64]]) -> Answer:
        value = ExactValue(query)
        for start in starts:
            value.value(start)
        return greedy(query, value), value

    return OneShot(solve)


def _set_valued() -> OneShot:
    from ocp.set_valued import solve_set_valued

    def solve(query: Query, _starts: Sequence[NDArray[np.float64]]) -> Answer:
        solution = solve_set_valued(query)
        return solution.policy(), solution.value

    return OneShot(solve)


METHODS: dict[str, Method] = {}
