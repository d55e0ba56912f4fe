"""From a robot's SDF file to its swing-up as a policy in a Drake Diagram."""

from pathlib import Path

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from ocp import Query, greedy
from ocp.cost import RunningCost
from ocp.models.drake_adaptors import StateFeedback
from ocp.models.multibody import multibody_model
from ocp.query import Equilibrium
from ocp.regulation_value import RegulationValue

robot = multibody_model(Path(__file__).parent / "furuta.sdf")
weights = ((1.0, 0, 0, 0), (0, 5.0, 0, 0), (0, 0, 0.1, 0), (0, 0, 0, 0.1))
query = Query(
    robot.system,
    Equilibrium(state=(0.0, np.pi, 0.0, 0.0), radius=0.3),
    cost=RunningCost(goal=0.0, state=weights, input=(5.0,)),
)
policy = greedy(query, RegulationValue(query))
print(f"optimal cost from hanging: {policy.value.value([0.0, 0, 0, 0]):.4f}")

builder = DiagramBuilder()
plant = builder.AddSystem(robot.diagram())  # Drake's own dynamics, not ours
feedback = builder.AddSystem(StateFeedback(lambda x: policy(robot.from_drake(x)), 4, 1))
builder.Connect(plant.GetOutputPort("state"), feedback.get_input_port())
builder.Connect(feedback.get_output_port(), plant.GetInputPort("u"))
simulator = Simulator(builder.Build())
simulator.AdvanceTo(6.0)
end = simulator.get_context().get_continuous_state_vector().CopyToVector()
print("after 6 s:", robot.from_drake(end).round(3))
