"""Motions foretold by the controller, and references whose motion keeps clear of what is known.

The rules `EACH_LEG` and `MOVING` of `rrt_qx` rest on these choices; why that is safe is said there.
"""

import numpy as np
from numpy.typing import NDArray

from planners.leg_clearance import Surroundings
from planners.leg_controller import LegController
from planners.navigation_settings import NavigatorSettings, WaypointRule
from planners.perceived import Perceived

Array = NDArray[np.float64]

SHARES = np.array([1.0, 0.85, 0.7, 0.57, 0.45, 0.35, 0.26, 0.19, 0.13, 0.08, 0.04])
"""Of the farthest reference, those that are tried."""
BRAKES = np.array([0.3, 0.15, 0.5, 0.0, 0.8, 1.2, -0.3, 1.8])
"""Seconds of the present velocity ahead: references that are tried to brake to."""
DIRECTIONS = 12
EVASIONS = (0.4, 1.2, 3.0)
"""Metres: how far away references are tried when braking alone is not enough."""


class ForetoldMotions:
    """Where a robot's controller would take it, held against the obstacles it knows of."""

    def __init__(
        self,
        controller: LegController,
        perceived: Perceived,
        settings: NavigatorSettings,
        dimension: int,
    ) -> None:
        """The motions of a robot whose position is the first `dimension` (d) numbers of its state.

        Args:
            controller: has to forecast.
            perceived: the obstacles.
            settings: the robot's.
            dimension: d.
        """
        self._controller, self._perceived = controller, perceived
        self._settings, self._d = settings, dimension
        self._chosen: Array | None = None

    def farthest_clear(self, state: Array, references: Array) -> Array | None:
        """The first of `references` `[c, d]` that is reached clear of everything, as foretold.

        Its motion is remembered for `still_clear`.
        """
        settings = self._settings
        receding = settings.rules.waypoints is WaypointRule.MOVING
        paths = self._foretell(state, references, receding)
        clear = self._perceived.surroundings.first_clear(
            paths, settings.sample_period, settings.foresight, self._needed(state)
        )
        if clear is None:
            return None
        self._chosen = paths[clear]
        return references[clear]

    def still_clear(self, elapsed: float, state: Array) -> bool:
        """Whether the rest of the motion chosen last, `elapsed` seconds ago, is clear.

        The robot is now in `state` `[n]`.
        """
        assert self._chosen is not None
        done = round(elapsed / self._settings.sample_period)
        rest = self._chosen[min(done, len(self._chosen) - 1) :]
        return bool(self._clearances(rest[None])[0] >= self._needed(state))

    def safest_stop(self, state: Array, held: Array, stopped: bool) -> Array:
        """A reference `[d]` to hold, brake or make way: `held` if safe, else the safest other.

        Args:
            state: `[n]`.
            held: `[d]`, the position of the last reference.
            stopped: whether the robot has stopped; before, it is better to brake than to hold.
        """
        p, v = state[: self._d], state[self._d : 2 * self._d]
        needed = self._needed(state)
        body = self._settings.robot_radius
        references = np.concatenate([held[None], p + BRAKES[:, None] * v, p + self._evasions()])
        paths = self._foretell(state, references, True)
        clear = self._clearances(paths)
        ends = self._clearances(paths[:, -1:]) - body
        stay = self._settings.least_padding - body
        safe = clear >= needed
        roomy = safe & (ends >= stay)
        if stopped and roomy[0]:
            chosen = 0
        elif roomy[1 : 1 + len(BRAKES)].any():
            # The brake that ends soonest: least motion beyond where the robot is.
            reach = np.linalg.norm(paths - p, axis=-1).max(axis=1)
            reach[~roomy] = np.inf
            chosen = 1 + int(np.argmin(reach[1 : 1 + len(BRAKES)]))
        elif roomy.any():
            far = np.linalg.norm(references - p, axis=1)
            chosen = int(np.argmin(np.where(roomy, far, np.inf)))
        else:
            # Nothing is safe: what keeps farthest from the obstacles, or leads away from them. What
            # moves is a guess that may not come true; what stands is not to be met for its sake.
            certain = self._clearances(paths, self._perceived.standing())
            spared = [certain >= needed, certain >= body, np.full(len(paths), True)]
            allowed = next(keeps for keeps in spared if keeps.any())
            worth = np.minimum(clear, needed) + 0.1 * np.minimum(ends, stay)
            chosen = int(np.argmax(np.where(allowed, worth, -np.inf)))
        return references[chosen]

    def _evasions(self) -> Array:
        """`[e, d]`, ways off in all directions."""
        if self._d == 2:
            turns = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
            rays = np.column_stack([np.cos(turns), np.sin(turns)])
        else:
            grid = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * self._d)).reshape(self._d, -1).T
            grid = grid[np.any(grid != 0, axis=1)]
            rays = grid / np.linalg.norm(grid, axis=1, keepdims=True)
        return np.concatenate([length * rays for length in EVASIONS])

    def _foretell(self, state: Array, references: Array, receding: bool) -> Array:
        """Positions `[c, k, d]` on the way to standstill at `references` `[c, d]`."""
        states = np.zeros((len(references), len(state)))
        states[:, : self._d] = references
        told = self._controller.forecast(state - states, receding)
        if told is None:
            rule = self._settings.rules.padding.value
            raise ValueError(f"rules: {rule!r} needs a controller that can forecast")
        return np.concatenate([told + references[:, None], references[:, None]], axis=1)

    def _clearances(self, paths: Array, obstacles: Surroundings | None = None) -> Array:
        """Least clearance `[c]` of motions `[c, k, d]` to `obstacles`, by default all."""
        settings = self._settings
        asked = self._perceived.surroundings if obstacles is None else obstacles
        return asked.clearances(
            paths, settings.sample_period, settings.foresight, settings.least_padding + 1.0
        )

    def _needed(self, state: Array) -> float:
        """Clearance that a motion has to keep: no less than now, if that is already too little."""
        here = self._perceived.clearance(state[: self._d])
        return max(self._settings.robot_radius, min(self._settings.least_padding, here - 1e-3))
