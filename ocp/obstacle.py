"""Obstacles: circles (balls), diamonds and convex polygons, with exact geometry.

Every shape is convex with a centre c and a size r. Its gauge g(p) is 0 at c, 1 on the boundary and
grows linearly along rays from c; the soft penalty of the running cost is a function of g.
A polygon's c is its centroid and its r the largest distance from c to a vertex, so that the diamond
of the paper (a ball of the 1-norm) and the polygon with the same four vertices are one obstacle.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_FACETS = 16

Shape = Literal["circle", "diamond", "polygon"]


@dataclass(frozen=True)
class Obstacle:
    """One obstacle in the coordinates of position, lengths in metres.

    Build it with `Obstacle.circle`, `Obstacle.diamond` or `Obstacle.polygon`, which check.

    Attributes:
        shape: the shape's name in a query file.
        center: c, `[d]`.
        radius: r, the size of the shape.
        vertices: `[k, 2]`, counter-clockwise; empty for a circle.
        hard: never entered, beside the soft cost.
    """

    shape: Shape
    center: tuple[float, ...]
    radius: float
    vertices: tuple[tuple[float, float], ...] = ()
    hard: bool = False

    @classmethod
    def circle(cls, center: ArrayLike, radius: float, hard: bool = False) -> "Obstacle":
        """A disc (a ball in other dimensions)."""
        return cls("circle", _point(center), _positive(radius), (), hard)

    @classmethod
    def diamond(cls, center: ArrayLike, radius: float, hard: bool = False) -> "Obstacle":
        """The ball of the 1-norm: a square standing on a corner, `radius` from centre to corner.

        Raises:
            ValueError: if the centre is not a point of the plane, or the radius not positive.
        """
        c, r = _point(center), _positive(radius)
        if len(c) != 2:
            raise ValueError(f"center: a diamond lives in the plane, got {len(c)} coordinates")
        corners = ((c[0] + r, c[1]), (c[0], c[1] + r), (c[0] - r, c[1]), (c[0], c[1] - r))
        return cls("diamond", c, r, corners, hard)

    @classmethod
    def polygon(cls, vertices: ArrayLike, hard: bool = False) -> "Obstacle":
        """The convex polygon with these `[k, 2]` vertices, in order, either way round.

        Raises:
            ValueError: if the vertices are too few or many, not finite, or not strictly convex.
        """
        corners = np.asarray(vertices, dtype=float)
        if corners.ndim != 2 or corners.shape[1] != 2 or not 3 <= len(corners) <= MAX_FACETS:
            raise ValueError(
                f"vertices: a polygon needs 3 to {MAX_FACETS} points in the plane, "
                f"got an array of shape {corners.shape}"
            )
        if not np.isfinite(corners).all():
            raise ValueError(f"vertices: numbers must be finite, got {corners.tolist()}")
        x, y = corners.T
        cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        if cross.sum() < 0:
            corners = corners[::-1]
            x, y = corners.T
            cross = x * np.roll(y, -1) - np.roll(x, -1) * y
        edges = np.roll(corners, -1, axis=0) - corners
        following = np.roll(edges, -1, axis=0)
        turn = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
        winding = np.arctan2(turn, (edges * following).sum(axis=1)).sum()
        if not (turn > 1e-12).all() or abs(winding - 2 * np.pi) > 1e-6:
            raise ValueError(
                "vertices: the polygon must be strictly convex (no repeated, collinear or "
                f"reflex corners), got {corners.tolist()}"
            )
        weighted = (corners + np.roll(corners, -1, axis=0)) * cross[:, None]
        centroid = weighted.sum(axis=0) / (3 * cross.sum())
        radius = float(np.linalg.norm(corners - centroid, axis=1).max())
        pairs = tuple((float(a), float(b)) for a, b in corners)
        return cls("polygon", tuple(map(float, centroid)), radius, pairs, hard)

    @cached_property
    def facets(self) -> NDArray[np.float64]:
        """`[k, 2]` rows a with a . (p - c) <= 1 inside; no rows for a circle."""
        if not self.vertices:
            return np.zeros((0, 2))
        corners = np.array(self.vertices) - np.array(self.center)
        edges = np.roll(corners, -1, axis=0) - corners
        normals = np.column_stack([edges[:, 1], -edges[:, 0]])
        return normals / (normals * corners).sum(axis=1, keepdims=True)

    def signed_distance(self, points: ArrayLike) -> NDArray[np.float64]:
        """Exact distance from `points` `[..., d]` to the boundary, negative inside, in metres."""
        points = np.asarray(points, dtype=float)
        offset = points - np.array(self.center)
        if not self.vertices:
            return np.linalg.norm(offset, axis=-1) - self.radius
        corners = np.array(self.vertices)
        edges = np.roll(corners, -1, axis=0) - corners
        relative = points[..., None, :] - corners
        along = np.clip((relative * edges).sum(-1) / (edges**2).sum(-1), 0.0, 1.0)
        nearest = np.linalg.norm(relative - along[..., None] * edges, axis=-1).min(axis=-1)
        inside = (offset @ self.facets.T <= 1.0).all(axis=-1)
        return np.where(inside, -nearest, nearest)

    def signed_distance_expression(self, position: ca.SX) -> ca.SX:
        """`signed_distance` in CasADi for `position` `d x 1`."""
        offset = position - ca.DM(self.center)
        if not self.vertices:
            return ca.norm_2(offset) - self.radius  # pyright: ignore[reportReturnType]
        outside = ca.SX(np.inf)
        corners = np.array(self.vertices)
        for corner, after in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            edge, relative = ca.DM(after - corner), position - ca.DM(corner)
            along = ca.fmin(ca.fmax(ca.dot(relative, edge) / ca.sumsqr(edge), 0), 1)
            outside = ca.fmin(outside, ca.norm_2(relative - along * edge))
        lengths = np.linalg.norm(self.facets, axis=1)
        depth = ca.mmax((ca.DM(self.facets) @ offset - 1) / ca.DM(lengths))
        return ca.if_else(depth > 0, outside, depth)


def _point(center: ArrayLike) -> tuple[float, ...]:
    point = np.asarray(center, dtype=float)
    if point.ndim != 1 or not np.isfinite(point).all():
        raise ValueError(f"center: must be a list of finite numbers, got {point.tolist()}")
    return tuple(map(float, point))


def _positive(radius: float) -> float:
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius: must be a positive finite number, got {radius}")
    return float(radius)
