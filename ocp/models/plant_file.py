"""Robot files, SDF or URDF, as finalized plants with their propellers and domains.

In a robot file, elements of the XML namespace "zermelo" say what SDF and URDF cannot; Drake ignores
them:
    <zermelo:propeller frame="left" moment_ratio="0.02" max_thrust="8"/>
        thrust along the z axis of a frame, from 0 to `max_thrust`; the moment about that axis is
        `moment_ratio` times the thrust (as in Drake's Propeller)
    <zermelo:domain coordinate="x" lower="-4" upper="4"/>
        the domain of one coordinate, by its name
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RpyFloatingJoint

NAMESPACE = "{zermelo}"


@dataclass(frozen=True)
class Thruster:
    """A propeller: its input is a thrust in newtons.

    Attributes:
        frame: name of the plant's frame along whose z axis it pushes.
        moment_ratio: moment about that axis over thrust, metres.
        max_thrust: newtons; the least is 0.
    """

    frame: str
    moment_ratio: float = 0.0
    max_thrust: float = math.inf


def load_plant(
    path: str | os.PathLike[str],
) -> tuple[MultibodyPlant, tuple[Thruster, ...], dict[str, tuple[float, float]]]:
    """A finalized plant from an SDF or URDF file, the propellers and domains the file names.

    Free bodies get the roll-pitch-yaw chart.

    Raises:
        ValueError: if the file is not a robot.
        OSError: if it cannot be read.
    """
    path = Path(path)
    if path.suffix not in (".sdf", ".urdf"):
        raise ValueError(f"model: a robot file ends in .sdf or .urdf, got {path.name!r}")
    text = path.read_text(encoding="utf-8")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"model: {path.name} is no XML: {error}") from error
    thrusters = tuple(
        Thruster(
            _attribute(e, "frame"),
            _number(e, "moment_ratio", 0.0),
            _number(e, "max_thrust", math.inf),
        )
        for e in root.iter(f"{NAMESPACE}propeller")
    )
    domain = {
        _attribute(e, "coordinate"): (_number(e, "lower"), _number(e, "upper"))
        for e in root.iter(f"{NAMESPACE}domain")
    }
    plant = MultibodyPlant(0.0)
    try:
        Parser(plant).AddModelsFromString(_without_ours(root), path.suffix[1:])
    except RuntimeError as error:
        raise ValueError(f"model: {path.name}: {error}") from error
    children = {plant.get_joint(i).child_body().index() for i in plant.GetJointIndices()}
    for index in range(1, plant.num_bodies()):
        body = plant.get_body(BodyIndex(index))
        if body.index() not in children:
            plant.AddJoint(RpyFloatingJoint(body.name(), plant.world_frame(), body.body_frame()))
    plant.Finalize()
    return plant, thrusters, domain


def _without_ours(root: ElementTree.Element) -> str:
    """The robot's XML without the elements that Drake does not know."""
    for parent in root.iter():
        for child in [c for c in parent if c.tag.startswith(NAMESPACE)]:
            parent.remove(child)
    ElementTree.register_namespace("drake", "drake.mit.edu")
    return ElementTree.tostring(root, encoding="unicode")


def _attribute(element: ElementTree.Element, name: str) -> str:
    value = element.get(name)
    if value is None:
        raise ValueError(f"model: <{element.tag.replace(NAMESPACE, 'zermelo:')}> lacks {name!r}")
    return value


def _number(element: ElementTree.Element, name: str, default: float | None = None) -> float:
    if default is not None and element.get(name) is None:
        return default
    text = _attribute(element, name)
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"model: {name}={text!r} must be a number") from None
