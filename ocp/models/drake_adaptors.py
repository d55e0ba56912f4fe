"""A robot and a policy as Drake systems, for Diagrams and Drake's Simulator."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, LeafSystem

from ocp.kernels import kernels, parameters
from ocp.query import Query
from ocp.value import Policy


class Plant(LeafSystem):
    """x' = f(x) + G(x) u, with the running cost accumulated in a last continuous state.

    Ports: input "u" `[m]`; output "state" `[n]`. Continuous state `[n + 1]`: x and the cost so far.
    """

    def __init__(self, query: Query) -> None:
        super().__init__()
        self._kernels = kernels(query)
        self._parameters = parameters(query)
        n, m = query.system.n, query.system.m
        self.DeclareVectorInputPort("u", m)
        self.DeclareContinuousState(n + 1)
        self.DeclareVectorOutputPort("state", n, self._output, {self.xc_ticket()})
        self._n = n

    def _output(self, context: Context, output: Any) -> None:
        output.SetFromVector(context.get_continuous_state_vector().CopyToVector()[: self._n])

    def DoCalcTimeDerivatives(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, context: Context, derivatives: Any
    ) -> None:
        x = context.get_continuous_state_vector().CopyToVector()[: self._n]
        u: Any = self.get_input_port(0).Eval(context)
        rate = np.empty(self._n + 1)
        self._kernels.dynamics(x, u, rate[: self._n])
        rate[self._n] = self._kernels.running_cost(np.concatenate([x, u]), self._parameters)
        derivatives.get_mutable_vector().SetFromVector(rate)


class SampledPolicy(LeafSystem):
    """A policy sampled every `period` seconds, its input held in between (zero-order hold).

    Ports: input "state" `[n]`; output "u" `[m]`.
    """

    def __init__(self, policy: Policy, period: float) -> None:
        super().__init__()
        self._policy = policy
        system = policy.query.system
        self.DeclareVectorInputPort("state", system.n)
        held = self.DeclareDiscreteState(system.m)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)
        self.DeclareStateOutputPort("u", held)

    def _sample(self, context: Context, discrete: Any) -> None:
        state: Any = self.get_input_port(0).Eval(context)
        discrete.get_mutable_vector().SetFromVector(np.asarray(self._policy(state)))


class StateFeedback(LeafSystem):
    """u = law(state), without memory or delay.

    Ports: input "state" `[n]`; output "u" `[m]`.
    """

    def __init__(self, law: Callable[[NDArray[np.float64]], NDArray[np.float64]], n: int, m: int):
        super().__init__()
        self._law = law
        self.DeclareVectorInputPort("state", n)
        self.DeclareVectorOutputPort("u", m, self._output)

    def _output(self, context: Context, output: Any) -> None:
        state: Any = self.get_input_port(0).Eval(context)
        output.SetFromVector(np.asarray(self._law(np.array(state))))
