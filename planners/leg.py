"""Legs between waypoints: the paper's distances (4) to (6) and its test of the terminal state.

Kontoudis, Vamvoudakis and Xu, "RRT-Q^X: Real-Time Kinodynamic Motion Planning in Dynamic
Environments with Continuous-Time Reinforcement Learning" (2022).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Leg:
    """From the state where it began to a waypoint.

    Attributes:
        origin: x_0,k `[n]`, where the leg began.
        waypoint: x_r,k `[n]`, at rest.
        dimension: d, how many leading states are the position.
        begun: seconds.
    """

    origin: Array
    waypoint: Array
    dimension: int
    begun: float

    @property
    def initial_distance(self) -> float:
        """D_0 (4): of the whole state, velocities included, as printed."""
        return float(np.linalg.norm(self.origin - self.waypoint))

    def arrived(self, state: Array, window: float) -> bool:
        """D <= rho D_0 (5), with rho = `window`."""
        return float(np.linalg.norm(state - self.waypoint)) <= window * self.initial_distance

    def deviation(self, state: Array) -> float:
        """D_rob (6): metres from the position to the nominal straight line.

        (6) divides a cross product of whole states, which exists in three dimensions only, by a
        distance that holds velocities, and measures to an infinite line. Here: positions, and the
        segment from the leg's origin to its waypoint, so that overshooting counts.
        """
        d = self.dimension
        return distance_to_segment(state[:d], self.origin[:d], self.waypoint[:d])


def distance_to_segment(point: Array, start: Array, end: Array) -> float:
    """Metres from `point` `[d]` to the segment between `start` and `end` `[d]`."""
    along = end - start
    square = float(along @ along)
    t = float(np.clip((point - start) @ along / square, 0.0, 1.0)) if square > 0 else 0.0
    return float(np.linalg.norm(start + t * along - point))


def distances_to_segment(points: Array, start: Array, end: Array) -> Array:
    """The same of `[..., d]` points."""
    along = end - start
    square = float(along @ along)
    offset = points - start
    t = np.clip(offset @ along / square, 0.0, 1.0) if square > 0 else np.zeros(points.shape[:-1])
    return np.linalg.norm(offset - t[..., None] * along, axis=-1)


def along_route(points: Array, distances: Array) -> Array:
    """The points `[k, d]` at these arc lengths `[k]` of a polyline `[p, d]`; its end beyond it."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.clip(distances, 0.0, arc[-1])
    return np.stack([np.interp(at, arc, points[:, i]) for i in range(points.shape[1])], axis=-1)
