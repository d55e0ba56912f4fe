"""A car with steering: five states, driven by acceleration and steering rate."""

import math

import casadi as ca

from ocp.system import Coordinate, Input, System

WHEELBASE = 1.0
"""Metres between the axles."""


def car() -> System:
    """x' = v cos(heading), y' = v sin(heading), heading' = v tan(steering) / wheelbase.

    The point (x, y) is the middle of the rear axle; wheels roll without slip. The tangent of the
    steering angle is finite in the domain, and the input limits are those of a slow car.
    """
    state = ca.SX.sym("x", 5)  # pyright: ignore[reportArgumentType]
    heading, speed, steering = state[2], state[3], state[4]
    rate = ca.vertcat(
        speed * ca.cos(heading),
        speed * ca.sin(heading),
        speed * ca.tan(steering) / WHEELBASE,
        ca.SX.zeros(2, 1),
    )
    return System(
        name="car",
        coordinates=(
            Coordinate("x", "m", -5.0, 5.0),
            Coordinate("y", "m", -5.0, 5.0),
            Coordinate("heading", "rad", -math.pi, math.pi, periodic=True),
            Coordinate("speed", "m/s", -2.0, 2.0),
            Coordinate("steering", "rad", -0.8, 0.8),
        ),
        inputs=(
            Input("acceleration", "m/s^2", -3.0, 3.0),
            Input("steering rate", "rad/s", -2.0, 2.0),
        ),
        state=state,
        drift=rate,
        input_matrix=ca.vertcat(ca.SX.zeros(3, 2), ca.SX.eye(2)),
        position=(0, 1),
    )
