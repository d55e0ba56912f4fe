"""A robot seen from a frame that moves: resting in it means moving along with it."""

from collections.abc import Mapping
from dataclasses import replace

import casadi as ca

from ocp.models.car import car
from ocp.system import System


def in_moving_frame(system: System, velocity: Mapping[str, float], name: str) -> System:
    """`system` in coordinates that move at a constant rate: x' = f(x) + G(x) u - v.

    Args:
        system: any robot.
        velocity: the rates v of the coordinates that move, by name; the dynamics must not depend
            on these coordinates.
        name: of the result.

    Raises:
        ValueError: if a coordinate is unknown, or the dynamics depend on it.
    """
    index = {c.name: i for i, c in enumerate(system.coordinates)}
    rate = ca.SX.zeros(system.n, 1)
    everything = ca.vertcat(system.drift, ca.vec(system.input_matrix))
    for moving, speed in velocity.items():
        if moving not in index:
            raise ValueError(
                f"velocity: {system.name} has no coordinate {moving!r}; known are "
                f"{', '.join(index)}"
            )
        i = index[moving]
        if ca.depends_on(everything, system.state[i]):
            raise ValueError(f"velocity: the dynamics of {system.name} depend on {moving}")
        rate[i] = speed
    return replace(system, name=name, drift=system.drift - rate)


CRUISE = 1.2
"""Metres a second: the speed of the lane in which `car_in_lane` drives."""


def car_in_lane() -> System:
    """The car in a frame that moves along x at `CRUISE`: a slot in the traffic to merge into.

    At rest a car cannot be regulated smoothly (its linearisation does not reach sideways motion);
    in the slot, where it drives straight at `CRUISE`, it can.
    """
    return in_moving_frame(car(), {"x": CRUISE}, "car_in_lane")
