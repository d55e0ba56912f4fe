"""The registry of robots. A model added to `MODELS` is met by every law in the tests."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

from ocp.models.car import car
from ocp.models.linear import double_integrator, rover, single_integrator, springless_rover
from ocp.models.moving_frame import car_in_lane
from ocp.models.robots import ROBOTS, robot_file
from ocp.models.unicycle import unicycle
from ocp.system import System


def _from_file(path: Path) -> System:
    from ocp.models.multibody import multibody_system  # Drake takes a second to import

    return multibody_system(path)


MODELS: dict[str, Callable[[], System]] = {
    "unicycle": unicycle,
    "single-integrator-1d": lambda: single_integrator(1),
    "single-integrator-2d": lambda: single_integrator(2),
    "single-integrator-3d": lambda: single_integrator(3),
    "double-integrator-1d": lambda: double_integrator(1),
    "double-integrator-2d": lambda: double_integrator(2),
    "double-integrator-3d": lambda: double_integrator(3),
    "rover": rover,
    "springless-rover": springless_rover,
    "car": car,
    "car_in_lane": car_in_lane,
    **{name: (lambda name=name: _from_file(robot_file(name))) for name in ROBOTS},
}


@cache
def get_model(name: str) -> System:
    """The registered robot `name`.

    Raises:
        ValueError: if no such robot is registered; the message lists those that are.
    """
    if name not in MODELS:
        raise ValueError(f"model: {name!r} is not registered; known are {', '.join(MODELS)}")
    return MODELS[name]()


@cache
def get_model_file(path: Path) -> System:
    """The robot of an SDF or URDF file, read once.

    Raises:
        ValueError: if the file is not a robot that can be read.
    """
    return _from_file(path)


__all__ = ["MODELS", "get_model", "get_model_file"]
