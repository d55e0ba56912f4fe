"""Stick figures of Drake robots: their sticks are where Drake has the links."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from ocp.models.multibody import MultibodyModel, multibody_model
from ocp.obstacle import Obstacle
from ocp.trajectory import Trajectory
from sims.pictures.skeleton import Skeleton, draw_strobe, save_robot_replay

ROOT = Path(__file__).resolve().parents[3]
ROBOTS = ROOT / "ocp" / "models" / "robots"


def furuta() -> MultibodyModel:
    return multibody_model(ROOT / "examples" / "furuta.sdf")


def swinging(model: MultibodyModel) -> Trajectory:
    times = np.linspace(0.0, 1.0, 20)
    states = np.zeros((20, model.system.n))
    states[:, 1] = 3.0 * times
    return Trajectory(times, states, np.zeros((20, model.system.m)), None, times)


def test_sticks_end_where_trigonometry_says() -> None:
    arm, pole = 0.7, 0.4
    (places,) = Skeleton.of(furuta()).places([[arm, pole, 0.0, 0.0]])
    out = np.array([np.cos(arm), np.sin(arm), 0.0])
    across = np.array([-np.sin(arm), np.cos(arm), 0.0])
    hinge = 0.2 * out
    mass = hinge + 0.15 * (np.sin(pole) * across - np.cos(pole) * np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(places, [[[0, 0, 0], hinge], [hinge, mass]], atol=1e-12)


def test_a_quadrotor_has_a_stick_to_each_propeller() -> None:
    model = multibody_model(ROBOTS / "planar_quadrotor.sdf")
    (places,) = Skeleton.of(model).places(np.zeros((1, 6)))
    tips = sorted(places[:, 1, 0])
    assert tips == pytest.approx([-0.2, 0.2])


@pytest.mark.parametrize("name", ["pendulum.sdf", "cart_pole.sdf", "two_link_arm.urdf"])
def test_sticks_keep_their_lengths(name: str) -> None:
    model = multibody_model(ROBOTS / name)
    states = np.random.default_rng(0).uniform(-1, 1, (10, model.system.n))
    places = Skeleton.of(model).places(states)
    lengths = np.linalg.norm(places[:, :, 1] - places[:, :, 0], axis=-1)
    np.testing.assert_allclose(lengths, np.broadcast_to(lengths[0], lengths.shape), atol=1e-12)
    assert lengths.max() > 0.1


def test_figure_and_replay_are_written(tmp_path: Path) -> None:
    skeleton = Skeleton.of(furuta())
    motion = swinging(skeleton.model)
    figure, axes = plt.subplots()
    draw_strobe(axes, skeleton, motion, count=5)
    assert len(axes.collections) == 5
    assert axes.get_xlabel() == "x (m)"
    plt.close(figure)
    page = tmp_path / "replay.html"
    save_robot_replay(skeleton, motion, page, (Obstacle.circle((0.5, 0.5), 0.1),))
    assert len(page.read_text(encoding="utf-8")) > 1_000_000
