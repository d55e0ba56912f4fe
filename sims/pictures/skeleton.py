"""Any Drake robot as a stick figure: no file needs visuals to be seen moving.

A link is drawn from where it hangs to where other links hang on it, to its propellers, and to its
centre of mass if nothing hangs there.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import ArrayLike, NDArray

from ocp.files import write_text
from ocp.models.multibody import MultibodyModel
from ocp.obstacle import Obstacle
from ocp.trajectory import Trajectory
from planners.drake_geometry import drake_shape
from planners.solids import Solid

Array = NDArray[np.float64]

SAME_POINT = 1e-6  # metres
FRAMES_PER_SECOND = 32.0


@dataclass(frozen=True)
class Skeleton:
    """The sticks of a robot.

    Attributes:
        model: the robot.
        sticks: the frame of each stick's link, and its ends `[2, 3]` there, metres.
    """

    model: MultibodyModel
    sticks: tuple[tuple[Any, Array], ...]

    @classmethod
    def of(cls, model: MultibodyModel) -> "Skeleton":
        """The sticks of a robot; links welded to the world have none."""
        from pydrake.multibody.tree import BodyIndex

        plant: Any = model.plant
        root = {
            joint.child_body().index(): joint.frame_on_child()
            for joint in map(plant.get_joint, plant.GetJointIndices())
        }
        tips: dict[Any, list[Any]] = {}
        for joint in map(plant.get_joint, plant.GetJointIndices()):
            tips.setdefault(joint.parent_body().index(), []).append(joint.frame_on_parent())
        for thruster in model.thrusters:
            frame = plant.GetFrameByName(thruster.frame)
            tips.setdefault(frame.body().index(), []).append(frame)
        anchored = {b.index() for b in plant.GetBodiesWeldedTo(plant.world_body())}
        sticks = []
        for k in range(plant.num_bodies()):
            body = plant.get_body(BodyIndex(k))
            if body.index() in anchored:
                continue
            begin = _place(root[body.index()])
            hung = [_place(frame) for frame in tips.get(body.index(), [])]
            ends = hung or [np.asarray(body.default_com(), dtype=float)]
            ends = [e for e in ends if np.linalg.norm(e - begin) > SAME_POINT]
            frame = body.body_frame()
            sticks += [(frame, np.array([begin, end])) for end in ends or [begin]]
        return cls(model, tuple(sticks))

    def places(self, states: ArrayLike) -> Array:
        """Ends `[k, s, 2, 3]` of the sticks in the world, metres, in states `[k, n]`."""
        plant: Any = self.model.plant
        context = plant.CreateDefaultContext()
        world = plant.world_frame()
        rows = self.model.to_drake(np.atleast_2d(np.asarray(states, dtype=float)))
        found = np.empty((len(rows), len(self.sticks), 2, 3))
        for k, row in enumerate(rows):
            plant.SetPositionsAndVelocities(context, row)
            for s, (frame, ends) in enumerate(self.sticks):
                found[k, s] = plant.CalcPointsPositions(context, frame, ends.T, world).T
        return found


SIDE = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""From -y: x to the right, z up."""
OBLIQUE = ((0.83, -0.56, 0.0), (0.22, 0.33, 0.92))
"""From above, the front and the right."""


def draw_strobe(
    axes: Axes,
    skeleton: Skeleton,
    motion: Trajectory,
    count: int = 16,
    view: ArrayLike = SIDE,
) -> None:
    """Draw a robot `count` times, its joints equally far apart, fading in from first to last.

    Args:
        axes: where to draw.
        skeleton: the robot.
        motion: its motion.
        count: of pictures.
        view: `[2, 3]`, the directions that go to the right and up.
    """
    to_picture = np.asarray(view, dtype=float)
    fine = skeleton.places(sampled(motion, np.linspace(0.0, motion.duration, 400)))
    steps = np.linalg.norm(np.diff(fine, axis=0), axis=-1).sum(axis=(1, 2))
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    marks = np.linspace(0.0, travelled[-1], count)
    ends = fine[np.searchsorted(travelled, marks).clip(max=len(fine) - 1)] @ to_picture.T
    for k, places in enumerate(ends):
        share = (k + 1) / count
        colour = (0.0, 0.45, 0.70, 0.12 + 0.88 * share**2)
        axes.add_collection(
            LineCollection(list(places), colors=[colour], linewidths=1.2 + 2.0 * share)
        )
        tips = places.reshape(-1, 2)
        axes.plot(*tips.T, "o", ms=2 + 2.5 * share, color=colour, zorder=3)
    last = fine[:, -1, 1] @ to_picture.T
    axes.plot(*last.T, color="#D55E00", lw=1.0, zorder=2)
    drawn = np.concatenate([ends.reshape(-1, 2), last])
    low, high = drawn.min(axis=0), drawn.max(axis=0)
    room = 0.08 * float((high - low).max()) + 0.01
    axes.set_xlim(low[0] - room, high[0] + room)
    axes.set_ylim(low[1] - room, high[1] + room)
    axes.set_aspect("equal")
    for direction, say in zip(to_picture, (axes.set_xlabel, axes.set_ylabel), strict=True):
        if np.count_nonzero(direction) == 1:
            say(f"{'xyz'[int(np.abs(direction).argmax())]} (m)")


def sampled(motion: Trajectory, times: Array) -> Array:
    """States `[k, n]` of a motion at times `[k]`, linear in between."""
    return np.column_stack([np.interp(times, motion.times, c) for c in motion.states.T])


def save_robot_replay(
    skeleton: Skeleton, motion: Trajectory, path: Path, obstacles: tuple[Obstacle, ...] = ()
) -> None:
    """Write a Meshcat replay of a motion as one HTML file that plays by itself.

    Args:
        skeleton: the robot.
        motion: its motion.
        path: of the file.
        obstacles: of the plane in which the robot's position lies, drawn upright across it.
    """
    from pydrake.geometry import Capsule, Meshcat, MeshcatAnimation, MeshcatParams, Rgba, Sphere
    from pydrake.math import RigidTransform, RotationMatrix

    meshcat: Any = Meshcat(MeshcatParams(host="localhost"))
    animation: Any = MeshcatAnimation(FRAMES_PER_SECOND)
    count = max(2, round(motion.duration * FRAMES_PER_SECOND))
    times = np.linspace(0.0, motion.duration, count)
    places = skeleton.places(sampled(motion, times))
    lengths = np.linalg.norm(places[0, :, 1] - places[0, :, 0], axis=1)
    thick = 0.05 * max(float(lengths.max()), 0.05)
    for s, length in enumerate(lengths):
        name = f"robot/{s}"
        if length > SAME_POINT:
            meshcat.SetObject(f"{name}/stick", Capsule(thick, length), Rgba(0.0, 0.45, 0.70))
        meshcat.SetObject(f"{name}/tip", Sphere(1.8 * thick), Rgba(0.84, 0.37, 0.0))
        upwards: Any = np.array([0.0, 0.0, length / 2])
        meshcat.SetTransform(f"{name}/tip", RigidTransform(upwards))
        for k, (begin, end) in enumerate(places[:, s]):
            along: Any = end - begin if length > SAME_POINT else np.array([0.0, 0.0, 1.0])
            turned = RotationMatrix.MakeFromOneVector(along, 2)
            pose = RigidTransform(turned, (begin + end) / 2)
            animation.SetTransform(animation.frame(times[k]), name, pose)
    for k, obstacle in enumerate(obstacles):
        upright = RotationMatrix.MakeXRotation(np.pi / 2)
        place: Any = np.array([obstacle.center[0], 0.0, obstacle.center[1]])
        meshcat.SetObject(
            f"obstacles/{k}", drake_shape(Solid.of(obstacle), 8 * thick), Rgba(0.4, 0.4, 0.4)
        )
        meshcat.SetTransform(f"obstacles/{k}", RigidTransform(upright, place))
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Background", "top_color", [1, 1, 1])
    meshcat.SetProperty("/Background", "bottom_color", [0.93, 0.95, 0.97])
    points = places.reshape(-1, 3)
    middle: Any = (points.min(axis=0) + points.max(axis=0)) / 2
    size = float((points.max(axis=0) - points.min(axis=0)).max()) + 2 * thick
    away: Any = np.array([0.5, -1.3, 0.4])
    meshcat.SetCameraPose(middle + size * away, middle)
    meshcat.SetAnimation(animation)
    write_text(path, meshcat.StaticHtml())


def _place(frame: Any) -> Array:
    """The origin `[3]` of a frame in the frame of its body."""
    return np.asarray(frame.GetFixedPoseInBodyFrame().translation(), dtype=float)
