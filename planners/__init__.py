"""Planning in changing worlds: RRT^X on Drake's geometry."""

from typing import TYPE_CHECKING

from ocp.lazy import lazy_names

if TYPE_CHECKING:
    from planners.blockage import Barrier, Blockage
    from planners.robot_world import RobotWorld, three_link_arm
    from planners.rrtx import RRTX, Cause, Route, TreeView, Update
    from planners.solids import Solid
    from planners.world import SceneWorld, World

_HOMES = {
    "Barrier": "blockage",
    "Blockage": "blockage",
    "Cause": "rrtx",
    "RRTX": "rrtx",
    "RobotWorld": "robot_world",
    "Route": "rrtx",
    "SceneWorld": "world",
    "Solid": "solids",
    "TreeView": "rrtx",
    "Update": "rrtx",
    "World": "world",
    "three_link_arm": "robot_world",
}

__all__ = [
    "RRTX",
    "Barrier",
    "Blockage",
    "Cause",
    "RobotWorld",
    "Route",
    "SceneWorld",
    "Solid",
    "TreeView",
    "Update",
    "World",
    "three_link_arm",
]


__getattr__ = lazy_names(__name__, _HOMES)
