"""A robot in a moving frame: the same motion, seen from a slot that moves."""

import numpy as np
import pytest

from ocp.models import get_model
from ocp.models.moving_frame import CRUISE, in_moving_frame


def test_the_motion_is_the_robots_less_the_frames() -> None:
    car, lane = get_model("car"), get_model("car_in_lane")
    rng = np.random.default_rng(0)
    for _ in range(5):
        x, u = rng.uniform(-0.5, 0.5, 5), rng.normal(size=2)
        gap = np.array(car.dynamics(x, u) - lane.dynamics(x, u))[:, 0]
        assert np.allclose(gap, [CRUISE, 0, 0, 0, 0], rtol=1e-14, atol=1e-14)


def test_driving_at_cruise_speed_is_rest() -> None:
    rate = get_model("car_in_lane").dynamics([0.3, -1.0, 0.0, CRUISE, 0.0], [0.0, 0.0])
    assert np.abs(np.array(rate)).max() < 1e-15


def test_frames_that_would_change_the_dynamics_are_refused() -> None:
    with pytest.raises(ValueError, match="depend on heading"):
        in_moving_frame(get_model("car"), {"heading": 1.0}, "spinning")
    with pytest.raises(ValueError, match="no coordinate 'z'"):
        in_moving_frame(get_model("car"), {"z": 1.0}, "flying")
