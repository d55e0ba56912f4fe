"""Maps for planners in the plane, 40 m wide, and in space: fixed by name and seed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from planners.solids import Solid

HALF = 20.0


@dataclass(frozen=True)
class Map:
    """A planning problem.

    Attributes:
        solids: the obstacles.
        start, goal: where from, where to.
    """

    solids: tuple[Solid, ...]
    start: tuple[float, ...]
    goal: tuple[float, ...]

    @property
    def dimension(self) -> int:
        return len(self.start)


def wall(seed: int) -> Map:
    """Empty but for one wall, at a place that depends on the seed."""
    x = np.random.default_rng(seed).uniform(-5, 5)
    return Map((Solid.box([x - 0.5, -14], [x + 0.5, 14]),), (-15, -15), (17, 17))


def obstacles_20(seed: int) -> Map:
    """Twenty random convex obstacles of 1 to 2.5 m."""
    return _scattered(20, (1.0, 2.5), seed, 2)


def obstacles_100(seed: int) -> Map:
    """A hundred random convex obstacles of 0.4 to 1.2 m."""
    return _scattered(100, (0.4, 1.2), seed, 2)


def space_100(seed: int) -> Map:
    """A hundred random balls, boxes and hulls in space, of 1 to 3 m."""
    return _scattered(100, (1.0, 3.0), seed, 3)


def maze(seed: int, rooms: int = 6, door: float = 1.2, thickness: float = 0.4) -> Map:
    """Rooms in a square grid, with narrow doors: a random maze with some loops."""
    rng = np.random.default_rng(seed)
    size = 2 * HALF / rooms
    room_of = {(i, j): (i, j) for i in range(rooms) for j in range(rooms)}

    def origin(room: tuple[int, int]) -> tuple[int, int]:
        while room_of[room] != room:
            room = room_of[room]
        return room

    walls = [((i, j), (i + 1, j)) for i in range(rooms - 1) for j in range(rooms)]
    walls += [((i, j), (i, j + 1)) for i in range(rooms) for j in range(rooms - 1)]
    solids = []
    for k in rng.permutation(len(walls)):
        a, b = walls[k]
        joined = origin(a) == origin(b)
        room_of[origin(a)] = origin(b)
        has_door = not joined or rng.random() < 0.35
        # The wall runs across `axis`, along the other one.
        axis = 0 if a[1] == b[1] else 1
        at = -HALF + size * max(a[axis], b[axis])
        low = -HALF + size * a[1 - axis]
        pieces = [(low, low + size)]
        if has_door:
            middle = low + size * rng.uniform(0.3, 0.7)
            pieces = [(low, middle - door / 2), (middle + door / 2, low + size)]
        for begin, end in pieces:
            across, along = (at - thickness / 2, at + thickness / 2), (begin, end)
            x, y = (across, along) if axis == 0 else (along, across)
            solids.append(Solid.box([x[0], y[0]], [x[1], y[1]]))
    middle = size / 2
    return Map(tuple(solids), (-HALF + middle,) * 2, (HALF - middle,) * 2)


def bug_trap(seed: int) -> Map:
    """A trap whose only way out is a funnel that leads inwards; the goal is behind it."""
    width = 1.5 + np.random.default_rng(seed).uniform(0, 0.5)
    boxes = [
        ([-8, -8], [-7.5, 8]),
        ([-8, 7.5], [8, 8]),
        ([-8, -8], [8, -7.5]),
        ([7.5, width / 2], [8, 8]),
        ([7.5, -8], [8, -width / 2]),
        ([1, width / 2], [8, width / 2 + 0.5]),
        ([1, -width / 2 - 0.5], [8, -width / 2]),
    ]
    return Map(tuple(Solid.box(a, b) for a, b in boxes), (-4, 0), (-16, 0))


PLANE: dict[str, Callable[[int], Map]] = {
    "wall": wall,
    "20 obstacles": obstacles_20,
    "maze": maze,
    "100 obstacles": obstacles_100,
    "bug trap": bug_trap,
}


def random_solid(
    rng: np.random.Generator, center: np.ndarray, size: float, dimension: int
) -> Solid:
    """A random convex solid round `center` whose farthest point is `size` away."""
    kind = rng.random()
    if kind < 0.3:
        return Solid.ball(center, size)
    if dimension == 2:
        corners = int(rng.integers(3, 8))
        angles = (np.arange(corners) + rng.uniform(0.15, 0.85, corners)) * (2 * np.pi / corners)
        return Solid.polygon(center + size * np.column_stack([np.cos(angles), np.sin(angles)]))
    if kind < 0.6:
        half = rng.uniform(0.5, 1, 3)
        half *= size / np.linalg.norm(half)
        return Solid.box(center - half, center + half)
    points = rng.normal(size=(12, 3))
    return Solid.hull(center + size * points / np.linalg.norm(points, axis=1, keepdims=True))


def _scattered(count: int, sizes: tuple[float, float], seed: int, dimension: int) -> Map:
    rng = np.random.default_rng(seed)
    start, goal = np.full(dimension, -15.0), np.full(dimension, 17.0)
    solids: list[Solid] = []
    while len(solids) < count:
        center = rng.uniform(-0.9 * HALF, 0.9 * HALF, dimension)
        size = rng.uniform(*sizes)
        if min(np.linalg.norm(center - start), np.linalg.norm(center - goal)) > size + 1.5:
            solids.append(random_solid(rng, center, size, dimension))
    return Map(tuple(solids), tuple(start), tuple(goal))
