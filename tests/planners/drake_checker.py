"""Drake's own collision checker for a point robot among padded solids: the referee of routes."""

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.planning import RobotDiagramBuilder, SceneGraphCollisionChecker

from planners.drake_geometry import drake_shape
from planners.solids import Solid


class PaddedChecker:
    """Prismatic joints carry a point through the solids."""

    def __init__(self, dimension: int) -> None:
        builder = RobotDiagramBuilder()
        plant = builder.plant()
        model = plant.AddModelInstance("robot")
        inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
        before = plant.world_body()
        for k in range(dimension):
            body = plant.AddRigidBody(f"body{k}", model, inertia)
            plant.AddJoint(
                PrismaticJoint(f"joint{k}", before.body_frame(), body.body_frame(), np.eye(3)[k])
            )
            before = body
        plant.RegisterCollisionGeometry(
            before, RigidTransform(), Sphere(0.0), "point", CoulombFriction(1.0, 1.0)
        )
        plant.Finalize()
        self._world_body = plant.world_body()
        options: dict[str, Any] = {
            "model": builder.Build(),
            "robot_model_instances": [model],
            "edge_step_size": 0.05,
        }
        self._checker = SceneGraphCollisionChecker(**options)
        self._dimension = dimension

    def set(self, solids: Iterable[Solid], padding: float) -> None:
        """Put these solids in, and no others."""
        self._checker.RemoveAllAddedCollisionShapes()
        d = self._dimension
        for k, solid in enumerate(solids):
            rotation: Any = np.eye(3)
            center: Any = np.zeros(3)
            rotation[:d, :d], center[:d] = solid.rotation, solid.center
            pose = RigidTransform(RotationMatrix(rotation), center)
            shape = drake_shape(solid, height=100.0 if d == 2 else None)
            assert self._checker.AddCollisionShapeToBody(
                f"solid {k}", self._world_body, shape, pose
            )
        self._checker.SetPaddingAllRobotEnvironmentPairs(padding)

    def free(self, way: NDArray[np.float64], step: float) -> bool:
        """Whether configurations `step` apart along the way are free of collision."""
        for a, b in pairwise(way):
            count = max(int(np.ceil(np.linalg.norm(b - a) / step)), 1) + 1
            for t in np.linspace(0, 1, count):
                if not self._checker.CheckConfigCollisionFree(a + t * (b - a)):
                    return False
        return True
