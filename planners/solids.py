"""Convex solids, checked before any geometry engine sees them.

A solid is the Minkowski sum of the convex hull of its vertices with a ball: a disc or sphere is one
vertex with a radius; polygons, boxes and hulls have radius 0.
"""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ocp.obstacle import Obstacle

# Thinner than this, in metres, a hull has no interior to speak of.
MINIMUM_THICKNESS = 1e-6


class Shape(Enum):
    """What kind of solid, for whoever registers or draws it."""

    BALL = "ball"
    POLYGON = "polygon"
    BOX = "box"
    HULL = "hull"


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex solid in the plane or in space, lengths in metres.

    Build it with `Solid.ball`, `Solid.polygon`, `Solid.box`, `Solid.hull` or `Solid.of`, which
    check.

    Attributes:
        shape: what it is.
        center: `[d]`, a point inside.
        rotation: `[d, d]`, from the solid's axes to the world's.
        corners: `[k, d]`, vertices about the centre, in the solid's own axes.
        radius: of the ball added to the hull of the vertices; 0 unless the solid is a ball.
    """

    shape: Shape
    center: NDArray[np.float64]
    rotation: NDArray[np.float64]
    corners: NDArray[np.float64]
    radius: float

    @classmethod
    def ball(cls, center: ArrayLike, radius: float) -> "Solid":
        """A disc in the plane, a ball in space."""
        middle = _point(center, "center")
        return cls(
            Shape.BALL,
            middle,
            np.eye(len(middle)),
            np.zeros((1, len(middle))),
            _positive(radius, "radius"),
        )

    @classmethod
    def polygon(cls, vertices: ArrayLike) -> "Solid":
        """The convex polygon with these `[k, 2]` vertices, in order, either way round."""
        checked = Obstacle.polygon(vertices)
        middle = np.array(checked.center)
        return cls(Shape.POLYGON, middle, np.eye(2), np.array(checked.vertices) - middle, 0.0)

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike) -> "Solid":
        """The box (a rectangle in the plane) between two corners `[d]`.

        Raises:
            ValueError: if the corners do not fit each other, or leave no interior.
        """
        a, b = _point(lower, "lower"), _point(upper, "upper")
        if a.shape != b.shape:
            raise ValueError(f"upper: must have {len(a)} coordinates like lower, got {len(b)}")
        if not (b - a > MINIMUM_THICKNESS).all():
            raise ValueError(
                f"upper: must exceed lower in every coordinate, got {b.tolist()} over {a.tolist()}"
            )
        if len(a) == 2:
            return cls.polygon([a, (b[0], a[1]), b, (a[0], b[1])])
        signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij")).reshape(3, -1).T
        return cls(Shape.BOX, (a + b) / 2, np.eye(3), signs * (b - a), 0.0)

    @classmethod
    def hull(cls, points: ArrayLike) -> "Solid":
        """The convex hull of `[k, d]` points, which must span the plane or space.

        Raises:
            ValueError: if the points span no interior.
        """
        from scipy.spatial import ConvexHull, QhullError

        cloud = np.asarray(points, dtype=float)
        if cloud.ndim != 2 or cloud.shape[1] not in (2, 3) or len(cloud) <= cloud.shape[-1]:
            raise ValueError(
                f"points: a hull needs 3 points in the plane or 4 in space, got shape {cloud.shape}"
            )
        _finite(cloud, "points")
        try:
            hull = ConvexHull(cloud)
        except QhullError as error:
            raise ValueError(f"points: a hull needs an interior, got {cloud.tolist()}") from error
        vertices = cloud[hull.vertices]
        # Distances of the vertices below each facet: the widest of a flat hull is still tiny.
        depths = -(hull.equations[:, :-1] @ vertices.T + hull.equations[:, -1:]).min(axis=1)
        if depths.min() < MINIMUM_THICKNESS:
            raise ValueError(f"points: a hull needs an interior, got {cloud.tolist()}")
        if cloud.shape[1] == 2:
            return cls.polygon(vertices)
        middle = vertices.mean(axis=0)
        return cls(Shape.HULL, middle, np.eye(3), vertices - middle, 0.0)

    @classmethod
    def of(cls, obstacle: "Obstacle | Solid") -> "Solid":
        """The solid of a query's obstacle (a circle, diamond or polygon); a solid is kept.

        Raises:
            ValueError: if it is neither.
        """
        if isinstance(obstacle, Solid):
            return obstacle
        if not isinstance(obstacle, Obstacle):
            raise ValueError(f"obstacle: must be a Solid or an Obstacle, got {obstacle!r}")
        if obstacle.vertices:
            return cls.polygon(obstacle.vertices)
        return cls.ball(obstacle.center, obstacle.radius)

    def moved(self, translation: ArrayLike, rotation: ArrayLike | float = 0.0) -> "Solid":
        """The solid moved by `translation` `[d]`, turned about its centre.

        Args:
            translation: metres.
            rotation: an angle in the plane (radians), a `[3, 3]` rotation matrix in space.

        Raises:
            ValueError: if the translation has the wrong number of coordinates.
        """
        shift = _point(translation, "translation")
        if len(shift) != self.dimension:
            raise ValueError(
                f"translation: must have {self.dimension} coordinates, got {shift.tolist()}"
            )
        turn = _rotation(rotation, self.dimension)
        return Solid(
            self.shape, self.center + shift, turn @ self.rotation, self.corners, self.radius
        )

    @property
    def dimension(self) -> int:
        return len(self.center)

    @cached_property
    def vertices(self) -> NDArray[np.float64]:
        """`[k, d]` in the world; the centre alone for a ball."""
        return self.center + self.corners @ self.rotation.T

    @cached_property
    def sides(self) -> NDArray[np.float64]:
        """`[s, 2, d]`, the ends of the edges of the hull of the vertices, in the world."""
        if self.dimension == 2:
            return np.stack([self.vertices, np.roll(self.vertices, -1, axis=0)], axis=1)
        pairs = {(i, j) for f in self._hull.simplices for i in f for j in f if i < j}
        return np.ascontiguousarray(self.vertices[np.array(sorted(pairs))])

    @cached_property
    def facets(self) -> NDArray[np.float64]:
        """`[f, d + 1]`, rows (a, b) with |a| = 1 and a . x + b <= 0 inside the hull."""
        if self.dimension == 2:
            along = np.roll(self.vertices, -1, axis=0) - self.vertices
            normals = np.column_stack([along[:, 1], -along[:, 0]])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            return np.column_stack([normals, -(normals * self.vertices).sum(axis=1)])
        return np.ascontiguousarray(self._hull.equations)

    @cached_property
    def _hull(self) -> Any:
        from scipy.spatial import ConvexHull

        return ConvexHull(self.vertices)

    @cached_property
    def bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The corners `[d]`, `[d]` of the box that holds the solid, in the solid's own axes."""
        return self.corners.min(axis=0) - self.radius, self.corners.max(axis=0) + self.radius

    @cached_property
    def reach(self) -> float:
        """Largest distance from the centre to a point of the solid, in metres."""
        return float(np.linalg.norm(self.corners, axis=1).max()) + self.radius


def _finite(array: NDArray[np.float64], name: str) -> None:
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: numbers must be finite, got {array.tolist()}")


def _point(value: ArrayLike, name: str) -> NDArray[np.float64]:
    point = np.array(value, dtype=float)
    if point.ndim != 1 or len(point) not in (2, 3):
        raise ValueError(f"{name}: must be 2 or 3 coordinates, got {point.tolist()}")
    _finite(point, name)
    return point


def _positive(value: float, name: str) -> float:
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name}: must be a positive finite number, got {value}")
    return float(value)


def _rotation(rotation: ArrayLike | float, dimension: int) -> NDArray[np.float64]:
    turn = np.asarray(rotation, dtype=float)
    _finite(turn, "rotation")
    if turn.ndim == 0 and dimension == 2:
        cos, sin = np.cos(turn), np.sin(turn)
        return np.array([[cos, -sin], [sin, cos]])
    if turn.ndim == 0 and turn == 0:
        return np.eye(3)
    if dimension != 3 or turn.shape != (3, 3):
        raise ValueError(
            "rotation: must be an angle in the plane or a 3 x 3 matrix in space, "
            f"got shape {turn.shape}"
        )
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-9 or np.linalg.det(turn) < 0:
        raise ValueError(f"rotation: must be a rotation matrix, got {turn.tolist()}")
    return turn
