"""How far the links of a robot can move: bounds that turn a clearance into a certificate."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Positions of a joint that turn its child about its own origin, and those that shift it.
TURNS_AND_SHIFTS = {
    "weld": ((), ()),
    "revolute": ((0,), ()),
    "universal": ((0, 1), ()),
    "ball_rpy": ((0, 1, 2), ()),
    "prismatic": ((), (0,)),
    "planar": ((2,), (0, 1)),
    "rpy_floating": ((0, 1, 2), (3, 4, 5)),
}


class MotionBounds:
    """Bounds on the motion of a robot's collision geometries.

    A point that turns with joint j moves at most |dq_j| times its distance from the joint's origin,
    and that distance is at most the length of the chain of links between them; a joint that shifts
    moves it at most |dq_j|. The bounds hold for all configurations in the box.
    """

    def __init__(
        self, plant: Any, context: Any, lower: NDArray[np.float64], upper: NDArray[np.float64]
    ) -> None:
        self._plant, self._context = plant, context
        self._farthest = np.maximum(np.abs(lower), np.abs(upper))
        self._inboard = {
            int(joint.child_body().index()): joint
            for joint in map(plant.get_joint, plant.GetJointIndices())
        }
        self.known = all(j.type_name() in TURNS_AND_SHIFTS for j in self._inboard.values())

    def of(self, body: Any, inspector: Any, geometry: Any) -> NDArray[np.float64]:
        """Metres that a point of the geometry moves at most per unit of each position, `[n]`."""
        box = inspector.GetObbInGeometryFrame(geometry)
        in_body = inspector.GetPoseInFrame(geometry)
        signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1)
        corners = box.pose().multiply(np.diag(box.half_width()) @ signs)
        pose = self._plant.EvalBodyPoseInWorld(self._context, body).multiply(in_body)
        points = pose.multiply(corners).T
        bound = np.zeros(len(self._farthest))
        joint = self._inboard.get(int(body.index()))
        chain = 0.0
        while joint is not None:
            turns, shifts = TURNS_AND_SHIFTS[joint.type_name()]
            first = joint.position_start()
            if turns or shifts:
                origin = self._origin(joint.frame_on_child())
                chain += float(np.linalg.norm(points - origin, axis=1).max())
                bound[[first + k for k in turns]] = chain
                bound[[first + k for k in shifts]] = 1.0
                chain += float(np.linalg.norm(self._farthest[[first + k for k in shifts]]))
                points = self._origin(joint.frame_on_parent())[None]
            joint = self._inboard.get(int(joint.parent_body().index()))
        return bound

    def upstream(self, body: Any) -> set[int]:
        """The positions that move the body."""
        found: set[int] = set()
        joint = self._inboard.get(int(body.index()))
        while joint is not None:
            found.update(
                range(joint.position_start(), joint.position_start() + joint.num_positions())
            )
            joint = self._inboard.get(int(joint.parent_body().index()))
        return found

    def _origin(self, frame: Any) -> NDArray[np.float64]:
        return frame.CalcPoseInWorld(self._context).translation()
