"""Convex solids as Drake's shapes, and contexts of a SceneGraph to ask for distances in."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from planners.solids import Shape, Solid


class Lens:
    """A context of the scene graph, and the geometry in it."""

    def __init__(self, graph: Any, source: Any) -> None:
        self._graph, self._source = graph, source
        self._context = graph.CreateDefaultContext()
        self.query = graph.get_query_output_port().Eval(self._context)

    def add(self, solid: Solid, name: str) -> Any:
        """Register the solid. Returns Drake's identity of it."""
        from pydrake.geometry import GeometryInstance, ProximityProperties
        from pydrake.math import RigidTransform, RotationMatrix

        rotation = np.eye(3)
        rotation[: solid.dimension, : solid.dimension] = solid.rotation
        pose = RigidTransform(RotationMatrix(rotation), in_space(solid.center[None])[0])
        instance = GeometryInstance(pose, drake_shape(solid), name)
        instance.set_proximity_properties(ProximityProperties())
        identity = self._graph.RegisterGeometry(
            self._context, self._source, self._graph.world_frame_id(), instance
        )
        self.query = self._graph.get_query_output_port().Eval(self._context)
        return identity

    def remove(self, identity: Any) -> None:
        self._graph.RemoveGeometry(self._context, self._source, identity)
        self.query = self._graph.get_query_output_port().Eval(self._context)


def drake_shape(solid: Solid, height: float | None = None) -> Any:
    """The solid as a Drake shape about its centre; a cylinder or prism if it is of the plane.

    Args:
        height: of the cylinder or prism, metres; by default four times the solid's reach.
    """
    from pydrake.geometry import Box, Convex, Cylinder, Sphere

    height = 4 * solid.reach if height is None else height
    if solid.shape is Shape.BALL:
        return Sphere(solid.radius) if solid.dimension == 3 else Cylinder(solid.radius, height)
    if solid.shape is Shape.BOX:
        return Box(*(solid.bounds[1] - solid.bounds[0]))
    corners = solid.corners
    if solid.dimension == 2:
        levels = np.repeat([-height / 2, height / 2], len(corners))
        corners = np.column_stack([np.tile(corners, (2, 1)), levels])
    return Convex(corners.T.copy(), solid.shape.value)  # pyright: ignore[reportCallIssue, reportArgumentType]


def in_space(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """`[k, 3]` from `[k, 2 or 3]`."""
    if points.shape[1] == 3:
        return points
    return np.column_stack([points, np.zeros(len(points))])
