"""The numbers of a query as one vector, the argument q of every compiled kernel."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ocp.obstacle import MAX_FACETS
from ocp.query import Query


@dataclass(frozen=True)
class Layout:
    """Where each number of a query stands in its parameter vector q.

    Attributes:
        n, m, d: states, inputs, position coordinates.
        quadratic: whether there is a quadratic state cost.
        bounded: whether any input is.
        resting: whether inputs are measured from those that hold the goal's equilibrium.
        own_cost: the user's own cost, see `RunningCost`; it is compiled in.
    """

    n: int
    m: int
    d: int
    quadratic: bool
    bounded: bool
    resting: bool = False
    own_cost: str = ""

    @property
    def goal(self) -> int:
        return (4 if self.resting else 3) * self.m

    @property
    def state(self) -> int:
        return self.goal + self.d + 5

    @property
    def count(self) -> int:
        return self.state + (self.n**2 + self.n if self.quadratic else 0)

    @property
    def stride(self) -> int:
        return 2 + self.d + (2 * MAX_FACETS if self.d == 2 else 0)

    @classmethod
    def of(cls, query: Query) -> "Layout":
        return _layout(query)


@lru_cache(maxsize=256)
def _layout(query: Query) -> Layout:
    system = query.system
    return Layout(
        system.n,
        system.m,
        len(system.position),
        query.cost.state is not None,
        query.is_bounded,
        query.is_regulation,
        str(query.cost.own),
    )


def parameters(query: Query) -> NDArray[np.float64]:
    """The parameter vector q of a query: input limits and weights, goal, cost, obstacles."""
    # A copy: compiled signatures take writable arrays, and nobody may write into the kept one.
    return _parameters(query).copy()


@lru_cache(maxsize=256)
def _parameters(query: Query) -> NDArray[np.float64]:
    layout = Layout.of(query)
    w = query.cost
    head = [
        query.input_weights,
        *query.input_bounds,
        *([query.reference_input] if layout.resting else []),
        query.goal_position,
        [query.goal.radius, w.goal, w.goal_steepness, w.obstacle, w.obstacle_steepness],
    ]
    if w.state is not None:
        head += [query.reference, np.array(w.state).ravel()]
    records = np.zeros((len(query.obstacles), layout.stride))
    for record, o in zip(records, query.obstacles, strict=True):
        facets = o.facets.ravel()
        record[0], record[1] = len(o.facets), o.radius
        record[2 : 2 + layout.d] = o.center
        record[2 + layout.d : 2 + layout.d + len(facets)] = facets
    return np.concatenate([*head, [len(records)], records.ravel()])
