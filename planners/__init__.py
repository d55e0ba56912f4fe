"""Planning in changing worlds: RRT^X on Drake's geometry."""

from typing import TYPE_CHECKING

from ocp.lazy import lazy_names

if TYPE_CHECKING:
    from planners.blockage import Barrier, Blockage
    from planners.leg_controller import LegController
    from planners.navigation_settings import NavigatorSettings, Rules
    from planners.robot_world import RobotWorld, three_link_arm
    from planners.rrt_qx import Navigator
    from planners.rrtx import RRTX
    from planners.solids import Solid
    from planners.update import Cause, Route, TreeView, Update
    from planners.world import SceneWorld, World

_HOMES = {
    "Barrier": "blockage",
    "Blockage": "blockage",
    "Cause": "update",
    "LegController": "leg_controller",
    "Navigator": "rrt_qx",
    "NavigatorSettings": "navigation_settings",
    "RRTX": "rrtx",
    "RobotWorld": "robot_world",
    "Route": "update",
    "Rules": "navigation_settings",
    "SceneWorld": "world",
    "Solid": "solids",
    "TreeView": "update",
    "Update": "update",
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
