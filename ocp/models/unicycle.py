"""The unicycle of Xu and Zhu (RSS 2022, section IV-A)."""

import math

import casadi as ca

from ocp.system import Coordinate, Input, System


def unicycle() -> System:
    """p_x' = v cos(beta), p_y' = v sin(beta), beta' = omega; v may be negative.

    Turning the robot round (beta + pi) and reversing v gives the same motion, hence `half_turn`.
    """
    state = ca.SX.sym("x", 3)
    heading = state[2]
    return System(
        name="unicycle",
        coordinates=(
            Coordinate("x", "m", -5.0, 5.0),
            Coordinate("y", "m", -5.0, 5.0),
            Coordinate("heading", "rad", -math.pi, math.pi, periodic=True),
        ),
        inputs=(Input("forward speed", "m/s"), Input("turn rate", "rad/s")),
        state=state,
        drift=ca.SX.zeros(3, 1),
        input_matrix=ca.vertcat(
            ca.horzcat(ca.cos(heading), 0), ca.horzcat(ca.sin(heading), 0), ca.horzcat(0, 1)
        ),
        position=(0, 1),
        half_turn=2,
    )
