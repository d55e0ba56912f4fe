"""Planning in changing worlds: RRT^X on Drake's geometry."""

from typing import TYPE_CHECKING

from ocp.lazy import lazy_names

if TYPE_CHECKING:
    from planners.blockage import Barrier, Blockage
    from planners.robot_world import RobotWorld, three_link_arm
    from planners.rrt_qx import LegController, Navigator, NavigatorSettings, Rules
    from planners.rrtx import RRTX, Cause, Route, TreeView, Update
    from planners.solids import Solid
    from planners.world import SceneWorld, World

_HOMES = {
    "Barrier": "blockage",
    "Blockage": "blockage",
    "Cause": "rrtx",
    "LegController": "rrt_qx",
    "Navigator": "rrt_qx",
    "NavigatorSettings": "rrt_qx",
    "RRTX": "rrtx",
    "RobotWorld": "robot_world",
    "Route": "rrtx",
    "Rules": "rrt_qx",
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
    "LegController",
    "Navigator",
    "NavigatorSettings",
    "RobotWorld",
    "Route",
    "Rules",
    "SceneWorld",
    "Solid",
    "TreeView",
    "Update",
    "World",
    "three_link_arm",
]


__getattr__ = lazy_names(__name__, _HOMES)
