"""Robots of Drake's MultibodyPlant, linearised by Drake: the plants of two shipped system files.

`python -m sims.regulation.linearised cart-pole` (or `planar-quadrotor`) prints A and B.
"""

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant, Propeller, PropellerInfo
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Linearize

Array = NDArray[np.float64]

GRAVITY = 9.81

# Any: Drake's stubs mistype vectors.
X_AXIS: Any = np.array([1.0, 0.0, 0.0])
Y_AXIS: Any = np.array([0.0, 1.0, 0.0])
Z_AXIS: Any = np.array([0.0, 0.0, 1.0])


def cart_pole() -> tuple[Array, Array]:
    """A cart of 1 kg with a uniform rod of 0.2 kg and 1 m standing on it; the input is its force.

    State: cart position (m), rod angle from upright (rad), their rates. Linearised upright.
    """
    cart_mass, rod_mass, length = 1.0, 0.2, 1.0
    plant = MultibodyPlant(0.0)
    cart = plant.AddRigidBody("cart", SpatialInertia.SolidBoxWithMass(cart_mass, 0.4, 0.2, 0.2))
    center = 0.5 * length * Z_AXIS
    about_center = UnitInertia.ThinRod(length, Z_AXIS)
    rod = plant.AddRigidBody(
        "rod",
        SpatialInertia(rod_mass, center, about_center.ShiftFromCenterOfMass(-center)),
    )
    slide = plant.AddJoint(PrismaticJoint("slide", plant.world_frame(), cart.body_frame(), X_AXIS))
    plant.AddJoint(RevoluteJoint("pivot", cart.body_frame(), rod.body_frame(), Y_AXIS))
    plant.AddJointActuator("force", slide)
    plant.mutable_gravity_field().set_gravity_vector(-GRAVITY * Z_AXIS)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.get_actuation_input_port().FixValue(context, np.zeros(1))
    linear = Linearize(
        plant,
        context,
        plant.get_actuation_input_port().get_index(),
        plant.get_state_output_port().get_index(),
    )
    return np.array(linear.A()), np.array(linear.B())


def planar_quadrotor() -> tuple[Array, Array]:
    """A quadrotor of 1 kg in a vertical plane, two rotors 0.25 m from its centre, in hover.

    State: position x, height, tilt (m, m, rad) and their rates; inputs: the rotors' thrusts beyond
    hover (N).
    """
    mass, arm = 1.0, 0.25
    builder: Any = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.0))
    frame_inertia = SpatialInertia.SolidBoxWithMass(mass, 2 * arm, 0.05, 0.2)
    body = plant.AddRigidBody("frame", frame_inertia)
    # PlanarJoint moves in its frame's x-y plane; turn that plane upright.
    upright = RigidTransform(RotationMatrix.MakeXRotation(np.pi / 2))
    plant.AddJoint(
        PlanarJoint(
            "flight",
            plant.AddFrame(FixedOffsetFrame("vertical", plant.world_frame(), upright)),
            body.body_frame(),
            0.0 * Z_AXIS,
        )
    )
    plant.mutable_gravity_field().set_gravity_vector(-GRAVITY * Z_AXIS)
    plant.Finalize()
    along_y = RotationMatrix.MakeXRotation(-np.pi / 2)
    rotors = builder.AddSystem(
        Propeller(
            [
                PropellerInfo(body.index(), RigidTransform(along_y, side * arm * X_AXIS))
                for side in (1.0, -1.0)
            ]
        )
    )
    builder.Connect(
        rotors.get_spatial_forces_output_port(), plant.get_applied_spatial_force_input_port()
    )
    builder.Connect(plant.get_body_poses_output_port(), rotors.get_body_poses_input_port())
    command = builder.ExportInput(rotors.get_command_input_port(), "thrust")
    output = builder.ExportOutput(plant.get_state_output_port(), "state")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.get_input_port(command).FixValue(context, np.full(2, mass * GRAVITY / 2))
    linear = Linearize(diagram, context, command, output)
    return np.array(linear.A()), np.array(linear.B())


LINEARISED: dict[str, Callable[[], tuple[Array, Array]]] = {
    "cart-pole": cart_pole,
    "planar-quadrotor": planar_quadrotor,
}


def _print(name: str) -> None:
    for label, matrix in zip("AB", LINEARISED[name](), strict=True):
        print(f"{label} = [")
        for row in np.where(np.abs(matrix) < 1e-12, 0.0, matrix):
            print(f"    {row.tolist()},")
        print("]")


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] not in LINEARISED:
        sys.exit(f"usage: python -m sims.regulation.linearised {{{','.join(LINEARISED)}}}")
    _print(sys.argv[1])
