"""What a robot knows of the world: obstacles within its perception, and how they move."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from planners.leg_clearance import Surroundings
from planners.solids import Solid

Array = NDArray[np.float64]

STILL = 1e-3
"""Metres a second; what moves more slowly is standing."""
STEP = 0.1
"""Metres an obstacle moves before the planner is told."""
STEADY = 1.0
"""Seconds without a change of velocity, after which an obstacle's motion counts as known."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One obstacle as it is seen now.

    Attributes:
        key: the same whenever the same obstacle is seen.
        solid: where it is now. Its whole shape is known as soon as some part of it is seen.
        mobile: whether it drives by itself, as other robots do, although it may be standing now.
    """

    key: int
    solid: Solid
    mobile: bool = False


@dataclass(eq=False)
class _Known:
    handle: int | None
    solid: Solid
    planned: Array
    seen: float
    velocity: Array = field(default_factory=lambda: np.zeros(0))
    unsteady: float = -np.inf

    def __post_init__(self) -> None:
        self.velocity = np.zeros_like(self.planned)


@dataclass
class Changes:
    """What the planner has to be told.

    Attributes:
        add: solids that were not known, and their keys.
        remove: handles of what is gone.
        move: translations by handle.
    """

    add: list[tuple[int, Solid]] = field(default_factory=list)
    remove: list[int] = field(default_factory=list)
    move: dict[int, Array] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.add or self.remove or self.move)


class Perceived:
    """The obstacles that were seen: standing ones are remembered, moving ones only while seen.

    A standing obstacle that is not where it was although it should be seen has vanished. An
    obstacle's velocity is the difference of two sightings; at the first it is taken as standing.
    Another robot that covers this one's goal is kept from the planner, which would find no route
    and wait for ever for somebody who may be waiting too; forecasts still keep clear of it.
    """

    def __init__(self, goal: Array, body: float, radius: float, growth: float) -> None:
        """Perception up to `radius` metres.

        Args:
            goal: `[d]`, of this robot.
            body: radius of this robot and its comfort, metres.
            radius: of the perception, metres.
            growth: metres a second by which a body is extended in forecasts while it changes its
                velocity: what it will do is then not known.
        """
        self._goal, self._body = goal, body
        self._radius, self._growth = radius, growth
        self._known: dict[int, _Known] = {}
        self._standing: list[Solid] = []
        self.surroundings = Surroundings(len(goal))

    @property
    def known(self) -> list[tuple[int, Solid]]:
        """All that is known of, by key, where it was seen last."""
        return [(key, known.solid) for key, known in self._known.items()]

    @property
    def moving(self) -> bool:
        """Whether something that is known of moves."""
        return any(np.linalg.norm(known.velocity) > STILL for known in self._known.values())

    def look(self, time: float, position: Array, sightings: Iterable[Sighting]) -> Changes:
        """Take in what is seen at `time` (seconds) from `position` `[d]`."""
        changes = Changes()
        seen = set()
        for sighting in sightings:
            seen.add(sighting.key)
            known = self._known.get(sighting.key)
            if known is None:
                known = _Known(None, sighting.solid, sighting.solid.center.copy(), time)
                self._known[sighting.key] = known
            elif sighting.solid is not known.solid:
                self._follow(known, sighting.solid, time)
            elif known.velocity.any():
                known.velocity = np.zeros_like(known.velocity)
                known.unsteady = time
            known.seen = time
            self._tell(sighting, known, changes)
        for key, known in list(self._known.items()):
            if key in seen:
                continue
            moving = np.linalg.norm(known.velocity) > STILL
            if moving or self._should_be_seen(known.solid, position):
                if known.handle is not None:
                    changes.remove.append(known.handle)
                del self._known[key]
        return changes

    def remember(self, key: int, handle: int) -> None:
        """The planner knows an obstacle by this handle."""
        self._known[key].handle = handle

    def refresh(self, time: float) -> None:
        """Bring `surroundings` up to date."""
        every = list(self._known.values())
        velocities = np.array([k.velocity for k in every])
        growths = np.array([self._growth * (time - k.unsteady < STEADY) for k in every])
        self.surroundings.update([k.solid for k in every], velocities, growths)
        self._standing = [
            k.solid
            for k, growth in zip(every, growths, strict=True)
            if not growth and not k.velocity.any()
        ]

    def standing(self) -> Surroundings:
        """What stands, as of the last `refresh`: certain, where what moves is a guess."""
        d, count = len(self._goal), len(self._standing)
        still = Surroundings(d)
        still.update(self._standing, np.zeros((count, d)), np.zeros(count))
        return still

    def clearance(self, position: Array) -> float:
        """Metres from `position` `[d]` to the nearest obstacle known; `FAR` if there is none."""
        return float(self.surroundings.clearances(position[None, None], 1.0, 1.0)[0])

    def _tell(self, sighting: Sighting, known: _Known, changes: Changes) -> None:
        """What the planner has to be told of an obstacle that is seen."""
        solid = known.solid
        near = float(np.linalg.norm(solid.center - self._goal)) - solid.reach <= self._body
        if sighting.mobile and near:
            if known.handle is not None:
                changes.remove.append(known.handle)
                known.handle = None
            return
        if known.handle is None:
            changes.add.append((sighting.key, solid))
            known.planned = solid.center.copy()
            return
        shift = solid.center - known.planned
        if np.linalg.norm(shift) > STEP:
            changes.move[known.handle] = shift
            known.planned = solid.center.copy()

    def _follow(self, known: _Known, solid: Solid, time: float) -> None:
        velocity = (solid.center - known.solid.center) / (time - known.seen)
        if np.linalg.norm(velocity - known.velocity) > 0.02 and known.velocity.any():
            known.unsteady = time
        known.velocity, known.solid = velocity, solid

    def _should_be_seen(self, solid: Solid, position: Array) -> bool:
        away = float(np.linalg.norm(solid.center - position))
        if away - solid.reach >= self._radius:
            return False
        lens = Surroundings(len(position))
        lens.update([solid], np.zeros((1, len(position))), np.zeros(1))
        # What is a hair's breadth within the radius may be seen or not.
        return float(lens.clearances(position[None, None], 1.0, 1.0)[0]) < self._radius - 1e-6
