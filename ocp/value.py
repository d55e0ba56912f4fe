"""Values and policies: the only place where a control is read off a value's gradient."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.compiled.batch import optimal_inputs, state_costs
from ocp.query import Query


class Value(Protocol):
    """A cost-to-go V >= 0: 0 in the goal, infinite where no admissible motion reaches it."""

    def value(self, states: ArrayLike) -> NDArray[np.float64]:
        """V at states `[..., n]`, as `[...]`."""
        ...

    def gradient(self, states: ArrayLike) -> NDArray[np.float64]:
        """The costate p = grad V at states `[..., n]`, as `[..., n]`."""
        ...


class Policy(Protocol):
    """A feedback policy; it knows its query."""

    @property
    def query(self) -> Query: ...

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        """Inputs `[..., m]` at states `[..., n]`."""
        ...


@dataclass(frozen=True)
class GreedyPolicy:
    """u(x) = argmin_u H(x, u, grad V(x)).

    Where time can be scaled away (no drift, no bounds), u' R u = W on every optimal motion, so only
    the gradient's direction is used and the input's size is set to satisfy this exactly.
    """

    query: Query
    value: Value

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        states = np.asarray(states, dtype=float)
        inputs = GradientPolicy(self.query, self.value)(states)
        if not self.query.is_time_free:
            return inputs
        effort = (self.query.input_weights * inputs**2).sum(axis=-1)
        wanted = state_costs(self.query, states)
        scale = np.sqrt(wanted / np.where(effort > 0, effort, np.inf))
        return inputs * scale[..., None]


@dataclass(frozen=True)
class GradientPolicy:
    """u(x) = argmin_u H(x, u, grad V(x)) as it stands: the gradient's size counts, not only where
    it points. An error of size can stall such a policy; `GreedyPolicy` is what to use."""

    query: Query
    value: Value

    def __call__(self, states: ArrayLike) -> NDArray[np.float64]:
        states = np.asarray(states, dtype=float)
        return optimal_inputs(self.query, states, self.value.gradient(states))


def greedy(query: Query, value: Value) -> GreedyPolicy:
    """The policy that is greedy with respect to `value`."""
    return GreedyPolicy(query, value)
