"""A linear plant under a sampled controller, as a Drake Diagram."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import AffineSystem, LinearSystem

from sims.regulation.simulation import Controller, LinearPlant, Motion

Array = NDArray[np.float64]


class SampledController(LeafSystem):
    """A controller (a learner, a law, a regulator) that meets the plant once a sample.

    Its memory lives in the Python object, not in the Drake context: one Simulator at a time.

    Ports: input "state" `[n]`; output "u" `[m]`, held between samples.
    """

    def __init__(
        self,
        controller: Controller,
        n: int,
        m: int,
        period: float,
        noise: float,
        rng: np.random.Generator,
    ) -> None:
        super().__init__()
        self._controller, self._noise, self._rng = controller, noise, rng
        self.log: list[tuple[float, Array, Array, Array]] = []
        self.DeclareVectorInputPort("state", n)
        held = self.DeclareDiscreteState(m)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._sample)
        self.DeclareStateOutputPort("u", held)

    def _sample(self, context: Context, discrete: Any) -> None:
        state: Any = self.get_input_port(0).Eval(context)
        measured = np.array(state)
        if self._noise > 0:
            measured += self._noise * self._rng.standard_normal(len(measured))
        u = np.array(self._controller.control(measured))
        self.log.append((context.get_time(), np.array(state), measured, u))
        discrete.get_mutable_vector().SetFromVector(u)


def simulate(
    plant: LinearPlant,
    controller: Controller,
    start: Array,
    seconds: float,
    period: float,
    noise: float,
    rng: np.random.Generator,
    accuracy: float,
) -> Motion:
    """See `regulation.drake_motion`."""
    n, m = plant.B.shape
    builder: Any = DiagramBuilder()
    # Any: Drake's stubs mistype arrays.
    A, B, C, D = (*map(np.array, (plant.A, plant.B)), np.eye(n), np.zeros((n, m)))
    matrices: tuple[Any, ...] = (A, B, C, D)
    if plant.drift.any():
        affine: tuple[Any, ...] = (A, B, plant.drift, C, D, np.zeros(n))
        robot = builder.AddSystem(AffineSystem(*affine))
    else:
        robot = builder.AddSystem(LinearSystem(*matrices))
    sampler = builder.AddSystem(SampledController(controller, n, m, period, noise, rng))
    builder.Connect(robot.get_output_port(), sampler.get_input_port(0))
    builder.Connect(sampler.get_output_port(0), robot.get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    ResetIntegratorFromFlags(simulator, "runge_kutta5", period)
    simulator.get_mutable_integrator().set_target_accuracy(accuracy)
    context = simulator.get_mutable_context()
    # Context.SetContinuousState exists, but the diagram's only continuous state is the robot's.
    context.SetContinuousState(start)  # pyright: ignore[reportArgumentType]
    simulator.Initialize()
    simulator.AdvanceTo(seconds)
    # The sample at the very end closes the last hold.
    simulator.AdvancePendingEvents()
    times, states, measured, inputs = zip(*sampler.log, strict=True)
    return Motion(np.array(times), np.array(states), np.array(measured), np.array(inputs))
